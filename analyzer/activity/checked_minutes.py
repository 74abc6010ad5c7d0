"""Checked minutes: reviewed labels, and random minutes with their true events."""

from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.activity.event_counts import (
    AROUND,
    FEWEST,
    MINUTE,
    CheckedRates,
    beta_quantile,
    checked_rates,
    events_and_confidences,
    events_of,
    overlapping,
    sounding_minutes,
    television_minutes,
)
from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.hidden_classes import common_names_of
from hearthlog.analyzer.logs.home_logs import HomeLogs
from hearthlog.analyzer.logs.labelling import Labelling, find_labellings, overlaid, unified
from hearthlog.analyzer.logs.recorder_info import model_of
from hearthlog.analyzer.logs.spans import NONE, Spans, cut, difference, lengths, overlay, rows_at
from hearthlog.analyzer.marks.marks import (
    CHOICES,
    RANDOM,
    Mark,
    ReviewedSpan,
    read_marks,
    read_reviewed,
)
from hearthlog.models.classes import ON_TELEVISION, SILENCE, TELEVISION, UNKNOWN, class_name
from hearthlog.schemas.arrays import Bool, Float64, Int64
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.files import REVIEW_LAYER, log_of_layer
from hearthlog.schemas.messages.topics import LIVE, relabelling

_FOLLOWING = 3  # logs: a segment is in the one in which it ends


class ReviewedLabels(NamedTuple):
    """A reviewed span, with the labels in it and in the ten minutes before and after."""

    span: ReviewedSpan
    labels: Labelling
    true: Labelling
    model: str  # SHA-256 of the model that labelled; empty if unknown
    undecided: Spans = NONE  # the labels there are neither right nor wrong


def count_unchanged(reviewed: Iterable[ReviewedLabels]) -> tuple[int, int]:
    """Count the reviewed spans that were not drawn at random."""
    spans = [one for one in reviewed if one.span.chosen != RANDOM and not _is_undecided(one)]
    return sum(2 * _changed(one) < one.span.end - one.span.start for one in spans), len(spans)


def _is_undecided(reviewed: ReviewedLabels) -> bool:
    start, end = reviewed.span.start, reviewed.span.end
    return 2 * cut(reviewed.undecided, start, end).length >= end - start


def _changed(reviewed: ReviewedLabels) -> int:
    """Return how long the true label of a span differs from its labelling."""
    parts = overlay([reviewed.labels, reviewed.true]).in_all()
    differs = reviewed.labels.labels[parts.rows[0]] != reviewed.true.labels[parts.rows[1]]
    spans = Spans(parts.starts[differs], parts.ends[differs])
    return cut(spans, reviewed.span.start, reviewed.span.end).length


def read_reviewed_labels(  # noqa: PLR0913, PLR0917
    logs: HomeLogs,
    labelling: str,
    start: int,
    end: int,
    losses: list[str],
    chosen: Collection[str] = CHOICES,
) -> Iterator[ReviewedLabels]:
    """Read the labels of the reviewed spans in logs from start to end, in nanoseconds of UTC."""
    found: list[tuple[Path, ReviewedSpan]] = []
    for layer in logs.between(start, end, REVIEW_LAYER):
        log = log_of_layer(layer.path)
        try:
            spans = [span for span in read_reviewed(log) if span.chosen in chosen]
        except LogError as error:
            _lose(losses, error)
            continue
        found += [(log, span) for span in spans if span.corrects == labelling]
    of_log: dict[Path, list[ReviewedSpan]] = {}
    for log, span in _joined_parts(found):
        of_log.setdefault(log, []).append(span)
    for log, spans in of_log.items():
        try:
            yield from _reviewed_labels(logs, log, spans, labelling)
        except (DataError, LogError) as error:
            _lose(losses, error)


def _lose(losses: list[str], error: Exception) -> None:
    if str(error) not in losses:
        losses.append(str(error))


def _joined_parts(found: list[tuple[Path, ReviewedSpan]]) -> list[tuple[Path, ReviewedSpan]]:
    """Merge spans that were cut at the boundary of two logs."""
    merged: list[tuple[Path, ReviewedSpan]] = []
    open_: dict[ReviewedSpan, tuple[int, Path]] = {}  # index and log by continuing span
    for log, span in found:
        place, before = open_.pop(span._replace(end=0), (len(merged), log))
        if place < len(merged) and before != log and _is_one(merged[place][1], span):
            first, earlier = merged[place]
            merged[place] = first, earlier._replace(end=span.end)
        else:
            place = len(merged)
            merged.append((log, span))
        open_[span._replace(start=span.end, end=0)] = place, log
    return merged


