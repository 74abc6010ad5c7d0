"""Directions of sounds as vectors, and their means: a circle has no mean of numbers."""

from typing import NamedTuple

import numpy as np

from hearthlog.schemas.arrays import Float32, Float64, Int64


class Bearings(NamedTuple):
    """Whence the sound of each of some spans came.

    Attributes
    ----------
    azimuths : np.ndarray [shape=(n,)], float64
        In radians, counter-clockwise from x; NaN where nothing was located.
    spreads : np.ndarray [shape=(n,)], float64
        Circular standard deviation, in radians; NaN where nothing was located. It is large where
        the sound moved, or there were several.
    counts : np.ndarray [shape=(n,)], int64
        Of the blocks that were located.
    """

    azimuths: Float64
    spreads: Float64
    counts: Int64


def as_vectors(azimuths: Float32, confidences: Float32) -> Float64:
    """Turn directions into vectors that can be added.

    Parameters
    ----------
    azimuths : np.ndarray [shape=(n,)], float32
        In radians.
    confidences : np.ndarray [shape=(n,)], float32

    Returns
    -------
    np.ndarray [shape=(n, 2)], float64
        Ahead and left: of a length that is the confidence.
    """
    turned = azimuths.astype(np.float64)
    return np.stack([np.cos(turned), np.sin(turned)], axis=1) * confidences[:, np.newaxis]


def degrees_of(vectors: Float64) -> Float64:
    """Return whence vectors come, in degrees.

    Parameters
    ----------
    vectors : np.ndarray [shape=(n, 2)], float64
        Ahead and left; NaN gives NaN.

    Returns
    -------
    np.ndarray [shape=(n,)], float64
        -180 to 180; 90 is left.
    """
    ahead, left = vectors.T
    return np.rad2deg(np.arctan2(left, ahead))


def mean_bearings(times: Int64, vectors: Float64, starts: Int64, ends: Int64) -> Bearings:
    """Compute whence the sound of spans came.

    The circular mean and standard deviation are those of Mardia and Jupp, "Directional Statistics",
    2000, weighted by the confidence.

    Parameters
    ----------
    times : np.ndarray [shape=(m,)], int64
        Starts of the blocks that were located, in their order, in nanoseconds of UTC.
    vectors : np.ndarray [shape=(m, 2)], float64
        As `as_vectors` makes them.
    starts, ends : np.ndarray [shape=(n,)], int64
        Of the spans, which may overlap. A block belongs to those in which it begins.
    """
    first, last = np.searchsorted(times, starts), np.searchsorted(times, ends)
    weights = np.hypot(*vectors.T)
    sums = np.zeros((len(times) + 1, 3))
    np.cumsum(np.column_stack([vectors, weights]), axis=0, out=sums[1:])
    counts = np.maximum(last - first, 0)
    ahead, left, weight = np.where(counts[:, np.newaxis] > 0, sums[last] - sums[first], np.nan).T
    with np.errstate(divide="ignore"):
        agreement = np.minimum(np.hypot(ahead, left) / weight, 1.0)
        spreads = np.sqrt(-2 * np.log(agreement))
    return Bearings(np.arctan2(left, ahead), spreads, counts)
