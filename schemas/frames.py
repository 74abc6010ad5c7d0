"""Frames, the time step of all logs, and times as text.

Feature sets define what is computed from a frame; its length is the same for all logs.
"""

import re
from datetime import UTC, datetime, timedelta

NANOSECONDS = 1_000_000_000  # per second
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_BEYOND_MICROSECONDS = re.compile(r"(?<=\.\d{6})\d{1,3}(?!\d)")


def read_time(text: str) -> int:
    """Parse a time in ISO 8601 to nanoseconds of UTC since 1970.

    A date such as `2026-03-01`, or date and time such as `2026-03-01T07:00:00.123456789+01:00`; UTC
    without an offset, at most nine decimals. Raise `ValueError` for another text.
    """
    rest = _BEYOND_MICROSECONDS.search(text)  # datetime has no room for these digits
    moment = datetime.fromisoformat(_BEYOND_MICROSECONDS.sub("", text))
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=UTC)
    nanoseconds = (moment - _EPOCH) // timedelta(microseconds=1) * 1_000
    return nanoseconds + (int(rest.group().ljust(3, "0")) if rest else 0)


def millisecond_text(nanoseconds: int) -> str:
    """Format nanoseconds of UTC since 1970 as `2026-03-01T07:00:00.123Z`.

    If no calendar has the time, the text is `<nanoseconds> ns`.
    """
    seconds, rest = divmod(nanoseconds, NANOSECONDS)
    try:
        moment = datetime.fromtimestamp(seconds, UTC)
    except (OverflowError, ValueError, OSError):
        return f"{nanoseconds} ns"
    return f"{moment:%Y-%m-%dT%H:%M:%S}.{rest // 1_000_000:03}Z"


def time_text(nanoseconds: int) -> str:
    """Format nanoseconds of UTC since 1970 as `2026-03-01T07:00:00.123456789Z`; years 1 to 9999."""
    seconds, rest = divmod(nanoseconds, NANOSECONDS)
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%dT%H:%M:%S}.{rest:09}Z"


def seconds_text(nanoseconds: int) -> str:
    """Format nanoseconds, possibly negative, in seconds with nine decimals: `-1.500000000`."""
    seconds, rest = divmod(abs(nanoseconds), NANOSECONDS)
    return f"{'-' * (nanoseconds < 0)}{seconds}.{rest:09}"


SAMPLE_RATE = 16_000  # Hz, one channel
FRAME_SAMPLES = 800
FRAME_SECONDS = FRAME_SAMPLES / SAMPLE_RATE
FRAME_NANOSECONDS = NANOSECONDS * FRAME_SAMPLES // SAMPLE_RATE
