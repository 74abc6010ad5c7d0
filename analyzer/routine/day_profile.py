"""Profile of a day: its start, its longest quiet span, and events and minutes of each class."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import date, datetime, timedelta, tzinfo
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.accuracy.event_counts import (
    MINUTE,
    SET_APART,
    events_of,
    television_minutes,
)
from hearthlog.analyzer.logs.labelling import Labelling
from hearthlog.analyzer.logs.local_time import EVENING, MORNING, at_hour
from hearthlog.analyzer.logs.spans import (
    NONE,
    Spans,
    common,
    cut,
    joined,
    lengths,
    one,
    without,
)
from hearthlog.models.classes import (
    COUGHING,
    CRYING,
    FLUSHING_WATER,
    OTHER,
    SILENCE,
    TAP_WATER,
    UNKNOWN,
    YELLING,
    find_class,
)
from hearthlog.schemas.arrays import Float64, Int64
from hearthlog.schemas.frames import NANOSECONDS

_QUIET_PAUSE, _STRETCH = 10 * MINUTE, 30 * NANOSECONDS


def longest_quiet(sound: Spans, coverage: Spans, day: date, zone: tzinfo) -> Spans:
    """Find the longest quiet span from 07:00 to 22:00.

    Returns
    -------
    Spans
        A single one; none if nothing was heard then.
    """
    waking = one(at_hour(day, MORNING, zone), at_hour(day, EVENING, zone))
    quiet = without(common(coverage, waking), sound)
    if not len(quiet.starts):
        return NONE
    longest = int((quiet.ends - quiet.starts).argmax())
    return Spans(*(edge[longest : longest + 1] for edge in quiet))


def stretches(sound: Spans, night: Spans) -> int:
    """Count the stretches of sound in a night, with ten quiet minutes between them.

    Returns
    -------
    int
        Number of those with at least half a minute of sound.
    """
    inside = common(sound, night)
    found = joined(*inside, _QUIET_PAUSE)
    if not len(found.starts):
        return 0
    edges = np.append(found.starts, found.ends[-1:])
    return int((lengths(inside, edges) >= _STRETCH).sum())


COUNT, LENGTH, CLOCK = "count", "minutes", "clock"
STRETCHES, SOUND, FIRST, LAST, QUIET = "stretches", "sound", "first", "last", "quiet"
BINS = 48  # of a day: half hours
_NAMELESS = {SILENCE, OTHER, UNKNOWN}
_AT_NIGHT = (FLUSHING_WATER, TAP_WATER, COUGHING, CRYING, YELLING)
_LEAST = 0.9  # of a span has to be heard for what it has to be known
_LEAST_FIGURES = 0.5
_LEAST_BESIDE = 0.9  # of the time before what is said to be the first, or after the last
_ONE = timedelta(days=1)
_RISING = 4  # of the clock: what is busy before is still of the day before
_BUSY, _HALF_HOUR = 5, 30 * MINUTE  # so many sounds begin in half an hour that is busy
_PAUSE = 10 * NANOSECONDS


class DayFigure(NamedTuple):
    """One figure of a day.

    Attributes
    ----------
    kind : str
        `COUNT`, `LENGTH` (in minutes) or `CLOCK` (minutes from midnight on).
    night : bool
        Whether it is of the night, 22:00 to 07:00; else of the day.
    hours : (int, int) or None
        Half hours of the day that it is about, the last one not included; None for all of it.
    """

    what: str
    kind: str
    night: bool = False
    hours: tuple[int, int] | None = None


@dataclass(frozen=True)
class HomeSegments:
    """What was heard in a home.

    Attributes
    ----------
    labels : Labelling
        Of all microphones, by their starts, with one name for each class; they may overlap.
    """

    labels: Labelling
    listened: Mapping[str, Spans]


@dataclass(frozen=True)
class DayProfile:
    """What a day was like.

    Attributes
    ----------
    values : np.ndarray [shape=(f,)], float64
        Of the `figures` of its `Profiles`; NaN for what is not known.
    half_hours : np.ndarray [shape=(c, 48)], float64
        Minutes in each half hour of the day, for each of their `classes`; NaN for what is not
        known.
    """

    day: date
    values: Float64
    half_hours: Float64

    @property
    def is_known(self) -> bool:
        """Whether at least half of the figures are, so that the day can be compared."""
        return bool(np.isfinite(self.values).mean() >= _LEAST_FIGURES)


class Profiles:
    """Makes profiles of the days of a home.

    Parameters
    ----------
    night_after : bool
        Whether the night after a day belongs to it, and not the one before.

    Attributes
    ----------
    figures : list of DayFigure
        Of each day.
    classes : list of str
        Whose half hours are counted.
    """

    def __init__(self, home: HomeSegments, zone: tzinfo, *, night_after: bool) -> None:
        labels = home.labels
        self._zone = zone
        self._night_ends = _ONE if night_after else timedelta(0)
        names = [name for name in home.listened if name not in _NAMELESS]
        self.figures = list(_figures(names))
        self.classes = [name for name in names if name not in SET_APART]
        self._listened = dict(home.listened)
        self._coverage = joined(labels.starts, labels.ends)
        loud = labels.labels != SILENCE
        self._sound = joined(labels.starts[loud], labels.ends[loud])
        self._starts = joined(*self._sound, _PAUSE).starts
        beside = _television(labels) if set(names) & set(SET_APART) else NONE
        self._spans, self._events = dict[str, Spans](), dict[str, Spans]()
        for name in names:
            own = labels.labels == name
            spans, events = joined(labels.starts[own], labels.ends[own]), events_of(labels, name)
            if name in SET_APART:
                spans, events = without(spans, beside), _outside(events, beside)
            self._spans[name], self._events[name] = spans, events

    def of(self, day: date) -> DayProfile:
        """Return the profile of a day."""
        values = np.array([self._value(figure, day) for figure in self.figures])
        edges = _half_hours(day, self._zone)
        table = [self._minutes(name, edges) for name in self.classes]
        return DayProfile(day, values, np.array(table).reshape(-1, BINS))

    def _minutes(self, name: str, edges: Int64) -> Float64:
        widths = np.diff(edges)
        heard = lengths(self._listened[name], edges)
        minutes = lengths(self._spans[name], edges) / MINUTE
        return np.where(heard >= _LEAST * np.maximum(widths, 1), minutes, np.nan)

    def _value(self, figure: DayFigure, day: date) -> float:
        if figure.kind == CLOCK:
            return self._busy(day, last=figure.what == LAST)
        start, end = self._part(figure, day)
        listened = self._listened.get(figure.what, self._coverage)
        share = cut(listened, start, end).length / (end - start)
        return np.nan if share < _LEAST else self._amount(figure, day, (start, end), share)

    def _amount(self, figure: DayFigure, day: date, part: tuple[int, int], share: float) -> float:
        if figure.what == QUIET:
            quiet = longest_quiet(self._sound, self._coverage, day, self._zone)
            return quiet.length / MINUTE
        if figure.what == STRETCHES:
            return stretches(self._sound, one(*part)) / share
        if figure.kind == COUNT:
            starts = self._events[figure.what].starts
            return int(np.diff(np.searchsorted(starts, part))[0]) / share
        spans = self._sound if figure.what == SOUND else self._spans[figure.what]
        return cut(spans, *part).length / MINUTE / share

    def _part(self, figure: DayFigure, day: date) -> tuple[int, int]:
        if not figure.night:
            return at_hour(day, MORNING, self._zone), at_hour(day, EVENING, self._zone)
        ends = day + self._night_ends
        begins = at_hour(ends - _ONE, EVENING, self._zone)
        return begins, at_hour(ends, MORNING, self._zone)

    def _busy(self, day: date, *, last: bool) -> float:
        """Return when the first busy half hour begins, or the last ends, if that was heard."""
        begin, end = (at_hour(each, _RISING, self._zone) for each in (day, day + _ONE))
        starts = self._starts[slice(*np.searchsorted(self._starts, (begin, end)))]
        firsts, lasts = starts[: 1 - _BUSY], starts[_BUSY - 1 :]
        is_busy = lasts - firsts <= _HALF_HOUR
        if not is_busy.any():
            return np.nan
        time = int(lasts[is_busy][-1] if last else firsts[is_busy][0])
        outside = (time, end) if last else (begin, time)
        heard = cut(self._coverage, *outside).length
        known = heard >= _LEAST_BESIDE * (outside[1] - outside[0])
        return self._clock(time, day) if known else np.nan

    def _clock(self, time: int, day: date) -> float:
        """Return what the clock shows, in minutes from the midnight of a day on."""
        local = datetime.fromtimestamp(time // NANOSECONDS, self._zone)
        return 60.0 * local.hour + local.minute + 1440.0 * (local.date() - day).days


def _figures(names: list[str]) -> Iterator[DayFigure]:
    """List the figures of a day, what matters most first."""
    yield DayFigure(STRETCHES, COUNT, night=True)
    yield DayFigure(SOUND, LENGTH, night=True)
    for name in _AT_NIGHT:
        if name in names:
            yield DayFigure(name, COUNT, night=True)
    yield DayFigure(FIRST, CLOCK)
    yield DayFigure(LAST, CLOCK)
    yield DayFigure(QUIET, LENGTH)
    yield DayFigure(SOUND, LENGTH)
    for name in names:
        row = find_class(name)
        yield DayFigure(name, COUNT if row is not None and row.several else LENGTH)


def _television(labels: Labelling) -> Spans:
    """Return the minutes in which something sounds like a television."""
    if not len(labels):
        return NONE
    first, last = int(labels.starts[0]) // MINUTE, -(-int(labels.ends.max()) // MINUTE)
    edges = np.arange(first, last + 1) * MINUTE
    minutes = edges[:-1][television_minutes(labels, edges)]
    return joined(minutes, minutes + MINUTE)


def _outside(events: Spans, spans: Spans) -> Spans:
    """Return the events that do not begin in some spans."""
    rows = np.searchsorted(spans.starts, events.starts, side="right") - 1
    ends = np.append(spans.ends, 0)[rows]
    apart = (rows < 0) | (ends <= events.starts)
    return Spans(events.starts[apart], events.ends[apart])


def _half_hours(day: date, zone: tzinfo) -> Int64:
    """Return when the clock shows each half hour; of one that is left out, nothing is between."""
    midnight = datetime(day.year, day.month, day.day)  # noqa: DTZ001  of the clock on the wall
    clock = [midnight + timedelta(minutes=30 * number) for number in range(BINS + 1)]
    times = np.array([int(each.replace(tzinfo=zone).timestamp()) for each in clock]) * NANOSECONDS
    return np.minimum.accumulate(times[::-1])[::-1]