def _is_one(before: ReviewedSpan, after: ReviewedSpan) -> bool:
    """Return whether two spans are parts of one drawn minute rather than two drawn minutes."""
    return before.chosen != RANDOM or after.end - before.start <= MINUTE


def _reviewed_labels(
    logs: HomeLogs, log: Path, spans: list[ReviewedSpan], labelling: str
) -> Iterator[ReviewedLabels]:
    start, end = spans[0].start, max(span.end for span in spans)
    around = [*logs.between(start - AROUND * MINUTE, end), *logs.between(start)[:_FOLLOWING]]
    near = [path for path in dict.fromkeys(entry.path for entry in around) if path.exists()]
    sources = find_labellings(*near)
    name = labelling if labelling == LIVE else relabelling(labelling)
    models = {name: model_of(log, name) for name in {span.microphone for span in spans}}
    marks = [mark for path in near for mark in _marks(path)]
    for span in spans:
        with suppress(LogError):  # no labels there
            first, last = span.start - AROUND * MINUTE, span.end + AROUND * MINUTE
            labels = unified(sources.read(span.microphone, name, first, last).labelling)
            own = labelling_of_marks(mark for mark in marks if mark.microphone == span.microphone)
            names = common_names_of(log, [*labels.labels, *own.labels])
            labels = labels.renamed(names)
            decided = own.rows(own.labels != UNKNOWN).renamed(names)
            rest = own.rows(own.labels == UNKNOWN)
            yield ReviewedLabels(
                span,
                labels,
                overlaid(labels, decided),
                models[span.microphone].model_sha256,
                rest.spans(),
            )


def _marks(log: Path) -> list[Mark]:
    with suppress(LogError):
        return read_marks(log)
    return []


def labelling_of_marks(marks: Iterable[Mark]) -> Labelling:
    """Convert marks of one microphone to a labelling."""
    ordered = sorted(marks)
    return Labelling(
        np.array([mark.start for mark in ordered], np.int64),
        np.array([mark.end for mark in ordered], np.int64),
        np.array([class_name(mark.label) for mark in ordered], object),
    )


class ClassCheck(NamedTuple):
    """Counts of correct and missed events of a class in the checked minutes."""

    labelled: int
    right: int
    true: int
    missed: int
    in_quiet: int = 0  # missed events in minutes labelled as silent

    @property
    def precision(self) -> tuple[float, float] | None:
        """90 % interval of the precision; None without a labelled event.

        Every labelled event is in a minute with sound, and all such minutes are equally likely to
        be drawn.
        """
        return _interval(self.right, self.labelled)

    def miss_rate(self, weight: float) -> tuple[float, float] | None:
        """Return the 90 % interval of the miss rate; None without a true event.

        The weight of a quiet minute is from `quiet_weight`.
        """
        if not self.true:
            return None
        more, squares = (weight - 1) * self.in_quiet, (weight**2 - 1) * self.in_quiet
        effective = (self.true + more) ** 2 / (self.true + squares)  # Kish's effective sample size
        return _interval(effective * (self.missed + more) / (self.true + more), effective)


def _interval(some: float, total: float) -> tuple[float, float] | None:
    """Return the central 90 % of a beta distribution with Jeffreys prior."""
    if not total:
        return None
    low, high = (beta_quantile(some + 0.5, total - some + 0.5, share) for share in (0.05, 0.95))
    return low, high


@dataclass(frozen=True, eq=False)
class CheckedMinutes:
    """Events of each class in reviewed minutes drawn at random."""

    # [shape=(4, n)], by class: events that start in each minute: labelled; labelled, and true in
    # part; true; true, without any labelled part
    events: dict[str, Int64]
    sounding: Bool  # [shape=(n,)]; whether the labels show any sound
    television: Bool  # [shape=(n,)]; whether the labels resemble a television
    models: list[str]  # SHA-256 of the model that labelled each minute; empty if unknown

    def __len__(self) -> int:
        return len(self.models)

    def of_model(self, model: str) -> "CheckedMinutes":
        """Return the minutes that a model labelled; all minutes if those are too few."""
        rows = np.flatnonzero([each == model for each in self.models])
        if len(rows) < FEWEST:
            return self
        return CheckedMinutes(
            {name: counts[:, rows] for name, counts in self.events.items()},
            self.sounding[rows],
            self.television[rows],
            [self.models[row] for row in rows.tolist()],
        )

    def check(self, name: str) -> ClassCheck:
        """Return the counts of correct and missed events of a class."""
        events, sounding = self._counted(name)
        in_quiet = events[3, ~sounding]
        return ClassCheck(*(int(counts.sum()) for counts in (*events, in_quiet)))

    def rates(self, name: str, share: float) -> CheckedRates | None:
        """Return the rates of a class of a share, 0 to 1, of all labelled events.

        None if too few minutes were checked.
        """
        (labelled, _, true, _), sounding = self._counted(name)
        return checked_rates(labelled, true, sounding, share)

    def rates_by_class(self, labelled: Mapping[str, int]) -> dict[str, CheckedRates]:
        """Return the rates of the classes with enough checked minutes, given labelled events."""
        # No sound is truly `unknown`.
        amounts = {name: n + 1 for name, n in labelled.items() if class_name(name) != UNKNOWN}
        total = sum(amounts.values())
        fewest = 1 / max(len(amounts), 1)  # rarely labelled classes may be missed more often
        drawn = {name: self.rates(name, max(n / total, fewest)) for name, n in amounts.items()}
        return {name: rates for name, rates in drawn.items() if rates is not None}

    def _counted(self, name: str) -> tuple[Int64, Bool]:
        """Return the events of a class, and what sounds, in the minutes that count for it."""
        events = self.events.get(name, np.zeros((4, len(self)), np.int64))
        kept = ~self.television if name in ON_TELEVISION else np.ones(len(self), bool)
        return events[:, kept], self.sounding[kept]


