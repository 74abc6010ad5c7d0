"""The day and the night that a home is in, by its own clock."""

from datetime import timedelta, tzinfo
from typing import NamedTuple

from hearthlog.analyzer.logs.local_time import EVENING, MORNING, at_hour, local_time, midnight
from hearthlog.schemas.frames import NANOSECONDS


class Today(NamedTuple):
    """When the day began that a home is in, and its last night; in nanoseconds of UTC.

    Attributes
    ----------
    midnight : int
        When the day began.
    night, morning : int
        When the last night began, at 22:00 of this day or of the one before, and when it ends, at
        7:00.
    """

    now: int
    midnight: int
    night: int
    morning: int


def today(now: int, zone: tzinfo) -> Today:
    """Return the day and the night at a time."""
    day = local_time(now, zone).date()
    last = day if at_hour(day, EVENING, zone) <= now else day - timedelta(days=1)
    night = at_hour(last, EVENING, zone), at_hour(last + timedelta(days=1), MORNING, zone)
    return Today(now, midnight(day, zone), *night)


def iso_time(nanoseconds: int, zone: tzinfo) -> str:
    """Write a time as ISO 8601, with the offset of the home and milliseconds.

    Parameters
    ----------
    nanoseconds : int
        Of UTC.
    """
    moment = local_time(nanoseconds, zone)
    milliseconds = nanoseconds % NANOSECONDS // 1_000_000
    return moment.replace(microsecond=1000 * milliseconds).isoformat(timespec="milliseconds")
