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
    """Inference of one model; equal to scikit-learn's calibrated `SVC` within 1e-5.

    A row's probabilities do not depend on the rows computed together with it, nor on threads.

    Attributes
    ----------
    classes : tuple of str
        Names behind the columns of the probabilities.
    inputs : str
        What `probabilities` takes, as `models.inputs` makes them.
    """

    def __init__(self, model: Model) -> None:
        self.classes = model.classes
        self.inputs = model.description.inputs
        self._mean = model.scaler_mean
        self._scale = model.scaler_scale
        self._intercepts = model.intercepts
        self._inverse_temperature = model.description.inverse_temperature
        self._blocks = _blocks(model)
        count = len(self.classes)
        self._first, self._second = np.triu_indices(count, 1)
        one_hot = np.eye(count)
        self._sides = one_hot[self._first] - one_hot[self._second]
        self._times_second = np.bincount(self._second, minlength=count)

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
            votes = self._votes(self._pairs(inputs[rows])) * self._inverse_temperature
            votes -= votes.max(axis=1, keepdims=True)
            np.exp(votes, out=votes)
            result[rows] = votes / votes.sum(axis=1, keepdims=True)
        return result

    def _pairs(self, inputs: Float32) -> Float64:
        """Decision of every pair of classes, shape (n, C (C - 1) / 2)."""
        scaled = (inputs - self._mean) / self._scale
        square = np.vecdot(scaled, scaled)[:, np.newaxis]
        extended = np.concatenate([scaled, square, np.ones_like(square)], axis=1)
        classes = len(self.classes)
        against = np.zeros((classes, len(inputs), classes - 1))
        for index, weights, coefficients in self._blocks:
            kernel = rowwise_matmul(extended, weights)
            np.minimum(kernel, 0.0, out=kernel)  # a distance rounded to less than none
            np.exp(kernel, out=kernel)
            against[index] += rowwise_matmul(kernel, coefficients)
        first, second = self._first, self._second
        decision = against[first, :, second - 1] + against[second, :, first]
        return decision.T + self._intercepts

    def _votes(self, decision: Float64) -> Float64:
        """One value a class from the pairs, as scikit-learn's `decision_function_shape="ovr"`."""
        if len(self.classes) == 2:
            return np.concatenate([decision, -decision], axis=1)
        won = rowwise_matmul((decision >= 0.0).astype(np.float64), self._sides)
        sure = rowwise_matmul(decision, self._sides)
        return won + self._times_second + sure / (3.0 * (np.abs(sure) + 1.0))


def _blocks(model: Model) -> list[tuple[int, Float64, Float64]]:
    """Support vectors class by class, as (class, weights, coefficients).

    A row (x, |x|^2, 1) times the weights is -gamma |x - s|^2.
    """
    gamma = model.description.gamma
    support = (model.support_vectors - model.scaler_mean) / model.scaler_scale
    square = np.vecdot(support, support)[:, np.newaxis]
    weights = np.concatenate(
        [2.0 * gamma * support, np.full_like(square, -gamma), -gamma * square], axis=1
    )
    blocks = []
    end = 0
    for index, count in enumerate(model.support_counts):
        start, end = end, end + int(count)
        for low in range(start, end, _SUPPORT_AT_ONCE):
            part = slice(low, min(low + _SUPPORT_AT_ONCE, end))
            coefficients = np.ascontiguousarray(model.dual_coefficients[:, part].T)
            blocks.append((index, np.ascontiguousarray(weights[part].T), coefficients))
    return blocks
