"""What is usual in a home: the middle and the edges of each figure over its last weeks."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from hearthlog.analyzer.routine.day_profile import BINS, CLOCK, COUNT, LENGTH, DayProfile, Figure
from hearthlog.schemas.arrays import Bool, Float64, Int64

_LOW, _HIGH = 0.1, 0.9  # of the days: the edges
_PRIOR_DAYS = 7  # of which what is assumed of a figure counts as much as one day each
# Assumed from the middle to an edge: so much, and a share of the middle.
_ASSUMED = {CLOCK: (45.0, 0.0), COUNT: (0.7, 0.0), LENGTH: (0.3, 0.2)}
_FEWEST_OF_KIND = 6
_SPREAD = 1.86  # error of a median for a median deviation of 1, times the root of the number
_TINY = 1e-9
_HEARD = 0.1  # minutes in half an hour, of a class that is heard then
_REGULAR = 0.9  # of the days on which it is
_SHORTEST, _LONGEST, _MOST_HOURS = 2, 6, 3


@dataclass(frozen=True)
class Usual:
    """What is usual, each array of shape (..., f), float64.

    Attributes
    ----------
    low, middle, high : np.ndarray
        On one day in ten a figure is below the low edge, on one above the high one.
    below, above : np.ndarray
        From the middle to the edges, never quite 0.
    """

    low: Float64
    middle: Float64
    high: Float64
    below: Float64
    above: Float64
    weekend: Float64

    def deviations(self, row: Float64, weekend: Bool) -> Float64:
        """Measure how far the figures of a day are from the middle, in widths to the edge.

        Parameters
        ----------
        row : np.ndarray [shape=(..., f)], float64
            As of `rooted`.
        weekend : np.ndarray [shape=(...)], bool

        Returns
        -------
        np.ndarray [shape=(..., f)], float64
            Above 0 for more, or later; NaN for what is not known.
        """
        away = row - self.middle - weekend[..., np.newaxis] * self.weekend
        return away / np.where(away > 0, self.above, self.below)


def learn(table: Float64, weekend: Bool, figures: Sequence[Figure]) -> Usual:
    """Learn what is usual.

    Parameters
    ----------
    table : np.ndarray [shape=(..., n, f)], float64
        Figures of n days, as of `rooted`; NaN for what is not known.
    weekend : np.ndarray [shape=(..., n)], bool
        Which of the days are of a weekend.
    """
    weekend = weekend[..., np.newaxis]
    offset = _weekend(table, weekend)
    even = table - weekend * offset[..., np.newaxis, :]
    low, middle, high = (quantile(even, share) for share in (_LOW, 0.5, _HIGH))
    days = np.isfinite(even).sum(axis=-2)
    base, share = np.array([_ASSUMED[figure.kind] for figure in figures]).reshape(-1, 2).T
    assumed = base + share * middle

    def edge(away: Float64) -> Float64:
        squares = days * away**2 + _PRIOR_DAYS * assumed**2
        return np.sqrt(squares / (days + _PRIOR_DAYS))

    return Usual(low, middle, high, edge(middle - low), edge(high - middle), offset)


def _weekend(table: Float64, weekend: Bool) -> Float64:
    """Return by how much more figures are at a weekend, less where that may be chance."""
    at, apart = (_middle(np.where(own, table, np.nan)) for own in (weekend, ~weekend))
    more = at[0] - apart[0]
    sure = np.clip(1 - (at[1] + apart[1]) / np.maximum(more**2, _TINY), 0, 1)
    enough = np.minimum(at[2], apart[2]) >= _FEWEST_OF_KIND
    return np.where(enough, more * sure, 0.0)


def _middle(table: Float64) -> tuple[Float64, Float64, Int64]:
    """Return the median of the days, the square of its error, and the number of days."""
    days = np.isfinite(table).sum(axis=-2)
    middle = quantile(table, 0.5)
    spread = quantile(np.abs(table - middle[..., np.newaxis, :]), 0.5)
    return middle, (_SPREAD * spread) ** 2 / np.maximum(days, 1), days


def quantile(table: Float64, share: float) -> Float64:
    """Return a quantile over the days of what is known.

    Parameters
    ----------
    table : np.ndarray [shape=(..., n, f)], float64
    share : float
        0 to 1.

    Returns
    -------
    np.ndarray [shape=(..., f)], float64
        NaN where nothing is known.
    """
    ascending = np.sort(table, axis=-2)  # NaN last
    days = np.isfinite(table).sum(axis=-2, keepdims=True)
    place = share * np.maximum(days - 1, 0)
    below = np.floor(place).astype(np.int64)
    above = np.minimum(below + 1, np.maximum(days - 1, 0))
    low, high = (np.take_along_axis(ascending, each, axis=-2) for each in (below, above))
    return (low + (place - below) * (high - low))[..., 0, :]


def regular_hours(days: Sequence[DayProfile], classes: Sequence[str]) -> list[Figure]:
    """Find hours of the day in which a class is heard on nine of ten days.

    Parameters
    ----------
    classes : sequence of str
        Of their half hours.

    Returns
    -------
    list of Figure
        At most three for each class, with half an hour before and after.
    """
    found = []
    for row, name in enumerate(classes):
        heard = np.array([day.half_hours[row] for day in days])
        found += [Figure(name, LENGTH, hours=hours) for hours in _hours(heard)]
    return found


def _hours(minutes: Float64) -> list[tuple[int, int]]:
    """Find the shortest spans of half hours that are regular; of shape (days, 48)."""
    free = np.ones(BINS, bool)
    found: list[tuple[int, int]] = []
    for width in range(_SHORTEST, _LONGEST + 1):
        shares, amounts = _regular(minutes, width)
        for first in np.lexsort((-amounts, -shares)).tolist():
            if shares[first] < _REGULAR or len(found) == _MOST_HOURS:
                break
            if free[first : first + width].all():
                hours = _widened(free, first, first + width)
                free[slice(*hours)] = False
                found.append(hours)
    return found


def _widened(free: Bool, first: int, last: int) -> tuple[int, int]:
    """Add half an hour before and after, where no other span has it."""
    before = first > 0 and free[first - 1]
    after = last < BINS and free[last]
    return first - int(before), last + int(after)


def _regular(minutes: Float64, width: int) -> tuple[Float64, Float64]:
    """Return on which share of the days each span of a width has sound, and how long on average."""
    sums = sliding_window_view(minutes, width, axis=1).sum(axis=-1)
    known = np.maximum(np.isfinite(sums).sum(axis=0), 1)
    amounts = np.nan_to_num(sums)
    return (amounts >= _HEARD).sum(axis=0) / known, amounts.sum(axis=0) / known


def figure_table(
    days: Sequence[DayProfile], classes: Sequence[str], hours: Sequence[Figure]
) -> Float64:
    """Return the figures of days as rows: those of each profile, then those of regular hours.

    Parameters
    ----------
    classes : sequence of str
        Of their half hours.

    Returns
    -------
    np.ndarray [shape=(n, f)], float64
        NaN for what is not known.
    """
    places = [(classes.index(each.what), *(each.hours or (0, BINS))) for each in hours]
    return np.array(
        [[*day.values, *(day.half_hours[row, a:b].sum() for row, a, b in places)] for day in days]
    )


def rooted(table: Float64, figures: Sequence[Figure]) -> Float64:
    """Take the square root of counts and lengths.

    Parameters
    ----------
    table : np.ndarray [shape=(n, f)], float64
    """
    clocks = np.array([figure.kind == CLOCK for figure in figures])
    return np.where(clocks, table, np.sqrt(np.where(clocks, 0, table)))
