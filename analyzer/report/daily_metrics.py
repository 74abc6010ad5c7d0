"""The figures of a day: what was heard, for how long, how often, when."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import date, timedelta, tzinfo
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.accuracy.checked_minutes import CheckedMinutes
from hearthlog.analyzer.accuracy.count_range import CheckedRates, strata_of
from hearthlog.analyzer.accuracy.events import (
    MINUTE,
    SET_APART,
    events_by_minute,
    events_of,
    sounding_minutes,
    television_minutes,
)
from hearthlog.analyzer.logs.labelling import Labelling
from hearthlog.analyzer.logs.local_time import at_hour, day_span, local_time
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
from hearthlog.analyzer.report.read_home import HomeData
from hearthlog.analyzer.report.values import Clock, Count, Minutes, exactly
from hearthlog.models.classes import SILENCE
from hearthlog.schemas.arrays import Bool, Int64
from hearthlog.schemas.times import NANOSECONDS

EVENING, MORNING = 22, 7  # of the clock: between them is the night
_RISING = 4  # of the clock: what is heard before is of the night
HOUR = 60 * MINUTE
_STRETCH_PAUSE, _STRETCH = 10 * MINUTE, 30 * NANOSECONDS
MOST = 0.75  # of a day and of its night, for its figures to be compared
_BIN, _BUSY = 10 * MINUTE, MINUTE


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
    minutes: "HomeMinutes"
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
            {name: _within(starts, one(start, end)) for name, starts in self.events.items()},
            self.minutes.between(one(start, end)),
            self.rates,
        )


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
    said, corrected : dict of str to np.ndarray [shape=(n,)], int64
        By class but silence, the events that begin in each minute: as labelled, and with what a
        person says in the place of labels.
    """

    starts: Int64
    sounding: Bool
    television: Bool
    gone_through: Bool
    said: dict[str, Int64]
    corrected: dict[str, Int64]

    def between(self, spans: Spans) -> "HomeMinutes":
        """Return the minutes that begin in some spans of time.

        Parameters
        ----------
        spans : Spans
            In nanoseconds of UTC.
        """
        of = np.searchsorted(spans.starts, self.starts, side="right") - 1
        return self.rows((of >= 0) & (self.starts < spans.ends[of]))

    def count(self, name: str, rates: CheckedRates | None) -> Count:
        """Count the events of a class; those of `SET_APART` only where no television sounds.

        Parameters
        ----------
        name : str
            Of the class.
        rates : CheckedRates or None
            Of the class.
        """
        own = self.rows(~self.television) if name in SET_APART else self
        if name not in own.said:
            return Count(rates=rates)
        certain, rest = own.gone_through, ~own.gone_through
        return Count(
            int(own.corrected[name].sum()),
            int(own.corrected[name][certain].sum()),
            strata_of(own.said[name][rest], own.sounding[rest]),
            rates,
        )

    def beside_television(self, name: str) -> int:
        """Count the labelled events of a class where something sounds like a television.

        Parameters
        ----------
        name : str
            Of the class; 0 for one that is not set apart.
        """
        if name not in SET_APART or name not in self.said:
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
            {name: counts[rows] for name, counts in self.said.items()},
            {name: counts[rows] for name, counts in self.corrected.items()},
        )


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
    minutes = _minutes(data, everything, events)
    return HomeMetrics(
        classes, everything, listened, sound, spans, events, minutes, _rates(minutes, checks)
    )


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


def _minutes(data: HomeData, coverage: Spans, events: Mapping[str, Int64]) -> HomeMinutes:
    """Count what begins in each minute that was heard, at least in part."""
    first, last = int(coverage.starts[0]) // MINUTE, -(-int(coverage.ends[-1]) // MINUTE)
    edges = np.arange(first, last + 1) * MINUTE
    labels = _together(data.labelled.values())
    through = [data.gone_through.get(source, NONE) for source in data.segments]
    whole = [lengths(spans, edges) == MINUTE for spans in through]
    minutes = HomeMinutes(
        edges[:-1],
        sounding_minutes(labels, edges),
        television_minutes(labels, edges),
        np.logical_and.reduce(whole),
        {name: events_by_minute(events_of(labels, name), edges) for name in events},
        {name: np.diff(np.searchsorted(starts, edges)) for name, starts in events.items()},
    )
    return minutes.rows(lengths(coverage, edges) > 0)


def _rates(minutes: HomeMinutes, checks: CheckedMinutes | None) -> dict[str, CheckedRates]:
    if checks is None:
        return {}
    amounts = {name: int(counts.sum()) + 1 for name, counts in minutes.said.items()}
    whole = sum(amounts.values())
    fewest = 1 / max(len(amounts), 1)  # a class that labels hardly name may be missed all the more
    drawn = {
        name: checks.rates(name, max(amount / whole, fewest)) for name, amount in amounts.items()
    }
    return {name: rates for name, rates in drawn.items() if rates is not None}


