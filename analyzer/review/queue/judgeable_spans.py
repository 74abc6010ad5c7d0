"""Windows: spans with one label, of a length that a person can judge."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.evaluation.event_scores import Events
from hearthlog.analyzer.logs.spans import Spans, overlay, remains, runs
from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.times import NANOSECONDS

SHORTEST = NANOSECONDS // 2
LONGEST = 10 * NANOSECONDS
_FLICKER = NANOSECONDS
_MOST = 5_000_000


@dataclass(frozen=True)
class JudgeableSpans:
    """Spans of time, in its order, that do not overlap.

    Attributes
    ----------
    starts, ends : np.ndarray [shape=(n,)], int64
    labels : np.ndarray [shape=(n,)], int64
        Indices of classes.
    sources : np.ndarray [shape=(n,)], int64
        Equal for windows that were cut from one stretch.
    """

    starts: Int64
    ends: Int64
    labels: Int64
    sources: Int64

    def __len__(self) -> int:
        return len(self.starts)

    def taken(self, rows: Int64) -> "JudgeableSpans":
        """Return some of them."""
        return JudgeableSpans(
            self.starts[rows], self.ends[rows], self.labels[rows], self.sources[rows]
        )


def judgeable_spans(segments: Events) -> JudgeableSpans:
    """Join segments that flicker, and cut long ones.

    Successive segments of less than a second each are one stretch, labelled as the longest of
    them. Stretches of more than ten seconds are cut into equal windows; those of less than half a
    second are left out, for nobody could judge them.

    Parameters
    ----------
    segments : Events
        In the order of time, one label at a time.

    Raises
    ------
    DataError
        If it is more than a year and a half.
    """
    lengths = segments.ends - segments.starts
    short = lengths < _FLICKER
    joined = short[1:] & short[:-1] & (segments.starts[1:] == segments.ends[:-1])
    new = np.append(True, ~joined)[: len(lengths)]
    first = np.flatnonzero(new)
    last = np.append(first[1:], len(new))[: len(first)] - 1
    longest = np.lexsort((lengths, np.cumsum(new)))[last]
    starts, ends = segments.starts[first], segments.ends[last]
    parts = np.where(ends - starts < SHORTEST, 0, -(-(ends - starts) // LONGEST))
    if parts.sum() > _MOST:
        raise DataError("too much to rank at once: choose a part with --start and --end")
    source, part = runs(np.zeros(len(first), np.int64), parts)
    begins, stops = (
        starts[source] + (ends - starts)[source] * number // parts[source]
        for number in (part, part + 1)
    )
    return JudgeableSpans(begins, stops, segments.labels[longest][source], source)


def without(segments: Events, starts: Int64, ends: Int64) -> Events:
    """Leave of some segments what is outside of spans that do not overlap."""
    spans, rows = remains(segments, Spans(starts, ends))
    return Events(*spans, segments.labels[rows])


def other_labels(windows: JudgeableSpans, others: Events) -> tuple[Int64, NDArray[np.float64]]:
    """Tell what another labelling says in each window.

    Returns
    -------
    labels : np.ndarray [shape=(n,)], int64
        What it says the longest; -1 for nothing.
    differing : np.ndarray [shape=(n,)], float64
        Share of the window in which it says something else.
    """
    own = Events(windows.starts, windows.ends, windows.labels)
    pieces = overlay([own, others]).in_all()
    row, label = pieces.rows[0], others.labels[pieces.rows[1]]
    lengths = pieces.ends - pieces.starts
    apart = np.where(label != windows.labels[row], lengths, 0)
    differing = np.bincount(row, apart, len(windows)) / (windows.ends - windows.starts)
    pairs, place = np.unique(np.stack([row, label]), axis=1, return_inverse=True)
    by_length = np.lexsort((np.bincount(place, lengths), pairs[0]))
    labels = np.full(len(windows), -1)
    labels[pairs[0][by_length]] = pairs[1][by_length]  # of equal rows the last one stays
    return labels, differing
