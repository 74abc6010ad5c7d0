"""Quantities of a report (counts, durations, times of day), and their usual range."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

from hearthlog.analyzer.accuracy.event_counts import NO_MINUTES, CheckedRates, Strata

_MIN = " min"


class _Quantity(ABC):
    """What is counted."""

    @property
    @abstractmethod
    def middle(self) -> float:
        """The number, as it is compared with that of other days."""

    @property
    def text(self) -> str:
        """The number in words."""
        return self.show(self.middle)

    @staticmethod
    @abstractmethod
    def show(number: float) -> str:
        """Write a number."""

    def spread(self, median: float, lowest: float, highest: float) -> str:
        """Write what is usual: `4 (3 to 6)`; where both ends are minutes alone, `min` comes once.

        Parameters
        ----------
        median, lowest, highest : float
            Numbers, as `show` takes them.
        """
        low, high = self.show(lowest), self.show(highest)
        if low == high:
            return self.show(median)
        if high.endswith(_MIN) and low.endswith(_MIN) and " h " not in low + high:
            low = low.removesuffix(_MIN)
        return f"{self.show(median)} ({low} to {high})"


@dataclass(frozen=True)
class Count(_Quantity):
    """A number of events."""

    labelled: int = 0  # where a person has corrected labels, as corrected
    certain: int = 0  # of those, the ones in minutes that a person has gone through
    unchecked: Strata = NO_MINUTES  # the other ones
    rates: CheckedRates | None = None  # None where too few minutes were checked

    def __add__(self, other: "Count") -> "Count":
        return Count(
            self.labelled + other.labelled,
            self.certain + other.certain,
            self.unchecked.plus(other.unchecked),
            self.rates or other.rates,
        )

    @property
    def middle(self) -> float:
        """The number of labelled events."""
        return self.labelled

    @property
    def range(self) -> tuple[int, int] | None:
        """Where the right number lies nine times in ten; None if nobody has checked."""
        if not any(self.unchecked):
            return self.certain, self.certain
        if self.rates is None:
            return None
        low, high = self.rates.range_of(self.unchecked)
        return self.certain + low, self.certain + high

    @property
    def text(self) -> str:
        """In words: `4 to 6 (7 labelled)`; the labelled number alone if nobody has checked."""
        if self.range is None or self.range == (self.labelled, self.labelled):
            return f"{self.labelled}"
        low, high = self.range
        return f"{low} to {high} ({self.labelled} labelled)"

    @staticmethod
    def show(number: float) -> str:
        """Write a number of events, rounded."""
        return f"{whole(number)}"


def exactly(number: int) -> Count:
    """Return a count that is certain."""
    return Count(number, number)


@dataclass(frozen=True)
class Duration(_Quantity):
    """A length of time."""

    minutes: float = 0.0

    def __add__(self, other: Self) -> "Duration":
        return Duration(self.minutes + other.minutes)

    @property
    def middle(self) -> float:
        """Minutes."""
        return self.minutes

    @staticmethod
    def show(number: float) -> str:
        """Write a length of time: `2 h 05 min`.

        Parameters
        ----------
        number : float
            In minutes.
        """
        hours, minutes = divmod(whole(number), 60)
        if hours:
            return f"{hours} h {minutes:02} min"
        return "under 1 min" if not minutes and number > 0 else f"{minutes} min"


@dataclass(frozen=True)
class Clock(_Quantity):
    """A time of day, in minutes from midnight on."""

    minutes: float

    @property
    def middle(self) -> float:
        """Minutes from midnight on."""
        return self.minutes

    @staticmethod
    def show(number: float) -> str:
        """Write a time of day: `07:05`.

        Parameters
        ----------
        number : float
            Minutes from midnight on.
        """
        hours, minutes = divmod(int(number), 60)
        return f"{hours:02}:{minutes:02}"


Value = Count | Duration | Clock


def whole(number: float) -> int:
    """Round to a whole number, halves upwards: 2.5 is 3."""
    return math.floor(number + 0.5)


BASELINE_DAYS = 28
FEWEST = 7


class UsualRange(NamedTuple):
    """Median, lowest and highest of some days."""

    median: float
    lowest: float
    highest: float


def usual_range(values: Sequence[Value | None]) -> UsualRange | None:
    """Return what is usual; None if there are too few days.

    Parameters
    ----------
    values : sequence of (Count, Duration, Clock or None)
        The same figure on each day; None where it is not known.

    Returns
    -------
    UsualRange or None
        Of the `middle` of each value; None if fewer than seven days have one.
    """
    numbers = [value.middle for value in values if value is not None]
    if len(numbers) < FEWEST:
        return None
    return UsualRange(float(np.median(numbers)), min(numbers), max(numbers))


def compared(value: Value, baseline: UsualRange) -> int:
    """Compare a figure, as labelled, with what is usual.

    Returns
    -------
    int
        1: more than on any of those days, or later; -1: less, or earlier; 0: as usual.
    """
    if whole(value.middle) > whole(baseline.highest):
        return 1
    return -1 if whole(value.middle) < whole(baseline.lowest) else 0
