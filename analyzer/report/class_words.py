"""Plain words: for classes, days and times."""

from datetime import date, tzinfo

import numpy as np

from hearthlog.analyzer.logs.local_time import local_time
from hearthlog.models.classes import find_class, in_words
from hearthlog.schemas.arrays import Int64

_WEEKDAYS = ("Monday", "Tuesday", "Wednesday", "Thursday", "Friday", "Saturday", "Sunday")
_MONTHS = (
    *("January", "February", "March", "April", "May", "June"),
    *("July", "August", "September", "October", "November", "December"),
)


def several_in_words(label: str) -> str:
    """Name the events of a class as people who count them would."""
    row = find_class(label)
    return (row.several if row else "") or in_words(label)


def day_in_words(day: date) -> str:
    """Write a day: `Sunday, 1 March 2026`."""
    return f"{_WEEKDAYS[day.weekday()]}, {date_in_words(day)}"


def date_in_words(day: date) -> str:
    """Write a date: `1 March 2026`."""
    return f"{day.day} {_MONTHS[day.month - 1]} {day.year}"


def short_day(day: date) -> str:
    """Write a day: `Sun 1 Mar`."""
    return f"{_WEEKDAYS[day.weekday()][:3]} {day.day} {_MONTHS[day.month - 1][:3]}"


def clock_text(nanoseconds: int, zone: tzinfo) -> str:
    """Write the time of day: `07:05`.

    Parameters
    ----------
    nanoseconds : int
        Of UTC.
    """
    return f"{local_time(nanoseconds, zone):%H:%M}"


def times_in_words(starts: Int64, zone: tzinfo, most: int = 16) -> str:
    """List times of day; where they are many, the first and how many more.

    Parameters
    ----------
    starts : np.ndarray [shape=(n,)], int64
        In nanoseconds of UTC, in any order.
    most : int, optional
        Number of times that are listed, at most.
    """
    shown = [clock_text(start, zone) for start in np.sort(starts)[:most].tolist()]
    more = len(starts) - len(shown)
    return ", ".join(shown) + (f" and {more} more" if more else "")
