"""Evaluation: scores of labelled spans against a reference, and differences of labellings."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.labelling import Labelling, NamedLabelling
from hearthlog.analyzer.logs.spans import (
    EVENT_PAUSE,
    Overlay,
    Spans,
    concatenated_ranges,
    intersection,
    intersection_rows,
    joined,
    overlay,
)
from hearthlog.schemas.arrays import Bool, Float64, Indices, Int64
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS

COLLAR = NANOSECONDS // 5
_PART_OF_LENGTH = 0.5
DAY = 86_400 * NANOSECONDS
_MOST_PAIRS = 20_000_000


@dataclass(frozen=True)
class Events:
    """Labelled spans; those of different labels may overlap."""

    starts: Int64  # shape (n,), nanoseconds; every end is after its start
    ends: Int64
    labels: Int64  # shape (n,), indices of classes

    def __len__(self) -> int:
        return len(self.starts)

    def of(self, label: int) -> "Events":
        """Return the spans of one label."""
        return self.select(np.flatnonzero(self.labels == label))

    def select(self, rows: Indices | Bool) -> "Events":
        """Return a selection of the spans, by mask, or by row numbers in their new order."""
        return Events(self.starts[rows], self.ends[rows], self.labels[rows])


def indexed_events(labelling: Labelling, classes: Sequence[str]) -> Events:
    """Return the spans of a labelling, with labels as indices."""
    indices = {name: i for i, name in enumerate(classes)}
    labels = np.fromiter(map(indices.__getitem__, labelling.labels), np.int64, len(labelling))
    return Events(labelling.starts, labelling.ends, labels)


@dataclass(frozen=True)
class Detection:
    """Detection scores; None where undefined."""

    precision: float | None
    recall: float | None
    f1: float | None
    reference: int  # seconds, or events, of the reference
    found: int  # those of the prediction


@dataclass(frozen=True)
class DetectionScores:
    """Detection scores of the classes."""

    f1: float | None  # micro-average over all classes
    precision: float | None
    recall: float | None
    macro_f1: float | None  # mean over the classes of the reference
    per_class: dict[str, Detection]


@dataclass(frozen=True)
class Detections:
    """Detection of events in an evaluated time."""

    segment_based: DetectionScores
    event_based: DetectionScores
    # per 24 hours: events that overlap no event of their class in the reference
    false_alarms_per_day: dict[str, float]


def detect(
    reference: Events, predicted: Events, classes: Sequence[str], duration: int
) -> Detections:
    """Score events, as from `laid_out`, by the second and by the event, and count false alarms.

    `duration` is the evaluated time in nanoseconds. The scores are those of sed_eval, on arrays: a
    day of labels has too many spans for a loop. Raise `DataError` if too many events start together
    for a labelling.
    """
    return Detections(
        segment_based(reference, predicted, classes),
        event_based(reference, predicted, classes),
        false_alarms_per_day(reference, predicted, classes, duration),
    )


def laid_out(events: Events, spans: Spans) -> Events:
    """Clip events to spans, and place the spans one after the other as recordings, from 0 ns on.

    Every span starts on a full second, at least one second after the end of the previous span, so
    that events of different spans are never compared. The order is that of `events`; an event may
    be split into several pieces.
    """
    seconds = -((spans.starts - spans.ends) // NANOSECONDS) + 1
    places = (np.cumsum(seconds) - seconds) * NANOSECONDS
    parts, event, span = intersection_rows(events, spans)
    shift = (places - spans.starts)[span]
    return Events(parts.starts + shift, parts.ends + shift, events.labels[event])


def segment_based(reference: Events, predicted: Events, classes: Sequence[str]) -> DetectionScores:
    """Score by the second: a class is active in each second that one of its events touches.

    Events are as from `laid_out`. These are the segment-based metrics of Mesaros et al., "Metrics
    for Polyphonic Sound Event Detection", 2016, with segments of one second.
    """
    counts = []
    for label in range(len(classes)):
        true, own = _seconds(reference.of(label)), _seconds(predicted.of(label))
        counts.append((intersection(true, own).length, true.length, own.length))
    return _scores(counts, classes)


def _seconds(events: Events) -> Spans:
    """Return the full seconds that events touch."""
    return joined(events.starts // NANOSECONDS, -(-events.ends // NANOSECONDS))


def event_based(reference: Events, predicted: Events, classes: Sequence[str]) -> DetectionScores:
    """Score by the event; each event is matched with at most one other.

    Events are as from `laid_out`. These are the event-based metrics of Mesaros et al. (2016). Two
    events match if their onsets are at most 0.2 s apart, and their offsets at most 0.2 s or half
    the length of the reference's, whichever is more. As many as possible are matched. Raise
    `DataError` if too many events start together for a labelling.
    """
    counts = []
    for label in range(len(classes)):
        true, own = reference.of(label), predicted.of(label)
        counts.append((_matches(true, own), len(true), len(own)))
    return _scores(counts, classes)


def _matches(reference: Events, predicted: Events) -> int:
    """Size of the largest matching."""
    predicted = predicted.select(np.argsort(predicted.starts, kind="stable"))
    first = np.searchsorted(predicted.starts, reference.starts - COLLAR, "left")
    count = np.searchsorted(predicted.starts, reference.starts + COLLAR, "right") - first
    if count.sum() > _MOST_PAIRS:
        raise DataError("too many events start within 0.2 s of each other; this is no labelling")
    from scipy.sparse import coo_array  # noqa: PLC0415  which most readers of events do without
    from scipy.sparse.csgraph import maximum_bipartite_matching  # noqa: PLC0415

    row, column = concatenated_ranges(first, count)
    tolerance = np.maximum(COLLAR, _PART_OF_LENGTH * (reference.ends - reference.starts))
    near = np.abs(reference.ends[row] - predicted.ends[column]) <= tolerance[row]
    if not near.any():
        return 0
    shape = len(reference), len(predicted)
    hits = coo_array((np.ones(near.sum(), np.int8), (row[near], column[near])), shape)
    return int((maximum_bipartite_matching(hits.tocsr()) >= 0).sum())


def false_alarms_per_day(
    reference: Events, predicted: Events, classes: Sequence[str], duration: int
) -> dict[str, float]:
    """Count predicted events that overlap no event of their class in the reference, by class.

    Counts are per 24 hours of `duration`, the evaluated time in nanoseconds, more than 0. Events
    are as from `laid_out`.
    """
    alarms = (_false_alarms(reference.of(i), predicted.of(i)) for i in range(len(classes)))
    return {name: n * DAY / duration for name, n in zip(classes, alarms, strict=True)}


def _false_alarms(reference: Events, predicted: Events) -> int:
    starts, ends = joined(reference.starts, reference.ends)
    before = np.searchsorted(starts, predicted.ends, "left")
    reached = np.concatenate([[np.iinfo(np.int64).min], ends])[before]
    return int((reached <= predicted.starts).sum())


def _scores(counts: list[tuple[int, int, int]], classes: Sequence[str]) -> DetectionScores:
    """Return scores from (correct, in the reference, predicted) for each class."""
    right, reference, predicted = np.sum(counts, axis=0).tolist()
    every = _detection(right, reference, predicted)
    per_class = {name: _detection(*c) for name, c in zip(classes, counts, strict=True)}
    f1_scores = [d.f1 for d in per_class.values() if d.f1 is not None]
    macro = float(np.mean(f1_scores)) if f1_scores else None
    return DetectionScores(every.f1, every.precision, every.recall, macro, per_class)


def _detection(right: int, reference: int, predicted: int) -> Detection:
    return Detection(
        precision=right / predicted if predicted else None,
        recall=right / reference if reference else None,
        f1=2 * right / (reference + predicted) if reference else None,
        reference=reference,
        found=predicted,
    )


_MINUTE = 60 * NANOSECONDS


class LabelRuns(NamedTuple):
    """Runs of time with constant labels on both sides."""

    starts: Int64  # shape (n,)
    ends: Int64
    a: Int64  # shape (n,), indices of classes
    b: Int64

    def select(self, which: Bool | Indices) -> "LabelRuns":
        """Return a selection of the runs, by mask, or by row numbers in their new order."""
        return LabelRuns(*(column[which] for column in self))


@dataclass(frozen=True)
class ClassAmounts:
    """Amounts of a class on each side, in the time that both label."""

    minutes_a: float
    minutes_b: float
    minutes_both: float  # both sides have this class
    events_a: int  # segments with pauses of at most ten seconds between them are one
    events_b: int


@dataclass(frozen=True)
class Amounts:
    """Agreement in the time that both label."""

    minutes: float
    agreement: float  # share of time with the same label
    kappa: float | None  # Cohen's; None if both have the same single class throughout
    per_class: dict[str, ClassAmounts]  # of the classes that occur


@dataclass(frozen=True)
class LabellingDifference:
    """Comparison of two labellings."""

    a: str  # name of the first labelling
    b: str
    minutes_a: float  # labelled by the first
    minutes_b: float
    only_a: list[str]  # classes that the other lacks
    only_b: list[str]
    classes: list[str]
    total: Amounts
    confusion: list[list[float]]  # minutes; the classes of a in rows, those of b in columns
    days: dict[str, Amounts]  # by UTC day; an event belongs to the day of its start
    disagreements: LabelRuns  # where they differ, longest first


def compare_labellings(a: NamedLabelling, b: NamedLabelling) -> LabellingDifference:
    """Compare two labellings where both have a label, with Cohen's kappa.

    Synonyms in b (see `hearthlog.models.classes`) take the names of a. Classes of a come first,
    then classes only in b. Raise `DataError` if they have no time in common.
    """
    b = b.called_as(a.classes)
    classes = list(dict.fromkeys([*a.classes, *b.classes]))
    events = [indexed_events(side.labelling, classes) for side in (a, b)]
    pieces = overlay(events, DAY).in_all()
    if not len(pieces.starts):
        raise DataError(f"{a.name} and {b.name} have no time in common")
    counts = _Counts(pieces, events, len(classes))
    runs = runs_of(pieces, *events)
    differing = runs.select(runs.a != runs.b)
    return LabellingDifference(
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
        disagreements=differing.select(
            np.argsort(differing.starts - differing.ends, kind="stable")
        ),
    )


def runs_of(pieces: Overlay, a: Events, b: Events) -> LabelRuns:
    """Merge successive pieces of two labellings with the same pair of labels.

    The pieces, at least one, are of `a` and `b`, where both have a span; those of a run may be a
    frame apart. Labels are indices of the same classes.
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
        self._events = [self._count_events(pieces, label) for label in labels]

    def _count_events(self, pieces: Overlay, labels: Int64) -> Float64:
        counts = np.zeros((len(self.days), self._classes))
        for label in np.unique(labels).tolist():
            own = labels == label
            events = joined(pieces.starts[own], pieces.ends[own], EVENT_PAUSE)
            day = np.searchsorted(self.days, events.starts // DAY)
            counts[:, label] = np.bincount(day, minlength=len(self.days))
        return counts

    def confusion(self) -> Float64:
        """Minutes of each pair of classes."""
        a, b = self._labels
        return _added(a, b, self._lengths, (self._classes, self._classes)) / _MINUTE

    def amounts(self, classes: Sequence[str], days: int | slice) -> Amounts:
        """Return the totals of one day, or of all days."""
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


def _added(row: Int64, column: Int64, weight: Int64, shape: tuple[int, int]) -> Float64:
    """Sum weights into a table."""
    places = row * shape[1] + column
    return np.bincount(places, weight, shape[0] * shape[1]).astype(np.float64).reshape(shape)


def _minutes(events: Events) -> float:
    return float((events.ends - events.starts).sum() / _MINUTE)
