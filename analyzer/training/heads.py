"""Linear heads on what a network hears, learned by ridge regression.

Classes of few sources decide it: a logistic head separates nine coughs by whatever they have in
common, ridge regression weighs by what varies in all windows.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from hearthlog.analyzer.training.calibration import inverse_temperature
from hearthlog.analyzer.training.dataset import EmbeddingWindows
from hearthlog.models.classes import SILENCE
from hearthlog.models.classifiers.evidence import UNIT, UNTAUGHT
from hearthlog.schemas.arrays import Bool, Float64, Indices, Int32

_ALPHA = 30.0  # of inputs of one standard deviation, whatever their number
_ROOT = 0.5  # a collection weighs as its number of windows to this power
_FEWEST_COLLECTIONS = 3
_PARTS = 5  # of the sources, where there are fewer collections
FEWEST_SOURCES = 3  # of a class; one of fewer is left to the other heads, and to names
_LARGEST = 2**31 - 1
_STEPS = 200  # of a regression


class LinearHeads(NamedTuple):
    """Heads as a model has them.

    Attributes
    ----------
    weights : np.ndarray [shape=(H, W, C)], int32
        In units of `hearthlog.models.classifiers.evidence.UNIT`.
    bias : np.ndarray [shape=(H, C)], int32
    """

    weights: Int32
    bias: Int32


def learn_heads(
    windows: EmbeddingWindows,
    classes: Sequence[str],
    inputs: Sequence[slice],
    seen: Bool | None = None,
) -> LinearHeads:
    """Learn heads, each with the temperature that holds in collections left out.

    Parameters
    ----------
    seen : np.ndarray [shape=(m,)], bool, optional
        Which of the windows may be learned from; all by default.
    """
    sound = np.array([name != SILENCE for name in classes])[windows.target]
    chosen = sound if seen is None else sound & seen
    pairs = np.unique(np.stack([windows.target[chosen], windows.group[chosen]]), axis=1)
    sources = np.bincount(pairs[0], minlength=len(classes))
    rows = windows.rows(chosen & (sources >= FEWEST_SOURCES)[windows.target])
    width, count = windows.values.shape[1], len(classes)
    weights = np.zeros((len(inputs), width, count))
    bias = np.full((len(inputs), count), UNTAUGHT, np.int32)
    for number, columns in enumerate(inputs):
        values = rows.values[:, columns].astype(np.float64)
        if len(values):
            slopes, constants, learned = _calibrated(values, rows, count)
            weights[number, columns], bias[number, learned] = slopes, in_units(constants)
    return LinearHeads(in_units(weights), bias)


def regressed(  # noqa: PLR0913
    inputs: Float64, truth: Float64, weight: Float64, before: Float64, pull: Float64, *, free: bool
) -> tuple[Float64, Float64]:
    """Return the weights and biases that, added to decision values, tell windows best.

    This is multinomial logistic regression.

    Parameters
    ----------
    inputs : np.ndarray [shape=(n, d)], float64
    truth : np.ndarray [shape=(n, C)], float64
        Probabilities of the classes.
    weight : np.ndarray [shape=(n,)], float64
    before : np.ndarray [shape=(n, C)], float64
        Logarithms of probabilities, up to a constant.
    pull : np.ndarray [shape=(C,)], float64
        Of weights and biases to zero.

    Returns
    -------
    weights : np.ndarray [shape=(d, C)], float64
    biases : np.ndarray [shape=(C,)], float64
    """
    width, count = inputs.shape[1], before.shape[1]
    pulls = np.tile(pull, (width + 1, 1))
    if free:
        pulls[-1] = 0.0

    def loss(flat: Float64) -> tuple[float, Float64]:
        both = flat.reshape(width + 1, count)
        decisions = before + inputs @ both[:-1] + both[-1]
        decisions -= decisions.max(axis=1, keepdims=True)
        grown = np.exp(decisions)
        total = grown.sum(axis=1, keepdims=True)
        lost = -(weight @ (truth * (decisions - np.log(total)))).sum()
        wrong = weight[:, np.newaxis] * (grown / total - truth)
        slope = np.concatenate([inputs.T @ wrong, wrong.sum(axis=0, keepdims=True)])
        value = lost + (pulls * np.square(both)).sum() / 2
        return float(value), (slope + pulls * both).ravel()

    start = np.zeros((width + 1) * count)
    found = minimize(loss, start, jac=True, method="L-BFGS-B", options={"maxiter": _STEPS})
    both = found.x.reshape(width + 1, count)
    return both[:-1], both[-1]


def scaler_of(windows: EmbeddingWindows, classes: Sequence[str]) -> Float64:
    """Return mean and standard deviation of the values of windows with sound, shape (2, W)."""
    sound = np.array([name != SILENCE for name in classes])[windows.target]
    values = windows.values[sound].astype(np.float64)
    return np.stack([values.mean(axis=0), np.maximum(values.std(axis=0), 1.0)])


def in_units(values: Float64) -> Int32:
    """Round weights or biases to those of a model."""
    steps = np.clip(np.rint(values / UNIT), -_LARGEST, _LARGEST)
    return steps.astype(np.int32)


def _calibrated(
    values: Float64, rows: EmbeddingWindows, count: int
) -> tuple[Float64, Float64, Indices]:
    """Learn one head; returns weights and biases, times its inverse temperature, and which."""
    unit = rows.collection
    if len(np.unique(unit)) < _FEWEST_COLLECTIONS:
        unit = rows.group % _PARTS
    sums = _Sums(values, rows.target, rows.collection, unit)
    left_out = np.full((len(values), count), -np.inf)
    for one in np.unique(unit):
        weights, bias, learned = sums.ridge(sums.unit != one)
        own = unit == one
        left_out[np.ix_(own, learned)] = values[own] @ weights + bias
    usable = rows.tried & np.isfinite(left_out[np.arange(len(values)), rows.target])
    inverse = inverse_temperature(left_out[usable], rows.target[usable]) if usable.any() else 1.0
    weights, bias, learned = sums.ridge(np.ones(len(sums.unit), bool))
    slopes = np.zeros((values.shape[1], count))
    slopes[:, learned] = inverse * weights
    return slopes, inverse * bias, learned


class _Sums:
    """Sums over the windows of each class, collection and unit, of which any may be left out.

    Parameters
    ----------
    values : np.ndarray [shape=(m, d)], float64
    target, collection, unit : np.ndarray [shape=(m,)], intp
    """

    def __init__(
        self, values: Float64, target: Indices, collection: Indices, unit: Indices
    ) -> None:
        keys = np.stack([target, collection, unit], axis=1)
        distinct, row = np.unique(keys, axis=0, return_inverse=True)
        self.target, self.collection, self.unit = distinct.reshape(-1, 3).T
        parts = [values[row.ravel() == number] for number in range(len(distinct))]
        self._count = np.array([len(part) for part in parts], np.float64)
        width = values.shape[1]
        self._sum = np.array([part.sum(axis=0) for part in parts]).reshape(-1, width)
        self._gram = np.array([part.T @ part for part in parts]).reshape(-1, width, width)

    def ridge(self, kept: Bool) -> tuple[Float64, Float64, Indices]:
        """Regress on the classes, which weigh the same; returns weights, biases and which."""
        target, collection = self.target[kept], self.collection[kept]
        count, total, gram = self._count[kept], self._sum[kept], self._gram[kept]
        windows = count.sum()
        mean = total.sum(axis=0) / windows
        power = np.einsum("kii->i", gram) / windows
        scale = np.sqrt(np.maximum(power - mean**2, 0.0)) + 1e-6
        learned, number = np.unique(target, return_inverse=True)
        weight = self._weights(number, collection, count) * windows
        centre = (weight / count * total.T).sum(axis=1) / windows
        spread = np.tensordot(weight / count, gram, 1) - windows * np.outer(centre, centre)
        spread /= np.outer(scale, scale)
        own = np.zeros((len(learned), len(mean)))
        np.add.at(own, number, (weight / count)[:, np.newaxis] * total)
        each = windows / len(learned)
        toward = 2.0 * (own - each * centre) / scale
        spread[np.diag_indices(len(spread))] += _ALPHA
        weights = np.linalg.solve(spread, toward.T) / scale[:, np.newaxis]
        bias = 2.0 / len(learned) - 1.0 - centre @ weights
        return weights, bias, learned

    @staticmethod
    def _weights(number: Indices, collection: Indices, count: Float64) -> Float64:
        """Weigh sums, 1 in all: classes the same, in each its collections by their root."""
        pairs, of_pair = np.unique(np.stack([number, collection]), axis=1, return_inverse=True)
        of_pair = of_pair.ravel()
        together = np.bincount(of_pair, count)
        root = together**_ROOT
        root /= np.bincount(pairs[0], root)[pairs[0]]
        weights: Float64 = (root / together)[of_pair] * count / (number.max() + 1)
        return weights
