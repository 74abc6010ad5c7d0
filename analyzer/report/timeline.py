"""Timeline of a day: a lane of events for each class, night, hours, time without a record."""

from collections.abc import Iterable, Sequence
from itertools import groupby
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.activity.daily_metrics import DayMetrics
from hearthlog.analyzer.activity.event_counts import MINUTE
from hearthlog.analyzer.activity.values import Duration, UsualRange, usual_range
from hearthlog.analyzer.logs.local_time import EVENING, MORNING, local_time
from hearthlog.analyzer.logs.spans import (
    NONE,
    Spans,
    difference,
    intersection,
    lengths,
    single_span,
)
from hearthlog.analyzer.report.report_data import sound_near_television
from hearthlog.analyzer.report.wording import clock_text, days_in_short, short_day
from hearthlog.models.classes import SILENCE, Colour, colour_on_paper, in_words
from hearthlog.schemas.arrays import Bool, Float64, Int64

PHONE_LANES = 12
LOW = 0.5  # height of a mark of which the model is not sure
BEFORE_LOGS, AFTER_LOGS = "before the first log", "after the last log"
_LEAST_HATCHED = 2  # minutes
# Marks are at least three pixels wide: of the widest page 5.5 steps, of the narrowest 16.
_TOUCHING, _SHORT, _LONG = 5, 16.0, 2.0  # steps
_STEPS = 1440  # of an axis; minutes, where it is a day
_MOST_CLOSE = 1 / 3  # of a day: a shorter recording is drawn as wide as a day
_FEWEST_HOURS = 3  # of an axis
_FEW_HOURS, _MANY_HOURS = 4, 12  # on an axis: half hours are written, and only even hours


class TimelineBlock(NamedTuple):
    """Part of an axis, in per cent of its width."""

    left: float
    width: float


class MarkPaths(NamedTuple):
    """SVG paths in a box as wide as the steps of an axis, and 1 high."""

    long: str  # filled
    short: str  # upright lines, three pixels wide: events too short to be seen otherwise
    many: str  # level lines, dashed, through many short events that no screen can separate


class TimelineLane(NamedTuple):
    """Events of a class on a day, in steps of the axis."""

    name: str
    words: str
    colour: Colour
    counted: Float64  # [shape=(n, 2)]; start and end of the events that count, and are sure
    unsure: Float64  # [shape=(n, 2)]; of those that count, but the model is not sure
    uncounted: Float64  # [shape=(n, 2)]; of those beside a television
    gaps: Sequence[TimelineBlock]  # time in which only other classes could be detected

    @property
    def empty(self) -> bool:
        """Whether nothing of the class was heard."""
        return not (len(self.counted) or len(self.unsure) or len(self.uncounted))

    @property
    def paths(self) -> Sequence[tuple[str, MarkPaths]]:
        """Marks by their look: pale beside a television, low if not sure."""
        return (
            ("pale", _paths(self.uncounted)),
            ("low", _paths(self.unsure, LOW)),
            ("", _paths(self.counted)),
        )


class HourTick(NamedTuple):
    """An hour on the axis; `coarse` ones are also on a phone."""

    text: str
    left: float
    coarse: bool


class HourBar(NamedTuple):
    """Minutes with sound in an hour, and what is usual, if known."""

    left: float
    width: float
    minutes: float
    usual: UsualRange | None
    beside: float  # minutes of these in which something like a television sounded
    has_room: bool  # whether its number has room on a phone


class DayTimeline(NamedTuple):
    """Picture of a day, or of the recorded hours of it, without its form."""

    day: DayMetrics
    span: Spans  # a single span: that of the axis
    steps: int  # 1440, but for days on which the clock is changed
    lanes: Sequence[TimelineLane]
    gaps: Sequence[TimelineBlock]  # nobody listened
    unlogged: Sequence[tuple[TimelineBlock, str]]  # before the first log, and after the last one
    empty_hours: Sequence[TimelineBlock]  # in which nobody listened
    nights: Sequence[TimelineBlock]
    ticks: Sequence[HourTick]

    @property
    def hours_shown(self) -> str:
        """The hours of the axis, `18:00 to 21:00`; empty if it is the day."""
        if self.span.length == self.day.span.length:
            return ""
        start, end = (clock_text(int(edge[0]), self.day.zone) for edge in self.span)
        return f"{start} to {'24:00' if end == '00:00' else end}"

    @property
    def phone_lanes(self) -> frozenset[str]:
        """The classes that a phone shows: at most twelve, those that were heard first."""
        names = [lane.name for lane in sorted(self.lanes, key=lambda lane: lane.empty)]
        return frozenset(names[:PHONE_LANES])

    @property
    def has_uncounted(self) -> bool:
        """Whether there are events beside a television."""
        return any(len(lane.uncounted) for lane in self.lanes)

    @property
    def has_unsure(self) -> bool:
        """Whether there are events that are not sure."""
        return any(len(lane.unsure) for lane in self.lanes)

    @property
    def has_gaps(self) -> bool:
        """Whether there is time without a record, at least of a class."""
        return bool(self.gaps) or any(lane.gaps for lane in self.lanes)

    @property
    def night_path(self) -> str:
        """SVG path of the night."""
        share = self.steps / 100
        spans = [(block.left * share, block.width * share) for block in self.nights]
        return "".join(f"M{left:g} 0h{width:g}v1h{-width:g}z" for left, width in spans)

    @property
    def hour_lines(self) -> str:
        """SVG path of the hours that are written below."""
        return "".join(f"M{tick.left / 100 * self.steps:g} 0v1" for tick in self.ticks[1:])

    @property
    def coarse_lines(self) -> str:
        """SVG path of the hours that a phone writes."""
        coarse = (tick for tick in self.ticks[1:] if tick.coarse)
        return "".join(f"M{tick.left / 100 * self.steps:g} 0v1" for tick in coarse)