@dataclass(frozen=True)
class Day:
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
        """Tell whether three quarters of the day, and of its night, were heard.

        Parameters
        ----------
        name : str, optional
            A class of the home: what was heard by microphones whose model knows it; by default the
            class that is worst off.
        """
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
        return common(self.home.listened.get(name, NONE), self.span).length / self.span.length

    def minutes(self, name: str) -> Minutes | None:
        """Return how long a class was heard; None if it could not be.

        Parameters
        ----------
        name : str
            Of the class.
        """
        if not self.share_of(name):
            return None
        return _length(common(self.home.spans.get(name, NONE), self.span))

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
        return _within(self.home.events.get(name, NONE.starts), self.span)

    def night_events(self, name: str) -> Int64:
        """Return when the events of a class began in the night.

        Parameters
        ----------
        name : str
            Of the class; one without events, such as silence, has none.

        Returns
        -------
        np.ndarray [shape=(n,)], int64
            In nanoseconds of UTC.
        """
        return _within(self.home.events.get(name, NONE.starts), self.night)

    def count(self, name: str) -> Count | None:
        """Return how often a class was heard on this day; None if it could not be.

        Parameters
        ----------
        name : str
            Of the class.
        """
        return self._count(name, self.span) if self.share_of(name) else None

    def night_count(self, name: str) -> Count | None:
        """Return how often a class was heard in the night; None if it could not be.

        Parameters
        ----------
        name : str
            Of the class.
        """
        listened = common(self.home.listened.get(name, NONE), self.night).length > 0
        return self._count(name, self.night) if listened else None

    def beside_television(self, name: str) -> int:
        """Return how many events of a class were not counted, because of a television.

        Parameters
        ----------
        name : str
            Of the class.
        """
        return self.home.minutes.between(self.span).beside_television(name)

    def _count(self, name: str, span: Spans) -> Count:
        return self.home.minutes.between(span).count(name, self.home.rates.get(name))

    @property
    def sound(self) -> Minutes:
        """How long there was any sound on this day."""
        return _length(common(self.home.sound, self.span))

    @property
    def night_sound(self) -> Minutes:
        """How long there was any sound in the night."""
        return _length(common(self.home.sound, self.night))

    @property
    def night_stretches(self) -> Count:
        """Number of stretches of sound in the night, with ten quiet minutes between them.

        A stretch has at least half a minute of sound.
        """
        sound = common(self.home.sound, self.night)
        stretches = joined(*sound, _STRETCH_PAUSE)
        if not len(stretches.starts):
            return exactly(0)
        edges = np.append(stretches.starts, stretches.ends[-1:])
        return exactly(int((lengths(sound, edges) >= _STRETCH).sum()))

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
        waking = one(at_hour(self.day, MORNING, self.zone), at_hour(self.day, EVENING, self.zone))
        quiet = without(common(self.home.coverage, waking), self.home.sound)
        if not len(quiet.starts):
            return NONE
        longest = int((quiet.ends - quiet.starts).argmax())
        return Spans(*(edge[longest : longest + 1] for edge in quiet))

    @property
    def quiet(self) -> Minutes | None:
        """Length of `longest_quiet`; None if nothing of the day was heard."""
        return _length(self.longest_quiet) if self.coverage.length else None

    @property
    def active(self) -> Int64:
        """Starts of the ten-minute blocks with a minute of sound or more, in ns of UTC.

        The first block of a day begins at 04:00.
        """
        edges = np.arange(at_hour(self.day, _RISING, self.zone), self.span.ends[0] + 1, _BIN)
        return edges[:-1][lengths(self.home.sound, edges) >= _BUSY]

    @property
    def first(self) -> Clock | None:
        """Start of the first of the `active` blocks; None if there are none."""
        return self._clock(self.active[:1])

    @property
    def last(self) -> Clock | None:
        """Last minute of the last of the `active` blocks; None if there are none."""
        return self._clock(self.active[-1:] + _BIN - MINUTE)

    def _clock(self, times: Int64) -> Clock | None:
        if not len(times):
            return None
        local = local_time(int(times[0]), self.zone)
        return Clock(60 * local.hour + local.minute)


def day_of(home: HomeMetrics, day: date, zone: tzinfo) -> Day:
    """Return the figures of one day of a home.

    Parameters
    ----------
    home : HomeMetrics
    day : date
        By the clock of the home; its night is from 22:00 on the day before to 07:00.
    zone : tzinfo
        Of the home.
    """
    start, end = day_span(day, zone)
    night = one(at_hour(day - timedelta(days=1), EVENING, zone), at_hour(day, MORNING, zone))
    span = one(start, end)
    near = home.between(min(int(night.starts[0]), start), max(int(night.ends[0]), end))
    return Day(day, near, zone, span, night, common(near.coverage, span))


def _within(starts: Int64, span: Spans) -> Int64:
    return starts[(starts >= span.starts[0]) & (starts < span.ends[0])]


def _length(spans: Spans) -> Minutes:
    return Minutes(spans.length / MINUTE)
