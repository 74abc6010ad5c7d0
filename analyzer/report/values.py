"""What a report counts: a number of events, minutes, a time of day; and how they are said."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Self

_MIN = " min"
_WIDTH = 1.645  # standard deviations: nine times in ten the number is within


@dataclass(frozen=True)
class Count:
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

    @property
    def text(self) -> str:
        """In words: `about 5 (4 to 6)`."""
        low, middle, high = (self.show(x) for x in (self.low, self.middle, self.high))
        return middle if low == high else f"about {middle} ({low} to {high})"

    @staticmethod
    def show(number: float) -> str:
        """Write a number of events, rounded.

        Parameters
        ----------
        number : float
            Of events.
        """
        return f"{whole(number)}"

    def spread(self, median: float, lowest: float, highest: float) -> str:
        """Write what is usual: `4 (3 to 6)`.

        Parameters
        ----------
        median, lowest, highest : float
            Numbers of events.
        """
        return _spread(self.show(median), self.show(lowest), self.show(highest))


def exactly(number: int) -> Count:
    """Return the count of events that happened for certain.

    Parameters
    ----------
    number : int
        Of events.
    """
    return Count(number, 0.0, number, number)


class _Plain(ABC):
    """What has no interval."""

    @property
    def low(self) -> float:
        """The same."""
        return self.middle

    high = low

    @property
    @abstractmethod
    def middle(self) -> float:
        """The number."""

    @property
    def text(self) -> str:
        """In words."""
        return self.show(self.middle)

    @staticmethod
    @abstractmethod
    def show(number: float) -> str:
        """Write a number."""

    def spread(self, median: float, lowest: float, highest: float) -> str:
        """Write what is usual."""
        return _spread(self.show(median), self.show(lowest), self.show(highest))


@dataclass(frozen=True)
class Minutes(_Plain):
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
class Clock(_Plain):
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


def _spread(middle: str, low: str, high: str) -> str:
    """Put median and range together; where both are minutes alone, that is said once."""
    if low == high:
        return middle
    if high.endswith(_MIN) and low.endswith(_MIN) and " h " not in low + high:
        low = low.removesuffix(_MIN)
    return f"{middle} ({low} to {high})"


def whole(number: float) -> int:
    """Round to a whole number, halves upwards: 2.5 is 3.

    Parameters
    ----------
    number : float
    """
    return math.floor(number + 0.5)
