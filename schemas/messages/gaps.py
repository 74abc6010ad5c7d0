"""Gaps: sound that a log does not have."""

from hearthlog.schemas.messages.message_types import (
    GAP,
    duration_message,
    encode,
    header,
    message,
)

LOG_DAMAGED = "the log was damaged"  # the reason of a gap that `recover` writes
CLOCK_SET = "the clock was set"  # in the reason: the gap may have any length, also less than none
QUIET_HOURS, PAUSED = ON_PURPOSE = "quiet hours", "paused"  # nobody was to be listened to


def encode_gap(microphone: str, start: int, end: int, reason: str, frames_lost: int) -> bytes:
    """Encode an `AudioGap` as CDR."""
    return encode(
        message(
            GAP,
            header=header(start, microphone),
            duration=duration_message(end - start),
            reason=reason,
            frames_lost=frames_lost,
        )
    )
