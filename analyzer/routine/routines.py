"""The routines of a home: the figures of a day that tell of one, and how far it is from usual."""

from collections.abc import Sequence

import numpy as np

from hearthlog.analyzer.routine.day_profile import FIRST, LAST, QUIET, Figure
from hearthlog.models.classes import (
    COUGHING,
    CRYING,
    FLUSHING_WATER,
    OBJECTS_ACTIVITY,
    SHOWER,
    TAP_WATER,
    YELLING,
)
from hearthlog.schemas.arrays import Float64, Int64

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
_MOST = 6.0  # that the deviation of one figure counts
_LOW, _HIGH = 0.1, 0.9
_NARROWEST = 0.35
_TOP = 3  # routines that make the score


def routine_of(figure: Figure) -> str:
    """Return the routine that a figure tells of."""
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
    own: Float64, others: Float64, figures: Sequence[Figure]
) -> tuple[float, Float64]:
    """Score how far a day is from what is usual: the mean of its three farthest routines.

    Parameters
    ----------
    own : np.ndarray [shape=(f,)], float64
        Deviations of the figures of a day; NaN for what is not known.
    others : np.ndarray [shape=(n, f)], float64
        Those of other days, by which the widths of routines are measured.

    Returns
    -------
    score : float
        Of the day.
    scores : np.ndarray [shape=(n,)], float64
        Of the other days.
    """
    groups = _groups(figures)
    means = np.array([_mean(np.vstack([others, own])[:, rows] * sign) for rows, sign in groups]).T
    low, middle, high = np.quantile(means[:-1], (_LOW, 0.5, _HIGH), axis=0)
    away = means - middle
    widths = np.where(away > 0, high - middle, middle - low)
    far = np.sort(np.abs(away) / np.maximum(widths, _NARROWEST), axis=1)
    scores = far[:, -_TOP:].mean(axis=1)
    return float(scores[-1]), scores[:-1]


def _groups(figures: Sequence[Figure]) -> list[tuple[Int64, Float64]]:
    """Return the places of the figures of each routine, and which way they point."""
    names = np.array([routine_of(figure) for figure in figures])
    signs = np.array([_sign(figure) for figure in figures])
    places = [np.flatnonzero(names == name) for name in _ROUTINES]
    return [(rows, signs[rows]) for rows in places if len(rows)]


def _sign(figure: Figure) -> float:
    """Return -1 for a figure that is less where the others of its routine are more."""
    is_less = figure.what == QUIET or (routine_of(figure) == MORNING and figure.what != FIRST)
    return -1.0 if is_less else 1.0


def _mean(deviations: Float64) -> Float64:
    """Average the deviations of a routine; what is not known counts as usual."""
    return np.clip(np.nan_to_num(deviations), -_MOST, _MOST).mean(axis=1)
