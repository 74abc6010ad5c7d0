"""Anomaly of a day: its figures and routines against the previous weeks."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import date, timedelta
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from hearthlog.analyzer.activity.day_profile import (
    BINS,
    CLOCK,
    COUNT,
    FIRST,
    LAST,
    LENGTH,
    QUIET,
    DayFigure,
    DayProfile,
    Profiles,
)
from hearthlog.models.classes import (
    COUGHING,
    CRYING,
    FLUSHING_WATER,
    OBJECTS_ACTIVITY,
    SHOWER,
    TAP_WATER,
    YELLING,
)
from hearthlog.schemas.arrays import Bool, Float64, Int64

_LOW, _HIGH = 0.1, 0.9  # quantiles of the days at the edges
_PRIOR_DAYS = 7  # weight of the prior of a figure, in days
# Prior distance from the middle to an edge: a constant plus a share of the middle.
_ASSUMED = {CLOCK: (45.0, 0.0), COUNT: (0.7, 0.0), LENGTH: (0.3, 0.2)}
_FEWEST_OF_KIND = 6
_SPREAD = 1.86  # error of a median for a median deviation of 1, times the root of the count
_TINY = 1e-9
_PRESENT = 0.1  # minimum minutes of a class in half an hour for it to be present
_REGULAR = 0.9  # minimum share of days for a regular hour
_SHORTEST, _LONGEST, _MOST_HOURS = 2, 6, 3


@dataclass(frozen=True)
class Baseline:
    """Usual range of figures; each array has shape (..., f)."""

    low: Float64  # edge: one day in ten is below
    middle: Float64  # median
    high: Float64  # edge: one day in ten is above
    below: Float64  # distance from the middle to the edge, never exactly 0
    above: Float64  # likewise
    weekend: Float64

    def deviations(self, row: Float64, weekend: Bool) -> Float64:
        """Return deviations of figures from the middle, in edge distances.

        They are positive for more, or later. The row [shape=(..., f)] is as from `rooted`; NaN
        marks a missing figure.
        """
        away = row - self.middle - weekend[..., np.newaxis] * self.weekend
        return away / np.where(away > 0, self.above, self.below)


def fit_baseline(table: Float64, weekend: Bool, figures: Sequence[DayFigure]) -> Baseline:
    """Fit the usual range of figures of n days [shape=(..., n, f)], as from `rooted`.

    A missing figure is NaN; `weekend` has shape (..., n).
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

    return Baseline(low, middle, high, edge(middle - low), edge(high - middle), offset)


def _weekend(table: Float64, weekend: Bool) -> Float64:
    """Return the weekend offset of figures, reduced where it may be chance."""
    at, apart = (_middle(np.where(own, table, np.nan)) for own in (weekend, ~weekend))
    more = at[0] - apart[0]
    sure = np.clip(1 - (at[1] + apart[1]) / np.maximum(more**2, _TINY), 0, 1)
    enough = np.minimum(at[2], apart[2]) >= _FEWEST_OF_KIND
    return np.where(enough, more * sure, 0.0)


def _middle(table: Float64) -> tuple[Float64, Float64, Int64]:
    """Return the median of the days, its squared error, and the number of days."""
    days = np.isfinite(table).sum(axis=-2)
    middle = quantile(table, 0.5)
    spread = quantile(np.abs(table - middle[..., np.newaxis, :]), 0.5)
    return middle, (_SPREAD * spread) ** 2 / np.maximum(days, 1), days


def quantile(table: Float64, share: float) -> Float64:
    """Return a quantile [shape=(..., f)], `share` 0 to 1, over the days [shape=(..., n, f)].

    Missing values are left out; NaN without any value.
    """
    ascending = np.sort(table, axis=-2)  # NaN sorts last
    days = np.isfinite(table).sum(axis=-2, keepdims=True)
    place = share * np.maximum(days - 1, 0)
    below = np.floor(place).astype(np.int64)
    above = np.minimum(below + 1, np.maximum(days - 1, 0))
    low, high = (np.take_along_axis(ascending, each, axis=-2) for each in (below, above))
    return (low + (place - below) * (high - low))[..., 0, :]


