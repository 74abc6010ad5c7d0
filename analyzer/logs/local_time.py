"""Local time of a home: time zone, days and hours."""

from collections.abc import Iterable, Mapping
from datetime import UTC, date, datetime, timedelta, tzinfo
from typing import NamedTuple

from hearthlog.analyzer.errors import DataError
from hearthlog.recorder.pause_schedule import DEFAULT, time_zone
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS

TIMEZONE = "timezone"  # key in the `hearthlog` metadata record of a log
EVENING, MORNING = 22, 7  # local hours between which it is night
Span = tuple[int, int]


def home_zone(name: str | None, records: Iterable[Mapping[str, str]] = ()) -> tzinfo:
    """Return the time zone of a home: the named one, the first in `hearthlog` records, or UTC.

    Raise `DataError` if there is no such zone.
    """
    if name is not None:
        return _zone(name, "use a name such as Europe/Vienna, or UTC")
    recorded = next((record[TIMEZONE] for record in records if record.get(TIMEZONE)), DEFAULT)
    return _zone(recorded, "the logs say so; name the right one with --timezone")


def _zone(name: str, advice: str) -> tzinfo:
    try:
        return time_zone(name)
    except LogError as error:
        raise DataError(f"{name[:64]!r} is no time zone: {advice}") from error


def midnight(day: date, zone: tzinfo) -> int:
    """Return the start of a day, in nanoseconds of UTC."""
    return at_hour(day, 0, zone)


def day_span(day: date, zone: tzinfo) -> Span:
    """Return the starts of a day and of the next day, in nanoseconds of UTC.

    In most zones they are 23 to 25 hours apart.
    """
    return midnight(day, zone), midnight(day + timedelta(days=1), zone)


def at_hour(day: date, hour: int, zone: tzinfo) -> int:
    """Return the time of a full local hour, 0 to 23, in nanoseconds of UTC."""
    local = datetime(day.year, day.month, day.day, hour, tzinfo=zone)
    return int(local.timestamp()) * NANOSECONDS


def local_time(nanoseconds: int, zone: tzinfo) -> datetime:
    """Return the local date and time of nanoseconds of UTC, without fractions of a second."""
    return datetime.fromtimestamp(nanoseconds // NANOSECONDS, UTC).astimezone(zone)


def awake_span(day: date, zone: tzinfo) -> Span:
    """Return 07:00 and 22:00 of a day, in nanoseconds of UTC."""
    return at_hour(day, MORNING, zone), at_hour(day, EVENING, zone)


def night_span(day: date, zone: tzinfo) -> Span:
    """Return start and end of the night that ends on a day, in nanoseconds of UTC."""
    return evening_before(day, zone), at_hour(day, MORNING, zone)


def evening_before(day: date, zone: tzinfo) -> int:
    """Return the start of the night that ends on a day, in nanoseconds of UTC."""
    return at_hour(day - timedelta(days=1), EVENING, zone)


class Today(NamedTuple):
    """The current local day and the last night, in nanoseconds of UTC."""

    now: int
    midnight: int  # start of the day
    night: int  # start of the last night, at 22:00 of this day or the day before
    morning: int  # its end at 7:00


def today(now: int, zone: tzinfo) -> Today:
    """Return the local day and the last night at a time, in nanoseconds of UTC."""
    day = local_time(now, zone).date()
    ends = day + timedelta(days=at_hour(day, EVENING, zone) <= now)
    return Today(now, midnight(day, zone), *night_span(ends, zone))


def iso_time(nanoseconds: int, zone: tzinfo) -> str:
    """Format nanoseconds of UTC as ISO 8601 in local time, with offset and milliseconds."""
    moment = local_time(nanoseconds, zone)
    milliseconds = nanoseconds % NANOSECONDS // 1_000_000
    return moment.replace(microsecond=1000 * milliseconds).isoformat(timespec="milliseconds")