def timeline_of(day: DayMetrics, names: Sequence[str] | None = None) -> DayTimeline:
    """Return the timeline of a day.

    The lanes are of the given classes, on an axis that is the day; by default of those that
    were labelled, or were not listened for all the time, on that of `shown_span`; of a day without
    sound, of all.
    """
    span = shown_span(day) if names is None else day.span
    if names is None:
        every = [_lane(day, span, name) for name in day.home.classes if name != SILENCE]
        lanes = [lane for lane in every if not lane.empty or lane.gaps]
        lanes = lanes if any(not lane.empty for lane in lanes) else every
    else:
        lanes = [_lane(day, span, name) for name in names]
    hours = _edges(day, span)
    clock = [local_time(int(time), day.zone).hour for time in hours[:-1]]
    lefts = _percent(span, hours)
    night = np.array([not MORNING <= hour < EVENING for hour in clock])
    return DayTimeline(
        day,
        span,
        round(span.length / _step(day, span)),
        lanes,
        list(_blocks(span, intersection(day.missing, span))),
        list(_unlogged(day, span)),
        list(_runs(lefts, _empty_hours(day, hours))),
        list(_runs(lefts, night)),
        list(_ticks(lefts, clock)),
    )


def week_timelines(days: Sequence[DayMetrics]) -> list[tuple[str, DayTimeline]]:
    """Return the timelines of days with their names; days without logs share one, without lanes."""
    names = occurring_classes(days)
    timelines = []
    for has_logs, run in groupby(days, lambda day: bool(day.logged.length)):
        if has_logs:
            timelines += [(short_day(day.day), timeline_of(day, names)) for day in run]
        else:
            same = [*run]
            name = days_in_short(same[0].day, same[-1].day)
            timelines.append((name, timeline_of(same[0], [])))
    return timelines


def _unlogged(day: DayMetrics, span: Spans) -> Iterable[tuple[TimelineBlock, str]]:
    """Yield the parts of an axis without logs, and what they are."""
    (start,), (end,) = day.span
    for first, last, text in (
        (start, day.logged.starts[0], BEFORE_LOGS),
        (day.logged.ends[0], end, AFTER_LOGS),
    ):
        part = intersection(single_span(int(first), int(last)), span)
        yield from ((block, text) for block in _blocks(span, part))


def _empty_hours(day: DayMetrics, hours: Int64) -> Bool:
    """Return in which of the hours nobody listened, though there are logs around them."""
    (first,), (last,) = day.logged
    empty: Bool = lengths(day.coverage, hours) < MINUTE
    return empty & (hours[1:] > first) & (hours[:-1] < last)


def shown_span(day: DayMetrics) -> Spans:
    """Return the span of the axis: the day, or the hours of a recording much shorter than it."""
    if not day.coverage.length:
        return day.span
    first, last = day.coverage.starts[0], day.coverage.ends[-1]
    if last - first > _MOST_CLOSE * day.span.length:
        return day.span
    start = int(np.searchsorted(day.hours, first, side="right")) - 1
    end = max(int(np.searchsorted(day.hours, last)), start + _FEWEST_HOURS)
    end = min(end, len(day.hours) - 1)
    return single_span(int(day.hours[min(start, end - _FEWEST_HOURS)]), int(day.hours[end]))


def occurring_classes(days: Sequence[DayMetrics]) -> list[str]:
    """Return the classes that were heard on some of the days; all if there are none."""
    names = [name for name in days[0].home.classes if name != SILENCE]
    occurring = [
        n for n in names if any(intersection(d.home.spans[n], d.span).length for d in days)
    ]
    return occurring or names


