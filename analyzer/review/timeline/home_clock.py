"""The clock of a home as an axis of time: as far from UTC from one end to the other."""

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta, tzinfo
from typing import Any

from hearthlog.analyzer.logs.local_time import local_time
from hearthlog.schemas.frames import NANOSECONDS


@dataclass(frozen=True)
class HomeClock:
    """What the clock of a home shows, as nanoseconds since 1970.

    Attributes
    ----------
    name : str
        Of the axis, in words, with the distance from UTC.
    offset : int
        Nanoseconds by which it is ahead of UTC.
    """

    name: str
    offset: int

    def shown(self, utc: Any) -> Any:
        """Turn nanoseconds of UTC, int or np.ndarray of int64, into what the clock shows."""
        return utc + self.offset

    def utc(self, shown: Any) -> Any:
        """Turn what the clock shows into nanoseconds of UTC, int or np.ndarray of int64."""
        return shown - self.offset


def home_clock(zone: tzinfo, start: int, end: int) -> HomeClock:
    """Make the clock of a home for a span of time.

    Where clocks are changed in between, it goes on with the time that holds in the middle, and its
    name says so: an axis of time has no hour twice.
    """
    ahead = _ahead((start + end) // 2, zone)
    is_one = _ahead(start, zone) == ahead == _ahead(max(start, end - 1), zone)
    hours = "" if not ahead else f"{datetime(1970, 1, 2, tzinfo=UTC) + abs(ahead):%H:%M}"
    sign = "+" if ahead > timedelta() else "-"
    distance = f"UTC{sign}{hours}" if hours else "UTC"
    return HomeClock(
        f"clock of the home ({distance}{'' if is_one else ' throughout'})",
        round(ahead.total_seconds()) * NANOSECONDS,
    )


def _ahead(time: int, zone: tzinfo) -> timedelta:
    return local_time(time, zone).utcoffset() or timedelta()
