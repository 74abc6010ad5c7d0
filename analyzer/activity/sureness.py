"""How sure a home can be of a label: limits of confidence that hold in its checked minutes."""

from collections.abc import Iterable
from math import inf
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.activity.checked_minutes import ReviewedLabels, read_reviewed_labels
from hearthlog.analyzer.activity.event_counts import beta_quantile, events_of, overlapping
from hearthlog.analyzer.logs.home_logs import HomeLogs
from hearthlog.analyzer.logs.spans import cut, rows_at, without
from hearthlog.analyzer.marks.marks import RANDOM
from hearthlog.models.classes import SILENCE, TELEVISION, UNKNOWN
from hearthlog.schemas.arrays import Bool, Float64
from hearthlog.schemas.messages.topics import LIVE

SURE, FAIRLY_SURE, NOT_SURE = "sure", "fairly sure", "not sure"
_SHARES = {SURE: 0.9, FAIRLY_SURE: 0.7}  # of the labels that are right
_DOUBTFUL = 0.7  # probability below which a model itself is in doubt
_FEWEST = 10  # labelled events
_LOWER = 0.25  # quantile of the share that is right
_NO_SOUNDS = {SILENCE, TELEVISION, UNKNOWN}


class Sureness(NamedTuple):
    """Least confidences of labels of which a home can be sure, and fairly sure.

    Attributes
    ----------
    sure, fairly_sure : float
        0 to 1; infinite if no confidence holds, or nothing was checked.
    """

    sure: float = inf
    fairly_sure: float = inf

    def word(self, confidence: float) -> str:
        """Return a word for a confidence; empty if none can be justified."""
        if confidence >= self.sure:
            return SURE
        if confidence >= self.fairly_sure:
            return FAIRLY_SURE
        is_measured = self.fairly_sure < inf
        return NOT_SURE if is_measured or confidence < _DOUBTFUL else ""


UNMEASURED = Sureness()


def checked_confidences(reviewed: Iterable[ReviewedLabels]) -> tuple[Float64, Bool]:
    """Return the confidence of the labelled events of random minutes, and whether each is right.

    Returns
    -------
    np.ndarray [shape=(n,)], float64
        The highest of the segments of an event.
    np.ndarray [shape=(n,)], bool
        Whether it is true in part.
    """
    confidences: list[float] = []
    rights: list[bool] = []
    for one in (each for each in reviewed if each.span.chosen == RANDOM):
        start, end = one.span.start, one.span.end
        for name in sorted(set(one.labels.labels) - _NO_SOUNDS):
            events = events_of(one.labels, name)
            own = one.labels.labels == name
            row = rows_at(events, one.labels.starts[own])
            highest = np.zeros(len(events.starts))
            np.maximum.at(highest, row, one.labels.confidences[own])
            begun = (events.starts >= start) & (events.starts < end)
            inside = events._replace(
                starts=events.starts[begun], ends=np.minimum(events.ends[begun], end)
            )
            decided = overlapping(inside, without(inside, one.undecided))
            true = without(cut(events_of(one.true, name), start, end), one.undecided)
            confidences += highest[begun][decided].tolist()
            rights += overlapping(inside, true)[decided].tolist()
    return np.array(confidences, np.float64), np.array(rights, bool)


def measured_sureness(confidences: Float64, right: Bool) -> Sureness:
    """Find the least confidences from which on nine, and seven, in ten labels are right.

    At least ten labels must have such a confidence, and the share must hold with a probability of
    three quarters (beta distribution with Jeffreys prior).
    """
    order = np.argsort(-confidences, kind="stable")
    ordered, rights = confidences[order], np.cumsum(right[order])
    limits = dict.fromkeys(_SHARES, inf)
    for number in range(_FEWEST, len(ordered) + 1):
        if number < len(ordered) and ordered[number] == ordered[number - 1]:
            continue  # all labels of one confidence, or none
        so = int(rights[number - 1])
        share = beta_quantile(so + 0.5, number - so + 0.5, _LOWER)
        for word, least in _SHARES.items():
            if share >= least:
                limits[word] = float(ordered[number - 1])
    return Sureness(limits[SURE], min(limits.values()))


def read_sureness(logs: HomeLogs, start: int, end: int) -> Sureness:
    """Measure the confidences of the recorder's labels in the checked minutes of a time.

    Parameters
    ----------
    start, end : int
        In nanoseconds of UTC.
    """
    reviewed = read_reviewed_labels(logs, LIVE, start, end, [], {RANDOM})
    return measured_sureness(*checked_confidences(reviewed))
