"""Probabilities of a model's classes, with numpy alone."""

from itertools import combinations, pairwise

import numpy as np
from numpy.typing import NDArray

from hearthlog.models.modelfile import Model
from hearthlog.models.rowwise import aligned, rowwise_matmul

_ROWS_AT_ONCE = 256
HOME_VOTE = 2.0  # decisions of pairs lie around -1 and 1
HOME_SHARE = 100.0  # of one vector of the home, where a support vector has 1
HOME_SHARPNESS = 10.0
_TINY = 1e-200
_SUPPORT_AT_ONCE = 256  # a product this small no BLAS divides among threads

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
_Part = tuple[int, slice, Float64]  # a class, its columns, their coefficients


class Classifier:
    """Inference of one model; its pairs of classes decide as scikit-learn's `SVC` within 1e-5.

    A class is as sure as the weakest of its pairs. Where a home has vectors of its own, it is the
    surer, the more of what is near is the home's, and of that class. These decisions, times the
    inverse temperature, are turned into probabilities.

    A row's probabilities do not depend on the rows computed together with it, nor on threads.

    Attributes
    ----------
    classes : tuple of str
        Names behind the columns of the probabilities.
    inputs : str
        What `probabilities` takes, as `hearthlog.models.inputs` makes them.
    smoothing : Smoothing
    transitions : np.ndarray [shape=(C, C)], float64
        How probabilities become segments.
    """

    def __init__(self, model: Model) -> None:
        self.classes = model.classes
        self.inputs = model.description.inputs
        self.smoothing = model.description.smoothing
        self.transitions = model.transitions
        self._mean = model.scaler_mean
        self._scale = model.scaler_scale
        self._intercepts = model.intercepts
        self._inverse_temperature = model.description.inverse_temperature
        self._blocks = _blocks(model)
        self._home_blocks = _home_blocks(model)
        count = len(self.classes)
        self._first, self._second = np.triu_indices(count, 1)

    def probabilities(self, inputs: Float32) -> Float32:
        """Compute the probability of each class; the first of what `classify` returns."""
        return self.classify(inputs)[0]

    def classify(self, inputs: Float32) -> tuple[Float32, Float32]:
        """Compute the probability of each class, and how unlike anything learned a window is.

        Parameters
        ----------
        inputs : np.ndarray [shape=(n, width)], float32
            Finite.

        Returns
        -------
        probabilities : np.ndarray [shape=(n, C)], float32
            In the order of the model's classes; every row sums to 1.
        novelty : np.ndarray [shape=(n,)], float32
            One minus the kernel of the nearest support vector: 0 where it is the same, towards 1
            where nothing is near.
        """
        result = np.empty((len(inputs), len(self.classes)), np.float32)
        novelty = np.empty(len(inputs), np.float32)
        for start in range(0, len(inputs), _ROWS_AT_ONCE):
            rows = slice(start, start + _ROWS_AT_ONCE)
            extended = self._extended(inputs[rows])
            pairs, others, nearest = self._pairs(extended)
            novelty[rows] = -np.expm1(np.minimum(nearest, 0.0))
            decision = weakest_pairs(pairs, len(self.classes))
            if self._home_blocks:
                decision += home_votes(self._home(extended), others)
            decision *= self._inverse_temperature
            decision -= decision.max(axis=1, keepdims=True)
            np.exp(decision, out=decision)
            result[rows] = decision / decision.sum(axis=1, keepdims=True)
        return result, novelty

    def _extended(self, inputs: Float32) -> Float64:
        """Scaled inputs x as (x, |x|^2, 1), shape (n, width + 2)."""
        scaled = (inputs - self._mean) / self._scale
        square = np.vecdot(scaled, scaled)[:, np.newaxis]
        return np.concatenate([scaled, square, np.ones_like(square)], axis=1)

    def _pairs(self, extended: Float64) -> tuple[Float64, Float64, Float64]:
        """Decide for every pair of classes, by the kernels of the support vectors.

        Returns
        -------
        decisions : np.ndarray [shape=(n, C (C - 1) / 2)]
        others : np.ndarray [shape=(n, 1)]
            Sums of the sharp kernels; zeros, where no home has vectors to be compared with.
        nearest : np.ndarray [shape=(n,)]
            Logarithm of the largest kernel.
        """
        classes = len(self.classes)
        nearest = np.full(len(extended), -np.inf)
        against = np.zeros((classes, len(extended), classes - 1))
        others = np.zeros((len(extended), 1))
        rows = np.arange(len(extended))
        for weights, parts in self._blocks:
            distance = rowwise_matmul(extended, weights)
            largest = distance[rows, distance.argmax(axis=1)]
            if largest.max() > 0.0:  # by rounding
                np.minimum(distance, 0.0, out=distance)
            np.maximum(nearest, largest, out=nearest)
            if self._home_blocks:
                sharp = np.exp(HOME_SHARPNESS * distance)
                others += rowwise_matmul(sharp, np.ones((len(weights.T), 1)))
            kernel = np.exp(distance, out=distance)
            for index, columns, coefficients in parts:
                against[index] += rowwise_matmul(kernel[:, columns], coefficients)
        first, second = self._first, self._second
        decision = against[first, :, second - 1] + against[second, :, first]
        return decision.T + self._intercepts, others, nearest

    def _home(self, extended: Float64) -> Float64:
        """Sum the sharp kernels of the home's vectors by class, shape (n, C)."""
        home = np.zeros((len(extended), len(self.classes)))
        for weights, one_hot in self._home_blocks:
            home += rowwise_matmul(np.exp(HOME_SHARPNESS * _distance(extended, weights)), one_hot)
        return home


