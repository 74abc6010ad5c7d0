"""The time of day, as far as a log can say it."""

import time
from datetime import UTC, datetime

from hearthlog.recorder.errors import SourceError
from hearthlog.schemas.frames import NANOSECONDS

# ROS has 32 bits for seconds, and MCAP no times before 1970. A minute for frames that were taken
# before the clock was looked at, a day for what a log says of the time to come.
_FIRST = 60 * NANOSECONDS
_LAST = ((1 << 31) - 86_400) * NANOSECONDS
_LAST_OF_CALENDAR = 253_402_300_799  # seconds: the year 9999 ends


class WallClock:
    """CLOCK_REALTIME; while that cannot be in a log, the time goes on without it.

    Without a right time before it goes on from 1970, as on a machine whose clock was never set.

    Attributes
    ----------
    trouble : str
        What is wrong with the clock; empty if nothing is.
    """

    def __init__(self) -> None:
        self.trouble = ""
        self._offset: int | None = None  # the last one that a log can have

    def offset(self) -> int:
        """Return CLOCK_REALTIME less CLOCK_MONOTONIC in nanoseconds."""
        before = time.monotonic_ns()
        now = time.time_ns()
        monotonic = (before + time.monotonic_ns()) // 2
        is_right = _FIRST <= now < _LAST
        if is_right:
            self._offset = now - monotonic
        elif self._offset is None or monotonic + self._offset >= _LAST:
            self._offset = _FIRST - monotonic
        self.trouble = "" if is_right else _trouble(now)
        return self._offset


def check_times(first: int, last: int) -> None:
    """Check that a log can have the times of audio files, in nanoseconds of UTC.

    Raise `SourceError` if it cannot.
    """
    if first < 0 or last >= _LAST:
        day = _day(first if first < 0 else last)
        raise SourceError(f"a log cannot have sound of {day}, only of 1970 to 2037; say --start")


def _trouble(now: int) -> str:
    return f"the clock says {_day(now)}, which a log cannot have; set it, for all stamps are wrong"


def _day(nanoseconds: int) -> str:
    seconds = min(nanoseconds // NANOSECONDS, _LAST_OF_CALENDAR)
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%d}"
