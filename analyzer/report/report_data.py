"""Content of a report: days and their baseline, sections of figures, and interRAI items."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date, tzinfo
from typing import NamedTuple

from hearthlog.analyzer.activity.checked_minutes import CheckedMinutes
from hearthlog.analyzer.activity.daily_metrics import MOST, DayMetrics
from hearthlog.analyzer.activity.day_anomaly import DayAnomaly
from hearthlog.analyzer.activity.doubtful_sounds import DoubtfulSound
from hearthlog.analyzer.activity.event_counts import FEWEST as FEWEST_CHECKED
from hearthlog.analyzer.activity.event_counts import MINUTE
from hearthlog.analyzer.activity.home_data import ScenarioMinutes
from hearthlog.analyzer.activity.values import (
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
from hearthlog.analyzer.logs.local_time import EVENING, MORNING
from hearthlog.analyzer.logs.recorder_info import Trouble
from hearthlog.analyzer.logs.spans import Spans, intersection, joined
from hearthlog.analyzer.report.wording import several_in_words, weekday
from hearthlog.models.classes import (
    COUGHING,
    CRYING,
    FLUSHING_WATER,
    PHONE_RING,
    RUNNING_WATER,
    SHOWER,
    SILENCE,
    SPEECH,
    TAP_WATER,
    UNKNOWN,
    WATER,
    YELLING,
    in_words,
    ordered,
)
from hearthlog.schemas.errors import listed


class ReportFigure(NamedTuple):
    """A figure of a day: counts and lengths are of the 24 hours to 22:00, as `info` has them."""

    title: str  # in the table of one day
    short: str  # column head
    value: Callable[[DayMetrics], Value | None]  # None if unknown
    name: str = ""  # class name, for a figure of one class
    sums: bool = True  # whether a total over days is meaningful
    counts: bool = False  # whether these are the events of a day
    lasts: bool = False  # whether it is the time of a class
    note: str = ""  # in small letters below the title
    late: Callable[[DayMetrics], Value | None] = lambda _: None  # the same after 22:00
    is_often: bool = False  # whether it is how often something was: `never`, `once`
    apart: Callable[[DayMetrics], float] = lambda _: 0.0  # minutes of it beside a television


class FigureSection(NamedTuple):
    """Related figures."""

    title: str
    figures: Sequence[ReportFigure]
    note: str


TELEVISION_PAUSE = 20 * MINUTE  # shorter pauses of a television are left out
NIGHT_HOURS = f"{EVENING:02}:00 to {MORNING:02}:00"


def day_television(day: DayMetrics, pause: int = 0) -> Spans:
    """Return when something like a television sounded, with short pauses closed."""
    starts = day.home.minutes.starts[day.home.minutes.television]
    return intersection(joined(starts, starts + MINUTE, pause), day.span)


def sound_near_television(day: DayMetrics) -> Spans:
    """Return when there was sound in the minutes of something like a television."""
    return intersection(day.home.sound, day_television(day))


def day_sections() -> list[FigureSection]:
    """Return the table of a day below that of its sounds."""
    sound, *edges = _ACTIVITY
    note = f"{_NIGHT_PAUSES} {_ACTIVITY_NOTE}"
    return [FigureSection("Quiet and activity", [sound, *_NIGHT, *edges], note)]


def week_sections(classes: Sequence[str], logged: int) -> list[FigureSection]:
    """Return the tables of a week for the classes of a home's model.

    Of a week with a single logged day, that of the night is part of that of the activity.
    """
    night = [
        *(
            _at_night(n, f"{in_words(n)} in the night", in_words(n))
            for n in _IN_NIGHT
            if n in classes
        ),
        *_NIGHT,
    ]
    bathroom = FigureSection("Bathroom", list(_bathroom(classes)), _BATHROOM_NOTE)
    if logged == 1:
        sound, *edges = _ACTIVITY
        together = FigureSection(
            "Quiet and activity", [sound, *night, *edges], f"{_NIGHT_NOTE} {_ACTIVITY_NOTE}"
        )
        return [section for section in (bathroom, together) if section.figures]
    found = [
        bathroom,
        FigureSection("Night", night, _NIGHT_NOTE),
        FigureSection("Quiet and activity", _ACTIVITY, _ACTIVITY_NOTE),
    ]
    return [section for section in found if section.figures]


def minutes_figure(name: str) -> ReportFigure:
    """Return the figure of a class's duration, without that beside a television."""
    title = in_words(name)
    return ReportFigure(title, title, lambda day: day.to_evening.minutes(name), name, lasts=True)


