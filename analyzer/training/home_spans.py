"""The time of a home that a model has learned from, as its description says it."""

import numpy as np

from hearthlog.models.classifiers.model import MOST_SPANS
from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.frames import NANOSECONDS

_NEAR = 60 * NANOSECONDS


def merged_spans(spans: Int64) -> list[list[int]]:
    """Join spans of time that are less than a minute apart.

    Parameters
    ----------
    spans : np.ndarray [shape=(n, 2)], int64
        Start and end of each, in nanoseconds of UTC, in any order.

    Returns
    -------
    list of [start, end]
        In order; not more than a description holds, for which the nearest are joined, too.
    """
    if not len(spans):
        return []
    ordered = spans[np.argsort(spans[:, 0], kind="stable")]
    ends = np.maximum.accumulate(ordered[:, 1])
    apart = ordered[1:, 0] - ends[:-1]
    widest = np.argsort(-apart, kind="stable")[: MOST_SPANS - 1]
    breaks = np.sort(widest[apart[widest] >= _NEAR])
    starts = ordered[np.concatenate([[0], breaks + 1]), 0]
    merged: list[list[int]] = np.stack([starts, ends[np.append(breaks, -1)]], axis=1).tolist()
    return merged
