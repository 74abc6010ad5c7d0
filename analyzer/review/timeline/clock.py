"""The clock on the wall of the home, as blocks of a lane."""

from collections.abc import Iterator
from datetime import timedelta, tzinfo

import numpy as np

from hearthlog.analyzer.logs.local_time import local_time
from hearthlog.analyzer.review.timeline.grid import Grid
from hearthlog.analyzer.review.timeline.model import LabelledSpans
from hearthlog.schemas.times import NANOSECONDS

_HOUR = 3600
_TICKS = (60, 300, 900, _HOUR, 3 * _HOUR, 6 * _HOUR, 24 * _HOUR)  # seconds
_MOST_TICKS = 30


def clock(grid: Grid, zone: tzinfo) -> LabelledSpans:
    """Divide a span of time into blocks whose text is the local time at which they begin.

    They have the shortest length that gives about thirty of them or fewer.
    """
    seconds = (grid.end - grid.start) / NANOSECONDS
    tick = next((tick for tick in _TICKS if seconds / tick <= _MOST_TICKS), _TICKS[-1])
    starts = np.unique(list(_ticks(grid, tick, zone)))  # also where clocks are changed
    ends = np.append(starts[1:], grid.end)
    texts = [_clock_text(int(start), tick, zone) for start in starts]
    return LabelledSpans(starts, ends, np.array(texts, object))


def _ticks(grid: Grid, tick: int, zone: tzinfo) -> Iterator[int]:
    """Yield the start, and each later time at which the local time is a multiple of a tick."""
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
