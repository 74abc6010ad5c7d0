"""Content of a report: days and their baseline, sections of figures, and interRAI items."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import date, tzinfo
from typing import NamedTuple

from hearthlog.analyzer.accuracy.checked_minutes import CheckedMinutes
from hearthlog.analyzer.accuracy.event_counts import FEWEST as FEWEST_CHECKED
from hearthlog.analyzer.logs.recorder_info import Trouble
from hearthlog.analyzer.report.daily_metrics import DayMetrics
from hearthlog.analyzer.report.read_home import ScenarioMinutes
from hearthlog.analyzer.report.values import (
    BASELINE_DAYS,
    FEWEST,
    Clock,
    Count,
    Duration,
    UsualRange,
    Value,
    compared,
    usual_range,
)
from hearthlog.analyzer.report.wording import several_in_words
from hearthlog.analyzer.routine.day_anomaly import DayAnomaly
from hearthlog.models.classes import (
    COUGHING,
    CRYING,
    FLUSHING_WATER,
    PHONE_RING,
    SHOWER,
    SILENCE,
    SPEECH,
    TAP_WATER,
    UNKNOWN,
    YELLING,
    in_words,
)
from hearthlog.schemas.errors import listed

BATHROOM = (FLUSHING_WATER, SHOWER, TAP_WATER)


class ReportFigure(NamedTuple):
    """One figure of a day."""

    title: str  # in a table of one day
    short: str  # as the head of a column
    value: Callable[[DayMetrics], Value | None]  # finds it; None where it cannot be known
    name: str = ""  # the class that it is about, if it is about one
    sums: bool = True  # whether a total over days means something


class FigureSection(NamedTuple):
    """Figures that belong together; `missing` says why there are none."""

    title: str
    figures: Sequence[ReportFigure]
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


def minutes_figure(name: str) -> ReportFigure:
    """Return the figure that says for how long a class was heard."""
    title = in_words(name)
    return ReportFigure(title, title, lambda day: day.minutes(name), name)


def event_figure(name: str, title: str = "") -> ReportFigure:
    """Return the figure that says how often a class was heard."""
    title = title or in_words(name)
    return ReportFigure(title, title, lambda day: day.count(name), name)


def _at_night(name: str, title: str, short: str) -> ReportFigure:
    return ReportFigure(title, short, lambda day: day.night_count(name), name)


def _day_and_night(name: str) -> Iterator[ReportFigure]:
    title = several_in_words(name)
    yield event_figure(name, title)
    yield _at_night(name, f"{title} at night", "at night")


def _bathroom(classes: Sequence[str]) -> Iterator[ReportFigure]:
    if FLUSHING_WATER in classes:
        yield from _day_and_night(FLUSHING_WATER)
    if SHOWER in classes:
        yield event_figure(SHOWER, several_in_words(SHOWER))
        yield minutes_figure(SHOWER)._replace(title="Time in the shower", short="Shower time")
    if TAP_WATER in classes:
        yield from _day_and_night(TAP_WATER)


def _night(classes: Sequence[str]) -> Iterator[ReportFigure]:
    for name in (COUGHING, CRYING):
        if name in classes:
            yield _at_night(name, several_in_words(name), in_words(name))
    yield ReportFigure("Times with sound", "Times with sound", lambda day: day.night_stretches)
    yield ReportFigure("Time with sound", "Time with sound", lambda day: day.night_sound)


_ACTIVITY = (
    ReportFigure("Time with sound", "Time with sound", lambda day: day.sound),
    ReportFigure("First lively time", "First lively time", lambda day: day.first, sums=False),
    ReportFigure("Last lively time", "Last lively time", lambda day: day.last, sums=False),
    ReportFigure(
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


_CHANGES = {
    (Clock, 1): "later",
    (Clock, -1): "earlier",
    (Duration, 1): "longer",
    (Duration, -1): "shorter",
    (Count, 1): "more often",
    (Count, -1): "less often",
}


@dataclass(frozen=True)
class Account:
    """What a page tells."""

    nodes: Sequence[str]
    microphones: Sequence[str]
    labelling: str  # `live`, or the name of a model
    zone: tzinfo
    days: Sequence[DayMetrics]  # one, or seven
    before: Sequence[
        DayMetrics
    ]  # the days before them that belong to what is asked about three days
    earlier: Sequence[DayMetrics]  # those that they are compared with
    judged: Mapping[date, DayAnomaly | None]  # of `days`: how unusual each was, if that is known
    beside: Mapping[date, int]  # of `days`: how many days there are to say so by
    unheard: Mapping[str, float]  # by microphone: hours in which it heard nothing
    gaps: Sequence[Trouble]
    troubles: Sequence[Trouble]
    checks: CheckedMinutes  # minutes of these weeks that were drawn at random, and gone through
    model: str  # SHA-256 of the model that labelled the days; empty if it is not known
    scenarios: ScenarioMinutes  # of `days`; of live labels only
    unread: int  # how many logs could not be read, or only in part
    networks: Sequence[str]  # what changed of them in these weeks, a microphone in a line

    @property
    def home(self) -> str:
        """Name of the home."""
        return listed(list(self.nodes), "and") or "Home"

    @property
    def classes(self) -> list[str]:
        """The classes that can be heard."""
        return self.days[0].home.classes

    @property
    def checked(self) -> bool:
        """Whether enough minutes were checked to say in which range counts lie."""
        return len(self.checks) >= FEWEST_CHECKED

    @property
    def checked_elsewhere(self) -> int:
        """How many of the checked minutes another model labelled."""
        return sum(model != self.model for model in self.checks.models)

    def rightness(self, name: str) -> str:
        """Say how right the labels of a class were in the checked minutes: `3 of 4, missed 1`.

        Parameters
        ----------
        name : str
            Of the class; of quiet, and of what is not sure, nothing is said: they are no sounds
            that one can count right or missed.
        """
        if name in {SILENCE, UNKNOWN}:
            return ""
        check = self.checks.check(name)
        if not (check.labelled or check.true):
            return "\u2013"
        missed = f", missed {check.missed}" if check.missed else ""
        return f"{check.right} of {check.labelled}{missed}"

    @property
    def comparable(self) -> bool:
        """Whether there are days to compare with."""
        return len(self.earlier) >= FEWEST

    def baseline(self, figure: ReportFigure) -> tuple[UsualRange, Value] | None:
        """Return what is usual, and a value that can write it; None if there are too few days.

        Returns
        -------
        (UsualRange, Value) or None
            Of the earlier days of which most was heard; None if fewer than seven of them know the
            figure.
        """
        days = [day for day in self.earlier if day.comparable(figure.name)]
        values = [value for day in days if (value := figure.value(day)) is not None]
        baseline = usual_range(values)
        return None if baseline is None else (baseline, values[0])

    def usually(self, figure: ReportFigure) -> str:
        """Say what is usual: `4 (3 to 6)`.

        Returns
        -------
        str
            Empty if there are too few days.
        """
        baseline = self.baseline(figure)
        return "" if baseline is None else baseline[1].spread(*baseline[0])

    def change(self, figure: ReportFigure, day: DayMetrics) -> str:
        """Compare a figure of a day with all earlier days.

        Returns
        -------
        str
            A word or two, as `more often` or `later`; empty if the figure is as usual, or cannot be
            compared.
        """
        value, baseline = figure.value(day), self.baseline(figure)
        if value is None or baseline is None or not day.comparable(figure.name):
            return ""
        return _CHANGES.get((type(value), compared(value, baseline[0])), "")

    @property
    def too_few(self) -> str:
        """Say that there is too little to compare with."""
        number = len(self.earlier)
        there = {0: "no day", 1: "only 1 day"}.get(number, f"only {number} days")
        return (
            f"Not compared with other days: of the {BASELINE_DAYS} days before, "
            f"{there} could be used; {FEWEST} are needed that were heard for the most part, with "
            "their night."
        )


ASSESSED_DAYS = 3


class AssessedItem(NamedTuple):
    """One question."""

    topic: str  # what the assessment asks about
    heard: str  # what is counted
    needs: str  # the class that must be known; empty if any sound will do
    value: Callable[[DayMetrics], Count | Duration | None]  # counts it on one day
    limits: str  # what sound cannot tell


def _several(name: str) -> str:
    return several_in_words(name).lower()


ASSESSED_ITEMS = (
    AssessedItem(
        "Sleep",
        "times with sound in the night",
        "",
        lambda day: day.night_stretches,
        "Whether the person slept, woke, or felt rested. A radio or a visitor sounds too.",
    ),
    AssessedItem(
        "Toilet use at night",
        f"{_several(FLUSHING_WATER)} in the night",
        FLUSHING_WATER,
        lambda day: day.night_count(FLUSHING_WATER),
        "Whether help was needed, or whether there was any incontinence.",
    ),
    AssessedItem(
        "Toilet use",
        f"{_several(FLUSHING_WATER)}, day and night",
        FLUSHING_WATER,
        lambda day: day.count(FLUSHING_WATER),
        "Toilet visits without a flush, and who used it.",
    ),
    AssessedItem(
        "Bathing",
        _several(SHOWER),
        SHOWER,
        lambda day: day.count(SHOWER),
        "Whether help was needed, and washing at the basin.",
    ),
    AssessedItem(
        "Coughing",
        f"{_several(COUGHING)}, day and night",
        COUGHING,
        lambda day: day.count(COUGHING),
        "The cause, or whether there is phlegm or shortness of breath.",
    ),
    AssessedItem(
        "Mood: crying",
        _several(CRYING),
        CRYING,
        lambda day: day.count(CRYING),
        "Who cried and why; a film sounds the same. Sadness is often silent.",
    ),
    AssessedItem(
        "Behaviour: shouting",
        _several(YELLING),
        YELLING,
        lambda day: day.count(YELLING),
        "At whom, or whether it was a call for help, anger or television.",
    ),
    AssessedItem(
        "Using the telephone",
        _several(PHONE_RING),
        PHONE_RING,
        lambda day: day.count(PHONE_RING),
        "Whether it was answered, by whom, and calls that the person made.",
    ),
    AssessedItem(
        "Company and conversation",
        f"{in_words(SPEECH).lower()}, in all",
        SPEECH,
        lambda day: day.minutes(SPEECH),
        "Who talked. Radio and television count as well; what was said is not kept.",
    ),
)
