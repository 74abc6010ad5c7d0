"""Metrics of a home and its days: coverage, durations, events, and counts with ranges."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date, tzinfo
from functools import reduce
from itertools import chain
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.activity.checked_minutes import CheckedMinutes, unsure_below
from hearthlog.analyzer.activity.day_profile import HomeSegments, longest_quiet, stretches
from hearthlog.analyzer.activity.event_counts import (
    MINUTE,
    CheckedRates,
    events_and_confidences,
    events_of,
    sounding_minutes,
    strata_of,
    television_minutes,
)
from hearthlog.analyzer.activity.home_data import HomeData
from hearthlog.analyzer.activity.values import Clock, Count, Duration, exactly
from hearthlog.analyzer.logs.labelling import Labelling, in_order
from hearthlog.analyzer.logs.local_time import at_hour, awake_span, day_span, local_time, night_span
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
    ON_TELEVISION,
    SILENCE,
    WORRYING,
    ordered,
)
from hearthlog.schemas.arrays import Bool, Float32, Int64


@dataclass(frozen=True)
class HomeMinutes:
    """Minutes covered by at least one microphone; by class, all except silence."""

    starts: Int64  # [shape=(n,)], in nanoseconds of UTC
    sounding: Bool  # [shape=(n,)]; whether the labels have any sound
    television: Bool  # [shape=(n,)]; whether they have a television-like sound
    gone_through: Bool  # [shape=(n,)]; whether a person reviewed the complete minute
    reviewed: Spans  # by a person, at all microphones
    # [shape=(4, n)]; events that begin in each minute: labelled ones outside of reviewed spans, all
    # after corrections, and those of them that begin in reviewed spans, or are not sure elsewhere
    events: dict[str, Int64]

    def between(self, spans: Spans) -> "HomeMinutes":
        """Return the minutes that begin in some spans."""
        of = np.searchsorted(spans.starts, self.starts, side="right") - 1
        return self.rows((of >= 0) & (self.starts < spans.ends[of]))

    def count(self, name: str, rates: CheckedRates | None) -> Count:
        """Count the events of a class.

        `ON_TELEVISION` classes count in minutes without a television, and where a person reviewed.
        """
        own = self.rows(~self.television) if name in ON_TELEVISION else self
        if name not in own.events:
            return Count(rates=rates)
        labelled, corrected, certain, unsure = own.events[name]
        near_television = int(self.events[name][2].sum() - certain.sum())
        rest = ~own.gone_through
        strata = strata_of(labelled[rest], own.sounding[rest])
        return Count(
            int(corrected.sum()) + near_television,
            int(certain.sum()) + near_television,
            strata,
            rates,
            int(unsure.sum()),
        )

    def counted(self, name: str, starts: Int64) -> Int64:
        """Return the events of a class, by starts within these minutes, that `count` counts."""
        if name not in ON_TELEVISION:
            return starts
        near_television = np.isin(starts // MINUTE * MINUTE, self.starts[self.television])
        return starts[~near_television | (rows_at(self.reviewed, starts) >= 0)]

    def uncounted_events(self, name: str) -> int:
        """Count the events beside a television that `count` leaves out."""
        if name not in ON_TELEVISION or name not in self.events:
            return 0
        _, corrected, certain, _ = self.events[name]
        return int((corrected - certain)[self.television].sum())

    def rows(self, rows: Bool) -> "HomeMinutes":
        """Select rows."""
        return HomeMinutes(
            self.starts[rows],
            self.sounding[rows],
            self.television[rows],
            self.gone_through[rows],
            self.reviewed,
            {name: counts[:, rows] for name, counts in self.events.items()},
        )


def home_minutes(
    labels: Labelling,
    gone_through: Sequence[Spans],
    coverage: Spans,
    events: Mapping[str, tuple[Int64, Float32]],
) -> HomeMinutes:
    """Count the events that begin in each minute with coverage by at least one microphone.

    `events` has the starts and highest confidences of the events of each class except silence,
    after corrections.
    """
    first, last = int(coverage.starts[0]) // MINUTE, -(-int(coverage.ends[-1]) // MINUTE)
    edges = np.arange(first, last + 1) * MINUTE
    reviewed = reduce(intersection, gone_through)
    begun = {}
    for name, (starts, confidences) in events.items():
        labelled, certain = events_of(labels, name).starts, rows_at(reviewed, starts) >= 0
        unreviewed = labelled[rows_at(reviewed, labelled) < 0]
        unsure = starts[~certain & (confidences < unsure_below(name))]
        kinds = unreviewed, starts, starts[certain], unsure
        begun[name] = np.array([np.diff(np.searchsorted(kind, edges)) for kind in kinds])
    minutes = HomeMinutes(
        edges[:-1],
        sounding_minutes(labels, edges),
        television_minutes(labels, edges),
        lengths(reviewed, edges) == MINUTE,
        reviewed,
        begun,
    )
    return minutes.rows(lengths(coverage, edges) > 0)


@dataclass(frozen=True)
class HomeMetrics:
    """Sounds of a home, combined over all microphones."""

    classes: list[str]
    coverage: Spans  # covered by at least one microphone
    listened: dict[str, Spans]  # by class: covered by a microphone whose model has the class
    sound: Spans  # spans in which at least one microphone has a label other than silence
    spans: dict[str, Spans]  # by class: union over the microphones
    # by class except silence: event starts; spans at most ten seconds apart are one event, also
    # across microphones
    events: dict[str, Int64]
    minutes: HomeMinutes
    rates: dict[str, CheckedRates]  # by class, from the checked minutes
    unsure: dict[str, Int64]  # by class: those starts that are not sure, and not reviewed
    steady: Spans = NONE  # loud, but labelled quiet; read for the report of a day only

    def between(self, start: int, end: int) -> "HomeMetrics":
        """Return the metrics of a span in nanoseconds of UTC; events belong where they begin."""
        return HomeMetrics(
            self.classes,
            cut(self.coverage, start, end),
            {name: cut(spans, start, end) for name, spans in self.listened.items()},
            cut(self.sound, start, end),
            {name: cut(spans, start, end) for name, spans in self.spans.items()},
            {name: self.events_in(name, single_span(start, end)) for name in self.events},
            self.minutes.between(single_span(start, end)),
            self.rates,
            self.unsure,
            cut(self.steady, start, end),
        )

    def events_in(self, name: str, span: Spans) -> Int64:
        """Return the event starts of a class, if any, in a time span, in nanoseconds of UTC."""
        starts = self.events.get(name, NONE.starts)
        return starts[(starts >= span.starts[0]) & (starts < span.ends[0])]


def metrics_of_home(data: HomeData, checks: CheckedMinutes | None = None) -> HomeMetrics:
    """Combine the one or more microphones of a home.

    A span is silent if every microphone labels silence; segments of one class at most ten seconds
    apart, from any microphones, are one event. `checks` are randomly drawn, checked minutes of the
    home.
    """
    labels = in_order(data.segments.values())
    everything = labels.spans()
    sound = labels.spans(labels.labels != SILENCE)
    classes = ordered(chain.from_iterable(data.classes.values()))
    listened, spans, events = {}, {}, {}
    for name in classes:
        knowing = [part for source, part in data.segments.items() if name in data.classes[source]]
        listened[name] = in_order(knowing).spans()
        spans[name] = labels.spans(labels.labels == name)
        own, highest = events_and_confidences(labels, name)
        events[name] = own.starts, highest
    if SILENCE in spans:
        spans[SILENCE] = difference(spans[SILENCE], sound)  # another microphone has a sound
        del events[SILENCE]
    gone_through = [data.gone_through.get(source, NONE) for source in data.segments]
    labelled = in_order(data.labelled.values())
    minutes = home_minutes(labelled, gone_through, everything, events)
    amounts = {name: int(counts[0].sum()) for name, counts in minutes.events.items()}
    rates = {} if checks is None else checks.rates_by_class(amounts)
    starts, unsure = {}, {}
    for name, (begun, confidences) in events.items():
        doubtful = (confidences < unsure_below(name)) & (rows_at(minutes.reviewed, begun) < 0)
        starts[name], unsure[name] = begun, begun[doubtful]
    return HomeMetrics(classes, everything, listened, sound, spans, starts, minutes, rates, unsure)


def home_sound(data: HomeData, metrics: HomeMetrics) -> HomeSegments:
    """Return the input of the routine: the labels of all microphones."""
    return HomeSegments(in_order(data.segments.values()), metrics.listened)


# Of composed homes, 100 of 100 ranges of coughing hold in the night, but 38 of household sounds.
RANGED_AT_NIGHT = frozenset(WORRYING)
RISING = 4  # local hour; earlier sound belongs to the night
HOUR = 60 * MINUTE
MOST = 0.75  # minimum covered share for a reported 0, and for comparisons of days
_Figure = TypeVar("_Figure", Count, Duration)
_HALF = 0.5
_BIN, _BUSY = 10 * MINUTE, MINUTE


@dataclass(frozen=True)
class DayMetrics:
    """Figures of one day, and of the night that ends on it."""

    day: date
    home: HomeMetrics
    zone: tzinfo
    span: Spans  # a single span, like the night
    night: Spans
    logs: tuple[int, int]  # from when to when the home has logs, in nanoseconds of UTC

    @property
    def with_night(self) -> "DayMetrics":
        """The day together with the evening before it: from 22:00 to midnight."""
        return replace(self, span=single_span(int(self.night.starts[0]), int(self.span.ends[0])))

    @property
    def to_evening(self) -> "DayMetrics":
        """The 24 hours to 22:00: no two days have a time in common, and each night is in one."""
        return replace(self, span=single_span(int(self.night.starts[0]), int(self.waking.ends[0])))

    @property
    def waking(self) -> Spans:
        """The time from 07:00 to 22:00."""
        return single_span(*awake_span(self.day, self.zone))

    @property
    def evening(self) -> Spans:
        """The time from 22:00 to midnight, which belongs to the next night, too."""
        return single_span(int(self.waking.ends[0]), int(self.span.ends[0]))

    @property
    def coverage(self) -> Spans:
        """Covered spans of the day."""
        return intersection(self.home.coverage, self.span)

    @property
    def logged(self) -> Spans:
        """The part of the day that has logs, if any; all of it if less than a minute lacks."""
        (start,), (end,) = self.span
        first, last = (min(max(time, start), end) for time in self.logs)
        first = start if first - start < MINUTE else first
        return single_span(first, end if end - last < MINUTE else last)

    @property
    def before_logs(self) -> int:
        """Nanoseconds of the day before the first log."""
        return int(self.logged.starts[0] - self.span.starts[0])

    @property
    def after_logs(self) -> int:
        """Nanoseconds of the day after the last log."""
        return int(self.span.ends[0] - self.logged.ends[0])

    @property
    def missing(self) -> Spans:
        """Spans of the day without coverage, from the first log to the last one."""
        return difference(self.logged, self.coverage) if self.logged.length else NONE

    @property
    def share(self) -> float:
        """Covered share of the day, 0 to 1."""
        return self.coverage.length / self.span.length

    @property
    def night_hours(self) -> float:
        """Covered hours of the night."""
        return intersection(self.home.coverage, self.night).length / HOUR

    def comparable(self, name: str = "") -> bool:
        """Return whether three quarters of the day, and of its night, are covered."""
        spans = [self.home.listened[name]] if name else [*self.home.listened.values()]
        periods = self.span, self.night
        shares = [
            intersection(own, period).length / period.length for own in spans for period in periods
        ]
        return min(shares) >= MOST

    def share_of(self, name: str) -> float:
        """Return the share of the day covered for a class, 0 to 1; 0 if no model has it."""
        return _share(self.home.listened.get(name, NONE), self.span)

    def joined_events(self, name: str) -> tuple[Spans, Spans]:
        """Return the spans of the events of a class that count, and of those that do not."""
        spans = self.home.spans.get(name, NONE)
        events = joined(spans.starts, spans.ends, EVENT_PAUSE)
        counts = np.isin(events.starts, self.home.minutes.counted(name, events.starts))
        counted, apart = (Spans(events.starts[own], events.ends[own]) for own in (counts, ~counts))
        return counted, apart

    def spans_of(self, name: str) -> Spans:
        """Return the spans of a class on this day, as far as its events count."""
        counted, _ = self.joined_events(name)
        return self._spans_in(name, counted)

    def minutes(self, name: str) -> Duration | None:
        """Return the duration of the events of a class that count; None if unknown."""
        return _if_covered(_length(self.spans_of(name)), self.share_of(name))

    def uncounted_minutes(self, name: str) -> float:
        """Return the minutes of the events of a class that do not count: beside a television."""
        return self.uncounted_spans(name).length / MINUTE

    def uncounted_spans(self, name: str) -> Spans:
        """Return the spans of the events of a class that do not count."""
        _, apart = self.joined_events(name)
        return self._spans_in(name, apart)

    def _spans_in(self, name: str, events: Spans) -> Spans:
        spans = intersection(self.home.spans.get(name, NONE), events)
        return intersection(spans, self.span)

    def events(self, name: str) -> Int64:
        """Return the event starts of a class, if any, on this day, in nanoseconds of UTC."""
        return self.home.events_in(name, self.span)

    def unsure_events(self, name: str) -> Int64:
        """Return the starts of the events that a count has apart: none where it has a range."""
        unsure = NONE.starts if self.home.rates.get(name) else self.home.unsure.get(name)
        return NONE.starts if unsure is None else unsure

    def counted_events(self, name: str, span: Spans) -> Int64:
        """Return the event starts of a class in a span that count, in nanoseconds of UTC."""
        return self.home.minutes.counted(name, self.home.events_in(name, span))

    def night_events(self, name: str) -> Int64:
        """Return the event starts that `night_count` counts for a class, in nanoseconds of UTC."""
        return self.counted_events(name, self.night)

    def count(self, name: str, span: Spans | None = None) -> Count | None:
        """Return the number of events of a class on this day, or in a part; None if unknown."""
        span = self.span if span is None else span
        share = _share(self.home.listened.get(name, NONE), span)
        return _if_covered(self.count_in(name, span), share)

    def night_count(self, name: str) -> Count | None:
        """Return the number of events of a class in the night; None if unknown."""
        return self.count(name, self.night)

    def uncounted_events(self, name: str) -> int:
        """Return the number of events of a class not counted because of a television."""
        return self.home.minutes.between(self.span).uncounted_events(name)

    def count_in(self, name: str, span: Spans) -> Count:
        """Return the number of events of a class that begin in a span of this day or its night.

        In the night only `RANGED_AT_NIGHT` classes have a range: for others, minutes checked at any
        time say too little of how often a label of a quiet night is right.
        """
        is_ranged = span is not self.night or name in RANGED_AT_NIGHT
        rates = self.home.rates.get(name) if is_ranged else None
        return self.home.minutes.between(span).count(name, rates)

    @property
    def sound(self) -> Duration | None:
        """Duration of any sound on this day; None if unknown."""
        return _if_covered(_length(intersection(self.home.sound, self.span)), self.share)

    @property
    def night_sound(self) -> Duration | None:
        """Duration of any sound in the night; None if unknown."""
        return _if_covered(
            _length(intersection(self.home.sound, self.night)), self._share_of(self.night)
        )

    @property
    def night_stretches(self) -> Count | None:
        """Number of stretches of sound in the night, separated by ten quiet minutes.

        A stretch has at least half a minute of sound. None if unknown.
        """
        count = exactly(stretches(self.home.sound, self.night))
        return _if_covered(count, self._share_of(self.night))

    @property
    def hours(self) -> Int64:
        """Edges of the hours of the day, in nanoseconds of UTC; 24 to 26 of them."""
        start, end = self.span.starts[0], self.span.ends[0]
        return np.append(np.arange(start, end, HOUR), end)

    @property
    def sound_by_hour(self) -> NDArray[np.float64]:
        """Minutes with sound between successive edges of `hours`."""
        return lengths(self.home.sound, self.hours) / MINUTE

    @property
    def longest_quiet(self) -> Spans:
        """The longest quiet span from 07:00 to 22:00; empty without coverage."""
        return longest_quiet(self.home.sound, self.home.coverage, self.day, self.zone)

    @property
    def quiet(self) -> Duration | None:
        """Length of `longest_quiet`; None if less than half of its search window is covered."""
        is_covered = self._share_of(self.waking) >= _HALF
        return _length(self.longest_quiet) if is_covered else None

    @property
    def active(self) -> Int64:
        """Starts of the ten-minute blocks with at least a minute of sound, in ns of UTC.

        The first block of a day begins at 04:00.
        """
        edges = np.arange(at_hour(self.day, RISING, self.zone), self.span.ends[0] + 1, _BIN)
        return edges[:-1][lengths(self.home.sound, edges) >= _BUSY]

    @property
    def first(self) -> Clock | None:
        """Start of the first of the `active` blocks; None if unknown, or without a block."""
        before = at_hour(self.day, RISING, self.zone)
        return self._clock(self.active[:1], lambda time: (before, time))

    @property
    def first_sound(self) -> Clock | None:
        """Start of the first sound from 04:00 on, however short; None as for `first`."""
        before = at_hour(self.day, RISING, self.zone)
        sound = intersection(self.home.sound, self.span)
        return self._clock(sound.starts[sound.starts >= before][:1], lambda time: (before, time))

    @property
    def last(self) -> Clock | None:
        """Last minute of the last of the `active` blocks; None as for `first`."""
        after = int(self.span.ends[0])
        return self._clock(self.active[-1:] + _BIN - MINUTE, lambda time: (time + MINUTE, after))

    def _share_of(self, span: Spans) -> float:
        return _share(self.home.coverage, span)

    def _clock(self, times: Int64, quiet: Callable[[int], tuple[int, int]]) -> Clock | None:
        """Return the first time as a time of day; None if its quiet span is mostly not covered."""
        if not len(times):
            return None
        start, end = quiet(int(times[0]))
        if start < end and self._share_of(single_span(start, end)) < MOST:
            return None
        local = local_time(int(times[0]), self.zone)
        return Clock(60 * local.hour + local.minute)


def day_of(
    home: HomeMetrics,
    day: date,
    zone: tzinfo,
    logged: tuple[int, int] | None = None,
) -> DayMetrics:
    """Return the figures of a local day; its night is from 22:00 on the day before to 07:00.

    `logged` is from when to when the home has logs, in nanoseconds of UTC; by default all the time.
    """
    start, end = day_span(day, zone)
    span, night = single_span(start, end), single_span(*night_span(day, zone))
    near = home.between(min(int(night.starts[0]), start), max(int(night.ends[0]), end))
    always = int(night.starts[0]), end
    return DayMetrics(day, near, zone, span, night, always if logged is None else logged)


def _share(covered: Spans, span: Spans) -> float:
    return intersection(covered, span).length / span.length


def _if_covered(value: _Figure, share: float) -> _Figure | None:
    """Return a figure; None without coverage, or for a 0 with too little coverage."""
    return value if share >= MOST or (share and value.middle) else None


def _length(spans: Spans) -> Duration:
    return Duration(spans.length / MINUTE)
