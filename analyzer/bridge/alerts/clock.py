"""Times of day on a clock on the wall, also on the days on which it is changed."""

from datetime import UTC, date, datetime, timedelta, tzinfo

from hearthlog.analyzer.logs.local_time import local_time
from hearthlog.recorder.pause_schedule import QuietHours
from hearthlog.schemas.frames import NANOSECONDS


def wall_times(day: date, minute: int, zone: tzinfo) -> tuple[int, int]:
    """Return when a clock on the wall shows a minute of a day, the first and the last time.

    Parameters
    ----------
    minute : int
        0 to 1439.

    Returns
    -------
    first, last : int
        In nanoseconds of UTC. They differ where the clock is set back past the minute; where it is
        set forward past it, both are the moment of the change.
    """
    shown = datetime(day.year, day.month, day.day, *divmod(minute, 60), tzinfo=zone)
    first, last = (int(shown.replace(fold=fold).timestamp()) for fold in (0, 1))
    if first > last:  # the offset before the change gives a time after it, and the other way round
        first = last = _change_between(last, first, zone)
    return first * NANOSECONDS, last * NANOSECONDS


def _change_between(before: int, after: int, zone: tzinfo) -> int:
    """Return the second at which the clock is changed between two times, in seconds of UTC."""
    offset = datetime.fromtimestamp(before, UTC).astimezone(zone).utcoffset()
    while after - before > 1:
        middle = (before + after) // 2
        if datetime.fromtimestamp(middle, UTC).astimezone(zone).utcoffset() == offset:
            before = middle
        else:
            after = middle
    return after


def days_around(start: int, end: int, zone: tzinfo) -> list[date]:
    """List the days of the home from the one before a time to the one of a later time."""
    first = local_time(start, zone).date() - timedelta(days=1)
    last = local_time(end, zone).date()
    return [first + timedelta(days=number) for number in range((last - first).days + 1)]


def end_of_quiet(hours: list[QuietHours], time: int, zone: tzinfo) -> int:
    """Return when quiet hours are over; the time itself outside of them.

    Returns
    -------
    int
        In nanoseconds of UTC; where all of the day is quiet, no later than a day from the time.
    """
    until = time
    for _ in hours:  # one may begin where another ends
        moment = local_time(until, zone)
        left = max(each.minutes_left(60 * moment.hour + moment.minute) for each in hours)
        if not left:
            break
        day, minute = divmod(60 * moment.hour + moment.minute + left, 24 * 60)
        ends = wall_times(moment.date() + timedelta(days=day), minute, zone)
        until = next(end for end in (*ends, until + left * 60 * NANOSECONDS) if end > until)
    return until
