"""Spans with one label each, of a length that a person can judge."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.evaluation.event_scores import Events
from hearthlog.analyzer.logs.spans import Spans, overlay, ranges, remains
from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.frames import NANOSECONDS

SHORTEST = NANOSECONDS // 2
LONGEST = 10 * NANOSECONDS
_FLICKER = NANOSECONDS
_MOST = 5_000_000


@dataclass(frozen=True)
class JudgeableSpans:
    """Spans in the order of time, which do not overlap.

    Attributes
    ----------
    starts, ends : np.ndarray [shape=(n,)], int64
        In nanoseconds of UTC.
    labels : np.ndarray [shape=(n,)], int64
        Indices of classes.
    sources : np.ndarray [shape=(n,)], int64
        Equal for spans that were cut from one.
    """

    starts: Int64
    ends: Int64
    labels: Int64
    sources: Int64

    def __len__(self) -> int:
        return len(self.starts)

    def take(self, rows: Int64) -> "JudgeableSpans":
        """Return some of the spans.

        Parameters
        ----------
        rows : np.ndarray [shape=(m,)], int64
            In the order of time, or they are no longer in it.
        """
        return JudgeableSpans(
            self.starts[rows], self.ends[rows], self.labels[rows], self.sources[rows]
        )


def judgeable_spans(segments: Events) -> JudgeableSpans:
    """Make spans that a person can judge: join segments that flicker, and cut long ones.

    Successive segments of less than a second each are joined, with the label of the longest. What
    is longer than ten seconds is cut into equal spans; what is shorter than half a second is left
    out, for nobody could judge it.

    Parameters
    ----------
    segments : Events
        In nanoseconds of UTC, in the order of time, one label at a time.

    Raises
    ------
    DataError
        If there are more than five million spans, as of a year and a half.
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
    source, part = ranges(np.zeros(len(first), np.int64), parts)
    begins, stops = (
        starts[source] + (ends - starts)[source] * number // parts[source]
        for number in (part, part + 1)
    )
    return JudgeableSpans(begins, stops, segments.labels[longest][source], source)


def border_pieces(spans: JudgeableSpans, silent: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Tell which spans are less than a second of the border of another sound.

    Where one sound goes over into the next the label wavers, and a person hears only the two. What
    is as short and stands alone, such as a cough, can be judged.

    Parameters
    ----------
    silent : np.ndarray [shape=(classes,)], bool
        Which labels are silence.

    Returns
    -------
    np.ndarray [shape=(n,)], bool
    """
    touching = spans.starts[1:] == spans.ends[:-1]
    sounds = ~silent[spans.labels]
    beside = np.zeros(len(spans), bool)
    beside[1:] |= touching & sounds[:-1]
    beside[:-1] |= touching & sounds[1:]
    return beside & (spans.ends - spans.starts < _FLICKER)


def without(segments: Events, reviewed: Spans) -> Events:
    """Return the parts of segments outside of some time."""
    spans, rows = remains(segments, reviewed)
    return Events(*spans, segments.labels[rows])


def other_labels(spans: JudgeableSpans, others: Events) -> tuple[Int64, NDArray[np.float64]]:
    """Compare spans with another labelling.

    Returns
    -------
    labels : np.ndarray [shape=(n,)], int64
        The other label of most of each span; -1 for none.
    differing : np.ndarray [shape=(n,)], float64
        The share of each span that has another label, 0 to 1.
    """
    own = Events(spans.starts, spans.ends, spans.labels)
    pieces = overlay([own, others]).in_all()
    row, label = pieces.rows[0], others.labels[pieces.rows[1]]
    lengths = pieces.ends - pieces.starts
    apart = np.where(label != spans.labels[row], lengths, 0)
    differing = np.bincount(row, apart, len(spans)) / (spans.ends - spans.starts)
    pairs, place = np.unique(np.stack([row, label]), axis=1, return_inverse=True)
    by_length = np.lexsort((np.bincount(place, lengths), pairs[0]))
    labels = np.full(len(spans), -1)
    labels[pairs[0][by_length]] = pairs[1][by_length]  # of equal rows the last one stays
    return labels, differing
