"""Encoded messages, and those with which every file of a stream begins."""

from collections.abc import Sequence
from itertools import repeat
from typing import Any, NamedTuple

from hearthlog.models.classifiers.model import Model
from hearthlog.models.features.feature_set import FeatureSet
from hearthlog.recorder.events import OK, Notice
from hearthlog.recorder.stream import rosout
from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.frames import FRAME_SECONDS, SAMPLE_RATE
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.message_types import encode, header, message, nanoseconds
from hearthlog.schemas.messages.topics import ROSOUT, topic


class EncodedMessage(NamedTuple):
    """One message on its way into the log."""

    log_time: int  # in nanoseconds of UTC
    topic: str
    data: bytes  # CDR


def encoded_messages(
    topic_name: str, log_times: Int64, rows: Sequence[bytes]
) -> list[EncodedMessage]:
    """Return the messages of one topic, by their log times and their CDR."""
    fields = zip(log_times.tolist(), [topic_name] * len(rows), rows, strict=True)
    # `EncodedMessage` itself takes three times as long, 150,000 times in an hour.
    return list(map(tuple.__new__, repeat(EncodedMessage), fields))


def stream_info(microphone: str, device: str, features: FeatureSet, model: Model | None) -> Any:
    """Make the `AudioStreamInfo` of a microphone, with a stamp of zero.

    Parameters
    ----------
    model : Model or None
        The model that labels the sound; None for no labels.
    """
    return message(
        message_types.STREAM_INFO,
        header=header(0, microphone),
        device=device,
        sample_rate=SAMPLE_RATE,
        frame_seconds=FRAME_SECONDS,
        window_seconds=features.window_seconds,
        feature_set=features.name,
        feature_names=list(features.feature_names),
        model="" if model is None else model.name,
        model_sha256="" if model is None else model.sha256,
        labels=[] if model is None else list(model.classes),
    )


def opening_messages(info: Any, lines: Sequence[str] = ()) -> list[EncodedMessage]:
    """Return the first messages of every file: its `AudioStreamInfo`, and the same in words."""
    stamp, microphone = nanoseconds(info.header.stamp), info.header.frame_id
    said = [rosout.notice_line(microphone, stamp, Notice(OK, line)) for line in lines]
    return [
        EncodedMessage(stamp, topic(microphone, "info"), encode(info)),
        *(EncodedMessage(stamp, ROSOUT, line) for line in (rosout.info_line(info), *said)),
    ]
