"""The topics of a recorder's log and their message types, as docs/log.md has them."""

import re

from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import (
    CANDIDATE,
    DIAGNOSTICS,
    LIVE,
    ROSOUT,
    SCENARIO,
    parse_topic,
)

FEATURES, STATISTICS, LABEL, SEGMENT, GAP = "features", "statistics", "label", "segment", "gap"
DIRECTION = "direction"  # only of an array
EMBEDDING = "embedding"  # only with a network
_BESIDE = "beside"  # of a candidate or a scenario
BESIDE_LABEL, BESIDE_SEGMENT = f"{_BESIDE}/{LABEL}", f"{_BESIDE}/{SEGMENT}"
TYPES = {
    "info": message_types.STREAM_INFO,
    FEATURES: message_types.FEATURES,
    STATISTICS: message_types.STATISTICS,
    LABEL: message_types.LABEL,
    SEGMENT: message_types.SEGMENT,
    GAP: message_types.GAP,
    DIRECTION: message_types.DIRECTION,
    EMBEDDING: message_types.EMBEDDING,
    BESIDE_LABEL: message_types.LABEL,
    BESIDE_SEGMENT: message_types.SEGMENT,
}
ALWAYS = {"info", FEATURES, STATISTICS, GAP}  # what is a channel in every log of a recorder
LOG_NAME = re.compile(r"(?P<node>.+)_(?P<time>\d{8}T\d{6}Z)(_\d+)?\.mcap(\.active)?")
SHARED = {DIAGNOSTICS: message_types.DIAGNOSTICS, ROSOUT: message_types.LOG}


def split_topic(topic: str) -> tuple[str, str]:
    """Split a topic of a recorder into microphone and kind.

    Returns
    -------
    microphone, kind : str
        Such as `mic` and `features`, of a candidate or a scenario `BESIDE_LABEL` or
        `BESIDE_SEGMENT`; nothing and the whole topic if it is none of a microphone.
    """
    name = parse_topic(topic)
    if name is None:
        return "", topic
    kind = name.kind
    if name.labelling != LIVE:
        is_beside = name.labelling.partition("/")[0] in {CANDIDATE, SCENARIO}
        kind = f"{_BESIDE if is_beside else name.labelling}/{kind}"
    return (name.microphone, kind) if kind in TYPES else ("", topic)


def topic_type(topic: str) -> str | None:
    """Return the message type that docs/log.md gives to a topic.

    Returns
    -------
    str or None
        None if docs/log.md has no such topic.
    """
    return TYPES.get(split_topic(topic)[1], SHARED.get(topic))
