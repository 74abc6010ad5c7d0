"""Wording of days, times, classes and anomalies."""

from collections import Counter
from dataclasses import replace
from datetime import date, tzinfo

import numpy as np

from hearthlog.analyzer.activity.day_anomaly import FEWEST, LONGEST, DayAnomaly, FigureDifference
from hearthlog.analyzer.activity.day_profile import (
    CLOCK,
    COUNT,
    FIRST,
    LAST,
    QUIET,
    SOUND,
    STRETCHES,
    DayFigure,
)
from hearthlog.analyzer.activity.values import Clock, Count, Duration, rounded
from hearthlog.analyzer.logs.local_time import local_time
from hearthlog.models.classes import find_class, in_words
from hearthlog.schemas.arrays import Int64

_WEEKDAYS = ("Monday", "Tuesday", "Wednesday", "Thursday", "Friday", "Saturday", "Sunday")
_MONTHS = (
    *("January", "February", "March", "April", "May", "June"),
    *("July", "August", "September", "October", "November", "December"),
)


def several_in_words(label: str) -> str:
    """Return the plural of a class's events."""
    row = find_class(label)
    return (row.several if row else "") or in_words(label)


def day_in_words(day: date) -> str:
    """Format a day: `Sunday, 1 March 2026`."""
    return f"{_WEEKDAYS[day.weekday()]}, {date_in_words(day)}"


def date_in_words(day: date) -> str:
    """Format a date: `1 March 2026`."""
    return f"{day.day} {_MONTHS[day.month - 1]} {day.year}"


def dates_in_words(first: date, last: date) -> str:
    """Format two dates, with what they share once: `2 to 8 March 2026`."""
    day, month, year = date_in_words(first).split()
    shared = (first.year != last.year) + (first.month != last.month or first.year != last.year)
    return f"{' '.join([day, month, year][: 1 + shared])} to {date_in_words(last)}"


def short_day(day: date) -> str:
    """Format a day: `Sun 1 Mar`."""
    return f"{_WEEKDAYS[day.weekday()][:3]} {day.day} {_MONTHS[day.month - 1][:3]}"


def days_in_short(first: date, last: date) -> str:
    """Format one or several days, the month once: `Tue 3 to Sun 8 Mar`."""
    if first == last:
        return short_day(first)
    start = short_day(first)
    return f"{start[:-4] if first.month == last.month else start} to {short_day(last)}"


def weekday(day: date) -> str:
    """Return the name of a day: `Sunday`."""
    return _WEEKDAYS[day.weekday()]


def number_in_words(number: int) -> str:
    """Return a number up to twelve as a word."""
    return _NUMBERS[number] if number < len(_NUMBERS) else f"{number}"


_NUMBERS = (
    *("no", "one", "two", "three", "four", "five", "six"),
    *("seven", "eight", "nine", "ten", "eleven", "twelve"),
)


def clock_text(nanoseconds: int, zone: tzinfo) -> str:
    """Format the local time of day of a time in nanoseconds of UTC: `07:05`."""
    return f"{local_time(nanoseconds, zone):%H:%M}"


def clock_with_day(nanoseconds: int, zone: tzinfo, first: date | None) -> str:
    """Format a local time of day, with its weekday if that is before the first day."""
    moment = local_time(nanoseconds, zone)
    is_before = first is not None and moment.date() < first
    return f"{weekday(moment.date())} {moment:%H:%M}" if is_before else f"{moment:%H:%M}"


def edge_of_week(nanoseconds: int, zone: tzinfo, *, is_end: bool) -> str:
    """Format an edge of a time span with its day: `Mon 2 Mar 07:05`; at midnight just the day."""
    day, clock = local_time(nanoseconds - is_end, zone).date(), clock_text(nanoseconds, zone)
    return short_day(day) if clock == "00:00" else f"{short_day(day)} {clock}"


def times_in_words(
    starts: Int64,
    zone: tzinfo,
    most: int = 16,
    first: date | None = None,
    unsure: Int64 | None = None,
) -> str:
    """List times of day (nanoseconds of UTC, any order), `most` of them, and how many more.

    Those of days before the `first` have their weekday: `Sunday 23:28`. Those that are `unsure`
    have a question mark, if others are not.
    """
    doubted = set() if unsure is None or np.isin(starts, unsure).all() else {*unsure.tolist()}
    shown = Counter(
        clock_with_day(start, zone, first) + "?" * (start in doubted)
        for start in np.sort(starts)[:most].tolist()
    )
    more = len(starts) - shown.total()
    texts = [text if n == 1 else f"{text} {times_of(n)}" for text, n in shown.items()]
    return ", ".join(texts) + (f" and {more} more" if more else "")


