"""What a sound is like, whatever its level and length: numbers in which alike sounds are near."""

from collections.abc import Sequence

import numpy as np

from hearthlog.analyzer.logs.spans import ranges
from hearthlog.schemas.arrays import Float32, Float64, Int64

_ENERGY = "energy"
_WEIGHT = 0.3  # power of the energy: the loud part of a sound says most, and its end a little
_LEAST_ENERGY = 1e-12
_AT_ONCE = 16_384  # frames of sounds, or one sound: what a small box has room for


def descriptor_width(names: Sequence[str]) -> int:
    """Return how many numbers describe a sound of these features."""
    return 3 * len(_used(names)) + 1


def describe(values: Float32, names: Sequence[str], first: Int64, last: Int64) -> Float32:
    """Describe sounds by their features: mean, deviation, and how fast they change; and the length.

    Parameters
    ----------
    values : np.ndarray [shape=(frames, f)], float32
    names : sequence of str
        Of the features. Their energy weighs the frames, and is not in the result.
    first, last : np.ndarray [shape=(n,)], int64
        Rows of each sound: from `first` on, before `last`.

    Returns
    -------
    np.ndarray [shape=(n, descriptor_width(names))], float32
        Means, standard deviations and mean absolute differences of successive frames, each
        feature by feature, and the binary logarithm of the number of frames.
    """
    if not len(first):
        return np.empty((0, descriptor_width(names)), np.float32)
    block = np.cumsum(last - first) // _AT_ONCE
    begins = np.flatnonzero(np.diff(block, prepend=-1))
    ends = np.append(begins[1:], len(first))
    blocks = zip(begins, ends, strict=True)
    return np.concatenate(
        [_described(values, names, first[begin:end], last[begin:end]) for begin, end in blocks]
    )


def _described(values: Float32, names: Sequence[str], first: Int64, last: Int64) -> Float32:
    counts = last - first
    sound, rows = ranges(first, counts)
    begins = np.cumsum(counts) - counts
    x = values[rows][:, _used(names)].astype(np.float64)
    weights = _weights(values[rows], names)
    weights /= np.repeat(np.add.reduceat(weights, begins), counts)
    mean = np.add.reduceat(weights[:, np.newaxis] * x, begins)
    x -= mean[sound]
    deviation = np.sqrt(np.add.reduceat(weights[:, np.newaxis] * x**2, begins))
    change = np.abs(np.diff(x, axis=0, prepend=x[:1]))
    change[begins] = 0.0
    change = np.add.reduceat(change, begins) / np.maximum(counts - 1, 1)[:, np.newaxis]
    parts = mean, deviation, change, np.log2(counts)[:, np.newaxis]
    return np.concatenate(parts, axis=1).astype(np.float32)


def _used(names: Sequence[str]) -> list[int]:
    return [place for place, name in enumerate(names) if name != _ENERGY]


def _weights(values: Float32, names: Sequence[str]) -> Float64:
    if _ENERGY not in names:
        return np.ones(len(values))
    energy = values[:, list(names).index(_ENERGY)].astype(np.float64)
    return np.maximum(energy, _LEAST_ENERGY) ** _WEIGHT
