"""How unlike the weeks before it a day was: as one number, and what differs."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import date, timedelta
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from hearthlog.analyzer.routine.day_profile import CLOCK, DayProfile, Figure, Profiles
from hearthlog.analyzer.routine.routines import routine_scores
from hearthlog.analyzer.routine.usual import (
    Usual,
    figure_table,
    learn,
    quantile,
    regular_hours,
    rooted,
)
from hearthlog.schemas.arrays import Bool, Float64

DAYS = 28  # that a day is compared with, at most
FEWEST = 14
SPAN = 3  # days that are judged together, too: what lasts is sooner seen so
LONGEST = 365.0  # days: what comes more rarely cannot be told apart in four weeks
_TAIL = 0.3  # share of the days by which the rare ones are judged
_PRIOR_DAYS, _PRIOR_SHARE = 4, 0.15  # of the tail: days, and their excess as a share of its edge
# By how much the tail of days to come is longer than that of days that are left out, which lie
# between those they are compared with; more where there are fewer than 28 of these. Fitted to
# the false alarms of simulated homes, seeds 0 to 9 of `tools/lab/routine.py`.
_LONGER = {1: 1.8, SPAN: 2.7}
_DIFFERS = {1: 1.5, SPAN: 1.0}


class Difference(NamedTuple):
    """A figure that was not as usual.

    Attributes
    ----------
    value : float
        Of the day, or the median of three: a number of events, minutes, or those since midnight.
    low, middle, high : float
        On one day in ten it is below `low`, on one above `high`.
    deviation : float
        From the middle, in widths from there to the edge; above 0 for more, or later.
    """

    figure: Figure
    value: float
    low: float
    middle: float
    high: float
    deviation: float


@dataclass(frozen=True)
class Judgement:
    """How unusual a day was.

    Attributes
    ----------
    once_in : float
        Days in which one is expected that is as far from the usual, 1 to 365.
    span : int
        Days of which the differences are typical: the day by itself, 1, or with the two before, 3.
    days : int
        How many days it is compared with.
    """

    day: date
    once_in: float
    span: int
    differences: Sequence[Difference]
    days: int


class Routines:
    """Judges days of a home by the weeks before each."""

    def __init__(self, profiles: Profiles) -> None:
        self._profiles = profiles
        self._known: dict[date, DayProfile | None] = {}

    def judge(self, day: date) -> Judgement | None:
        """Judge a day.

        Returns
        -------
        Judgement or None
            None if less than half of its figures are known, or there are fewer than 14 days to
            compare with of which that many are.
        """
        span = self._between(day, SPAN - 1, 0)
        earlier = self.earlier(day)
        if self._of(day) is None or len(earlier) < FEWEST:
            return None
        compared = compare(span, earlier, self._profiles.figures, self._profiles.classes)
        return judge(compared, day)

    def earlier(self, day: date) -> list[DayProfile]:
        """Return the days to compare a day with: four weeks, up to the third day before."""
        return self._between(day, DAYS + SPAN - 1, SPAN)

    def _between(self, day: date, first: int, last: int) -> list[DayProfile]:
        days = [self._of(day - timedelta(days=ago)) for ago in range(first, last - 1, -1)]
        return [each for each in days if each is not None]

    def _of(self, day: date) -> DayProfile | None:
        if day not in self._known:
            profile = self._profiles.of(day)
            self._known[day] = profile if profile.is_known else None
        return self._known[day]


class Compared(NamedTuple):
    """Days beside what is usual.

    Attributes
    ----------
    figures : sequence of Figure
        That are known on half of the earlier days at least.
    rows : np.ndarray [shape=(k, f)], float64
        Of the days, as of `rooted`; NaN for what is not known.
    weekend : np.ndarray [shape=(k,)], bool
    own : np.ndarray [shape=(k, f)], float64
        Their deviations.
    others : np.ndarray [shape=(n, f)], float64
        Those of each earlier day from the other ones.
    """

    figures: Sequence[Figure]
    usual: Usual
    rows: Float64
    weekend: Bool
    own: Float64
    others: Float64


def compare(
    span: Sequence[DayProfile],
    earlier: Sequence[DayProfile],
    figures: Sequence[Figure],
    classes: Sequence[str],
) -> Compared:
    """Lay days beside earlier ones.

    Parameters
    ----------
    span : sequence of DayProfile
        One at least.
    earlier : sequence of DayProfile
        14 at least.
    classes : sequence of str
        Of their half hours.
    """
    hours = regular_hours(earlier, classes)
    every = [*figures, *hours]
    table = rooted(figure_table([*earlier, *span], classes, hours), every)
    weekend = np.array([day.day.weekday() >= 5 for day in (*earlier, *span)])
    days = len(earlier)
    often = np.isfinite(table[:days]).sum(axis=0) >= days / 2
    kept = [figure for figure, is_known in zip(every, often, strict=True) if is_known]
    before, rows = table[:days, often], table[days:, often]
    usual = learn(before, weekend[:days], kept)
    own = usual.deviations(rows, weekend[days:])
    return Compared(kept, usual, rows, weekend[days:], own, _left_out(before, weekend[:days], kept))


def judge(compared: Compared, day: date) -> Judgement:
    """Say how unusual the last of some days was.

    Parameters
    ----------
    compared : Compared
        The day, and those just before it.
    """
    # Halved, for either may be rare by chance.
    alone, together = (
        float(np.clip(rarity(own, compared) / 2, 1, LONGEST))
        for own in (compared.own[-1:], compared.own)
    )
    lasting = [] if alone >= together else list(_differences(compared, SPAN))
    length = SPAN if lasting else 1
    found = lasting or list(_differences(compared, 1))
    return Judgement(day, max(alone, together), length, found, len(compared.others))


def _left_out(table: Float64, weekend: Bool, figures: Sequence[Figure]) -> Float64:
    """Return how far each day is from what is usual on the others."""
    days = len(table)
    others = np.array([np.delete(np.arange(days), row) for row in range(days)])
    return learn(table[others], weekend[others], figures).deviations(table, weekend)


def rarity(own: Float64, compared: Compared) -> float:
    """Return in how many days some are expected that are as far from the usual, on average.

    Beyond the score that three of ten days exceed, scores are taken to fall off exponentially.

    Parameters
    ----------
    own : np.ndarray [shape=(k, f)], float64
        Deviations of one day or of successive ones.

    Returns
    -------
    float
        In days, 1 or more.
    """
    length = len(own)
    others = sliding_window_view(compared.others, length, axis=0)
    score, scores = routine_scores(_mean(own), _mean(np.moveaxis(others, -1, 0)), compared.figures)
    edge = float(np.quantile(scores, 1 - _TAIL))
    if score <= edge:
        return 1 / max(float((scores >= score).mean()), _TAIL)
    excess = scores[scores > edge] - edge
    total = excess.sum() + _PRIOR_DAYS * _PRIOR_SHARE * edge
    longer = _LONGER[SPAN if length > 1 else 1] * DAYS / len(compared.others)
    scale = longer * total / (len(excess) + _PRIOR_DAYS)
    return float(np.exp(min((score - edge) / scale, 50.0)) / _TAIL)


def _mean(rows: Float64) -> Float64:
    """Average rows over what is known; NaN where nothing is."""
    known = np.isfinite(rows)
    sums = np.where(known, rows, 0.0).sum(axis=0)
    return np.where(known.any(axis=0), sums / np.maximum(known.sum(axis=0), 1), np.nan)


def _differences(compared: Compared, length: int) -> Iterator[Difference]:
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
        yield Difference(figure, value, low, middle, high, float(deviations[number]))


def _amount(number: float, kind: str) -> float:
    return number if kind == CLOCK else max(number, 0.0) ** 2
