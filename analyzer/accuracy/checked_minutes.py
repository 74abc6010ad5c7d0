"""Minutes that were drawn at random and gone through: what labels say in them, and what is true."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.accuracy.count_range import (
    FEWEST,
    CheckedRates,
    beta_quantile,
    checked_rates,
)
from hearthlog.analyzer.accuracy.events import (
    AROUND,
    MINUTE,
    SET_APART,
    events_of,
    overlapping,
    sounding_minutes,
    television_minutes,
)
from hearthlog.analyzer.accuracy.reviewed_labels import ReviewedLabels, read_reviewed_labels
from hearthlog.analyzer.logs.home_logs import HomeLogs
from hearthlog.analyzer.logs.spans import Spans, cut, without
from hearthlog.analyzer.marks.marks import RANDOM
from hearthlog.models.classes import SILENCE
from hearthlog.schemas.arrays import Bool, Int64

_AROUND = AROUND * MINUTE


class ClassCheck(NamedTuple):
    """How right the labels of a class were in the checked minutes.

    Attributes
    ----------
    in_quiet : int
        Of the missed ones, those in minutes in which nothing sounds by the labels.
    """

    labelled: int
    right: int
    true: int
    missed: int
    in_quiet: int = 0

    @property
    def precision(self) -> tuple[float, float] | None:
        """Where the share of right ones lies nine times in ten; None if nothing was labelled.

        Every labelled event is in a minute with sound, and of those all are drawn alike.
        """
        return _interval(self.right, self.labelled)

    def miss_rate(self, weight: float) -> tuple[float, float] | None:
        """Return where the share of missed ones lies nine times in ten; None of no true event.

        Parameters
        ----------
        weight : float
            Of a quiet minute, as of `quiet_weight`.
        """
        if not self.true:
            return None
        more, squares = (weight - 1) * self.in_quiet, (weight**2 - 1) * self.in_quiet
        effective = (self.true + more) ** 2 / (self.true + squares)  # size, as Kish defines it
        return _interval(effective * (self.missed + more) / (self.true + more), effective)


def _interval(some: float, whole: float) -> tuple[float, float] | None:
    """Return the central 90 % of a beta distribution, with the prior of Jeffreys."""
    if not whole:
        return None
    low, high = (beta_quantile(some + 0.5, whole - some + 0.5, share) for share in (0.05, 0.95))
    return low, high


@dataclass(frozen=True, eq=False)
class CheckedMinutes:
    """Events of each class in minutes that were drawn at random and gone through.

    Attributes
    ----------
    labelled, right, true, missed : dict of str to np.ndarray [shape=(n,)], int64
        By class, of the events that begin in each minute: labelled ones, those of them that have a
        part in it that is true, true ones, and those of them of which nothing in it was labelled.
    sounding, television : np.ndarray [shape=(n,)], bool
        Whether anything sounds, and whether it sounds like a television, by the labels.
    models : list of str
        SHA-256 of the model that labelled each minute; empty if unknown.
    """

    labelled: dict[str, Int64]
    right: dict[str, Int64]
    true: dict[str, Int64]
    missed: dict[str, Int64]
    sounding: Bool
    television: Bool
    models: list[str]

    def __len__(self) -> int:
        return len(self.models)

    def of_model(self, model: str) -> "CheckedMinutes":
        """Return the minutes that a model labelled; all of them if they are too few."""
        rows = np.flatnonzero([each == model for each in self.models])
        if len(rows) < FEWEST:
            return self
        columns = (self.labelled, self.right, self.true, self.missed)
        labelled, right, true, missed = (
            {name: counts[rows] for name, counts in column.items()} for column in columns
        )
        return CheckedMinutes(
            labelled,
            right,
            true,
            missed,
            self.sounding[rows],
            self.television[rows],
            [self.models[row] for row in rows.tolist()],
        )

    def check(self, name: str) -> ClassCheck:
        """Return how right the labels of a class were."""
        kept = self._kept(name)
        columns = (self.labelled, self.right, self.true, self.missed)
        none = np.zeros(len(self), np.int64)
        labelled, right, true, missed = (column.get(name, none)[kept] for column in columns)
        sums = (labelled, right, true, missed, missed[~self.sounding[kept]])
        return ClassCheck(*(int(counts.sum()) for counts in sums))

    def rates(self, name: str, share: float) -> CheckedRates | None:
        """Return the rates of a class; None if too few minutes were checked.

        Parameters
        ----------
        share : float
            Of the class among all labelled events, 0 to 1.
        """
        kept = self._kept(name)
        none = np.zeros(len(self), np.int64)
        labelled, true = self.labelled.get(name, none), self.true.get(name, none)
        return checked_rates(labelled[kept], true[kept], self.sounding[kept], share)

    def _kept(self, name: str) -> Bool:
        return ~self.television if name in SET_APART else np.ones(len(self), bool)


def read_checked_minutes(
    logs: HomeLogs, labelling: str, start: int, end: int, losses: list[str]
) -> CheckedMinutes:
    """Read the minutes that were drawn at random, and gone through by a person.

    What is true of them are the labels that were looked at, overlaid with the marks.

    Parameters
    ----------
    start, end : int
        Nanoseconds of UTC: minutes that begin before or end after them are left out.
    """
    reviewed = read_reviewed_labels(logs, labelling, start, end, losses, {RANDOM})
    return checked_minutes(one for one in reviewed if start <= one.span.start < end)


def checked_minutes(reviewed: Iterable[ReviewedLabels]) -> CheckedMinutes:
    """Count the events of the minutes that were drawn at random, and gone through by a person."""
    minutes = [one for one in reviewed if one.span.chosen == RANDOM]
    names = {
        name for one in minutes for part in (one.labels, one.true) for name in set(part.labels)
    }
    counts = {
        name: np.array([_events(minute, name) for minute in minutes], np.int64).T
        for name in sorted(names - {SILENCE})
    }
    labelled, right, true, missed = (
        {name: rows[i] for name, rows in counts.items()} for i in range(4)
    )
    edges = [np.array([one.span.start, one.span.end]) for one in minutes]
    sounding = [bool(sounding_minutes(m.labels, e)[0]) for m, e in zip(minutes, edges, strict=True)]
    return CheckedMinutes(
        labelled,
        right,
        true,
        missed,
        np.array(sounding, bool),
        np.array([_like_television(minute) for minute in minutes], bool),
        [minute.model for minute in minutes],
    )


def _like_television(minute: ReviewedLabels) -> bool:
    first = minute.span.start - _AROUND
    edges = np.arange(first, first + (2 * AROUND + 2) * MINUTE, MINUTE)
    return bool(television_minutes(minute.labels, edges)[AROUND])


def _events(minute: ReviewedLabels, name: str) -> list[int]:
    """Count the events that begin in a minute: labelled, right, true and missed ones.

    Of what outlasts the minute only the part in it was looked at, and says whether it is right.
    Where nobody could tell what sounds, no event is counted, and none makes another one right.
    """
    start, end = minute.span.start, minute.span.end
    labelled, true = events_of(minute.labels, name), events_of(minute.true, name)
    own, others = _begun(labelled, minute), _begun(true, minute)
    right = overlapping(own, without(cut(true, start, end), minute.undecided))
    found = overlapping(others, without(cut(labelled, start, end), minute.undecided))
    return [len(own.starts), int(right.sum()), len(others.starts), int((~found).sum())]


def _begun(events: Spans, minute: ReviewedLabels) -> Spans:
    """Return the events that begin in a minute, and end with it at the latest."""
    span = minute.span
    first, last = np.searchsorted(events.starts, [span.start, span.end])
    begun = Spans(events.starts[first:last], np.minimum(events.ends[first:last], span.end))
    decided = overlapping(begun, without(begun, minute.undecided))
    return Spans(begun.starts[decided], begun.ends[decided])