def day_parts(day: date) -> Mapping[str, Callable[[DayMetrics], Spans]]:
    """Return the parts of a day with the night before it, by their titles; none overlap."""
    return {
        f"Night to {weekday(day)}, {EVENING:02}\N{EN DASH}{MORNING:02}": lambda day: day.night,
        f"Day {MORNING:02}\N{EN DASH}{EVENING:02}": lambda day: day.waking,
        f"After {EVENING}:00": lambda day: day.evening,
    }


def part_figure(name: str, part: Callable[[DayMetrics], Spans]) -> ReportFigure:
    """Return the figure of a class's event count in one of `day_parts`."""
    return ReportFigure(name, name, lambda day: day.count(name, part(day)), name)


def event_figure(name: str, title: str = "") -> ReportFigure:
    """Return the figure of a class's event count."""
    title = title or in_words(name)
    return ReportFigure(title, title, lambda day: day.to_evening.count(name), name, counts=True)


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
    for name in (TAP_WATER, RUNNING_WATER):
        if name in classes:
            yield from _day_and_night(name)


def _late_sound(day: DayMetrics) -> Duration | None:
    """Return the duration of any sound after 22:00; None if unknown."""
    covered = intersection(day.home.coverage, day.evening).length / day.evening.length
    sound = Duration(intersection(day.home.sound, day.evening).length / MINUTE)
    return sound if covered >= MOST or (covered and sound.minutes) else None


_IN_NIGHT = COUGHING, CRYING
_LONGER = "a minute or more in ten"
_LONGEST_QUIET = f"Longest quiet, {MORNING:02}\N{EN DASH}{EVENING:02}"
_NIGHT = (
    ReportFigure("Time with sound in the night", "Time with sound", lambda day: day.night_sound),
    ReportFigure(
        "30 s of sound or more in the night",
        "30 s of sound or more",
        lambda day: day.night_stretches,
        is_often=True,
    ),
)
_ACTIVITY = (
    ReportFigure(
        "Time with sound",
        "Time with sound",
        lambda day: day.to_evening.sound,
        late=_late_sound,
        apart=lambda day: sound_near_television(day.to_evening).length / MINUTE,
    ),
    ReportFigure(
        "First sound",
        "First sound",
        lambda day: day.first_sound,
        sums=False,
        note="from 04:00, however short",
    ),
    ReportFigure(
        "First longer sounds",
        "First longer sounds",
        lambda day: day.first,
        sums=False,
        note=_LONGER,
    ),
    ReportFigure(
        "Last longer sounds",
        "Last longer sounds",
        lambda day: day.last,
        sums=False,
        note=_LONGER,
    ),
    ReportFigure(_LONGEST_QUIET, _LONGEST_QUIET, lambda day: day.quiet, sums=False),
)
_BATHROOM_NOTE = f"Night is {NIGHT_HOURS}. A person, not the report, knows who used the bathroom."
_NIGHT_PAUSES = "30 s of sound or more: how many times, with ten quiet minutes between two of them."
_NIGHT_NOTE = (
    f"The night is {NIGHT_HOURS}, counted on the day on which the night ends. {_NIGHT_PAUSES}"
)
_ACTIVITY_NOTE = (
    "Longer sounds: the first and the last ten minutes, from 04:00 to midnight, with at least one "
    "minute of sound. There may be shorter sounds before and after them. Quiet can mean rest, "
    "reading, a nap, or nobody at home."
)


_CHANGES = {
    (Clock, 1): "later",
    (Clock, -1): "earlier",
    (Duration, 1): "longer",
    (Duration, -1): "shorter",
    (Count, 1): "more often",
    (Count, -1): "less often",
}


