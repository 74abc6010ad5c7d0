"""What happens, in words: the lines of `/rosout`, which viewers show without being told how."""

from typing import Any

from hearthlog.models.labels.segments import Segment
from hearthlog.recorder.events import Gap, Health
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.message_types import encode, message, nanoseconds, time_message
from hearthlog.schemas.times import NANOSECONDS

_INFO, _WARN, _ERROR = 20, 30, 40  # of rcl_interfaces/msg/Log
_LEVELS = {0: _INFO, 1: _WARN}  # by those of diagnostic_msgs


def of_info(info: Any) -> bytes:
    """Say what is recorded; `info` is the `AudioStreamInfo` of a file."""
    labels = "no model, no labels"
    if info.model:
        labels = f"{len(info.labels)} labels by {info.model} ({info.model_sha256[:12]})"
    stamp = nanoseconds(info.header.stamp)
    return _line(stamp, info.header.frame_id, _INFO, f"recording {info.device}: {labels}")


def of_segment(microphone: str, segment: Segment, label: str) -> bytes:
    """Say what was heard, once that is known."""
    duration = _seconds(segment.end - segment.start)
    text = f"{label} for {duration} ({100 * segment.confidence:.0f} %)"
    return _line(segment.known, microphone, _INFO, text)


def of_gap(microphone: str, gap: Gap) -> bytes:
    """Say that something was not heard, at its end."""
    text = f"gap of {_seconds(gap.end - gap.start)}: {gap.reason}"
    return _line(gap.end, microphone, _WARN, text)


def of_health(microphone: str, health: Health) -> bytes:
    """Say how the source is."""
    return _line(health.stamp, microphone, _LEVELS.get(health.level, _ERROR), health.summary)


def of_report(microphone: str, stamp: int, level: int, text: str) -> bytes:
    """Say which model speaks, or why no clip is kept; the level is one of `diagnostic_msgs`."""
    return _line(stamp, microphone, _LEVELS[level], text)


def _line(stamp: int, microphone: str, level: int, text: str) -> bytes:
    return encode(
        message(
            message_types.LOG,
            stamp=time_message(stamp),
            level=level,
            name=f"hearthlog.{microphone}",
            msg=text,
            file="",
            function="",
            line=0,
        )
    )


def _seconds(duration: int) -> str:
    return f"{duration / NANOSECONDS:.2f} s"  # the shortest is a frame of 0.05 s
