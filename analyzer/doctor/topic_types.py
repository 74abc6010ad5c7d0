"""The topics of a recorder's log and their message types, as docs/log.md has them."""

import re

from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import DIAGNOSTICS, LIVE, ROSOUT, parse_topic

FEATURES, STATISTICS, LABEL, SEGMENT, GAP = "features", "statistics", "label", "segment", "gap"
TYPES = {
    "info": message_types.STREAM_INFO,
    FEATURES: message_types.FEATURES,
    STATISTICS: message_types.STATISTICS,
    LABEL: message_types.LABEL,
    SEGMENT: message_types.SEGMENT,
    GAP: message_types.GAP,
}
ALWAYS = {"info", FEATURES, STATISTICS, GAP}  # what is a channel in every log of a recorder
LOG_NAME = re.compile(r"(?P<node>.+)_(?P<time>\d{8}T\d{6}Z)\.mcap(\.active)?")
SHARED = {DIAGNOSTICS: message_types.DIAGNOSTICS, ROSOUT: message_types.LOG}


def split_topic(topic: str) -> tuple[str, str]:
    """Split a topic of a recorder into microphone and kind.

    Parameters
    ----------
    topic : str
        Such as `/mic/features`.

    Returns
    -------
    microphone, kind : str
        Such as `mic` and `features`; nothing and the whole topic if it is none of a microphone.
    """
    name = parse_topic(topic)
    if name is None or name.labelling != LIVE or name.kind not in TYPES:
        return "", topic
    return name.microphone, name.kind


def topic_type(topic: str) -> str | None:
    """Return the message type that docs/log.md gives to a topic.

    Parameters
    ----------
    topic : str
        Such as `/mic/features`.

    Returns
    -------
    str or None
        None if docs/log.md has no such topic.
    """
    return TYPES.get(split_topic(topic)[1], SHARED.get(topic))
