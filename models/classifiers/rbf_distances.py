"""Squared distances of windows to the vectors of a machine, as its kernel takes them."""

from typing import NamedTuple, Protocol

import numpy as np

from hearthlog.models.batch_invariant import aligned, rowwise_matmul
from hearthlog.schemas.arrays import Float32, Float64

_NONE = np.empty(0)
_EXACT = 1 << 24  # the largest whole number to which float32 holds all
_FARTHEST = 1 << 20  # steps: with 8192 of them, sums of squares are exact in float64


class Prepared(NamedTuple):
    """Windows or vectors.

    Attributes
    ----------
    values : np.ndarray [shape=(n, k) or (k, m)], float32 or float64
        Windows in rows, vectors in columns.
    terms : np.ndarray [shape=(n, 1) or (m,)], float64
        Of the exponents; empty where the values have them.
    longest : float
        Length of the longest, in steps; 0 without steps.
    """

    values: Float32 | Float64
    terms: Float64
    longest: float


class Distances(Protocol):
    """The exponents of a kernel, -gamma |x - s|^2, of scaled inputs x and vectors s."""

    def rows(self, scaled: Float64) -> Prepared:
        """Prepare scaled inputs, of shape (n, width)."""

    def vectors(self, scaled: Float64) -> Prepared:
        """Prepare scaled vectors, of shape (m, width)."""

    def between(self, rows: Prepared, vectors: Prepared) -> Float64:
        """Return the exponents, of shape (n, m); by rounding, they may be a little above 0."""


class RoundedDistances:
    """Distances of inputs in whole steps: the same bits with any BLAS, on any processor.

    Products of whole numbers, and all their sums, are exact, in whatever order: in float32 where
    rows and vectors are as near to the mean as nearly all are, else in float64.

    Parameters
    ----------
    gamma : float
        Of the kernel.
    steps : int
        Of the standard deviation of an input.
    """

    def __init__(self, gamma: float, steps: int) -> None:
        self._steps = steps
        self._factor = gamma / steps**2

    def rows(self, scaled: Float64) -> Prepared:
        """Prepare scaled inputs, of shape (n, width)."""
        values, terms, longest = self._whole(scaled)
        return Prepared(values, terms[:, np.newaxis], longest)

    def vectors(self, scaled: Float64) -> Prepared:
        """Prepare scaled vectors, of shape (m, width)."""
        values, terms, longest = self._whole(scaled)
        return Prepared(aligned(values.T), terms, longest)

    def _whole(self, scaled: Float64) -> tuple[Float32, Float64, float]:
        whole = in_steps(scaled, self._steps)
        squares = np.vecdot(whole, whole)
        longest = float(squares.max(initial=0.0)) ** 0.5
        return whole.astype(np.float32), -self._factor * squares, longest

    def between(self, rows: Prepared, vectors: Prepared) -> Float64:
        """Return the exponents, of shape (n, m); by rounding, they may be a little above 0."""
        type_ = np.float32 if rows.longest * vectors.longest <= _EXACT else np.float64
        product = rows.values.astype(type_, copy=False) @ vectors.values.astype(type_, copy=False)
        exponents: Float64 = np.multiply(product, 2.0 * self._factor, dtype=np.float64)
        exponents += vectors.terms
        exponents += rows.terms
        return exponents


class UnroundedDistances:
    """Distances as models of hearthlog 0.1 take them.

    Parameters
    ----------
    gamma : float
        Of the kernel.
    """

    def __init__(self, gamma: float) -> None:
        self._gamma = gamma

    def rows(self, scaled: Float64) -> Prepared:
        """Prepare scaled inputs x as (x, |x|^2, 1)."""
        square = np.vecdot(scaled, scaled)[:, np.newaxis]
        return Prepared(np.concatenate([scaled, square, np.ones_like(square)], axis=1), _NONE, 0.0)

    def vectors(self, scaled: Float64) -> Prepared:
        """Prepare scaled vectors as columns whose product with (x, |x|^2, 1) is the exponent."""
        gamma, square = self._gamma, np.vecdot(scaled, scaled)[:, np.newaxis]
        parts = 2.0 * gamma * scaled, np.full_like(square, -gamma), -gamma * square
        return Prepared(aligned(np.concatenate(parts, axis=1).T), _NONE, 0.0)

    def between(self, rows: Prepared, vectors: Prepared) -> Float64:
        """Return the exponents, of shape (n, m); by rounding, they may be a little above 0."""
        return rowwise_matmul(
            rows.values.astype(np.float64, copy=False),
            vectors.values.astype(np.float64, copy=False),
        )


def in_steps(scaled: Float64, steps: int) -> Float64:
    """Round scaled inputs to whole steps.

    Parameters
    ----------
    scaled : np.ndarray [shape=(n, width)], float64
        In standard deviations from the mean.
    steps : int
        Of a standard deviation.

    Returns
    -------
    np.ndarray [shape=(n, width)], float64
        Whole numbers, from -2^20 to 2^20.
    """
    return np.clip(np.rint(steps * scaled), -_FARTHEST, _FARTHEST)
