"""What a report is about: some days, those they are compared with, and what was not well."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date, tzinfo

from hearthlog.analyzer.accuracy.checked_minutes import CheckedMinutes
from hearthlog.analyzer.accuracy.event_counts import FEWEST as FEWEST_CHECKED
from hearthlog.analyzer.logs.recorder_info import Trouble
from hearthlog.analyzer.report.baseline import DAYS, FEWEST, Usual, compared, usual
from hearthlog.analyzer.report.daily_metrics import Day
from hearthlog.analyzer.report.scenario_minutes import ScenarioMinutes
from hearthlog.analyzer.report.sections import Figure
from hearthlog.analyzer.report.values import Clock, Count, Minutes, Value
from hearthlog.analyzer.routine.day_anomaly import DayAnomaly
from hearthlog.models.classes import SILENCE, UNKNOWN
from hearthlog.schemas.errors import listed

_CHANGES = {
    (Clock, 1): "later",
    (Clock, -1): "earlier",
    (Minutes, 1): "longer",
    (Minutes, -1): "shorter",
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
    days: Sequence[Day]  # one, or seven
    before: Sequence[Day]  # the days before them that belong to what is asked about three days
    earlier: Sequence[Day]  # those that they are compared with
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

    def baseline(self, figure: Figure) -> tuple[Usual, Value] | None:
        """Return what is usual, and a value that can write it; None if there are too few days.

        Returns
        -------
        (Usual, Value) or None
            Of the earlier days of which most was heard; None if fewer than seven of them know the
            figure.
        """
        days = [day for day in self.earlier if day.comparable(figure.name)]
        values = [value for day in days if (value := figure.value(day)) is not None]
        baseline = usual(values)
        return None if baseline is None else (baseline, values[0])

    def usually(self, figure: Figure) -> str:
        """Say what is usual: `4 (3 to 6)`.

        Returns
        -------
        str
            Empty if there are too few days.
        """
        baseline = self.baseline(figure)
        return "" if baseline is None else baseline[1].spread(*baseline[0])

    def change(self, figure: Figure, day: Day) -> str:
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
            f"Not compared with other days: of the {DAYS} days before, {there} could be used; "
            f"{FEWEST} are needed that were heard for the most part, with their night."
        )
