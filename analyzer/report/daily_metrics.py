"""Metrics of a home and of its days: coverage, durations, events, and counts with their ranges."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import date, timedelta, tzinfo
from functools import reduce
from itertools import chain
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.accuracy.checked_minutes import CheckedMinutes
from hearthlog.analyzer.accuracy.event_counts import (
    MINUTE,
    SET_APART,
    CheckedRates,
    events_of,
    sounding_minutes,
    strata_of,
    television_minutes,
)
from hearthlog.analyzer.logs.labelling import Labelling
from hearthlog.analyzer.logs.local_time import EVENING, MORNING, at_hour, day_span, local_time
from hearthlog.analyzer.logs.spans import (
    NONE,
    Spans,
    common,
    cut,
    joined,
    lengths,
    one,
    rows_at,
    without,
)
from hearthlog.analyzer.report.read_home import HomeData
from hearthlog.analyzer.report.values import Clock, Count, Duration, exactly
from hearthlog.analyzer.routine.day_profile import HomeSegments, longest_quiet, stretches
from hearthlog.models.classes import SILENCE, UNKNOWN, class_name
from hearthlog.schemas.arrays import Bool, Int64


@dataclass(frozen=True)
class HomeMinutes:
    """The minutes in which at least one microphone heard.

    Attributes
    ----------
    starts : np.ndarray [shape=(n,)], int64
        In nanoseconds of UTC.
    sounding, television, gone_through : np.ndarray [shape=(n,)], bool
        Whether anything sounds, and like a television, by the labels; whether a person has gone
        through all of the minute.
    labelled, corrected, certain : dict of str to np.ndarray [shape=(n,)], int64
        By class but silence, the events that begin in each minute: labelled ones where no one has
        gone through; all, with what a person says in the place of labels; those of them that begin
        where a person has gone through.
    """

    starts: Int64
    sounding: Bool
    television: Bool
    gone_through: Bool
    labelled: dict[str, Int64]
    corrected: dict[str, Int64]
    certain: dict[str, Int64]

    def between(self, spans: Spans) -> "HomeMinutes":
        """Return the minutes that begin in some spans of time."""
        of = np.searchsorted(spans.starts, self.starts, side="right") - 1
        return self.rows((of >= 0) & (self.starts < spans.ends[of]))

    def count(self, name: str, rates: CheckedRates | None) -> Count:
        """Count the events of a class; those of `SET_APART` only where no television sounds."""
        own = self.rows(~self.television) if name in SET_APART else self
        if name not in own.labelled:
            return Count(rates=rates)
        rest = ~own.gone_through
        return Count(
            int(own.corrected[name].sum()),
            int(own.certain[name].sum()),
            strata_of(own.labelled[name][rest], own.sounding[rest]),
            rates,
        )

    def counted(self, name: str, starts: Int64) -> Int64:
        """Return those of the events of a class that `count` counts.

        Parameters
        ----------
        starts : np.ndarray [shape=(n,)], int64
            When they began, within these minutes.
        """
        if name not in SET_APART:
            return starts
        television = self.starts[self.television]
        return starts[~np.isin(starts // MINUTE * MINUTE, television)]

    def beside_television(self, name: str) -> int:
        """Count the labelled events of a class where something sounds like a television.

        Parameters
        ----------
        name : str
            Of the class; 0 for one that is not set apart.
        """
        if name not in SET_APART or name not in self.labelled:
            return 0
        return int(self.corrected[name][self.television].sum())

    def rows(self, rows: Bool) -> "HomeMinutes":
        """Return some of the minutes.

        Parameters
        ----------
        rows : np.ndarray [shape=(n,)], bool
        """
        return HomeMinutes(
            self.starts[rows],
            self.sounding[rows],
            self.television[rows],
            self.gone_through[rows],
            {name: counts[rows] for name, counts in self.labelled.items()},
            {name: counts[rows] for name, counts in self.corrected.items()},
            {name: counts[rows] for name, counts in self.certain.items()},
        )


def home_minutes(
    labels: Labelling, gone_through: Sequence[Spans], coverage: Spans, events: Mapping[str, Int64]
) -> HomeMinutes:
    """Count what begins in each minute that was heard, at least in part.

    Parameters
    ----------
    coverage : Spans
        When at least one of them heard.
    events : mapping of str to np.ndarray [shape=(n,)], int64
        By class but silence, when events began, with what a person says in the place of labels.
    """
    first, last = int(coverage.starts[0]) // MINUTE, -(-int(coverage.ends[-1]) // MINUTE)
    edges = np.arange(first, last + 1) * MINUTE
    known = reduce(common, gone_through)

    def begun(starts: Int64) -> Int64:
        return np.diff(np.searchsorted(starts, edges))

    def unknown(name: str) -> Int64:
        starts = events_of(labels, name).starts
        return starts[rows_at(known, starts) < 0]

    minutes = HomeMinutes(
        edges[:-1],
        sounding_minutes(labels, edges),
        television_minutes(labels, edges),
        lengths(known, edges) == MINUTE,
        {name: begun(unknown(name)) for name in events},
        {name: begun(starts) for name, starts in events.items()},
        {name: begun(starts[rows_at(known, starts) >= 0]) for name, starts in events.items()},
    )
    return minutes.rows(lengths(coverage, edges) > 0)


def checked_rates_of(minutes: HomeMinutes, checks: CheckedMinutes) -> dict[str, CheckedRates]:
    """Return the rates of the classes of which enough minutes were checked."""
    amounts = {
        name: int(counts.sum()) + 1
        for name, counts in minutes.labelled.items()
        if class_name(name) != UNKNOWN  # which nothing is truly
    }
    whole = sum(amounts.values())
    fewest = 1 / max(len(amounts), 1)  # a class that labels hardly name may be missed all the more
    drawn = {
        name: checks.rates(name, max(amount / whole, fewest)) for name, amount in amounts.items()
    }
    return {name: rates for name, rates in drawn.items() if rates is not None}


@dataclass(frozen=True)
class HomeMetrics:
    """What was heard in a home, by all its microphones together."""

    classes: list[str]
    coverage: Spans  # when at least one of them heard
    listened: dict[str, Spans]  # by class: when at least one of them heard whose model knows it
    sound: Spans  # when at least one of them heard something else than silence
    spans: dict[str, Spans]  # by class: when at least one of them heard it
    # by class, but silence: when events began; spans with no more than ten seconds between them are
    # one event, and so are those of two microphones at one time
    events: dict[str, Int64]
    minutes: HomeMinutes
    rates: dict[str, CheckedRates]  # by class, of the minutes that were checked

    def between(self, start: int, end: int) -> "HomeMetrics":
        """Return what was heard in a span of time.

        Parameters
        ----------
        start, end : int
            In nanoseconds of UTC; an event belongs to the span that it begins in.
        """
        return HomeMetrics(
            self.classes,
            cut(self.coverage, start, end),
            {name: cut(spans, start, end) for name, spans in self.listened.items()},
            cut(self.sound, start, end),
            {name: cut(spans, start, end) for name, spans in self.spans.items()},
            {name: self.events_in(name, one(start, end)) for name in self.events},
            self.minutes.between(one(start, end)),
            self.rates,
        )

    def events_in(self, name: str, span: Spans) -> Int64:
        """Return when the events of a class began in a span of time.

        Parameters
        ----------
        name : str
            Of the class; one without events, such as silence, has none.

        Returns
        -------
        np.ndarray [shape=(n,)], int64
            In nanoseconds of UTC.
        """
        starts = self.events.get(name, NONE.starts)
        return starts[(starts >= span.starts[0]) & (starts < span.ends[0])]


def whole_home(data: HomeData, checks: CheckedMinutes | None = None) -> HomeMetrics:
    """Put together what the microphones of a home heard.

    Parameters
    ----------
    data : HomeData
        With the segments and classes of at least one microphone.
    checks : CheckedMinutes, optional
        Minutes of the home that were drawn at random, and checked.

    Returns
    -------
    HomeMetrics
        A span is silent where no microphone heard anything else; segments of a class that are at
        most ten seconds apart, of whichever microphones, are one event.
    """
    labels = _together(data.segments.values())
    everything = joined(labels.starts, labels.ends)
    loud = labels.labels != SILENCE
    sound = joined(labels.starts[loud], labels.ends[loud])
    classes = list(dict.fromkeys(chain.from_iterable(data.classes.values())))
    listened, spans, events = {}, {}, {}
    for name in classes:
        own = labels.labels == name
        knowing = [part for source, part in data.segments.items() if name in data.classes[source]]
        listened[name] = _spans(_together(knowing))
        spans[name] = joined(labels.starts[own], labels.ends[own])
        events[name] = events_of(labels, name).starts
    if SILENCE in spans:
        spans[SILENCE] = without(spans[SILENCE], sound)  # another microphone heard something
        del events[SILENCE]
    gone_through = [data.gone_through.get(source, NONE) for source in data.segments]
    labelled = _together(data.labelled.values())
    minutes = home_minutes(labelled, gone_through, everything, events)
    rates = {} if checks is None else checked_rates_of(minutes, checks)
    return HomeMetrics(classes, everything, listened, sound, spans, events, minutes, rates)


def home_sound(data: HomeData, metrics: HomeMetrics) -> HomeSegments:
    """Return what routines are learned from: the labels of all microphones."""
    return HomeSegments(_together(data.segments.values()), metrics.listened)


def _together(parts: Iterable[Labelling]) -> Labelling:
    """Put labels of microphones in the order of time; they may overlap."""
    parts = list(parts)
    starts, ends, labels = (
        np.concatenate([getattr(part, name) for part in parts])
        for name in ("starts", "ends", "labels")
    )
    order = np.argsort(starts, kind="stable")
    return Labelling(starts[order], ends[order], labels[order])


def _spans(labels: Labelling) -> Spans:
    return joined(labels.starts, labels.ends)


_RISING = 4  # of the clock: what is heard before is of the night
HOUR = 60 * MINUTE
MOST = 0.75  # of a time: what has to be heard for a 0 to be said, and for days to be compared
_Figure = TypeVar("_Figure", Count, Duration)
_HALF = 0.5
_BIN, _BUSY = 10 * MINUTE, MINUTE


@dataclass(frozen=True)
class DayMetrics:
    """The figures of one day, and of the night that ends on it."""

    day: date
    home: HomeMetrics
    zone: tzinfo
    span: Spans  # a single span, as the night is
    night: Spans
    coverage: Spans  # what of the day was heard

    @property
    def share(self) -> float:
        """Share of the day that was heard, 0 to 1."""
        return self.coverage.length / self.span.length

    @property
    def night_hours(self) -> float:
        """Hours of the night that were heard."""
        return common(self.home.coverage, self.night).length / HOUR

    def comparable(self, name: str = "") -> bool:
        """Tell whether three quarters of the day, and of its night, were heard."""
        spans = [self.home.listened[name]] if name else [*self.home.listened.values()]
        wholes = self.span, self.night
        shares = [common(each, whole).length / whole.length for each in spans for whole in wholes]
        return min(shares) >= MOST

    def share_of(self, name: str) -> float:
        """Return the share of the day in which a class would have been heard, 0 to 1.

        Parameters
        ----------
        name : str
            Of the class; 0 for one that the home does not know.
        """
        return _share(self.home.listened.get(name, NONE), self.span)

    def minutes(self, name: str) -> Duration | None:
        """Return how long a class was heard; None if it is not known."""
        minutes = _length(common(self.home.spans.get(name, NONE), self.span))
        return _if_known(minutes, self.share_of(name))

    def events(self, name: str) -> Int64:
        """Return when the events of a class began on this day.

        Parameters
        ----------
        name : str
            Of the class; one without events, such as silence, has none.

        Returns
        -------
        np.ndarray [shape=(n,)], int64
            In nanoseconds of UTC.
        """
        return self.home.events_in(name, self.span)

    def night_events(self, name: str) -> Int64:
        """Return when the events of a class began in the night that `night_count` counts.

        Parameters
        ----------
        name : str
            Of the class; one without events, such as silence, has none.

        Returns
        -------
        np.ndarray [shape=(n,)], int64
            In nanoseconds of UTC.
        """
        return self.home.minutes.counted(name, self.home.events_in(name, self.night))

    def count(self, name: str) -> Count | None:
        """Return how often a class was heard on this day; None if it is not known."""
        return _if_known(self._count(name, self.span), self.share_of(name))

    def night_count(self, name: str) -> Count | None:
        """Return how often a class was heard in the night; None if it is not known."""
        share = _share(self.home.listened.get(name, NONE), self.night)
        return _if_known(self._count(name, self.night), share)

    def beside_television(self, name: str) -> int:
        """Return how many events of a class were not counted, because of a television."""
        return self.home.minutes.between(self.span).beside_television(name)

    def _count(self, name: str, span: Spans) -> Count:
        return self.home.minutes.between(span).count(name, self.home.rates.get(name))

    @property
    def sound(self) -> Duration | None:
        """How long there was any sound on this day; None if it is not known."""
        return _if_known(_length(common(self.home.sound, self.span)), self.share)

    @property
    def night_sound(self) -> Duration | None:
        """How long there was any sound in the night; None if it is not known."""
        return _if_known(_length(common(self.home.sound, self.night)), self._share_of(self.night))

    @property
    def night_stretches(self) -> Count | None:
        """Number of stretches of sound in the night, with ten quiet minutes between them.

        A stretch has at least half a minute of sound. None if it is not known.
        """
        count = exactly(stretches(self.home.sound, self.night))
        return _if_known(count, self._share_of(self.night))

    @property
    def hours(self) -> Int64:
        """Edges of the hours of the day, in nanoseconds of UTC; 24 to 26 of them."""
        start, end = self.span.starts[0], self.span.ends[0]
        return np.append(np.arange(start, end, HOUR), end)

    @property
    def sound_by_hour(self) -> NDArray[np.float64]:
        """Minutes with sound between each two successive edges of `hours`."""
        return lengths(self.home.sound, self.hours) / MINUTE

    @property
    def longest_quiet(self) -> Spans:
        """The longest quiet span from 07:00 to 22:00; empty if nothing was heard then."""
        return longest_quiet(self.home.sound, self.home.coverage, self.day, self.zone)

    @property
    def quiet(self) -> Duration | None:
        """Length of `longest_quiet`; None if less than half of the time it lies in was heard."""
        waking = one(at_hour(self.day, MORNING, self.zone), at_hour(self.day, EVENING, self.zone))
        return _length(self.longest_quiet) if self._share_of(waking) >= _HALF else None

    @property
    def active(self) -> Int64:
        """Starts of the ten-minute blocks with a minute of sound or more, in ns of UTC.

        The first block of a day begins at 04:00.
        """
        edges = np.arange(at_hour(self.day, _RISING, self.zone), self.span.ends[0] + 1, _BIN)
        return edges[:-1][lengths(self.home.sound, edges) >= _BUSY]

    @property
    def first(self) -> Clock | None:
        """Start of the first of the `active` blocks; None if it is not known, or there is none."""
        before = at_hour(self.day, _RISING, self.zone)
        return self._clock(self.active[:1], lambda time: (before, time))

    @property
    def last(self) -> Clock | None:
        """Last minute of the last of the `active` blocks; None as for `first`."""
        after = int(self.span.ends[0])
        return self._clock(self.active[-1:] + _BIN - MINUTE, lambda time: (time + MINUTE, after))

    def _share_of(self, span: Spans) -> float:
        return _share(self.home.coverage, span)

    def _clock(self, times: Int64, quiet: Callable[[int], tuple[int, int]]) -> Clock | None:
        """Return a time, if most of the span was heard in which there was nothing."""
        if not len(times):
            return None
        start, end = quiet(int(times[0]))
        if start < end and self._share_of(one(start, end)) < MOST:
            return None
        local = local_time(int(times[0]), self.zone)
        return Clock(60 * local.hour + local.minute)


def day_of(home: HomeMetrics, day: date, zone: tzinfo) -> DayMetrics:
    """Return the figures of one day of a home.

    Parameters
    ----------
    day : date
        By the clock of the home; its night is from 22:00 on the day before to 07:00.
    """
    start, end = day_span(day, zone)
    night = one(at_hour(day - timedelta(days=1), EVENING, zone), at_hour(day, MORNING, zone))
    span = one(start, end)
    near = home.between(min(int(night.starts[0]), start), max(int(night.ends[0]), end))
    return DayMetrics(day, near, zone, span, night, common(near.coverage, span))


def _share(heard: Spans, span: Spans) -> float:
    return common(heard, span).length / span.length


def _if_known(value: _Figure, share: float) -> _Figure | None:
    """Return a figure, but for a 0 where too little was heard to know that there was nothing."""
    return value if share >= MOST or (share and value.middle) else None


def _length(spans: Spans) -> Duration:
    return Duration(spans.length / MINUTE)
