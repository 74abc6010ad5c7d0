"""The figures of a day: what was heard, for how long, how often, when."""

from collections.abc import Callable
from dataclasses import dataclass
from datetime import date, timedelta, tzinfo
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.accuracy.event_counts import MINUTE
from hearthlog.analyzer.logs.local_time import EVENING, MORNING, at_hour, day_span, local_time
from hearthlog.analyzer.logs.spans import NONE, Spans, common, lengths, one
from hearthlog.analyzer.report.home_metrics import HomeMetrics
from hearthlog.analyzer.report.values import Clock, Count, Minutes, exactly
from hearthlog.analyzer.routine.day_profile import longest_quiet, stretches
from hearthlog.schemas.arrays import Int64

_RISING = 4  # of the clock: what is heard before is of the night
HOUR = 60 * MINUTE
MOST = 0.75  # of a time: what has to be heard for a 0 to be said, and for days to be compared
_Figure = TypeVar("_Figure", Count, Minutes)
_HALF = 0.5
_BIN, _BUSY = 10 * MINUTE, MINUTE


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

    def minutes(self, name: str) -> Minutes | None:
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
    def sound(self) -> Minutes | None:
        """How long there was any sound on this day; None if it is not known."""
        return _if_known(_length(common(self.home.sound, self.span)), self.share)

    @property
    def night_sound(self) -> Minutes | None:
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
    def quiet(self) -> Minutes | None:
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


def day_of(home: HomeMetrics, day: date, zone: tzinfo) -> Day:
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
    return Day(day, near, zone, span, night, common(near.coverage, span))


def _share(heard: Spans, span: Spans) -> float:
    return common(heard, span).length / span.length


def _if_known(value: _Figure, share: float) -> _Figure | None:
    """Return a figure, but for a 0 where too little was heard to know that there was nothing."""
    return value if share >= MOST or (share and value.middle) else None


def _length(spans: Spans) -> Minutes:
    return Minutes(spans.length / MINUTE)
