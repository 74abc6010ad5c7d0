"""Profile of a day: its start, longest quiet span, and events and minutes of each class."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import date, datetime, timedelta, tzinfo
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.activity.event_counts import MINUTE, events_of, television_minutes
from hearthlog.analyzer.logs.labelling import Labelling
from hearthlog.analyzer.logs.local_time import at_hour, awake_span, local_time, night_span
from hearthlog.analyzer.logs.spans import (
    EVENT_PAUSE,
    NONE,
    Spans,
    cut,
    difference,
    intersection,
    joined,
    lengths,
    rows_at,
    single_span,
)
from hearthlog.models.classes import (
    COUGHING,
    CRYING,
    FLUSHING_WATER,
    IMPORTANT,
    LAUGHING,
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
    """Find the longest quiet span from 07:00 to 22:00; empty without any sound in that time."""
    quiet = difference(cut(coverage, *awake_span(day, zone)), sound)
    if not len(quiet.starts):
        return NONE
    longest = int((quiet.ends - quiet.starts).argmax())
    return Spans(*(edge[longest : longest + 1] for edge in quiet))


def stretches(sound: Spans, night: Spans) -> int:
    """Count the stretches of half a minute of sound or more in a night, ten quiet minutes apart."""
    inside = intersection(sound, night)
    found = joined(*inside, _QUIET_PAUSE)
    if not len(found.starts):
        return 0
    edges = np.append(found.starts, found.ends[-1:])
    return int((lengths(inside, edges) >= _STRETCH).sum())


COUNT, LENGTH, CLOCK = "count", "minutes", "clock"
STRETCHES, SOUND, FIRST, LAST, QUIET = "stretches", "sound", "first", "last", "quiet"
BINS = 48  # of a day: half hours
# Lengths of other classes, such as talking, are as labelled here, also beside a television.
APART_IN_LENGTH = (*IMPORTANT, LAUGHING)
_NAMELESS = {SILENCE, OTHER, UNKNOWN}
_AT_NIGHT = (FLUSHING_WATER, TAP_WATER, COUGHING, CRYING, YELLING)
_LEAST = 0.9  # recorded share of a span for its figures to be present
_LEAST_FIGURES = 0.5
_LEAST_AROUND = 0.9  # recorded share before the first, or after the last, busy half hour
_ONE = timedelta(days=1)
_RISING = 4  # o'clock: earlier activity belongs to the previous day
_BUSY, _HALF_HOUR = 5, 30 * MINUTE  # number of sounds that start in a busy half hour


class DayFigure(NamedTuple):
    """One figure of a day."""

    what: str
    kind: str  # `COUNT`, `LENGTH` (in minutes) or `CLOCK` (minutes since midnight)
    night: bool = False  # of the night, 22:00 to 07:00, rather than the day
    # range of half hours, end exclusive; None for the complete day
    hours: tuple[int, int] | None = None


@dataclass(frozen=True)
class HomeSegments:
    """Labelled segments of a home."""

    labels: Labelling  # of all microphones by start, one name per class; may overlap
    listened: Mapping[str, Spans]


@dataclass(frozen=True)
class DayProfile:
    """Figures and half hours of a day; missing ones are NaN."""

    day: date
    values: Float64  # [shape=(f,)]; of the `figures` of its `Profiles`
    half_hours: Float64  # [shape=(c, 48)]; minutes, for each class of its `Profiles`

    @property
    def is_comparable(self) -> bool:
        """Whether at least half of the figures are present, so that the day can be compared."""
        return bool(np.isfinite(self.values).mean() >= _LEAST_FIGURES)


class Profiles:
    """Computes profiles of days, with `figures`, and half hours of `classes`, of each day.

    With `night_after`, the night after a day belongs to it, rather than the night before.
    """

    def __init__(self, home: HomeSegments, zone: tzinfo, *, night_after: bool) -> None:
        labels = home.labels
        self._zone = zone
        self._night_ends = _ONE if night_after else timedelta(0)
        names = [name for name in home.listened if name not in _NAMELESS]
        self.figures = list(_figures(names))
        self.classes = [name for name in names if name not in APART_IN_LENGTH]
        self._listened = dict(home.listened)
        self._coverage = labels.spans()
        self._sound = labels.spans(labels.labels != SILENCE)
        self._starts = joined(*self._sound, EVENT_PAUSE).starts
        television = television_spans(labels) if set(names) & set(APART_IN_LENGTH) else NONE
        self._spans, self._events = dict[str, Spans](), dict[str, Spans]()
        for name in names:
            spans, events = labels.spans(labels.labels == name), events_of(labels, name)
            if name in APART_IN_LENGTH:
                spans = difference(spans, television)
                apart = rows_at(television, events.starts) < 0
                events = Spans(events.starts[apart], events.ends[apart])
            self._spans[name], self._events[name] = spans, events

    def of(self, day: date) -> DayProfile:
        """Return the profile of a day."""
        values = np.array([self._value(figure, day) for figure in self.figures])
        edges = _half_hours(day, self._zone)
        table = [self._minutes(name, edges) for name in self.classes]
        return DayProfile(day, values, np.array(table).reshape(-1, BINS))

    def _minutes(self, name: str, edges: Int64) -> Float64:
        widths = np.diff(edges)
        covered = lengths(self._listened[name], edges)
        minutes = lengths(self._spans[name], edges) / MINUTE
        return np.where(covered >= _LEAST * np.maximum(widths, 1), minutes, np.nan)

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
            return stretches(self._sound, single_span(*part)) / share
        if figure.kind == COUNT:
            starts = self._events[figure.what].starts
            return int(np.diff(np.searchsorted(starts, part))[0]) / share
        spans = self._sound if figure.what == SOUND else self._spans[figure.what]
        return cut(spans, *part).length / MINUTE / share

    def _part(self, figure: DayFigure, day: date) -> tuple[int, int]:
        if not figure.night:
            return awake_span(day, self._zone)
        return night_span(day + self._night_ends, self._zone)

    def _busy(self, day: date, *, last: bool) -> float:
        """Return the start of the first busy half hour, or the end of the last, if recorded."""
        begin, end = (at_hour(each, _RISING, self._zone) for each in (day, day + _ONE))
        starts = self._starts[slice(*np.searchsorted(self._starts, (begin, end)))]
        firsts, lasts = starts[: 1 - _BUSY], starts[_BUSY - 1 :]
        is_busy = lasts - firsts <= _HALF_HOUR
        if not is_busy.any():
            return np.nan
        time = int(lasts[is_busy][-1] if last else firsts[is_busy][0])
        outside = (time, end) if last else (begin, time)
        covered = cut(self._coverage, *outside).length
        enough = covered >= _LEAST_AROUND * (outside[1] - outside[0])
        return self._clock(time, day) if enough else np.nan

    def _clock(self, time: int, day: date) -> float:
        """Return the clock time in minutes since the midnight of a day."""
        local = local_time(time, self._zone)
        return 60.0 * local.hour + local.minute + 1440.0 * (local.date() - day).days


def _figures(names: list[str]) -> Iterator[DayFigure]:
    """Return the figures of a day, the most important first."""
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


def television_spans(labels: Labelling) -> Spans:
    """Return the minutes that resemble a television."""
    if not len(labels):
        return NONE
    first, last = int(labels.starts[0]) // MINUTE, -(-int(labels.ends.max()) // MINUTE)
    edges = np.arange(first, last + 1) * MINUTE
    minutes = edges[:-1][television_minutes(labels, edges)]
    return joined(minutes, minutes + MINUTE)


def _half_hours(day: date, zone: tzinfo) -> Int64:
    """Return the start of each half hour by the clock; a skipped half hour is empty."""
    midnight = datetime(day.year, day.month, day.day)  # noqa: DTZ001  of the clock on the wall
    clock = [midnight + timedelta(minutes=30 * number) for number in range(BINS + 1)]
    times = np.array([int(each.replace(tzinfo=zone).timestamp()) for each in clock]) * NANOSECONDS
    return np.minimum.accumulate(times[::-1])[::-1]