def read_checked_minutes(
    logs: HomeLogs, labelling: str, start: int, end: int, losses: list[str]
) -> CheckedMinutes:
    """Read the reviewed minutes drawn at random between start and end, in nanoseconds of UTC.

    The true labels are the reviewed labels, overlaid with the marks.
    """
    reviewed = read_reviewed_labels(logs, labelling, start, end, losses, {RANDOM})
    return checked_minutes(one for one in reviewed if start <= one.span.start < end)


def checked_minutes(reviewed: Iterable[ReviewedLabels]) -> CheckedMinutes:
    """Count the events of the reviewed minutes that were drawn at random."""
    minutes = [one for one in reviewed if one.span.chosen == RANDOM]
    names = {
        name for one in minutes for part in (one.labels, one.true) for name in set(part.labels)
    }
    counts = {
        name: np.array([_events(minute, name) for minute in minutes], np.int64).T
        for name in sorted(names - {SILENCE, TELEVISION})
    }
    edges = [np.array([one.span.start, one.span.end]) for one in minutes]
    sounding = [bool(sounding_minutes(m.labels, e)[0]) for m, e in zip(minutes, edges, strict=True)]
    return CheckedMinutes(
        counts,
        np.array(sounding, bool),
        np.array([_like_television(minute) for minute in minutes], bool),
        [minute.model for minute in minutes],
    )


def _like_television(minute: ReviewedLabels) -> bool:
    first = minute.span.start - AROUND * MINUTE
    edges = np.arange(first, first + (2 * AROUND + 2) * MINUTE, MINUTE)
    return bool(television_minutes(minute.labels, edges)[AROUND])


def _events(minute: ReviewedLabels, name: str) -> list[int]:
    """Count the events that start in a minute: labelled, right, true and missed ones.

    Only the part within the minute was reviewed, and decides for an event that outlasts the minute.
    Undecided spans contain no event, and make no event right.
    """
    start, end = minute.span.start, minute.span.end
    labelled, true = events_of(minute.labels, name), events_of(minute.true, name)
    own, others = _begun(labelled, minute), _begun(true, minute)
    right = overlapping(own, difference(cut(true, start, end), minute.undecided))
    found = overlapping(others, difference(cut(labelled, start, end), minute.undecided))
    return [len(own.starts), int(right.sum()), len(others.starts), int((~found).sum())]


def _begun(events: Spans, minute: ReviewedLabels) -> Spans:
    """Return the events that start in a minute, cut at its end."""
    span = minute.span
    first, last = np.searchsorted(events.starts, [span.start, span.end])
    begun = Spans(events.starts[first:last], np.minimum(events.ends[first:last], span.end))
    decided = overlapping(begun, difference(begun, minute.undecided))
    return Spans(begun.starts[decided], begun.ends[decided])


_DAY = 1440 * MINUTE
_MOST = 7  # days: more would cost time and hardly change the share


def quiet_weight(logs: HomeLogs, checked: Bool) -> float:
    """Return the number of quiet minutes per checked one, relative to minutes with sound.

    `checked` [shape=(n,)] says whether anything sounds in each checked minute. This is the weight
    of Horvitz and Thompson, over the last seven days with checked minutes; 1 if only one kind of
    minutes was checked, or exists.
    """
    kinds = [sounding for day in _days(logs) for sounding in _sounding(logs, *day)]
    sounding = np.concatenate([*kinds, np.empty(0, bool)])
    loud, quiet = int(sounding.sum()), int((~sounding).sum())
    checked_loud, checked_quiet = int(checked.sum()), int((~checked).sum())
    if not (loud and quiet and checked_loud and checked_quiet):
        return 1.0
    return (quiet / checked_quiet) / (loud / checked_loud)


