"""The home's own time: its zone, its days, which begin at its midnight."""

from collections.abc import Iterable, Mapping
from datetime import UTC, date, datetime, timedelta, tzinfo

from hearthlog.analyzer.errors import DataError
from hearthlog.recorder.pause_schedule import DEFAULT, time_zone
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS

TIMEZONE = "timezone"  # in the `hearthlog` metadata record of a log
EVENING, MORNING = 22, 7  # of the clock: between them is the night
Span = tuple[int, int]


def home_zone(name: str | None, records: Iterable[Mapping[str, str]] = ()) -> tzinfo:
    """Find the time zone of a home.

    Parameters
    ----------
    records : iterable of mapping of str to str
        The `hearthlog` records of logs; the first that names a zone counts. Without one it is UTC.

    Raises
    ------
    DataError
        If there is no such zone.
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
    """Return the time at which a day begins, in nanoseconds of UTC."""
    local = datetime(day.year, day.month, day.day, tzinfo=zone)
    return int(local.timestamp()) * NANOSECONDS


def day_span(day: date, zone: tzinfo) -> Span:
    """Return the times at which a day and the next one begin, in nanoseconds of UTC.

    In most zones they are 23 to 25 hours apart.
    """
    return midnight(day, zone), midnight(day + timedelta(days=1), zone)


def at_hour(day: date, hour: int, zone: tzinfo) -> int:
    """Return the time at which the clock on the wall shows a full hour.

    Parameters
    ----------
    hour : int
        0 to 23.
    """
    local = datetime(day.year, day.month, day.day, hour, tzinfo=zone)
    return int(local.timestamp()) * NANOSECONDS


def local_time(nanoseconds: int, zone: tzinfo) -> datetime:
    """Return what the clock and the calendar on the wall show.

    Parameters
    ----------
    nanoseconds : int
        Of UTC.

    Returns
    -------
    datetime
        In `zone`, without fractions of a second.
    """
    return datetime.fromtimestamp(nanoseconds // NANOSECONDS, UTC).astimezone(zone)
