"""Squared distances of windows to the vectors of a machine, scaled for its kernel."""

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from hearthlog.models.batch_invariant import aligned, rowwise_matmul
from hearthlog.models.classifiers.model import Array
from hearthlog.schemas.arrays import Float32, Float64

_EXACT = 4096  # steps: its square, 2^24, is the limit up to which float32 holds all whole numbers
_FARTHEST = 1 << 20  # steps: with a thousand inputs, sums of squares are exact in float64


class Prepared(NamedTuple):
    """Windows or vectors."""

    # [shape=(n, width + 2) or (width + 2, m), float32 or float64] windows in rows, vectors in
    # columns
    values: NDArray[Any]
    longest: float  # length of the longest window or vector, in steps; 0 without steps


class Distances(Protocol):
    """The exponents of a kernel, -gamma |x - s|^2, of scaled inputs x and vectors s."""

    def rows(self, scaled: Float64) -> Prepared:
        """Prepare scaled inputs, of shape (n, width)."""

    def vectors(self, scaled: Float64) -> Prepared:
        """Prepare scaled vectors, of shape (m, width)."""

    def between(self, rows: Prepared, vectors: Prepared) -> Float64:
        """Return the exponents, of shape (n, m), all at most 0."""


class RoundedDistances:
    """Distances of inputs in whole steps: the same bits with any BLAS, on any processor.

    Products of whole numbers and all their sums are exact in any order: in float32 if rows and
    vectors are close enough to the mean, as almost all are, else in float64.
    """

    def __init__(self, gamma: float, steps: int) -> None:
        self._steps = steps
        self._factor = gamma / steps**2

    def rows(self, scaled: Float64) -> Prepared:
        """Prepare scaled inputs, of shape (n, width)."""
        rounded = in_steps(scaled, self._steps)
        return _exact(_as_rows(rounded), rounded)

    def vectors(self, scaled: Float64) -> Prepared:
        """Prepare scaled vectors, of shape (m, width)."""
        rounded = in_steps(scaled, self._steps)
        values, longest = _exact(_as_columns(rounded, 1.0), rounded)
        return Prepared(aligned(values), longest)

    def between(self, rows: Prepared, vectors: Prepared) -> Float64:
        """Return the exponents, of shape (n, m), all at most 0."""
        # No partial sum of the products is above (|x| + |s|)^2.
        type_ = np.float32 if rows.longest + vectors.longest <= _EXACT else np.float64
        product = rows.values.astype(type_, copy=False) @ vectors.values.astype(type_, copy=False)
        exponents: Float64 = np.multiply(product, self._factor, dtype=np.float64)
        return exponents


class UnroundedDistances:
    """Distances for models of hearthlog 0.1."""

    def __init__(self, gamma: float) -> None:
        self._gamma = gamma

    def rows(self, scaled: Float64) -> Prepared:
        """Prepare scaled inputs, of shape (n, width)."""
        return Prepared(_as_rows(scaled), 0.0)

    def vectors(self, scaled: Float64) -> Prepared:
        """Prepare scaled vectors, of shape (m, width)."""
        return Prepared(aligned(_as_columns(scaled, self._gamma)), 0.0)

    def between(self, rows: Prepared, vectors: Prepared) -> Float64:
        """Return the exponents, of shape (n, m), all at most 0."""
        product = rowwise_matmul(rows.values, vectors.values)
        return np.minimum(product, 0.0, out=product)  # rounding puts a few above 0


def in_steps(scaled: Float64, steps: int) -> Float64:
    """Round standard deviations from the mean [shape=(n, width)] to whole steps, -2^20 to 2^20."""
    return np.clip(np.rint(steps * scaled), -_FARTHEST, _FARTHEST)


def _as_rows(inputs: Float64) -> Float64:
    """Return inputs x as (x, |x|^2, 1)."""
    square = np.vecdot(inputs, inputs)[:, np.newaxis]
    return np.concatenate([inputs, square, np.ones_like(square)], axis=1)


def _as_columns(vectors: Float64, gamma: float) -> Float64:
    """Return columns whose product with (x, |x|^2, 1) is -gamma |x - s|^2."""
    square = np.vecdot(vectors, vectors)[:, np.newaxis]
    parts = 2.0 * gamma * vectors, np.full_like(square, -gamma), -gamma * square
    return np.concatenate(parts, axis=1).T


def _exact(values: Float64, rounded: Float64) -> Prepared:
    """Convert values to float32 if that is exact."""
    longest = float(np.vecdot(rounded, rounded).max(initial=0.0)) ** 0.5
    return Prepared(values if longest > _EXACT else values.astype(np.float32), longest)


SCALER: Mapping[str, np.dtype[Any]] = {
    "scaler_mean": np.dtype(np.float64),
    "scaler_scale": np.dtype(np.float64),
}
_SMALLEST_SCALE = 1e-30  # no quotient of finite inputs overflows


class Scaler:
    """Scales inputs by a model's mean and standard deviation."""

    def __init__(self, arrays: Mapping[str, Array]) -> None:
        self._mean = arrays["scaler_mean"]
        self._scale = arrays["scaler_scale"]

    def __call__(self, inputs: Float32) -> Float64:
        """Scale inputs, of shape (n, width)."""
        return (inputs - self._mean) / self._scale


def scaler_shapes(width: int) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the arrays `SCALER` for a number of inputs."""
    return dict.fromkeys(SCALER, (width,))


def scaler_problem(arrays: Mapping[str, Array]) -> str | None:
    """Return an error in the arrays of `Scaler`, which are finite and of valid shapes; or None."""
    if (arrays["scaler_scale"] >= _SMALLEST_SCALE).all():
        return None
    return "scaler_scale has values that are not positive"
