"""How sure a home can be of a label: limits of confidence that hold in its checked minutes."""

from collections.abc import Iterable
from math import inf
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.activity.checked_minutes import ReviewedLabels, read_reviewed_labels
from hearthlog.analyzer.activity.event_counts import beta_quantile, events_of, overlapping
from hearthlog.analyzer.logs.home_logs import HomeLogs
from hearthlog.analyzer.logs.spans import NONE, Spans, cut, rows_at, without
from hearthlog.analyzer.marks.marks import RANDOM
from hearthlog.models.classes import SILENCE, TELEVISION, UNKNOWN
from hearthlog.schemas.arrays import Bool, Float64
from hearthlog.schemas.messages.topics import LIVE

SURE, NOT_SURE = "sure", "not sure"
_RIGHT = 0.9  # of the labels
_DOUBTFUL = 0.7  # probability below which a model itself is in doubt
_FEWEST = 10  # labelled events
_LOWER = 0.25  # quantile of the share that is right
_NO_SOUNDS = {SILENCE, TELEVISION, UNKNOWN}


class Sureness(NamedTuple):
    """Least confidence of labels of which a home can be sure."""

    sure: float = inf  # 0 to 1; infinite if no confidence holds, or nothing was checked

    def word(self, confidence: float) -> str:
        """Return a word for a confidence; empty if none can be justified."""
        if confidence >= self.sure:
            return SURE
        return NOT_SURE if confidence < _DOUBTFUL else ""

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
            events = events_of(one.labels, name)
            row = rows_at(events, segments.starts)
            highest, right = np.zeros(len(events.starts)), np.zeros(len(events.starts), bool)
            np.maximum.at(highest, row, one.labels.confidences[own])
            known = without(cut(true.get(name, NONE), start, end), one.undecided)
            np.logical_or.at(right, row, overlapping(segments, known))
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