def weakest_pairs(pairs: Float64, classes: int) -> Float64:
    """Decide for each class as the weakest of its pairs does.

    Unlike the number of pairs that a class wins, this can be calibrated.

    Parameters
    ----------
    pairs : np.ndarray [shape=(n, C (C - 1) / 2)]
        Decisions for the first class of (0, 1), (0, 2) … (1, 2) …, against the second.
    classes : int
        C.

    Returns
    -------
    np.ndarray [shape=(n, C)]
    """
    decision = np.full((len(pairs), classes), np.inf)
    for place, (first, second) in enumerate(combinations(range(classes), 2)):
        np.minimum(decision[:, first], pairs[:, place], out=decision[:, first])
        np.minimum(decision[:, second], -pairs[:, place], out=decision[:, second])
    return decision


def home_votes(home: Float64, others: Float64) -> Float64:
    """Let what a home has corrected draw to its class what is nearer to it than to all else.

    With a few segments among thousands a support vector machine is content to get these right;
    the share that they have of what is near makes them count for others as well, and leaves alone
    what is near to nothing of the home.

    Parameters
    ----------
    home : np.ndarray [shape=(n, C)]
        Kernels, `HOME_SHARPNESS` times as sharp as the machine's, summed over the home's vectors.
    others : np.ndarray [shape=(n, 1)]
        The same, summed over the support vectors.
    """
    home = HOME_SHARE * home
    return HOME_VOTE * home / (home.sum(axis=1, keepdims=True) + others + _TINY)


def _distance(extended: Float64, weights: Float64) -> Float64:
    """Return -gamma |x - s|^2, which rounding must not make positive."""
    distance = rowwise_matmul(extended, weights)
    return np.minimum(distance, 0.0, out=distance)


def _blocks(model: Model) -> list[tuple[Float64, list[_Part]]]:
    """Divide the support vectors into blocks of weights, and these by class."""
    weights = _weights(model, model.support_vectors)
    ends = np.cumsum(model.support_counts).tolist()
    blocks = []
    for low in range(0, len(weights), _SUPPORT_AT_ONCE):
        high = min(low + _SUPPORT_AT_ONCE, len(weights))
        parts = []
        for index, (start, end) in enumerate(pairwise([0, *ends])):
            first, last = max(start, low), min(end, high)
            if first < last:
                coefficients = aligned(model.dual_coefficients[:, first:last].T)
                parts.append((index, slice(first - low, last - low), coefficients))
        blocks.append((aligned(weights[low:high].T), parts))
    return blocks


def _home_blocks(model: Model) -> list[tuple[Float64, Float64]]:
    """Vectors of the home, as (weights, which class each is of)."""
    if not len(model.home_vectors):
        return []
    weights = _weights(model, model.home_vectors)
    one_hot = np.eye(len(model.classes))[model.home_target]
    cuts = range(_SUPPORT_AT_ONCE, len(weights), _SUPPORT_AT_ONCE)
    return [
        (aligned(part.T), of)
        for part, of in zip(np.split(weights, cuts), np.split(one_hot, cuts), strict=True)
    ]


def _weights(model: Model, vectors: Float32) -> Float64:
    """Rows that, times (x, |x|^2, 1), give -gamma |x - s|^2 of every vector s."""
    gamma = model.description.gamma
    scaled = (vectors - model.scaler_mean) / model.scaler_scale
    square = np.vecdot(scaled, scaled)[:, np.newaxis]
    return np.concatenate([2.0 * gamma * scaled, np.full_like(square, -gamma), -gamma * square], 1)
