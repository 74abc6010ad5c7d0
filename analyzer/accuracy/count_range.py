"""From minutes that were checked to the range that a count of events lies in."""

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

from hearthlog.schemas.arrays import Bool, Float64, Int64

FEWEST = 5  # minutes
_DRAWS = 2000
_SEED = 20_261_123
_ENDS = (5.0, 95.0)  # percentiles: nine times in ten the count is between them
# Events and minutes that are added to what was checked, so that few minutes promise little.
_MISSED_IN_QUIET = (0.5, 30.0)  # of all classes together
_MISSED_IN_SOUND = (1.0, 5.0)  # of all classes together
_PER_LABELLED = (0.5, 1.0)


class Strata(NamedTuple):
    """Minutes by what the labels say of a class, as counts of them or of events in them.

    Attributes
    ----------
    quiet, without : int
        Minutes in which nothing sounds, and those in which something else does.
    once, more : int
        Labelled events of minutes that have one, and of those that have several.
    """

    quiet: int = 0
    without: int = 0
    once: int = 0
    more: int = 0

    def plus(self, other: Self) -> "Strata":
        """Return the sums."""
        return Strata(*(a + b for a, b in zip(self, other, strict=True)))


NO_MINUTES = Strata()


def stratum(labelled: Int64, sounding: Bool) -> Int64:
    """Return the number of the stratum that each minute is in, 0 to 3.

    Parameters
    ----------
    labelled : np.ndarray [shape=(n,)], int64
        Labelled events of a class.
    sounding : np.ndarray [shape=(n,)], bool
        Whether anything sounds.

    Returns
    -------
    np.ndarray [shape=(n,)], int64
    """
    numbers: Int64 = np.where(sounding | (labelled > 0), 1 + np.minimum(labelled, 2), 0)
    return numbers


def strata_of(labelled: Int64, sounding: Bool) -> Strata:
    """Count minutes, and the events in them, by stratum.

    Parameters
    ----------
    labelled : np.ndarray [shape=(n,)], int64
        Labelled events of a class.
    sounding : np.ndarray [shape=(n,)], bool
        Whether anything sounds.
    """
    number = stratum(labelled, sounding)
    minutes, events = np.bincount(number, minlength=4), np.bincount(number, labelled, 4)
    return Strata(int(minutes[0]), int(minutes[1]), int(events[2]), int(events[3]))


@dataclass(frozen=True, eq=False)
class CheckedRates:
    """How many events of a class there are in a minute, or for each labelled event.

    Attributes
    ----------
    rates : np.ndarray [shape=(draws, 4)], float64
        Draws from their distribution, by stratum.
    minutes : int
        That were checked.
    occurs : bool
        Whether any event in them was true.
    """

    rates: Float64
    minutes: int
    occurs: bool

    def range_of(self, strata: Strata) -> tuple[int, int]:
        """Return the range that the number of events lies in nine times in ten.

        Parameters
        ----------
        strata : Strata
            Of minutes that were not checked.
        """
        expected = self.rates @ np.array(strata, np.float64)
        totals = np.random.default_rng(_SEED).poisson(expected)
        low, high = np.percentile(totals, _ENDS)
        return int(np.floor(low)) if self.occurs else 0, int(np.ceil(high))


def checked_rates(
    labelled: Int64, true: Int64, sounding: Bool, share: float
) -> CheckedRates | None:
    """Draw rates of a class, given minutes that a person went through.

    A hot deck with a Bayesian prior: minutes are drawn again with replacement, for events come in
    bouts; then rates are drawn from gamma distributions. Within each stratum, minutes must be drawn
    at random, but not the same share of each.

    Parameters
    ----------
    labelled, true : np.ndarray [shape=(n,)], int64
        Labelled and true events that begin in each checked minute.
    sounding : np.ndarray [shape=(n,)], bool
        Whether labels say that anything sounds.
    share : float
        Of the class among all labelled events, 0 to 1.

    Returns
    -------
    CheckedRates or None
        None of fewer than five minutes.
    """
    if len(labelled) < FEWEST:
        return None
    rng = np.random.default_rng(_SEED)
    drawn, occurs = rng.integers(0, len(labelled), (_DRAWS, len(labelled))), bool(true.any())
    number, true, labelled = stratum(labelled, sounding)[drawn], true[drawn], labelled[drawn]
    rates = np.empty((_DRAWS, 4))
    for each, (events, size) in enumerate(
        (_MISSED_IN_QUIET, _MISSED_IN_SOUND, _PER_LABELLED, _PER_LABELLED)
    ):
        own = number == each
        by_minute = each < 2
        units = own.sum(axis=1) if by_minute else (labelled * own).sum(axis=1)
        counted = (true * own).sum(axis=1) + events * (share if by_minute else 1.0)
        rates[:, each] = rng.gamma(counted) / (units + size)
    return CheckedRates(rates, len(labelled[0]), occurs)