@dataclass(frozen=True)
class ReportData:
    """Data of a page."""

    nodes: Sequence[str]
    microphones: Sequence[str]
    labelling: str  # `live`, or a model name
    zone: tzinfo
    days: Sequence[DayMetrics]  # one or seven
    before: Sequence[DayMetrics]  # preceding days for three-day items
    earlier: Sequence[DayMetrics]  # baseline days
    judged: Mapping[date, DayAnomaly | None]  # of `days`: anomaly of each, if known
    baseline_days: Mapping[date, int]  # of `days`: number of baseline days
    uncovered: Mapping[str, float]  # by microphone: hours without coverage
    gaps: Sequence[Trouble]
    troubles: Sequence[Trouble]
    doubts: Sequence[DoubtfulSound]  # of `days`: those that need review
    checks: CheckedMinutes  # randomly drawn, reviewed minutes of these weeks
    model: str  # SHA-256 of the model that labelled the days; empty if unknown
    scenarios: ScenarioMinutes  # of `days`; live labels only
    unread: int  # number of logs that could not be read completely
    networks: Sequence[str]  # network changes in these weeks, one line per microphone
    hidden: frozenset[str]  # classes that nobody is told of

    @property
    def home(self) -> str:
        """Name of the home."""
        return listed(list(self.nodes), "and") or "Home"

    @property
    def logged_days(self) -> Sequence[DayMetrics]:
        """The days from the first log to the last one; all if none has logs."""
        return [day for day in self.days if day.logged.length] or self.days

    @property
    def classes(self) -> list[str]:
        """Classes that can occur."""
        return self.days[0].home.classes

    @property
    def from_evening(self) -> "ReportData":
        """The same data with days from the evening before: one to midnight, seven to 22:00.

        So each night is in one piece, and no sound is in two days of a week. A day of a week
        without logs stays as it is: two hours of the evening before make no day.
        """
        if len(self.days) == 1:
            days, earlier = ([day.with_night for day in each] for each in (self.days, self.earlier))
        else:
            days, earlier = (
                [day.to_evening if day.logged.length else day for day in each]
                for each in (self.days, self.earlier)
            )
        return replace(self, days=days, earlier=earlier)

    @property
    def unknown(self) -> list[str]:
        """Classes that a report is asked about, and the model of the home does not know."""
        wanted = {*WATER, *(item.needs for item in ASSESSED_ITEMS if item.needs)}
        if RUNNING_WATER in self.classes:
            wanted -= {*WATER}
        return ordered(wanted - {*self.classes, *self.hidden})

    @property
    def confused(self) -> list[str]:
        """Classes that a report is asked about, and the model does not tell apart."""
        return ordered(set(WATER) - self.hidden) if RUNNING_WATER in self.classes else []

    @property
    def checked(self) -> bool:
        """Whether enough minutes were checked for ranges of counts."""
        return len(self.checks) >= FEWEST_CHECKED

    @property
    def checked_elsewhere(self) -> int:
        """Number of checked minutes labelled by another model."""
        return sum(model != self.model for model in self.checks.models)

    def accuracy_text(self, name: str) -> str:
        """Return the accuracy of a class in the checked minutes: `3 of 4, missed 1`.

        Empty for silence and `unknown`, since neither is a sound that can be counted as correct or
        missed.
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
        """Whether there are baseline days."""
        return len(self.earlier) >= FEWEST

    def baseline(self, figure: ReportFigure) -> tuple[UsualRange, Value] | None:
        """Return the usual range of a figure over days with sufficient coverage, and its formatter.

        None if fewer than seven of the earlier days have the figure.
        """
        days = [day for day in self.earlier if day.comparable(figure.name)]
        values = [value for day in days if (value := figure.value(day)) is not None]
        baseline = usual_range(values)
        return None if baseline is None else (baseline, values[0])

    def usually(self, figure: ReportFigure) -> str:
        """Return the usual range: `4 (3 to 6)`; empty with too few days."""
        baseline = self.baseline(figure)
        return "" if baseline is None else baseline[1].spread(*baseline[0])

    def change(self, figure: ReportFigure, day: DayMetrics) -> str:
        """Compare a figure of a day with all earlier days in a word or two, such as `more often`.

        Empty if the figure is usual or cannot be compared.
        """
        value, baseline = figure.value(day), self.baseline(figure)
        if value is None or baseline is None or not day.comparable(figure.name):
            return ""
        return _CHANGES.get((type(value), compared(value, baseline[0])), "")

    @property
    def too_few(self) -> str:
        """Return a note on too few baseline days."""
        number = len(self.earlier)
        there = {0: "no day", 1: "only 1 day"}.get(number, f"only {number} days")
        return (
            f"Not compared with other days: of the {BASELINE_DAYS} days before, "
            f"{there} could be used; {FEWEST} are needed on which the box "
            "listened most of the time, nights included."
        )


ASSESSED_DAYS = 3


class AssessedItem(NamedTuple):
    """An item of the assessment."""

    topic: str  # subject of the item
    sounds: str  # that are counted
    needs: str  # required class; empty if any sound will do
    value: Callable[[DayMetrics], Count | Duration | None]  # count on one day
    limits: str  # limits of sound as evidence


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
        f"{in_words(SPEECH).lower()}, not beside a television",
        SPEECH,
        lambda day: day.minutes(SPEECH),
        "Who talked. Company that talks for long sounds like a television; what was said is not "
        "kept.",
    ),
)
