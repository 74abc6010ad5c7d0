"""Spans of time as arrays: joined, cut, taken from each other, measured."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hearthlog.schemas.arrays import Int64


class Spans(NamedTuple):
    """Spans of time in nanoseconds of UTC; they ascend and do not overlap.

    Attributes
    ----------
    starts, ends : np.ndarray [shape=(n,)], int64
    """

    starts: Int64
    ends: Int64

    @property
    def length(self) -> int:
        """Nanoseconds of all of them."""
        return int((self.ends - self.starts).sum())


NONE = Spans(np.empty(0, np.int64), np.empty(0, np.int64))


def one(start: int, end: int) -> Spans:
    """Return a single span."""
    return Spans(np.array([start]), np.array([end]))


def first_of_groups(starts: Int64, ends: Int64, pause: int) -> NDArray[np.intp]:
    """Find where, in spans by their starts, one begins more than a pause after all before it."""
    if not len(starts):
        return np.empty(0, np.intp)
    apart = starts[1:] > np.maximum.accumulate(ends)[:-1] + pause
    return np.concatenate([[0], np.flatnonzero(apart) + 1])


def joined(starts: Int64, ends: Int64, pause: int = 0) -> Spans:
    """Join spans, in any order, that overlap or are no more than a pause apart."""
    order = np.argsort(starts, kind="stable")
    starts, ends = starts[order], ends[order]
    firsts = first_of_groups(starts, ends, pause)
    return Spans(starts[firsts], np.maximum.reduceat(ends, firsts)) if len(firsts) else NONE


def common(a: Spans, b: Spans) -> Spans:
    """Return what is in both."""
    low = np.searchsorted(b.ends, a.starts, side="right")
    high = np.searchsorted(b.starts, a.ends, side="left")
    counts = np.maximum(high - low, 0)
    of_a = np.repeat(np.arange(len(counts)), counts)
    of_b = np.arange(counts.sum()) + np.repeat(low - (np.cumsum(counts) - counts), counts)
    return Spans(np.maximum(a.starts[of_a], b.starts[of_b]), np.minimum(a.ends[of_a], b.ends[of_b]))


def cut(spans: Spans, start: int, end: int) -> Spans:
    """Return what is between two times; unlike `common` it does not look at all the others."""
    first = np.searchsorted(spans.ends, start, side="right")
    last = max(np.searchsorted(spans.starts, end), first)
    rows = slice(first, last)
    return Spans(np.maximum(spans.starts[rows], start), np.minimum(spans.ends[rows], end))


def without(a: Spans, b: Spans) -> Spans:
    """Return what is in the first and not in the second."""
    if not len(a.starts) or not len(b.starts):
        return a
    first, last = min(a.starts[0], b.starts[0]), max(a.ends[-1], b.ends[-1])
    starts, ends = np.concatenate([[first], b.ends]), np.concatenate([b.starts, [last]])
    left = starts < ends
    return common(a, Spans(starts[left], ends[left]))


def lengths(spans: Spans, edges: Int64) -> Int64:
    """Measure how much of spans is between each two successive edges, in nanoseconds."""
    sums = np.concatenate([[0], np.cumsum(spans.ends - spans.starts)])
    begun = np.searchsorted(spans.starts, edges, side="right")
    before = sums[np.maximum(begun - 1, 0)]
    inside = np.zeros(len(edges), np.int64)
    some = begun > 0
    last = begun[some] - 1
    inside[some] = np.minimum(edges[some], spans.ends[last]) - spans.starts[last]
    return np.diff(before + inside)
