"""Probabilities of a model's classes, with numpy alone."""

import numpy as np
from numpy.typing import NDArray

from models.modelfile import Model
from models.rowwise import rowwise_matmul

_ROWS_AT_ONCE = 256
_SUPPORT_AT_ONCE = 256  # a product this small no BLAS divides among threads

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]


class Classifier:
    """Inference of one model; its pairs of classes decide as scikit-learn's `SVC` within 1e-5.

    Every pair votes for its first class with the hyperbolic tangent of its decision, against its
    second; the votes, times the inverse temperature, are turned into probabilities.

    A row's probabilities do not depend on the rows computed together with it, nor on threads.

    Attributes
    ----------
    classes : tuple of str
        Names behind the columns of the probabilities.
    inputs : str
        What `probabilities` takes, as `models.inputs` makes them.
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
        self._home_vote = model.description.home_vote
        self._home_blocks = _home_blocks(model)
        count = len(self.classes)
        self._first, self._second = np.triu_indices(count, 1)
        one_hot = np.eye(count)
        self._sides = one_hot[self._first] - one_hot[self._second]

    def probabilities(self, inputs: Float32) -> Float32:
        """Compute the probability of each class.

        Parameters
        ----------
        inputs : np.ndarray [shape=(n, width)], float32
            Finite.

        Returns
        -------
        np.ndarray [shape=(n, C)], float32
            In the order of the model's classes; every row sums to 1.
        """
        result = np.empty((len(inputs), len(self.classes)), np.float32)
        for start in range(0, len(inputs), _ROWS_AT_ONCE):
            rows = slice(start, start + _ROWS_AT_ONCE)
            extended = self._extended(inputs[rows])
            votes = rowwise_matmul(np.tanh(self._pairs(extended)), self._sides)
            votes += self._home(extended)
            votes *= self._inverse_temperature
            votes -= votes.max(axis=1, keepdims=True)
            np.exp(votes, out=votes)
            result[rows] = votes / votes.sum(axis=1, keepdims=True)
        return result

    def _extended(self, inputs: Float32) -> Float64:
        """Scaled inputs x as (x, |x|^2, 1), shape (n, width + 2)."""
        scaled = (inputs - self._mean) / self._scale
        square = np.vecdot(scaled, scaled)[:, np.newaxis]
        return np.concatenate([scaled, square, np.ones_like(square)], axis=1)

    def _pairs(self, extended: Float64) -> Float64:
        """Decision of every pair of classes, shape (n, C (C - 1) / 2)."""
        classes = len(self.classes)
        against = np.zeros((classes, len(extended), classes - 1))
        for index, weights, coefficients in self._blocks:
            against[index] += rowwise_matmul(_kernel(extended, weights), coefficients)
        first, second = self._first, self._second
        decision = against[first, :, second - 1] + against[second, :, first]
        return decision.T + self._intercepts

    def _home(self, extended: Float64) -> Float64:
        """Return what the home's own vectors add to the classes, shape (n, C)."""
        near = np.zeros((len(extended), len(self.classes)))
        for weights, one_hot in self._home_blocks:
            near += rowwise_matmul(_kernel(extended, weights), one_hot)
        return self._home_vote * np.sqrt(near)


def _kernel(extended: Float64, weights: Float64) -> Float64:
    kernel = rowwise_matmul(extended, weights)
    np.minimum(kernel, 0.0, out=kernel)  # a distance rounded to less than none
    return np.exp(kernel, out=kernel)


def _blocks(model: Model) -> list[tuple[int, Float64, Float64]]:
    """Support vectors class by class, as (class, weights, coefficients)."""
    weights = _weights(model, model.support_vectors)
    blocks = []
    end = 0
    for index, count in enumerate(model.support_counts):
        start, end = end, end + int(count)
        for low in range(start, end, _SUPPORT_AT_ONCE):
            part = slice(low, min(low + _SUPPORT_AT_ONCE, end))
            coefficients = np.ascontiguousarray(model.dual_coefficients[:, part].T)
            blocks.append((index, np.ascontiguousarray(weights[part].T), coefficients))
    return blocks


def _home_blocks(model: Model) -> list[tuple[Float64, Float64]]:
    """Vectors of the home, as (weights, which class each is of)."""
    if not len(model.home_vectors):
        return []
    weights = _weights(model, model.home_vectors)
    one_hot = np.eye(len(model.classes))[model.home_target]
    cuts = range(_SUPPORT_AT_ONCE, len(weights), _SUPPORT_AT_ONCE)
    return [
        (np.ascontiguousarray(part.T), of)
        for part, of in zip(np.split(weights, cuts), np.split(one_hot, cuts), strict=True)
    ]


def _weights(model: Model, vectors: Float32) -> Float64:
    """Rows that, times (x, |x|^2, 1), give -gamma |x - s|^2 of every vector s."""
    gamma = model.description.gamma
    scaled = (vectors - model.scaler_mean) / model.scaler_scale
    square = np.vecdot(scaled, scaled)[:, np.newaxis]
    return np.concatenate([2.0 * gamma * scaled, np.full_like(square, -gamma), -gamma * square], 1)
