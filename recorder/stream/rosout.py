"""Lines of `/rosout`: what happens, in words that every viewer of logs can show."""

from typing import Any

from hearthlog.models.labels.segments import Segment
from hearthlog.recorder.events import OK, WARNING, Gap, Notice, SourceHealth
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.message_types import encode, message, nanoseconds, time_message

_INFO, _WARN, _ERROR = 20, 30, 40  # levels of rcl_interfaces/msg/Log
_LEVELS = {OK: _INFO, WARNING: _WARN}


def info_line(info: Any) -> bytes:
    """Say in a line of `/rosout` what is recorded."""
    labels = "no model, no labels"
    if info.model:
        labels = f"{len(info.labels)} labels by {info.model} ({info.model_sha256[:12]})"
    stamp = nanoseconds(info.header.stamp)
    return _line(
        stamp, info.header.frame_id, _INFO, f"recording {info.device or 'no microphone'}: {labels}"
    )


def segment_line(microphone: str, segment: Segment, label: str) -> bytes:
    """Say in a line of `/rosout` which sound was labelled, and for how long."""
    duration = _seconds(segment.end - segment.start)
    text = f"{label} for {duration} ({100 * segment.confidence:.0f} %)"
    return _line(segment.decided_at, microphone, _INFO, text)


def gap_line(microphone: str, gap: Gap) -> bytes:
    """Say in a line of `/rosout`, at the end of a gap, that there was one."""
    text = f"gap of {_seconds(gap.end - gap.start)}: {gap.reason}"
    return _line(gap.end, microphone, _WARN, text)


def health_line(microphone: str, health: SourceHealth) -> bytes:
    """Say in a line of `/rosout` what state the source is in."""
    return _line(health.stamp, microphone, _LEVELS.get(health.level, _ERROR), health.summary)


def notice_line(microphone: str, stamp: int, notice: Notice) -> bytes:
    """Repeat a notice in a line of `/rosout`.

    Parameters
    ----------
    stamp : int
        Time of the notice, in nanoseconds of UTC.
    """
    return _line(stamp, microphone, _LEVELS[notice.level], notice.text)


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