def regular_hours(days: Sequence[DayProfile], classes: Sequence[str]) -> list[DayFigure]:
    """Find the hours of the day with sound of a class of the half hours on nine of ten days.

    They are at most three for each class, extended by half an hour before and after.
    """
    found = []
    for row, name in enumerate(classes):
        half_hours = np.array([day.half_hours[row] for day in days])
        found += [DayFigure(name, LENGTH, hours=hours) for hours in _hours(half_hours)]
    return found


def _hours(minutes: Float64) -> list[tuple[int, int]]:
    """Find the shortest regular spans of half hours; input has shape (days, 48)."""
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
    """Extend spans by half an hour before and after, where no other span is."""
    before = first > 0 and free[first - 1]
    after = last < BINS and free[last]
    return first - int(before), last + int(after)


def _regular(minutes: Float64, width: int) -> tuple[Float64, Float64]:
    """Return the share of days with sound, and the mean length, for each span of a width."""
    sums = sliding_window_view(minutes, width, axis=1).sum(axis=-1)
    counts = np.maximum(np.isfinite(sums).sum(axis=0), 1)
    amounts = np.nan_to_num(sums)
    return (amounts >= _PRESENT).sum(axis=0) / counts, amounts.sum(axis=0) / counts


def figure_table(
    days: Sequence[DayProfile], classes: Sequence[str], hours: Sequence[DayFigure]
) -> Float64:
    """Return the figures of days as rows [shape=(n, f)]: profile figures, then regular hours.

    `classes` are those of the half hours; a missing figure is NaN.
    """
    places = [(classes.index(each.what), *(each.hours or (0, BINS))) for each in hours]
    return np.array(
        [[*day.values, *(day.half_hours[row, a:b].sum() for row, a, b in places)] for day in days]
    )


def rooted(table: Float64, figures: Sequence[DayFigure]) -> Float64:
    """Return a table [shape=(n, f)] with the square root of counts and lengths."""
    clocks = np.array([figure.kind == CLOCK for figure in figures])
    return np.where(clocks, table, np.sqrt(np.where(clocks, 0, table)))


NIGHT, MORNING, EVENING, WATER = "night", "morning", "evening", "water"
HOUSEHOLD, COUGHS, DISTRESS, COMPANY = "household", "coughs", "distress", "company"
_ROUTINES = (NIGHT, MORNING, EVENING, WATER, HOUSEHOLD, COUGHS, DISTRESS, COMPANY)
_BY_CLASS = {
    COUGHING: COUGHS,
    CRYING: DISTRESS,
    YELLING: DISTRESS,
    FLUSHING_WATER: WATER,
    TAP_WATER: WATER,
    SHOWER: WATER,
    OBJECTS_ACTIVITY: HOUSEHOLD,
}
_MORNING_ENDS = 19  # half hours of the day
_MOST = 6.0  # limit of the deviation of one figure
_NARROWEST = 0.35
_TOP = 3  # routines in the score


def routine_of(figure: DayFigure) -> str:
    """Return the routine that a figure belongs to."""
    by_class = _BY_CLASS.get(figure.what, COMPANY)
    if by_class in {COUGHS, DISTRESS}:
        return by_class
    if figure.night:
        return NIGHT
    if figure.what == LAST:
        return EVENING
    is_early = figure.hours is not None and figure.hours[0] < _MORNING_ENDS
    return MORNING if is_early or figure.what == FIRST else by_class


def routine_scores(
    own: Float64, others: Float64, figures: Sequence[DayFigure]
) -> tuple[float, Float64]:
    """Score the anomaly of a day, and of other days: mean of the three most deviating routines.

    `own` [shape=(f,)] and `others` [shape=(n, f)] have the deviations, NaN for missing figures; the
    other days give the widths of routines.
    """
    groups = _groups(figures)
    means = np.array([_mean(np.vstack([others, own])[:, rows] * sign) for rows, sign in groups]).T
    low, middle, high = np.quantile(means[:-1], (_LOW, 0.5, _HIGH), axis=0)
    away = means - middle
    widths = np.where(away > 0, high - middle, middle - low)
    far = np.sort(np.abs(away) / np.maximum(widths, _NARROWEST), axis=1)
    scores = far[:, -_TOP:].mean(axis=1)
    return float(scores[-1]), scores[:-1]


