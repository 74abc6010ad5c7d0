"""Minutes that were drawn at random and gone through: what labels say in them, and what is true."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.special import betaincinv

from hearthlog.analyzer.accuracy.count_range import FEWEST, CheckedRates, checked_rates
from hearthlog.analyzer.accuracy.events import (
    AROUND,
    MINUTE,
    SET_APART,
    events_by_minute,
    events_of,
    overlapping,
    sounding_minutes,
    television_minutes,
)
from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.home_logs import HomeLog, HomeLogs
from hearthlog.analyzer.logs.labelling import Labelling, overlaid, unified
from hearthlog.analyzer.logs.labellings import find_labellings
from hearthlog.analyzer.logs.layers import latest_records
from hearthlog.analyzer.logs.spans import Spans, cut, overlay
from hearthlog.analyzer.marks.marks import RANDOM, Mark, ReviewedSpan, read_marks, read_reviewed
from hearthlog.models.classes import SILENCE, UNKNOWN, class_name
from hearthlog.schemas.arrays import Bool, Int64
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.files import REVIEW_LAYER, log_of_layer
from hearthlog.schemas.messages.topics import LIVE, relabelling

_AROUND = AROUND * MINUTE
_EVER = 1 << 62
_FOLLOWING = 3  # logs: a segment is in the one in which it ends


class ClassCheck(NamedTuple):
    """How right the labels of a class were in the checked minutes.

    Attributes
    ----------
    labelled, right : int
        Labelled events, and those with a part that is true.
    true, missed : int
        True events, and those of which no part was labelled.
    """

    labelled: int
    right: int
    true: int
    missed: int

    @property
    def precision(self) -> tuple[float, float] | None:
        """Where the share of right ones lies nine times in ten; None if nothing was labelled."""
        return _interval(self.right, self.labelled)

    @property
    def miss_rate(self) -> tuple[float, float] | None:
        """Where the share of missed ones lies nine times in ten; None if there was nothing."""
        return _interval(self.missed, self.true)


def _interval(some: int, whole: int) -> tuple[float, float] | None:
    """Return the central 90 % of a beta distribution, with the prior of Jeffreys."""
    if not whole:
        return None
    low, high = betaincinv(some + 0.5, whole - some + 0.5, (0.05, 0.95)).tolist()
    return low, high


@dataclass(frozen=True, eq=False)
class CheckedMinutes:
    """Events of each class in minutes that were drawn at random and gone through.

    Attributes
    ----------
    said, right, true, missed : dict of str to np.ndarray [shape=(n,)], int64
        By class, of the events that begin in each minute: labelled ones, those of them that have a
        part that is true, true ones, and those of them of which nothing was labelled.
    sounding, television : np.ndarray [shape=(n,)], bool
        Whether anything sounds, and whether it sounds like a television, by the labels.
    models : list of str
        SHA-256 of the model that labelled each minute; empty if unknown.
    """

    said: dict[str, Int64]
    right: dict[str, Int64]
    true: dict[str, Int64]
    missed: dict[str, Int64]
    sounding: Bool
    television: Bool
    models: list[str]

    def __len__(self) -> int:
        return len(self.models)

    def of_model(self, model: str) -> "CheckedMinutes":
        """Return the minutes that a model labelled; all of them if they are too few.

        Parameters
        ----------
        model : str
            SHA-256 of its file.
        """
        rows = np.flatnonzero([each == model for each in self.models])
        if len(rows) < FEWEST:
            return self
        columns = (self.said, self.right, self.true, self.missed)
        said, right, true, missed = (
            {name: counts[rows] for name, counts in column.items()} for column in columns
        )
        return CheckedMinutes(
            said,
            right,
            true,
            missed,
            self.sounding[rows],
            self.television[rows],
            [self.models[row] for row in rows.tolist()],
        )

    def check(self, name: str) -> ClassCheck:
        """Return how right the labels of a class were.

        Parameters
        ----------
        name : str
            Of the class.
        """
        kept = self._kept(name)
        columns = (self.said, self.right, self.true, self.missed)
        return ClassCheck(*(int(column[name][kept].sum()) if name in column else 0
                            for column in columns))  # fmt: skip

    def rates(self, name: str, share: float) -> CheckedRates | None:
        """Return the rates of a class; None if too few minutes were checked.

        Parameters
        ----------
        name : str
            Of the class.
        share : float
            Of the class among all labelled events, 0 to 1.
        """
        kept = self._kept(name)
        none = np.zeros(len(self), np.int64)
        said, true = self.said.get(name, none), self.true.get(name, none)
        return checked_rates(said[kept], true[kept], self.sounding[kept], share)

    def _kept(self, name: str) -> Bool:
        return ~self.television if name in SET_APART else np.ones(len(self), bool)


class _Reviewed(NamedTuple):
    """A reviewed span, with the labels around it."""

    span: ReviewedSpan
    said: Labelling
    true: Labelling
    model: str


def read_checked_minutes(
    logs: HomeLogs, labelling: str, start: int, end: int, losses: list[str]
) -> CheckedMinutes:
    """Read the minutes that were drawn at random, and gone through by a person.

    What is true of them are the labels that were looked at, overlaid with the marks.

    Parameters
    ----------
    logs : HomeLogs
    labelling : str
        `live`, or the name of the model of relabel layers.
    start, end : int
        Nanoseconds of UTC: minutes that begin before or end after them are left out.
    losses : list of str
        What cannot be read is appended.
    """
    spans = [
        reviewed
        for layer in logs.between(start, end, REVIEW_LAYER)
        for reviewed in _reviewed(logs, layer, labelling, losses)
        if reviewed.span.chosen == RANDOM and start <= reviewed.span.start < end
    ]
    return _counted(spans)


def read_looked_at(logs: HomeLogs, labelling: str, losses: list[str]) -> tuple[int, int]:
    """Count the spans that a person has looked at, but not because they were drawn at random.

    Parameters
    ----------
    logs : HomeLogs
    labelling : str
        `live`, or the name of the model of relabel layers.
    losses : list of str
        What cannot be read is appended.

    Returns
    -------
    right, number : int
        Spans that marks change in less than half, and all.
    """
    spans = [
        reviewed
        for layer in logs.between(0, _EVER, REVIEW_LAYER)
        for reviewed in _reviewed(logs, layer, labelling, losses)
        if reviewed.span.chosen != RANDOM
    ]
    return sum(2 * _changed(one) < one.span.end - one.span.start for one in spans), len(spans)


def _changed(reviewed: _Reviewed) -> int:
    """Measure for how long another label is true in a span than was labelled."""
    parts = overlay([reviewed.said, reviewed.true]).in_all()
    said, true = reviewed.said.labels[parts.rows[0]], reviewed.true.labels[parts.rows[1]]
    differs = said != true
    spans = Spans(parts.starts[differs], parts.ends[differs])
    return cut(spans, reviewed.span.start, reviewed.span.end).length


def _reviewed(
    logs: HomeLogs, layer: HomeLog, labelling: str, losses: list[str]
) -> Iterator[_Reviewed]:
    try:
        yield from _read(logs, log_of_layer(layer.path), labelling)
    except (DataError, LogError) as error:
        if str(error) not in losses:
            losses.append(str(error))


def _read(logs: HomeLogs, log: Path, labelling: str) -> Iterator[_Reviewed]:
    spans = [span for span in read_reviewed(log) if span.corrects == labelling]
    if not spans:
        return
    near = [e.path for e in logs.between(spans[0].start - _AROUND, max(s.end for s in spans))]
    later = [e.path for e in logs.between(spans[0].start, _EVER)][:_FOLLOWING]
    near = [path for path in dict.fromkeys([*near, *later]) if path.exists()]
    sources = find_labellings(*near)
    name = labelling if labelling == LIVE else relabelling(labelling)
    model = next(latest_records([log]), {}).get("model_sha256", "")
    marks = [mark for path in near for mark in _marks(path)]
    for span in spans:
        with suppress(LogError):  # nothing is labelled there
            around = span.start - _AROUND, span.end + _AROUND
            said = unified(sources.read(span.microphone, name, *around).labelling)
            own = marks_of(
                mark
                for mark in marks
                if mark.microphone == span.microphone and class_name(mark.label) != UNKNOWN
            )
            yield _Reviewed(span, said, overlaid(said, own), model)


def _marks(log: Path) -> list[Mark]:
    with suppress(LogError):
        return read_marks(log)
    return []


def marks_of(marks: Iterable[Mark]) -> Labelling:
    """Make a labelling of marks of one microphone.

    Parameters
    ----------
    marks : iterable of Mark
        In any order.
    """
    ordered = sorted(marks)
    return Labelling(
        np.array([mark.start for mark in ordered], np.int64),
        np.array([mark.end for mark in ordered], np.int64),
        np.array([class_name(mark.label) for mark in ordered], object),
    )


def _counted(minutes: Sequence[_Reviewed]) -> CheckedMinutes:
    names = {name for one in minutes for part in (one.said, one.true) for name in set(part.labels)}
    counts = {
        name: np.array([_events(minute, name) for minute in minutes], np.int64).T
        for name in sorted(names - {SILENCE})
    }
    said, right, true, missed = ({name: rows[i] for name, rows in counts.items()} for i in range(4))
    edges = [np.array([one.span.start, one.span.end]) for one in minutes]
    sounding = [bool(sounding_minutes(m.said, e)[0]) for m, e in zip(minutes, edges, strict=True)]
    return CheckedMinutes(
        said,
        right,
        true,
        missed,
        np.array(sounding, bool),
        np.array([_like_television(minute) for minute in minutes], bool),
        [minute.model for minute in minutes],
    )


def _like_television(minute: _Reviewed) -> bool:
    first = minute.span.start - _AROUND
    edges = np.arange(first, first + (2 * AROUND + 2) * MINUTE, MINUTE)
    return bool(television_minutes(minute.said, edges)[AROUND])


def _events(minute: _Reviewed, name: str) -> tuple[int, int, int, int]:
    """Count the events that begin in a minute: labelled, right, true and missed ones."""
    edges = np.array([minute.span.start, minute.span.end])
    said, true = events_of(minute.said, name), events_of(minute.true, name)
    right, found = overlapping(said, true), overlapping(true, said)
    counts = (
        events_by_minute(said, edges),
        events_by_minute(_rows(said, right), edges),
        events_by_minute(true, edges),
        events_by_minute(_rows(true, ~found), edges),
    )
    labelled, good, there, unheard = (int(count[0]) for count in counts)
    return labelled, good, there, unheard


def _rows(spans: Spans, which: Bool) -> Spans:
    return Spans(spans.starts[which], spans.ends[which])
