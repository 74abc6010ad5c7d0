"""The lanes of a review and of a watch: which there are, how they look, and what they show."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import timedelta, tzinfo
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.colours import GAP, Colour, colour
from hearthlog.analyzer.logs.local_time import home_zone, local_time
from hearthlog.analyzer.review.timeline.grid import Grid
from hearthlog.analyzer.review.timeline.model import (
    LabelledSpans,
    MicrophoneTimeline,
    Timeline,
)
from hearthlog.analyzer.review.timeline.overview import disagreements, overview
from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.messages.topics import LIVE, REVIEW
from hearthlog.schemas.times import NANOSECONDS

_HOURS: tuple[Colour, Colour] = ((52, 60, 70), (32, 38, 46))
_DIFFERENT: Colour = (222, 165, 32)
_TROUBLE: Colour = (240, 140, 40)
_TROUBLES = {"warning": _TROUBLE, "error": (230, 60, 60), "stale": (150, 90, 160)}
TROUBLES = tuple(_TROUBLES)  # texts of a live lane, by the level of a diagnostic status less one
NOT_HEARD = "not heard"
_HOUR = 3600
_TICKS = (60, 300, 900, _HOUR, 3 * _HOUR, 6 * _HOUR, 24 * _HOUR)  # seconds
_MOST_TICKS = 30


@dataclass(frozen=True)
class LaneKind:
    """How lanes of one kind look: those of a microphone are shown by place, then by name."""

    place: int  # 0 to 9
    colours: Callable[[Iterable[str]], dict[str, Colour]]  # of states
    states: Sequence[str] = ()  # that a watch announces to the viewer before they occur


def _class_colours(states: Iterable[str]) -> dict[str, Colour]:
    return {state: colour(state) for state in states}


def _trouble_colours(states: Iterable[str]) -> dict[str, Colour]:
    return {state: _TROUBLES.get(state, _TROUBLE) for state in states}


def _alternating(states: Iterable[str]) -> dict[str, Colour]:
    return {state: _HOURS[number % 2] for number, state in enumerate(states)}


CLOCK = LaneKind(0, _alternating, [f"{hour:02}:{m:02}" for hour in range(24) for m in range(60)])
RECORDER = LaneKind(1, _class_colours)
RELABELLING = LaneKind(2, _class_colours)
MARKS = LaneKind(8, _class_colours)
DIFFERENCE = LaneKind(9, lambda states: dict.fromkeys(states, _DIFFERENT))
GAPS = LaneKind(9, lambda states: dict.fromkeys(states, GAP), [NOT_HEARD])
TROUBLE = LaneKind(9, _trouble_colours, TROUBLES)


class Changes(NamedTuple):
    """When a lane changes, and to which states.

    Attributes
    ----------
    times : np.ndarray [shape=(n,)], int64
        In nanoseconds of UTC, ascending.
    states : list of (str or None)
        None is no state.
    """

    times: Int64
    states: list[str | None]


class Lane(NamedTuple):
    """A lane, or what is new in it."""

    kind: LaneKind
    microphone: str  # empty for the clock
    name: str
    changes: Changes
    states: Sequence[str] = ()  # that may follow, beside those of the changes

    @property
    def colours(self) -> dict[str, Colour]:
        """The colour of every state."""
        states = dict.fromkeys([*self.states, *self.changes.states])
        return self.kind.colours(state for state in states if state is not None)


def changes(spans: LabelledSpans) -> Changes:
    """Turn spans into changes of a lane.

    Parameters
    ----------
    spans : LabelledSpans
        In the order of time; they do not overlap.

    Returns
    -------
    Changes
        Each span begins with its text, and ends with None unless the next one follows at once.
    """
    followed = np.append(spans.starts[1:], np.iinfo(np.int64).max)
    last = np.flatnonzero(spans.ends < followed)
    times = np.concatenate([spans.ends[last], spans.starts])
    states = [*[None] * len(last), *spans.texts]
    order = np.argsort(times, kind="stable")
    return Changes(times[order], [states[i] for i in order])


def timeline_lanes(timeline: Timeline, *, detail: bool) -> Iterator[Lane]:
    """Make the lanes of a timeline, the clock first.

    Parameters
    ----------
    timeline : Timeline
    detail : bool
        Whether they show every segment, where there are any, or an `overview`.

    Yields
    ------
    Lane
        The clock, then microphone by microphone: the labellings, the marks, the differences from
        the first labelling, gaps and troubles.

    Raises
    ------
    DataError
        If there is no such time zone as the timeline's.
    """
    grid = timeline.grid
    hours = clock(grid, home_zone(timeline.zone))
    yield Lane(CLOCK, "", timeline.zone, changes(hours))
    for microphone in timeline.microphones.values():
        yield from _microphone_lanes(microphone, grid, detail=detail)


def _microphone_lanes(
    microphone: MicrophoneTimeline, grid: Grid, *, detail: bool
) -> Iterator[Lane]:
    name, classes = microphone.name, microphone.classes
    labellings = [one for one in microphone.labellings if one.name != REVIEW]
    marks = [one for one in microphone.labellings if one.name == REVIEW]
    for one in labellings:
        kind = RECORDER if one.name == LIVE else RELABELLING
        spans = one.spans if detail and len(one.spans) else overview(one, grid)
        yield Lane(kind, name, one.name, changes(spans), classes)
    unmarked = Changes(np.array([grid.start]), [None])
    yield Lane(MARKS, name, REVIEW, changes(marks[0].spans) if marks else unmarked, classes)
    for other in labellings[1:]:
        both = (labellings[0], other)
        spans = disagreements(*(one.spans if detail else overview(one, grid) for one in both))
        yield Lane(DIFFERENCE, name, f"differs {other.name}", changes(spans))
    if len(microphone.gaps):
        yield Lane(GAPS, name, NOT_HEARD, changes(microphone.gaps))
    if len(microphone.troubles):
        yield Lane(TROUBLE, name, "trouble", changes(microphone.troubles))


def clock(grid: Grid, zone: tzinfo) -> LabelledSpans:
    """Divide a span of time into blocks whose text is the local time at which they begin.

    A block lasts from a minute to a day: the shortest length that gives at most thirty of them.
    Spans of more than a month have one for each day.

    Parameters
    ----------
    grid : Grid
        Its start and end count.
    zone : tzinfo
        Of the home.
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