def _groups(figures: Sequence[DayFigure]) -> list[tuple[Int64, Float64]]:
    """Return the indices and signs of the figures of each routine."""
    names = np.array([routine_of(figure) for figure in figures])
    signs = np.array([_sign(figure) for figure in figures])
    places = [np.flatnonzero(names == name) for name in _ROUTINES]
    return [(rows, signs[rows]) for rows in places if len(rows)]


def _sign(figure: DayFigure) -> float:
    """Return -1 for a figure that falls when the others of its routine rise."""
    is_less = figure.what == QUIET or (routine_of(figure) == MORNING and figure.what != FIRST)
    return -1.0 if is_less else 1.0


def _mean(deviations: Float64) -> Float64:
    """Return the mean deviation of a routine; missing figures count as usual."""
    return np.clip(np.nan_to_num(deviations), -_MOST, _MOST).mean(axis=1)


DAYS = 28  # maximum number of days in the comparison
FEWEST = 14
SPAN = 3  # days that are also judged together: detects lasting changes sooner
LONGEST = 365.0  # days: longer periods cannot be distinguished in four weeks
_TAIL = 0.3  # share of the days that the tail is fitted to
_TAIL_PRIOR_DAYS, _PRIOR_SHARE = (
    4,
    0.15,
)  # of the tail: days, and their excess as a share of its edge
# Factor of the tail of future days over the tail of held-out days, which lie
# between the days they are compared with; greater with fewer than 28 of these. Fitted to
# the false alarms of simulated homes, seeds 0 to 9 of `tools/lab/routine.py`.
_LONGER = {1: 1.8, SPAN: 2.7}
_DIFFERS = {1: 1.5, SPAN: 1.0}


class FigureDifference(NamedTuple):
    """A figure outside its usual range."""

    figure: DayFigure
    # event count, minutes, or minutes since midnight; of the day, or median of three days
    value: float
    low: float  # one day in ten is below
    middle: float
    high: float  # one day in ten is above
    deviation: float  # from the middle, in units of the edge distance; positive for more, or later


@dataclass(frozen=True)
class DayAnomaly:
    """Anomaly of a day."""

    day: date
    once_in: float  # return period of such a deviation in days, 1 to 365
    span: int  # days that the differences cover: 1, or 3 with the two previous days
    differences: Sequence[FigureDifference]
    days: int  # number of days in the comparison


class Routines:
    """Computes the anomaly of days of a home against the previous weeks."""

    def __init__(self, profiles: Profiles) -> None:
        self._profiles = profiles
        self._profile_of_day: dict[date, DayProfile | None] = {}

    def judge(self, day: date) -> DayAnomaly | None:
        """Compute the anomaly of a day.

        None if less than half of its figures are present, or there are fewer than 14 days to
        compare with that have as many.
        """
        span = self._between(day, SPAN - 1, 0)
        earlier = self.earlier(day)
        if self._of(day) is None or len(earlier) < FEWEST:
            return None
        compared = compare(span, earlier, self._profiles.figures, self._profiles.classes)
        return judge(compared, day)

    def earlier(self, day: date) -> list[DayProfile]:
        """Return the days for comparison: four weeks, up to the third day before."""
        return self._between(day, DAYS + SPAN - 1, SPAN)

    def _between(self, day: date, first: int, last: int) -> list[DayProfile]:
        days = [self._of(day - timedelta(days=ago)) for ago in range(first, last - 1, -1)]
        return [each for each in days if each is not None]

    def _of(self, day: date) -> DayProfile | None:
        if day not in self._profile_of_day:
            profile = self._profiles.of(day)
            self._profile_of_day[day] = profile if profile.is_comparable else None
        return self._profile_of_day[day]


class Compared(NamedTuple):
    """Days with their deviations from the baseline."""

    figures: Sequence[DayFigure]  # present on at least half of the earlier days
    usual: Baseline
    rows: Float64  # [shape=(k, f)], as from `rooted`; NaN for missing figures
    weekend: Bool  # [shape=(k,)]
    own: Float64  # [shape=(k, f)]; deviations of the days
    others: Float64  # [shape=(n, f)]; deviations of each earlier day from the others


