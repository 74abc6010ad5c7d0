"""Quantities of a report (counts, durations, times of day), and their usual range."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

from hearthlog.analyzer.activity.event_counts import NO_MINUTES, CheckedRates, Strata

_MIN = " min"


class _Quantity(ABC):
    @property
    @abstractmethod
    def middle(self) -> float:
        """The number used in comparisons between days."""

    @property
    def text(self) -> str:
        """The number in words."""
        return self.show(self.middle)

    @staticmethod
    @abstractmethod
    def show(number: float) -> str:
        """Format a number."""

    def spread(self, median: float, lowest: float, highest: float) -> str:
        """Format a usual range: `4 (3 to 6)`; `min` appears once if both ends are minutes alone."""
        low, high = self.show(lowest), self.show(highest)
        if low == high:
            return self.show(median)
        if high.endswith(_MIN) and low.endswith(_MIN) and " h " not in low + high:
            low = low.removesuffix(_MIN)
        return f"{self.show(median)} ({low} to {high})"


@dataclass(frozen=True)
class Count(_Quantity):
    """A number of events."""

    labelled: int = 0  # events after corrections
    certain: int = 0  # events within reviewed minutes
    unchecked: Strata = NO_MINUTES  # events in minutes without review
    rates: CheckedRates | None = None  # None if too few minutes were checked
    unsure: int = 0  # labelled events of which the model is not sure, and that nobody reviewed

    def __add__(self, other: "Count") -> "Count":
        return Count(
            self.labelled + other.labelled,
            self.certain + other.certain,
            self.unchecked.combined_with(other.unchecked),
            self.rates or other.rates,
            self.unsure + other.unsure,
        )

    @property
    def middle(self) -> float:
        """The number of labelled events."""
        return self.labelled

    @property
    def range(self) -> tuple[int, int] | None:
        """90 % interval of the correct number; None without checks."""
        if not any(self.unchecked):
            return self.certain, self.certain
        if self.rates is None:
            return None
        low, high = self.rates.range_of(self.unchecked)
        return self.certain + low, self.certain + high

    @property
    def text(self) -> str:
        """In words: `4 to 6 (7 labelled)`; unchecked `4`, `4 (+3?)` or `3?` with 3 unsure."""
        if self.range is None and self.unsure:
            sure = self.labelled - self.unsure
            return f"{sure} (+{self.unsure}?)" if sure else f"{self.unsure}?"
        if self.range is None or self.range == (self.labelled, self.labelled):
            return f"{self.labelled}"
        low, high = self.range
        return f"{low} to {high} ({self.labelled} labelled)"

    @staticmethod
    def show(number: float) -> str:
        """Format a number of events, rounded."""
        return f"{rounded(number)}"


def exactly(number: int) -> Count:
    """Return a certain count."""
    return Count(number, number)


@dataclass(frozen=True)
class _Minutes(_Quantity):
    minutes: float = 0.0

    @property
    def middle(self) -> float:
        """Minutes."""
        return self.minutes


@dataclass(frozen=True)
class Duration(_Minutes):
    """A duration."""

    def __add__(self, other: Self) -> "Duration":
        return Duration(self.minutes + other.minutes)

    @staticmethod
    def show(number: float) -> str:
        """Format a duration in minutes: `2 h 05 min`."""
        hours, minutes = divmod(rounded(number), 60)
        if hours:
            return f"{hours} h {minutes:02} min"
        return "under 1 min" if not minutes and number > 0 else f"{minutes} min"


@dataclass(frozen=True)
class Clock(_Minutes):
    """A time of day, in minutes since midnight."""

    @staticmethod
    def show(number: float) -> str:
        """Format a time of day, given in minutes since midnight: `07:05`."""
        hours, minutes = divmod(int(number), 60)
        return f"{hours:02}:{minutes:02}"


Value = Count | Duration | Clock


def rounded(number: float) -> int:
    """Round to a whole number, halves upwards: 2.5 is 3."""
    return math.floor(number + 0.5)


BASELINE_DAYS = 28
FEWEST = 7


class UsualRange(NamedTuple):
    """Median, lowest and highest value of some days."""

    median: float
    lowest: float
    highest: float


def usual_range(values: Sequence[Value | None]) -> UsualRange | None:
    """Return the usual range of the `middle` of a figure; None for less than seven days."""
    numbers = [value.middle for value in values if value is not None]
    if len(numbers) < FEWEST:
        return None
    return UsualRange(float(np.median(numbers)), min(numbers), max(numbers))


def compared(value: Value, baseline: UsualRange) -> int:
    """Compare a figure, as labelled, with its usual range.

    1: above the highest day, or later; -1: below the lowest, or earlier; 0: usual.
    """
    if rounded(value.middle) > rounded(baseline.highest):
        return 1
    return -1 if rounded(value.middle) < rounded(baseline.lowest) else 0
