"""Processing of one microphone's sound without I/O, and the encoded messages of its stages."""

from collections.abc import Mapping, Sequence
from itertools import repeat
from typing import Any, NamedTuple

from hearthlog.models.classifiers.model import Model
from hearthlog.models.features import FeatureSet
from hearthlog.models.labels import Segment
from hearthlog.recorder.events import OK, WARNING, Gap, Notice, SourceHealth
from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.frames import FRAME_SECONDS, NANOSECONDS, SAMPLE_RATE
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.cdr_codec import Column, encode_rows
from hearthlog.schemas.messages.message_types import (
    encode,
    header,
    message,
    nanoseconds,
    status_name,
    time_message,
)
from hearthlog.schemas.messages.topics import DIAGNOSTICS, ROSOUT, topic

_INFO, _WARN, _ERROR = 20, 30, 40  # levels of rcl_interfaces/msg/Log
_LEVELS = {OK: _INFO, WARNING: _WARN}


class EncodedMessage(NamedTuple):
    """A message to be written to the log."""

    log_time: int  # in nanoseconds of UTC
    topic: str
    data: bytes  # CDR


def info_line(info: Any) -> EncodedMessage:
    """Format device and model as a line of `/rosout`."""
    labels = "no model, no labels"
    if info.model:
        labels = f"{len(info.labels)} labels by {info.model} ({info.model_sha256[:12]})"
    stamp = nanoseconds(info.header.stamp)
    return _line(
        stamp, info.header.frame_id, _INFO, f"recording {info.device or 'no microphone'}: {labels}"
    )


def segment_line(microphone: str, segment: Segment, label: str) -> EncodedMessage:
    """Format a segment, with its label and duration, as a line of `/rosout`."""
    duration = _seconds(segment.end - segment.start)
    text = f"{label} for {duration} ({100 * segment.confidence:.0f} %)"
    return _line(segment.decided_at, microphone, _INFO, text)


def gap_line(microphone: str, gap: Gap) -> EncodedMessage:
    """Format a gap as a line of `/rosout`, stamped at its end."""
    text = f"gap of {_seconds(gap.end - gap.start)}: {gap.reason}"
    return _line(gap.end, microphone, _WARN, text)


def health_line(microphone: str, health: SourceHealth) -> EncodedMessage:
    """Format the state of a source as a line of `/rosout`."""
    return _line(health.stamp, microphone, _LEVELS.get(health.level, _ERROR), health.summary)


def notice_line(microphone: str, stamp: int, notice: Notice) -> EncodedMessage:
    """Format a notice at a time in nanoseconds of UTC as a line of `/rosout`."""
    return _line(stamp, microphone, _LEVELS[notice.level], notice.text)


def _line(stamp: int, microphone: str, level: int, text: str) -> EncodedMessage:
    line = message(
        message_types.LOG,
        stamp=time_message(stamp),
        level=level,
        name=f"hearthlog.{microphone}",
        msg=text,
        file="",
        function="",
        line=0,
    )
    return EncodedMessage(stamp, ROSOUT, encode(line))


def _seconds(duration: int) -> str:
    return f"{duration / NANOSECONDS:.2f} s"  # the shortest is a frame of 0.05 s


LOGGED_EVERY = 20  # frames between messages of statistics, which do not overlap


def column_messages(
    topic_name: str, typename: str, log_times: Int64, columns: Mapping[str, Column]
) -> list[EncodedMessage]:
    """Return the messages of one topic from their log times and columns."""
    if not len(log_times):
        return []
    rows = encode_rows(typename, columns, len(log_times))
    fields = zip(log_times.tolist(), [topic_name] * len(rows), rows, strict=True)
    # `EncodedMessage` itself takes three times as long, 150,000 times in an hour.
    return list(map(tuple.__new__, repeat(EncodedMessage), fields))


def stream_info(microphone: str, device: str, features: FeatureSet, model: Model | None) -> Any:
    """Create the `AudioStreamInfo` of a microphone, with a stamp of zero."""
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
    """Return the first messages of every file: its `AudioStreamInfo`, and the same as text."""
    stamp, microphone = nanoseconds(info.header.stamp), info.header.frame_id
    return [
        EncodedMessage(stamp, topic(microphone, "info"), encode(info)),
        info_line(info),
        *(notice_line(microphone, stamp, Notice(OK, line)) for line in lines),
    ]


def diagnostics(subject: str, health: SourceHealth, microphone: str = "") -> EncodedMessage:
    """Encode the health of a microphone or recorder, or of its part, which follows a space."""
    status = message(
        "diagnostic_msgs/msg/DiagnosticStatus",
        level=health.level,
        name=status_name(subject),
        message=health.summary,
        hardware_id=subject.partition(" ")[0],
        values=[
            message("diagnostic_msgs/msg/KeyValue", key=key, value=value)
            for key, value in health.values.items()
        ],
    )
    head = header(health.stamp, microphone)
    array = message(message_types.DIAGNOSTICS, header=head, status=[status])
    return EncodedMessage(health.stamp, DIAGNOSTICS, encode(array))
