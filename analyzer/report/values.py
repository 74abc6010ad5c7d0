"""What a report counts: a number of events, minutes, a time of day; and how they are said."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Self

_MIN = " min"
_WIDTH = 1.645  # standard deviations: nine times in ten the number is within


class _Quantity(ABC):
    """What is counted: a number, with an interval where it is not certain."""

    @property
    @abstractmethod
    def middle(self) -> float:
        """The number, or what is expected of it."""

    @property
    def low(self) -> float:
        """Lower end of the interval."""
        return self.middle

    @property
    def high(self) -> float:
        """Upper end of the interval."""
        return self.middle

    @property
    def text(self) -> str:
        """In words: `about 5 (4 to 6)`; the number alone if that is all of the interval."""
        low, middle, high = (self.show(x) for x in (self.low, self.middle, self.high))
        return middle if low == high else f"about {middle} ({low} to {high})"

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
    """A number of events, each of which may have been none."""

    expected: float = 0.0  # sum of p: mean of a Poisson binomial distribution
    variance: float = 0.0  # sum of p (1 - p)
    certain: int = 0  # how many a person has confirmed
    marked: int = 0

    def __add__(self, other: "Count") -> "Count":
        return Count(
            self.expected + other.expected,
            self.variance + other.variance,
            self.certain + other.certain,
            self.marked + other.marked,
        )

    @property
    def middle(self) -> float:
        """The expected number."""
        return self.expected

    @property
    def low(self) -> float:
        """Lower end of the interval that the number lies in nine times in ten.

        It is 1.645 standard deviations below the mean, but at least the number of certain events.
        """
        return max(self.certain, self.expected - _WIDTH * math.sqrt(self.variance))

    @property
    def high(self) -> float:
        """Upper end of the interval that the number lies in nine times in ten.

        It is 1.645 standard deviations above the mean, but at most the number of marked events.
        """
        return min(self.marked, self.expected + _WIDTH * math.sqrt(self.variance))

    @staticmethod
    def show(number: float) -> str:
        """Write a number of events, rounded.

        Parameters
        ----------
        number : float
            Of events.
        """
        return f"{whole(number)}"


def exactly(number: int) -> Count:
    """Return the count of events that happened for certain.

    Parameters
    ----------
    number : int
        Of events.
    """
    return Count(number, 0.0, number, number)


@dataclass(frozen=True)
class Minutes(_Quantity):
    """A length of time."""

    minutes: float = 0.0

    def __add__(self, other: Self) -> "Minutes":
        return Minutes(self.minutes + other.minutes)

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


Value = Count | Minutes | Clock


def whole(number: float) -> int:
    """Round to a whole number, halves upwards: 2.5 is 3.

    Parameters
    ----------
    number : float
    """
    return math.floor(number + 0.5)
