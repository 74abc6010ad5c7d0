"""Set operations on arrays of time spans: union, intersection, difference, overlay, lengths."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.frames import NANOSECONDS

NEVER = 1 << 62  # later than every time, in nanoseconds
EVENT_PAUSE = 10 * NANOSECONDS  # longest pause between the spans of one event
# A segment is logged when it ends: a long silence hours after it began.
SEGMENT_DELAY = 12 * 3600 * NANOSECONDS

Rows = NDArray[np.intp]


class Spans(NamedTuple):
    """Spans of time in nanoseconds of UTC, ascending and without overlaps."""

    starts: Int64  # shape (n,)
    ends: Int64

    @property
    def length(self) -> int:
        """Total length of the spans, in nanoseconds."""
        return int((self.ends - self.starts).sum())

    def pairs(self) -> Iterator[tuple[int, int]]:
        """Yield the start and the end of each span."""
        return zip(self.starts.tolist(), self.ends.tolist(), strict=True)


class Timed(Protocol):
    """Anything with starts and ends, such as `Spans` and labelled spans."""

    @property
    def starts(self) -> Int64:
        """Starts, ascending."""

    @property
    def ends(self) -> Int64:
        """Ends, in the order of the starts."""


class Overlay(NamedTuple):
    """Intervals, in nanoseconds of UTC, in which no span of any layer begins or ends."""

    starts: Int64  # shape (n,)
    ends: Int64
    # shape (m, n): the row of the span in each layer; -1 for none
    rows: Int64

    def in_all(self) -> "Overlay":
        """Return the intervals in which every layer has a span."""
        which = np.logical_and.reduce(self.rows >= 0)
        return Overlay(self.starts[which], self.ends[which], self.rows[:, which])


NONE = Spans(np.empty(0, np.int64), np.empty(0, np.int64))


def single_span(start: int, end: int) -> Spans:
    """Return a single span in nanoseconds of UTC; the end is after the start."""
    return Spans(np.array([start]), np.array([end]))


def first_of_groups(starts: Int64, ends: Int64, pause: int) -> Rows:
    """Return the first row of each group of spans at most a pause (ns) apart; starts ascend.

    Those begin more than a pause after the end of all earlier spans.
    """
    if not len(starts):
        return np.empty(0, np.intp)
    apart = starts[1:] > np.maximum.accumulate(ends)[:-1] + pause
    return np.concatenate([[0], np.flatnonzero(apart) + 1])


def joined(starts: Int64, ends: Int64, pause: int = 0) -> Spans:
    """Merge spans, in any order, that overlap or are at most a pause (ns) apart; 0 if adjacent."""
    order = np.argsort(starts, kind="stable")
    starts, ends = starts[order], ends[order]
    firsts = first_of_groups(starts, ends, pause)
    return Spans(starts[firsts], np.maximum.reduceat(ends, firsts)) if len(firsts) else NONE


def concatenated_ranges(
    firsts: NDArray[np.integer], counts: NDArray[np.integer]
) -> tuple[Rows, Rows]:
    """Concatenate ranges of consecutive numbers, given the first number and length of each.

    Return the range (row) of each number, and the numbers: `firsts[0]`, `firsts[0] + 1` … of row 0,
    then row 1.
    """
    rows = np.repeat(np.arange(len(counts)), counts)
    return rows, np.arange(counts.sum()) + np.repeat(firsts - (np.cumsum(counts) - counts), counts)


def intersection_rows(a: Timed, b: Spans) -> tuple[Spans, Rows, Rows]:
    """Intersect spans with other spans; return the rows of `a` and of `b` with each piece, too."""
    low = np.searchsorted(b.ends, a.starts, side="right")
    high = np.searchsorted(b.starts, a.ends, side="left")
    of_a, of_b = concatenated_ranges(low, np.maximum(high - low, 0))
    starts = np.maximum(a.starts[of_a], b.starts[of_b])
    return Spans(starts, np.minimum(a.ends[of_a], b.ends[of_b])), of_a, of_b


def intersection(a: Spans, b: Spans) -> Spans:
    """Return the intersection of two sets of spans."""
    return intersection_rows(a, b)[0]


def union(*parts: Spans, pause: int = 0) -> Spans:
    """Return the union of sets of spans, with pauses up to a length, in nanoseconds, closed."""
    starts, ends = (np.concatenate(edges) for edges in zip(NONE, *parts, strict=True))
    return joined(starts, ends, pause)


def cut(spans: Spans, start: int, end: int) -> Spans:
    """Return the part of spans between two times, without visiting all spans."""
    first = np.searchsorted(spans.ends, start, side="right")
    last = max(np.searchsorted(spans.starts, end), first)
    rows = slice(first, last)
    return Spans(np.maximum(spans.starts[rows], start), np.minimum(spans.ends[rows], end))


def difference(a: Spans, b: Spans) -> Spans:
    """Return the difference of two sets of spans: the time in the first and not in the second."""
    return difference_rows(a, b)[0]


def difference_rows(a: Timed, b: Spans) -> tuple[Spans, Rows]:
    """Cut spans `a`, ascending by start and by end, to the parts outside of other spans, in order.

    Return the row of `a` for each part, too.
    """
    if not len(a.starts) or not len(b.starts):
        return Spans(a.starts, a.ends), np.arange(len(a.starts))
    first, last = min(a.starts[0], b.starts[0]), max(a.ends[-1], b.ends[-1])
    starts, ends = np.concatenate([[first], b.ends]), np.concatenate([b.starts, [last]])
    left = starts < ends
    spans, of_a, _ = intersection_rows(a, Spans(starts[left], ends[left]))
    return spans, of_a


def rows_at(spans: Timed, times: Int64) -> Int64:
    """Return the row of the span with each time (nanoseconds of UTC, in any order), or -1."""
    if not len(spans.starts):
        return np.full(len(times), -1)
    rows = np.searchsorted(spans.starts, times, side="right") - 1
    return np.where((rows >= 0) & (spans.ends[rows] > times), rows, -1)


def overlay(layers: Sequence[Timed], every: int = 0) -> Overlay:
    """Cut the time wherever a span of any layer begins or ends.

    There is at least one layer; the spans of a layer ascend and do not overlap. Cut also at
    multiples of `every` nanoseconds, unless 0; every layer must then have a span.
    """
    edges = [times for spans in layers for times in (spans.starts, spans.ends)]
    if every:
        first, last = min(int(e[0]) for e in edges), max(int(e[-1]) for e in edges)
        edges.append(np.arange(-(-first // every) * every, last, every))
    times = np.unique(np.concatenate(edges))
    rows = np.stack([rows_at(spans, times[:-1]) for spans in layers])
    return Overlay(times[:-1], times[1:], rows)


def lengths(spans: Spans, edges: Int64) -> Int64:
    """Return the length of the spans between n + 1 ascending edges, in nanoseconds."""
    sums = np.concatenate([[0], np.cumsum(spans.ends - spans.starts)])
    begun = np.searchsorted(spans.starts, edges, side="right")
    before = sums[np.maximum(begun - 1, 0)]
    inside = np.zeros(len(edges), np.int64)
    some = begun > 0
    last = begun[some] - 1
    inside[some] = np.minimum(edges[some], spans.ends[last]) - spans.starts[last]
    return np.diff(before + inside)
