"""The figures of a day: what was heard, for how long, how often, when."""

from dataclasses import dataclass
from datetime import date, timedelta, tzinfo
from itertools import chain
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.logs.local_time import at_hour, day_span, local_time
from hearthlog.analyzer.logs.spans import (
    NONE,
    Spans,
    common,
    cut,
    first_of_groups,
    joined,
    lengths,
    one,
    without,
)
from hearthlog.analyzer.report.read_home import HomeData
from hearthlog.analyzer.report.segments import Segments
from hearthlog.analyzer.report.values import Clock, Count, Minutes, exactly
from hearthlog.models.classes import SILENCE
from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.times import NANOSECONDS

EVENING, MORNING = 22, 7  # of the clock: between them is the night
_RISING = 4  # of the clock: what is heard before is of the night
_MINUTE = 60 * NANOSECONDS
HOUR = 60 * _MINUTE
_EVENT_PAUSE = 10 * NANOSECONDS
_STRETCH_PAUSE, _STRETCH = 10 * _MINUTE, 30 * NANOSECONDS
MOST = 0.75  # of a day and of its night, for its figures to be compared
_BIN, _BUSY = 10 * _MINUTE, _MINUTE


class CountedEvents(NamedTuple):
    """What happened, by when it began."""

    starts: Int64  # shape (n,), in nanoseconds of UTC; they ascend
    chances: NDArray[np.float64]  # shape (n,), of each that it happened

    def between(self, spans: Spans) -> "CountedEvents":
        """Return the events that began in some spans of time.

        Parameters
        ----------
        spans : Spans
            In nanoseconds of UTC.
        """
        of = np.searchsorted(spans.starts, self.starts, side="right") - 1
        inside = of >= 0
        inside[inside] = self.starts[inside] < spans.ends[of[inside]]
        return CountedEvents(self.starts[inside], self.chances[inside])

    @property
    def number(self) -> Count:
        """How many events there were, by the chances that they happened.

        The mean and the variance are those of a Poisson binomial distribution.
        """
        p = self.chances
        variance = float((p * (1 - p)).sum())
        return Count(float(p.sum()), variance, int((p == 1).sum()), len(p))


@dataclass(frozen=True)
class HomeMetrics:
    """What was heard in a home, by all its microphones together."""

    classes: list[str]
    coverage: Spans  # when at least one of them heard
    listened: dict[str, Spans]  # by class: when at least one of them heard whose model knows it
    sound: Spans  # when at least one of them heard something else than silence
    spans: dict[str, Spans]  # by class: when at least one of them heard it
    # by class, but silence; spans with no more than ten seconds between them are one event, and
    # so are those of two microphones at one time
    events: dict[str, CountedEvents]

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
            {name: events.between(one(start, end)) for name, events in self.events.items()},
        )


def whole_home(data: HomeData) -> HomeMetrics:
    """Put together what the microphones of a home heard.

    Parameters
    ----------
    data : HomeData
        With the segments and classes of at least one microphone.

    Returns
    -------
    HomeMetrics
        A span is silent where no microphone heard anything else; segments of a class that are at
        most ten seconds apart, of whichever microphones, are one event.
    """
    parts = list(data.segments.values())
    starts, ends, labels, chances = (
        np.concatenate([getattr(part, name) for part in parts]) for name in Segments._fields
    )
    everything = joined(starts, ends)
    loud = labels != SILENCE
    sound = joined(starts[loud], ends[loud])
    classes = list(dict.fromkeys(chain.from_iterable(data.classes.values())))
    listened, spans, events = {}, {}, {}
    for name in classes:
        own = labels == name
        knowing = [
            part.spans for source, part in data.segments.items() if name in data.classes[source]
        ]
        begun, ended = (np.concatenate(edges) for edges in zip(*knowing, strict=True))
        listened[name] = joined(begun, ended)
        spans[name] = joined(starts[own], ends[own])
        events[name] = _events(starts[own], ends[own], chances[own])
    if SILENCE in spans:
        spans[SILENCE] = without(spans[SILENCE], sound)  # another microphone heard something
        del events[SILENCE]
    return HomeMetrics(classes, everything, listened, sound, spans, events)


def _events(starts: Int64, ends: Int64, chances: NDArray[np.float64]) -> CountedEvents:
    """Make events of segments; of each the surest segment counts."""
    order = np.argsort(starts, kind="stable")
    starts, ends, chances = starts[order], ends[order], chances[order]
    firsts = first_of_groups(starts, ends, _EVENT_PAUSE)
    best = np.maximum.reduceat(chances, firsts) if len(firsts) else chances
    return CountedEvents(starts[firsts], best)


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
        return _minutes(common(self.home.spans.get(name, NONE), self.span))

    def events(self, name: str) -> CountedEvents:
        """Return the events of a class that began on this day.

        Parameters
        ----------
        name : str
            Of the class; one without events, such as silence, has none.
        """
        return _of(self.home, name).between(self.span)

    def night_events(self, name: str) -> CountedEvents:
        """Return the events of a class that began in the night.

        Parameters
        ----------
        name : str
            Of the class; one without events, such as silence, has none.
        """
        return _of(self.home, name).between(self.night)

    def count(self, name: str) -> Count | None:
        """Return how often a class was heard on this day; None if it could not be.

        Parameters
        ----------
        name : str
            Of the class.
        """
        return self.events(name).number if self.share_of(name) else None

    def night_count(self, name: str) -> Count | None:
        """Return how often a class was heard in the night; None if it could not be.

        Parameters
        ----------
        name : str
            Of the class.
        """
        listened = common(self.home.listened.get(name, NONE), self.night).length > 0
        return self.night_events(name).number if listened else None

    @property
    def sound(self) -> Minutes:
        """How long there was any sound on this day."""
        return _minutes(common(self.home.sound, self.span))

    @property
    def night_sound(self) -> Minutes:
        """How long there was any sound in the night."""
        return _minutes(common(self.home.sound, self.night))

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
        return lengths(self.home.sound, self.hours) / _MINUTE

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
        return _minutes(self.longest_quiet) if self.coverage.length else None

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
        return self._clock(self.active[-1:] + _BIN - _MINUTE)

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


def _of(home: HomeMetrics, name: str) -> CountedEvents:
    return home.events.get(name, CountedEvents(NONE.starts, np.empty(0)))


def _minutes(spans: Spans) -> Minutes:
    return Minutes(spans.length / _MINUTE)