def hour_bars(day: DayMetrics, earlier: Sequence[DayMetrics]) -> list[HourBar]:
    """Return the minutes with sound in each hour; nothing is usual where the clock was changed."""
    same = [each.sound_by_hour for each in earlier if len(each.hours) == len(day.hours)]
    span = shown_span(day)
    edges = _edges(day, span)
    first = int(np.searchsorted(day.hours, edges[0]))
    rows = slice(first, first + len(edges) - 1)
    lefts = _percent(span, edges)
    usual: list[UsualRange | None] = [None] * (len(edges) - 1)
    if same:
        hours = np.array(same).T[rows]
        usual = [usual_range([Duration(float(n)) for n in hour]) for hour in hours]
    minutes = day.sound_by_hour[rows].tolist()
    apart = (lengths(sound_near_television(day), edges) / MINUTE).tolist()
    places = lefts[:-1].tolist(), np.diff(lefts).tolist()
    columns = *places, minutes, usual, apart, _with_room(minutes)
    return [HourBar(*row) for row in zip(*columns, strict=True)]


def _with_room(minutes: Sequence[float]) -> list[bool]:
    """Return which hours have their number on a phone: of two side by side, the one with more."""
    chosen = [False] * len(minutes)
    for row in sorted(range(len(minutes)), key=lambda row: -minutes[row]):
        chosen[row] = not any(chosen[max(row - 1, 0) : row + 2])
    return chosen


def _edges(day: DayMetrics, span: Spans) -> Int64:
    """Return the edges of the hours of an axis."""
    return day.hours[(day.hours >= span.starts[0]) & (day.hours <= span.ends[0])]


def _ticks(lefts: Float64, clock: Sequence[int]) -> Iterable[HourTick]:
    """Return what is written below an axis: even hours of a day; all or half of an evening."""
    widths = np.diff(lefts).tolist()
    for hour, left, width in zip(clock, lefts.tolist(), widths, strict=False):
        if len(clock) > _MANY_HOURS:
            if hour % 2 == 0:
                yield HourTick(f"{hour:02}", left, hour % 6 == 0)
            continue
        yield HourTick(f"{hour:02}:00", left, len(clock) <= _FEW_HOURS or hour % 2 == 0)
        if len(clock) <= _FEW_HOURS:
            yield HourTick(f"{hour:02}:30", left + width / 2, coarse=False)


def _lane(day: DayMetrics, span: Spans, name: str) -> TimelineLane:
    events, apart = day.joined_events(name)
    is_unsure = np.isin(events.starts, day.home.unsure.get(name, NONE.starts))
    sure, unsure = (Spans(events.starts[own], events.ends[own]) for own in (~is_unsure, is_unsure))
    gaps = difference(intersection(day.coverage, span), day.home.listened[name])
    step = _step(day, span)
    counted, doubtful, uncounted = (
        (np.stack(intersection(own, span), axis=1) - span.starts) / step
        for own in (sure, unsure, apart)
    )
    return TimelineLane(
        name,
        in_words(name),
        colour_on_paper(name),
        counted,
        doubtful,
        uncounted,
        list(_blocks(span, gaps)),
    )


def _step(day: DayMetrics, span: Spans) -> float:
    """Return the nanoseconds of a step of an axis."""
    return MINUTE if span.length == day.span.length else span.length / _STEPS


def _blocks(span: Spans, spans: Spans) -> Iterable[TimelineBlock]:
    long = spans.ends - spans.starts >= _LEAST_HATCHED * MINUTE
    lefts, rights = (_percent(span, edges[long]).tolist() for edges in spans)
    return (TimelineBlock(left, right - left) for left, right in zip(lefts, rights, strict=True))


def _runs(lefts: Float64, which: Bool) -> Iterable[TimelineBlock]:
    """Return the runs of hours that have something."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], which, [False]]).astype(int)))
    bounds = lefts[edges].reshape(-1, 2).tolist()
    return (TimelineBlock(left, right - left) for left, right in bounds)


def _percent(span: Spans, times: Int64) -> Float64:
    return (times - span.starts[0]) / span.length * 100


def _paths(events: Float64, height: float = 1.0) -> MarkPaths:
    """Return the marks of events; their size does not grow with the number of short ones.

    They stand on the floor of their box; `height` is a share of it.
    """
    widths = events[:, 1] - events[:, 0]
    long = events[widths >= _LONG].round(1).tolist()
    places = np.unique(np.round(events[widths < _SHORT].mean(axis=1)).astype(np.int64))
    apart = np.diff(places, prepend=-_TOUCHING - 1) > _TOUCHING
    firsts, lasts = places[apart], places[np.roll(apart, -1)]
    runs = zip(firsts.tolist(), lasts.tolist(), strict=True)
    ends = np.unique(np.concatenate([firsts, lasts])).tolist()
    top, middle = 1 - height, 1 - height / 2
    return MarkPaths(
        "".join(f"M{a:g} {top:g}h{b - a:g}v{height:g}h{a - b:g}z" for a, b in long),
        "".join(f"M{place} {top:g}v{height:g}" for place in ends),
        "".join(f"M{a} {middle:g}H{b}" for a, b in runs if b > a),
    )
