"""Where two labellings agree, and where they do not: counted from segments, not frame by frame."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.evaluation.event_scores import Events, events_of
from hearthlog.analyzer.logs.labelling import NamedLabelling
from hearthlog.analyzer.logs.spans import Overlay, overlay
from hearthlog.schemas.arrays import Float64, Int64
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS

DAY = 86_400 * NANOSECONDS
_MINUTE = 60 * NANOSECONDS


class LabelRuns(NamedTuple):
    """Time in which both labels stay what they are."""

    starts: Int64  # shape (n,)
    ends: Int64
    a: Int64  # shape (n,), indices of classes
    b: Int64

    def taken(self, which: NDArray[np.bool_] | NDArray[np.intp]) -> "LabelRuns":
        """Return some of the runs.

        Parameters
        ----------
        which : np.ndarray, bool [shape=(n,)] or int [shape=(m,)]
            Whether each is taken, or the rows of those that are, in their new order.
        """
        return LabelRuns(*(column[which] for column in self))


@dataclass(frozen=True)
class ClassAmounts:
    """How much of a class each side has in the time that both label."""

    minutes_a: float
    minutes_b: float
    minutes_both: float  # where both sides have it
    events_a: int  # segments
    events_b: int


@dataclass(frozen=True)
class Amounts:
    """Agreement in some time that both label."""

    minutes: float
    agreement: float  # share of it in which both say the same
    kappa: float | None  # Cohen's; None where both say the same single class throughout
    per_class: dict[str, ClassAmounts]  # of the classes that occur


@dataclass(frozen=True)
class Difference:
    """Two labellings compared."""

    a: str  # name of the first labelling
    b: str
    minutes_a: float  # what the first labels
    minutes_b: float
    only_a: list[str]  # classes that the other does not know
    only_b: list[str]
    classes: list[str]
    total: Amounts
    confusion: list[list[float]]  # minutes; the classes of a in rows, those of b in columns
    days: dict[str, Amounts]  # by UTC day; an event belongs to the day it begins in
    disagreements: LabelRuns  # where they differ, longest first


def compare_labellings(a: NamedLabelling, b: NamedLabelling) -> Difference:
    """Compare two labellings where both have a label.

    What b has by another name (see `hearthlog.models.classes`) is called as a calls it.

    Returns
    -------
    Difference
        With Cohen's kappa; the classes are those of a, then those that only b has.

    Raises
    ------
    DataError
        If they have no time in common.
    """
    b = b.called_as(a.classes)
    classes = list(dict.fromkeys([*a.classes, *b.classes]))
    events = [events_of(side.labelling, classes) for side in (a, b)]
    pieces = overlay(events, DAY).in_all()
    if not len(pieces.starts):
        raise DataError(f"{a.name} and {b.name} have no time in common")
    counts = _Counts(pieces, events, len(classes))
    runs = runs_of(pieces, *events)
    differing = runs.taken(runs.a != runs.b)
    return Difference(
        a=a.name,
        b=b.name,
        minutes_a=_minutes(events[0]),
        minutes_b=_minutes(events[1]),
        only_a=[name for name in a.classes if name not in b.classes],
        only_b=[name for name in b.classes if name not in a.classes],
        classes=classes,
        total=counts.amounts(classes, slice(None)),
        confusion=counts.confusion().tolist(),
        days={
            str(np.datetime64(day, "D")): counts.amounts(classes, i)
            for i, day in enumerate(counts.days.tolist())
        },
        disagreements=differing.taken(np.argsort(differing.starts - differing.ends, kind="stable")),
    )


def runs_of(pieces: Overlay, a: Events, b: Events) -> LabelRuns:
    """Join successive pieces of two labellings while both labels stay the same.

    Parameters
    ----------
    pieces : Overlay
        Of `a` and `b`, where both have a span; at least one piece. Pieces of a run may be a frame
        apart.
    a, b : Events
        The spans behind its rows, labels as indices of the same classes.
    """
    label_a, label_b = a.labels[pieces.rows[0]], b.labels[pieces.rows[1]]
    new = np.ones(len(pieces.starts), bool)
    new[1:] = (
        (label_a[1:] != label_a[:-1])
        | (label_b[1:] != label_b[:-1])
        | (pieces.starts[1:] - pieces.ends[:-1] > FRAME_NANOSECONDS)
    )
    last = np.append(new[1:], True)
    return LabelRuns(pieces.starts[new], pieces.ends[last], label_a[new], label_b[new])


class _Counts:
    """Nanoseconds and events by day and class."""

    def __init__(self, pieces: Overlay, events: Sequence[Events], classes: int) -> None:
        self.days, day = np.unique(pieces.starts // DAY, return_inverse=True)
        labels = [e.labels[rows] for e, rows in zip(events, pieces.rows, strict=True)]
        self._labels, self._lengths, self._classes = labels, pieces.ends - pieces.starts, classes
        shape = len(self.days), classes
        self._minutes = [_added(day, label, self._lengths, shape) for label in labels]
        same = labels[0] == labels[1]
        self._both = _added(day[same], labels[0][same], self._lengths[same], shape)
        self._events = []
        for label, rows in zip(labels, pieces.rows, strict=True):
            _, first = np.unique(rows, return_index=True)
            self._events.append(_added(day[first], label[first], None, shape))

    def confusion(self) -> Float64:
        """Minutes of each pair of classes."""
        a, b = self._labels
        return _added(a, b, self._lengths, (self._classes, self._classes)) / _MINUTE

    def amounts(self, classes: Sequence[str], days: int | slice) -> Amounts:
        """Sum up a day, or all of them."""
        a, b, both, events_a, events_b = (
            np.atleast_2d(table[days]).sum(axis=0)
            for table in (*self._minutes, self._both, *self._events)
        )
        total = a.sum()
        agreement, chance = both.sum() / total, (a / total) @ (b / total)
        columns = (
            a / _MINUTE,
            b / _MINUTE,
            both / _MINUTE,
            events_a.astype(int),
            events_b.astype(int),
        )
        rows = zip(classes, *(column.tolist() for column in columns), strict=True)
        return Amounts(
            minutes=float(total / _MINUTE),
            agreement=float(agreement),
            kappa=float((agreement - chance) / (1.0 - chance)) if chance < 1.0 else None,
            per_class={name: ClassAmounts(*row) for name, *row in rows if row[0] or row[1]},
        )


def _added(row: Int64, column: Int64, weight: Int64 | None, shape: tuple[int, int]) -> Float64:
    """Add up weights, or count, in a table."""
    places = row * shape[1] + column
    return np.bincount(places, weight, shape[0] * shape[1]).astype(np.float64).reshape(shape)


def _minutes(events: Events) -> float:
    return float((events.ends - events.starts).sum() / _MINUTE)
