"""Where voices lie apart: seconds of speech as points, by a projection learned from 251 readers."""

from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from typing import NamedTuple

import numpy as np
from safetensors.numpy import load

from hearthlog.schemas.arrays import Float32, Float64, Int64

FILE = "voice_space.safetensors"
WINDOW_FRAMES = 30
HOP_FRAMES = 10
_NAMES = (
    *("zero_crossing_rate", "energy_entropy", "spectral_centroid", "spectral_spread"),
    *("spectral_entropy", "spectral_flux", "spectral_rolloff"),
    *(f"mfcc_{number}" for number in range(2, 14)),  # the first one is the level
)
ENERGY = "energy"
_LOUD_PERCENTILE = 90
_LOUD = 10 ** (-20 / 10)  # of the energy at that percentile
_LEAST_DEVIATION = 0.05
_TINY = 1e-9


class VoiceSpace(NamedTuple):
    """A space in which seconds of one voice scatter alike in all directions.

    Attributes
    ----------
    mean : np.ndarray [shape=(width,)], float64
        Of descriptions of speech.
    axes : np.ndarray [shape=(d, width)], float64
        Along each of them the variance of one voice is 1.
    spread : np.ndarray [shape=(d,)], float64
        Variance of the means of voices along each axis, descending.
    """

    mean: Float64
    axes: Float64
    spread: Float64

    def points(self, described: Float64) -> Float64:
        """Return where described windows lie, shape (n, d)."""
        points: Float64 = (described - self.mean) @ self.axes.T
        return points


@cache
def voice_space() -> VoiceSpace:
    """Return the space that comes with hearthlog."""
    arrays = load((files(__package__) / FILE).read_bytes())
    return VoiceSpace(*(arrays[name].astype(np.float64) for name in VoiceSpace._fields))


def has_voices(names: Sequence[str]) -> bool:
    """Tell whether features of these names can tell voices apart."""
    return {ENERGY, *_NAMES} <= set(names)


def window_starts(frames: int) -> Int64:
    """Return where windows of some frames begin: one at least, if there is a frame."""
    return np.arange(0, max(frames - WINDOW_FRAMES, 0) + 1, HOP_FRAMES)


def describe_speech(values: Float32, names: Sequence[str]) -> Float64:
    """Describe windows of speech: means and deviations of its features, in its loud frames.

    Parameters
    ----------
    values : np.ndarray [shape=(frames, f)], float32
        Features of speech, at least one frame.

    Returns
    -------
    np.ndarray [shape=(windows, 38)], float64
        Means, and logarithms of standard deviations, of each window of `window_starts`.
    """
    columns = [list(names).index(name) for name in _NAMES]
    length = min(WINDOW_FRAMES, len(values))
    view = np.lib.stride_tricks.sliding_window_view(values, length, axis=0)
    windows = view[window_starts(len(values))].astype(np.float64)
    energy = windows[:, list(names).index(ENERGY)]
    loudest = np.percentile(energy, _LOUD_PERCENTILE, axis=1, keepdims=True)
    weights = (energy >= loudest * _LOUD)[:, np.newaxis]
    weights = weights / weights.sum(axis=2, keepdims=True)
    x = windows[:, columns]
    mean = (weights * x).sum(axis=2)
    variance = (weights * (x - mean[:, :, np.newaxis]) ** 2).sum(axis=2)
    deviation = np.log(np.sqrt(variance + _TINY) + _LEAST_DEVIATION)
    return np.concatenate([mean, deviation], axis=1)