def _days(logs: HomeLogs) -> list[tuple[int, str]]:
    days = set()
    for layer in logs.between(layer=REVIEW_LAYER):
        try:
            spans = read_reviewed(log_of_layer(layer.path))
        except LogError:
            continue  # the reader of the minutes reports this
        own = (span for span in spans if span.chosen == RANDOM and span.corrects == LIVE)
        days |= {(span.start // _DAY * _DAY, span.microphone) for span in own}
    return sorted(days)[-_MOST:]


def _sounding(logs: HomeLogs, start: int, microphone: str) -> Iterator[Bool]:
    """Return which minutes of a day have sound; unlabelled minutes are dropped."""
    paths = [entry.path for entry in logs.between(start, start + _DAY) if entry.path.exists()]
    edges = start + np.arange(0, _DAY + 1, MINUTE)
    try:
        labels = find_labellings(*paths).read(microphone, LIVE, start, start + _DAY).labelling
    except (DataError, LogError):
        return
    labelled = lengths(labels.spans(), edges) > 0
    yield sounding_minutes(unified(labels), edges)[labelled]


SURE, NOT_SURE = "sure", "not sure"
_RIGHT = 0.9  # of the labels
UNSURE_BELOW = 0.7  # probability below which a model itself is in doubt
_FEWEST = 10  # labelled events
_LOWER = 0.25  # quantile of the share that is right
_NO_SOUNDS = {SILENCE, TELEVISION, UNKNOWN}


def unsure_below(label: str) -> float:
    """Return the probability below which events of a class may be of another one.

    What is not recognised is called nothing that it might not be.
    """
    return 0.0 if class_name(label) == UNKNOWN else UNSURE_BELOW


class Sureness(NamedTuple):
    """Least confidence of labels of which a home can be sure."""

    sure: float = inf  # 0 to 1; infinite if no confidence holds, or nothing was checked

    def word(self, confidence: float) -> str:
        """Return a word for a confidence; empty if none can be justified."""
        if confidence >= self.sure:
            return SURE
        return NOT_SURE if confidence < UNSURE_BELOW else ""

    def is_unsure(self, confidence: float) -> bool:
        """Whether a confidence is shown as not sure."""
        return self.word(confidence) == NOT_SURE


UNMEASURED = Sureness()


def checked_confidences(reviewed: Iterable[ReviewedLabels]) -> tuple[Float64, Bool]:
    """Return the highest confidence of labelled events of random minutes, and which are right.

    An event is right if one of its segments is true in part; what a person could not tell is not.
    """
    confidences: list[float] = []
    rights: list[bool] = []
    for one in (each for each in reviewed if each.span.chosen == RANDOM):
        start, end = one.span.start, one.span.end
        true = {name: one.true.spans(one.true.labels == name) for name in set(one.true.labels)}
        for name in sorted(set(one.labels.labels) - _NO_SOUNDS):
            own = one.labels.labels == name
            segments = Spans(one.labels.starts[own], np.minimum(one.labels.ends[own], end))
            events, highest = events_and_confidences(one.labels, name)
            row, right = rows_at(events, segments.starts), np.zeros(len(events.starts), bool)
            correct = difference(cut(true.get(name, NONE), start, end), one.undecided)
            np.logical_or.at(right, row, overlapping(segments, correct))
            begun = (events.starts >= start) & (events.starts < end)
            confidences += highest[begun].tolist()
            rights += right[begun].tolist()
    return np.array(confidences, np.float64), np.array(rights, bool)


def measured_sureness(confidences: Float64, right: Bool) -> Sureness:
    """Find the least confidence from which on nine in ten labels are right.

    At least ten labels must have such a confidence, and the share must hold with a probability of
    three quarters (beta distribution with Jeffreys prior).
    """
    order = np.argsort(-confidences, kind="stable")
    ordered, rights = confidences[order], np.cumsum(right[order])
    sure = inf
    for number in range(_FEWEST, len(ordered) + 1):
        if number < len(ordered) and ordered[number] == ordered[number - 1]:
            continue  # all labels of one confidence, or none
        so = int(rights[number - 1])
        if beta_quantile(so + 0.5, number - so + 0.5, _LOWER) >= _RIGHT:
            sure = float(ordered[number - 1])
    return Sureness(sure)


def read_sureness(logs: HomeLogs, start: int, end: int) -> Sureness:
    """Measure the confidences of the recorder's labels in checked minutes (nanoseconds of UTC)."""
    reviewed = read_reviewed_labels(logs, LIVE, start, end, [], {RANDOM})
    return measured_sureness(*checked_confidences(reviewed))