def compare(
    span: Sequence[DayProfile],
    earlier: Sequence[DayProfile],
    figures: Sequence[DayFigure],
    classes: Sequence[str],
) -> Compared:
    """Compare one or more days with at least 14 earlier days; `classes` are of the half hours."""
    hours = regular_hours(earlier, classes)
    every = [*figures, *hours]
    table = rooted(figure_table([*earlier, *span], classes, hours), every)
    weekend = np.array([day.day.weekday() >= 5 for day in (*earlier, *span)])
    days = len(earlier)
    often = np.isfinite(table[:days]).sum(axis=0) >= days / 2
    kept = [figure for figure, is_frequent in zip(every, often, strict=True) if is_frequent]
    before, rows = table[:days, often], table[days:, often]
    usual = fit_baseline(before, weekend[:days], kept)
    own = usual.deviations(rows, weekend[days:])
    return Compared(kept, usual, rows, weekend[days:], own, _left_out(before, weekend[:days], kept))


def judge(compared: Compared, day: date) -> DayAnomaly:
    """Return the anomaly of the last of successive days."""
    # Halved, because either may be rare by chance.
    alone, together = (
        float(np.clip(rarity(own, compared) / 2, 1, LONGEST))
        for own in (compared.own[-1:], compared.own)
    )
    lasting = [] if alone >= together else list(_differences(compared, SPAN))
    length = SPAN if lasting else 1
    found = lasting or list(_differences(compared, 1))
    return DayAnomaly(day, max(alone, together), length, found, len(compared.others))


def _left_out(table: Float64, weekend: Bool, figures: Sequence[DayFigure]) -> Float64:
    """Return the deviations of each day from the baseline of the other days."""
    days = len(table)
    others = np.array([np.delete(np.arange(days), row) for row in range(days)])
    return fit_baseline(table[others], weekend[others], figures).deviations(table, weekend)


def rarity(own: Float64, compared: Compared) -> float:
    """Return the return period in days, at least 1, of deviations of some days [shape=(k, f)].

    Beyond the score that three of ten days exceed, scores are assumed to fall off exponentially.
    """
    length = len(own)
    others = sliding_window_view(compared.others, length, axis=0)
    score, scores = routine_scores(
        _mean_of_finite(own), _mean_of_finite(np.moveaxis(others, -1, 0)), compared.figures
    )
    edge = float(np.quantile(scores, 1 - _TAIL))
    if score <= edge:
        return 1 / max(float((scores >= score).mean()), _TAIL)
    excess = scores[scores > edge] - edge
    total = excess.sum() + _TAIL_PRIOR_DAYS * _PRIOR_SHARE * edge
    longer = _LONGER[SPAN if length > 1 else 1] * DAYS / len(compared.others)
    scale = longer * total / (len(excess) + _TAIL_PRIOR_DAYS)
    return float(np.exp(min((score - edge) / scale, 50.0)) / _TAIL)


def _mean_of_finite(rows: Float64) -> Float64:
    """Return the mean over rows without missing values; NaN without any value."""
    finite = np.isfinite(rows)
    sums = np.where(finite, rows, 0.0).sum(axis=0)
    return np.where(finite.any(axis=0), sums / np.maximum(finite.sum(axis=0), 1), np.nan)


def _differences(compared: Compared, length: int) -> Iterator[FigureDifference]:
    rows, own = compared.rows[-length:], compared.own[-length:]
    values, deviations = quantile(rows, 0.5), np.nan_to_num(quantile(own, 0.5))
    usual = compared.usual
    offset = usual.weekend * compared.weekend[-length:].mean()
    edges = [edge + offset for edge in (usual.low, usual.middle, usual.high)]
    for number in np.argsort(-np.abs(deviations), kind="stable").tolist():
        if abs(deviations[number]) < _DIFFERS[length]:
            return
        figure = compared.figures[number]
        value, low, middle, high = (
            _amount(float(each[number]), figure.kind) for each in (values, *edges)
        )
        yield FigureDifference(figure, value, low, middle, high, float(deviations[number]))


def _amount(number: float, kind: str) -> float:
    return number if kind == CLOCK else max(number, 0.0) ** 2
