"""Timeline of a day: a lane of events for each class, night, hours, time without a record."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.activity.daily_metrics import DayMetrics
from hearthlog.analyzer.activity.event_counts import MINUTE
from hearthlog.analyzer.activity.values import Duration, UsualRange, usual_range
from hearthlog.analyzer.colours import Colour, colour_on_paper
from hearthlog.analyzer.logs.local_time import EVENING, MORNING, local_time
from hearthlog.analyzer.logs.spans import EVENT_PAUSE, Spans, common, joined, without
from hearthlog.models.classes import SILENCE, in_words
from hearthlog.schemas.arrays import Bool, Float64, Int64

PHONE_LANES = 12
_LEAST_HATCHED = 2  # minutes
# Marks are at least three pixels wide: of the widest page 5.5 minutes, of the narrowest 16.
_TOUCHING, _SHORT, _LONG = 5, 16.0, 2.0  # minutes


class TimelineBlock(NamedTuple):
    """Part of a day, in per cent of its width."""

    left: float
    width: float


class MarkPaths(NamedTuple):
    """SVG paths in a box as wide as the minutes of a day, and 1 high.

    Attributes
    ----------
    long : str
        Filled.
    short : str
        Upright lines, to be drawn three pixels wide: events too short to be seen otherwise.
    many : str
        Level lines through many short events, between which no screen has room; to be dashed.
    """

    long: str
    short: str
    many: str


class TimelineLane(NamedTuple):
    """Events of a class on a day, in minutes since midnight.

    Attributes
    ----------
    counted, uncounted : np.ndarray [shape=(n, 2)], float64
        Start and end of the events: those that count, and those beside a television.
    gaps : list of TimelineBlock
        Time in which the class could not have been heard, though others could.
    """

    name: str
    words: str
    colour: Colour
    counted: Float64
    uncounted: Float64
    gaps: Sequence[TimelineBlock]

    @property
    def empty(self) -> bool:
        """Whether nothing of the class was heard."""
        return not (len(self.counted) or len(self.uncounted))

    @property
    def paths(self) -> MarkPaths:
        """Marks of the events that count."""
        return _paths(self.counted)

    @property
    def pale_paths(self) -> MarkPaths:
        """Marks of the events beside a television."""
        return _paths(self.uncounted)


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


class DayTimeline(NamedTuple):
    """Picture of a day, without its form."""

    day: DayMetrics
    minutes: int  # 1440, but for days on which the clock is changed
    lanes: Sequence[TimelineLane]
    gaps: Sequence[TimelineBlock]  # nobody listened
    nights: Sequence[TimelineBlock]
    ticks: Sequence[HourTick]

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
    def has_gaps(self) -> bool:
        """Whether there is time without a record, at least of a class."""
        return bool(self.gaps) or any(lane.gaps for lane in self.lanes)

    @property
    def night_path(self) -> str:
        """SVG path of the night."""
        share = self.minutes / 100
        spans = [(block.left * share, block.width * share) for block in self.nights]
        return "".join(f"M{left:g} 0h{width:g}v1h{-width:g}z" for left, width in spans)

    @property
    def hour_lines(self) -> str:
        """SVG path of the hours that are written below."""
        return "".join(f"M{tick.left / 100 * self.minutes:g} 0v1" for tick in self.ticks[1:])

    @property
    def coarse_lines(self) -> str:
        """SVG path of the hours that a phone writes."""
        coarse = (tick for tick in self.ticks[1:] if tick.coarse)
        return "".join(f"M{tick.left / 100 * self.minutes:g} 0v1" for tick in coarse)


def timeline_of(day: DayMetrics, names: Sequence[str] | None = None) -> DayTimeline:
    """Return the timeline of a day.

    Parameters
    ----------
    names : sequence of str, optional
        Classes of the lanes; by default all that can occur, but silence.
    """
    if names is None:
        names = [name for name in day.home.classes if name != SILENCE]
    clock = [local_time(int(time), day.zone).hour for time in day.hours[:-1]]
    lefts = _percent(day, day.hours)
    return DayTimeline(
        day,
        int(day.span.length // MINUTE),
        [_lane(day, name) for name in names],
        list(_blocks(day, without(day.span, day.coverage))),
        list(_nights(lefts, clock)),
        [
            HourTick(f"{hour:02}", left, hour % 6 == 0)
            for hour, left in zip(clock, lefts.tolist(), strict=False)
            if hour % 2 == 0
        ],
    )


def occurring_classes(days: Sequence[DayMetrics]) -> list[str]:
    """Return the classes that were heard on some of the days; all if there are none."""
    names = [name for name in days[0].home.classes if name != SILENCE]
    occurring = [n for n in names if any(common(d.home.spans[n], d.span).length for d in days)]
    return occurring or names


def hour_bars(day: DayMetrics, earlier: Sequence[DayMetrics]) -> list[HourBar]:
    """Return the minutes with sound in each hour; nothing is usual where the clock was changed."""
    same = [each.sound_by_hour for each in earlier if len(each.hours) == len(day.hours)]
    lefts = _percent(day, day.hours)
    usual: list[UsualRange | None] = [None] * len(day.sound_by_hour)
    if same:
        usual = [usual_range([Duration(float(n)) for n in hour]) for hour in np.array(same).T]
    columns = lefts[:-1].tolist(), np.diff(lefts).tolist(), day.sound_by_hour.tolist(), usual
    return [HourBar(*row) for row in zip(*columns, strict=True)]


def _lane(day: DayMetrics, name: str) -> TimelineLane:
    spans = day.home.spans[name]
    events = joined(spans.starts, spans.ends, EVENT_PAUSE)
    counts = np.isin(events.starts, day.home.minutes.counted(name, events.starts))
    gaps = without(without(day.span, day.home.listened[name]), without(day.span, day.coverage))
    return TimelineLane(
        name,
        in_words(name),
        colour_on_paper(name),
        _in_minutes(day, events, counts),
        _in_minutes(day, events, ~counts),
        list(_blocks(day, gaps)),
    )


def _in_minutes(day: DayMetrics, events: Spans, which: Bool) -> Float64:
    own = common(Spans(events.starts[which], events.ends[which]), day.span)
    return (np.stack(own, axis=1) - day.span.starts[0]) / MINUTE


def _blocks(day: DayMetrics, spans: Spans) -> Iterable[TimelineBlock]:
    long = spans.ends - spans.starts >= _LEAST_HATCHED * MINUTE
    lefts, rights = (_percent(day, edges[long]).tolist() for edges in spans)
    return (TimelineBlock(left, right - left) for left, right in zip(lefts, rights, strict=True))


def _nights(lefts: Float64, clock: Sequence[int]) -> Iterable[TimelineBlock]:
    night = np.array([not MORNING <= hour < EVENING for hour in clock])
    edges = np.flatnonzero(np.diff(np.concatenate([[False], night, [False]]).astype(int)))
    bounds = lefts[edges].reshape(-1, 2).tolist()
    return (TimelineBlock(left, right - left) for left, right in bounds)


def _percent(day: DayMetrics, times: Int64) -> Float64:
    return (times - day.span.starts[0]) / day.span.length * 100


def _paths(events: Float64) -> MarkPaths:
    """Return the marks of events; their size does not grow with the number of short ones."""
    widths = events[:, 1] - events[:, 0]
    long = events[widths >= _LONG].round(1).tolist()
    places = np.unique(np.round(events[widths < _SHORT].mean(axis=1)).astype(np.int64))
    apart = np.diff(places, prepend=-_TOUCHING - 1) > _TOUCHING
    firsts, lasts = places[apart], places[np.roll(apart, -1)]
    runs = zip(firsts.tolist(), lasts.tolist(), strict=True)
    ends = np.unique(np.concatenate([firsts, lasts])).tolist()
    return MarkPaths(
        "".join(f"M{a:g} 0h{b - a:g}v1h{a - b:g}z" for a, b in long),
        "".join(f"M{place} 0v1" for place in ends),
        "".join(f"M{a} .5H{b}" for a, b in runs if b > a),
    )