def times_of(number: int) -> str:
    """Return how often something was: `never`, `once`, `twice`, `3 times`."""
    return {0: "never", 1: "once", 2: "twice"}.get(number, f"{number} times")


WEEK = 7.0  # days: a shorter return period counts as usual
_MONTH = 30.0
_SHOWN = 4
_SINGLE = 3.0  # widths: a single figure this far from usual is reported even on a usual day
_DAY = 1440.0  # minutes
_LEAST_MINUTES = 0.05  # less is none
_BUSY = {FIRST: "first busy half hour from", LAST: "last busy half hour until"}
_NAMES = {STRETCHES: "times with sound", SOUND: "sound", QUIET: "longest quiet stretch"}


def judgement_text(judged: DayAnomaly) -> str:
    """Return how unusual a day was, and its differences from other days."""
    compared = f"{judged.days} earlier days"
    if judged.once_in < WEEK:
        single = [each for each in judged.differences if abs(each.deviation) >= _SINGLE]
        if not single:
            return f"As usual, compared with {compared}."
        odd = replace(judged, differences=single)
        return f"On the whole as usual, compared with {compared}, but: {differences_text(odd)}."
    rare = "Unusual" if judged.once_in >= _MONTH else "Somewhat unusual"
    return f"{rare} compared with {compared}: {rarity_text(judged)}. {_sentence(judged)}".strip()


def too_few_text(days: int) -> str:
    """Return a note on too few days for a judgement."""
    return (
        f"How unusual the day was cannot be said yet: that takes {FEWEST} days in the four "
        f"weeks before it on which the box listened most of the time, and there are {days}."
    )


def rarity_text(judged: DayAnomaly) -> str:
    """Return the return period of such a day: `one such day in 40`."""
    if judged.once_in >= LONGEST:
        return "less than one such day in a year"
    return f"one such day in {rounded(judged.once_in)}"


def differences_text(judged: DayAnomaly) -> str:
    """List the differences from other days, largest first."""
    more = len(judged.differences) - _SHOWN
    texts = [difference_text(each) for each in judged.differences[:_SHOWN]]
    text = "; ".join(texts) + (f"; and {more} more" if more > 0 else "")
    return f"typical of the last {judged.span} days: {text}" if judged.span > 1 else text


def difference_text(difference: FigureDifference) -> str:
    """Return a figure, and its range on eight of ten days."""
    figure, value = difference.figure, difference.value
    name = _name(figure)
    if figure.kind == CLOCK:
        away = Duration(abs(value - difference.middle)).text
        word = "later" if difference.deviation > 0 else "earlier"
        usual = _range(_clock(difference.low), _clock(difference.high))
        return f"{name} {_clock(value)}, {away} {word} than usual ({usual})"
    if figure.kind == COUNT:
        low, high = (Count.show(each) for each in (difference.low, difference.high))
        return f"{name} {Count.show(value)}, usually {_range(low, high)}"
    low, high = (Duration.show(each) for each in (difference.low, difference.high))
    return f"{_lasting(figure, value)}, usually {_range(low, high)}"


def _sentence(judged: DayAnomaly) -> str:
    text = differences_text(judged)
    return f"{text[:1].upper()}{text[1:]}." if text else ""


def _clock(minutes: float) -> str:
    return Clock.show(minutes % _DAY)  # may be past midnight


def _range(low: str, high: str) -> str:
    if low == high:
        return low
    if low.endswith(" min") and high.endswith(" min") and " h " not in low + high:
        low = low.removesuffix(" min")
    return f"{low} to {high}"


def _lasting(figure: DayFigure, minutes: float) -> str:
    name, text = _name(figure), Duration.show(minutes)
    if figure.what == QUIET:
        return f"{name} {text}"
    return f"{name} for {text}" if minutes >= _LEAST_MINUTES else f"no {name}"


def _name(figure: DayFigure) -> str:
    if figure.kind == CLOCK:
        return _BUSY[figure.what]
    name = _NAMES.get(figure.what)
    if name is None:
        words = several_in_words if figure.kind == COUNT else in_words
        name = words(figure.what).lower()
    if figure.hours is not None:
        first, last = (Clock.show(30.0 * half) for half in figure.hours)
        return f"{name} from {first} to {last}"
    return f"{name} {'in the night' if figure.night else 'by day'}"


def capital(text: str) -> str:
    """Return a text with a capital first letter."""
    return text[:1].upper() + text[1:]
