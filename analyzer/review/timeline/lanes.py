"""Lanes of a timeline: what changes when, close up and from afar."""

from collections.abc import Iterator
from datetime import timedelta, tzinfo
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.logs.local_time import local_time
from hearthlog.analyzer.logs.spans import overlay
from hearthlog.analyzer.review.timeline.grid import Grid, time_shares
from hearthlog.analyzer.review.timeline.model import LabelledSpans, LabellingTimeline, no_spans
from hearthlog.models.classes import SILENCE, class_name, translation
from hearthlog.schemas.arrays import Float64, Int64
from hearthlog.schemas.times import NANOSECONDS

BLOCKS = 420  # of a lane seen from afar: what is narrower than four pixels would be drawn grey
_QUIET_WEIGHT = 0.25  # so that a few minutes of a night in which someone coughs are seen
_HOUR = 3600
_TICKS = (60, 300, 900, _HOUR, 3 * _HOUR, 6 * _HOUR, 24 * _HOUR)  # seconds
_MOST_TICKS = 30


class Changes(NamedTuple):
    """When a lane changes, and to what; None is nothing.

    Attributes
    ----------
    times : np.ndarray [shape=(n,)], int64
        In nanoseconds of UTC, ascending.
    states : list of (str or None)
    """

    times: Int64
    states: list[str | None]


def changes(spans: LabelledSpans) -> Changes:
    """Begin each span with its text, and end it with None unless the next one follows at once."""
    followed = np.append(spans.starts[1:], np.iinfo(np.int64).max)
    last = np.flatnonzero(spans.ends < followed)
    times = np.concatenate([spans.ends[last], spans.starts])
    states = [*[None] * len(last), *spans.texts]
    order = np.argsort(times, kind="stable")
    return Changes(times[order], [states[i] for i in order])


def overview(labelling: LabellingTimeline, grid: Grid) -> LabelledSpans:
    """Show a labelling in blocks: what was heard the most in each, silence counting a quarter.

    A block in which nothing was heard is empty.

    Returns
    -------
    LabelledSpans
        Successive blocks that say the same are one.
    """
    coarse = Grid(grid.start, grid.end, BLOCKS)
    names, shares = _shares(labelling, coarse)
    if not names:
        return no_spans()
    weights = np.array([_QUIET_WEIGHT if class_name(name) == SILENCE else 1.0 for name in names])
    best = (shares * weights).argmax(axis=1)
    best = np.where(shares.sum(axis=1) > 0.0, best, -1)
    first = np.flatnonzero(np.diff(best, prepend=-2))
    edges = coarse.edges
    ends = edges[np.append(first[1:], coarse.count)]
    said = best[first] >= 0
    texts = np.array([*names, None], object)[best[first]]
    return LabelledSpans(edges[first][said], ends[said], texts[said])


def _shares(labelling: LabellingTimeline, grid: Grid) -> tuple[list[str], Float64]:
    """Measure how much of each block each label takes, or how probable it was if none is there."""
    spans = labelling.spans
    if len(spans):
        names, labels = np.unique(spans.texts.astype(str), return_inverse=True)
        return names.tolist(), time_shares(spans.starts, spans.ends, labels, len(names), grid)
    if labelling.probabilities is None:
        return [], np.empty((grid.count, 0))
    values = np.nan_to_num(labelling.probabilities.values)
    parts = np.linspace(0, len(values), grid.count + 1).astype(np.int64)[:-1]
    return list(labelling.probabilities.names), np.add.reduceat(values, parts, axis=0)


def disagreements(one: LabelledSpans, other: LabelledSpans) -> LabelledSpans:
    """Find where two labellings say different things; the text is what both say.

    Two names of one sound (see `hearthlog.models.classes`) are the same thing.
    """
    if not len(one) or not len(other):
        return no_spans()
    parts = overlay([one, other])
    a, b = parts.rows
    differ = (a >= 0) & (b >= 0)
    names = translation(set(other.texts), set(one.texts))
    said = np.array([names[text] for text in other.texts], object)
    differ[differ] = one.texts[a[differ]] != said[b[differ]]
    first = differ & (np.diff(np.where(differ, a, -1), prepend=-2) != 0)
    first |= differ & (np.diff(np.where(differ, b, -1), prepend=-2) != 0)
    places = np.flatnonzero(first)
    # A span of difference ends where either of the two says something else.
    stops = np.minimum(one.ends[a[places]], other.ends[b[places]])
    texts = [
        f"{x} / {y}" for x, y in zip(one.texts[a[places]], other.texts[b[places]], strict=True)
    ]
    return LabelledSpans(
        parts.starts[places], np.minimum(stops, parts.ends[-1]), np.array(texts, object)
    )


def clock(grid: Grid, zone: tzinfo) -> LabelledSpans:
    """Show the home's own time: blocks that say when they begin.

    They are as long as gives at most thirty of them.
    """
    seconds = (grid.end - grid.start) / NANOSECONDS
    tick = next((tick for tick in _TICKS if seconds / tick <= _MOST_TICKS), _TICKS[-1])
    starts = np.unique(list(_ticks(grid, tick, zone)))  # no hour is twice, nor missing, in it
    ends = np.append(starts[1:], grid.end)
    texts = [_clock_text(int(start), tick, zone) for start in starts]
    return LabelledSpans(starts, ends, np.array(texts, object))


def _ticks(grid: Grid, tick: int, zone: tzinfo) -> Iterator[int]:
    """Yield the start, and when the clock on the wall shows a whole number of ticks after it."""
    yield grid.start
    local = local_time(grid.start, zone)
    midnight = local.replace(hour=0, minute=0, second=0, microsecond=0)
    for number in range(1 << 16):
        moment = (midnight + timedelta(seconds=tick * number)).timestamp()
        time = int(moment) * NANOSECONDS
        if time >= grid.end:
            return
        if time > grid.start:
            yield time


def _clock_text(time: int, tick: int, zone: tzinfo) -> str:
    local = local_time(time, zone)
    if tick >= _TICKS[-1]:
        return f"{local:%a %d %b}"
    return f"{local:%H:%M}"
