"""The tables of a report: figures of a day with a name, put together by what they are about."""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from hearthlog.analyzer.report.class_words import several_in_words
from hearthlog.analyzer.report.daily_metrics import Day
from hearthlog.analyzer.report.values import Value
from hearthlog.models.classes import COUGHING, CRYING, FLUSHING_WATER, SHOWER, TAP_WATER, in_words
from hearthlog.schemas.errors import listed

BATHROOM = (FLUSHING_WATER, SHOWER, TAP_WATER)


class Figure(NamedTuple):
    """One figure of a day."""

    title: str  # in a table of one day
    short: str  # as the head of a column
    value: Callable[[Day], Value | None]  # finds it; None where it cannot be known
    name: str = ""  # the class that it is about, if it is about one
    sums: bool = True  # whether a total over days means something


class FigureSection(NamedTuple):
    """Figures that belong together; `missing` says why there are none."""

    title: str
    figures: Sequence[Figure]
    note: str
    missing: str = ""


def sections(classes: Sequence[str]) -> list[FigureSection]:
    """Return the tables, for the classes that the model of a home knows."""
    return [
        FigureSection(
            "Bathroom", list(_bathroom(classes)), _BATHROOM_NOTE, _missing(classes, BATHROOM)
        ),
        FigureSection("Night", list(_night(classes)), _NIGHT_NOTE),
        FigureSection("Quiet and activity", _ACTIVITY, _ACTIVITY_NOTE),
    ]


def minutes_of(name: str) -> Figure:
    """Return the figure that says for how long a class was heard."""
    title = in_words(name)
    return Figure(title, title, lambda day: day.minutes(name), name)


def events_of(name: str, title: str = "") -> Figure:
    """Return the figure that says how often a class was heard."""
    title = title or in_words(name)
    return Figure(title, title, lambda day: day.count(name), name)


def _at_night(name: str, title: str, short: str) -> Figure:
    return Figure(title, short, lambda day: day.night_count(name), name)


def _day_and_night(name: str) -> Iterator[Figure]:
    title = several_in_words(name)
    yield events_of(name, title)
    yield _at_night(name, f"{title} at night", "at night")


def _bathroom(classes: Sequence[str]) -> Iterator[Figure]:
    if FLUSHING_WATER in classes:
        yield from _day_and_night(FLUSHING_WATER)
    if SHOWER in classes:
        yield events_of(SHOWER, several_in_words(SHOWER))
        yield minutes_of(SHOWER)._replace(title="Time in the shower", short="Shower time")
    if TAP_WATER in classes:
        yield from _day_and_night(TAP_WATER)


def _night(classes: Sequence[str]) -> Iterator[Figure]:
    for name in (COUGHING, CRYING):
        if name in classes:
            yield _at_night(name, several_in_words(name), in_words(name))
    yield Figure("Times with sound", "Times with sound", lambda day: day.night_stretches)
    yield Figure("Time with sound", "Time with sound", lambda day: day.night_sound)


_ACTIVITY = (
    Figure("Time with sound", "Time with sound", lambda day: day.sound),
    Figure("First lively time", "First lively time", lambda day: day.first, sums=False),
    Figure("Last lively time", "Last lively time", lambda day: day.last, sums=False),
    Figure(
        "Longest quiet stretch, 07:00 to 22:00", "Longest quiet", lambda day: day.quiet, sums=False
    ),
)
_BATHROOM_NOTE = "Night is 22:00 to 07:00. A person, not the report, knows who used the bathroom."
_NIGHT_NOTE = (
    "22:00 to 07:00, counted to the day on which the night ends. A “time with sound” has at least "
    "half a minute of sound, and ten quiet minutes before the next one."
)
_ACTIVITY_NOTE = (
    "Lively: ten minutes with at least one minute of sound, from 04:00 on. Quiet can mean rest, "
    "reading, a nap, or nobody at home."
)


def _missing(classes: Sequence[str], needed: Sequence[str]) -> str:
    if any(name in classes for name in needed):
        return ""
    names = listed([in_words(name).lower() for name in needed], "and")
    return f"Cannot be told: the model of this home does not know these sounds ({names})."
