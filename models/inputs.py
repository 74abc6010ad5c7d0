"""What a classifier looks at: one row of numbers for every window of 20 frames.

`statistics` are the paper's (section 3.2): mean and standard deviation of the 21 features.
`bands` uses the same features better: energy and flux as logarithms, besides the 13 cepstra the 32
smooth mel bands they stand for, and besides mean and deviation how much a value changes from frame
to frame.
"""

from collections.abc import Sequence
from functools import cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from hearthlog.models.rowwise import rowwise_matmul

WINDOW_FRAMES = 20
Kind = Literal["statistics", "bands"]
_FRAMES_AT_ONCE = 256
_SCALARS, _CEPSTRA, _BANDS = 8, 13, 32
_LOGARITHMIC = (0, 6)  # energy and flux
_FLOOR = 1e-7

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]


class InputStream:
    """The inputs at the frames of one stream."""

    def __init__(self, kind: Kind) -> None:
        self._kind: Kind = kind
        self._recent: Float32 | None = None

    def restart(self) -> None:
        """Forget the past: the next frame does not follow the last one."""
        self._recent = None

    def __call__(self, features: Float32) -> Float32:
        """Compute the inputs at successive frames.

        Parameters
        ----------
        features : np.ndarray [shape=(n, 21)], float32

        Returns
        -------
        np.ndarray [shape=(m, width)], float32
            At the last m of these frames: those with 19 before them since the start or the last
            restart. The same frames give the same bits in blocks of any size.
        """
        if self._recent is not None:
            features = np.concatenate([self._recent, features])
        self._recent = features[max(len(features) - WINDOW_FRAMES + 1, 0) :].copy()
        values: NDArray[Any] = frame_values(self._kind, features)
        count = max(len(features) - WINDOW_FRAMES + 1, 0)
        inputs = np.empty((count, input_width(self._kind)), np.float32)
        for start in range(0, count, _FRAMES_AT_ONCE):
            end = min(start + _FRAMES_AT_ONCE, count)
            part = values[start : end + WINDOW_FRAMES - 1]
            changes = successive(np.abs(np.diff(part, axis=0)), WINDOW_FRAMES - 1)
            _reduce(self._kind, successive(part, WINDOW_FRAMES), changes, inputs[start:end])
        return inputs


def window_inputs(kind: Kind, windows: Float32) -> Float32:
    """Compute the inputs of windows that do not follow each other.

    Parameters
    ----------
    kind : Kind
    windows : np.ndarray [shape=(n, 20, 21)], float32
        Features.

    Returns
    -------
    np.ndarray [shape=(n, width)], float32
    """
    inputs = np.empty((len(windows), input_width(kind)), np.float32)
    for start in range(0, len(windows), _FRAMES_AT_ONCE):
        part = windows[start : start + _FRAMES_AT_ONCE]
        values = frame_values(kind, part.reshape(-1, part.shape[-1]))
        frames = values.reshape(len(part), WINDOW_FRAMES, -1).swapaxes(0, 1)
        changes = np.abs(np.diff(frames, axis=0))
        _reduce(kind, [*frames], [*changes], inputs[start : start + _FRAMES_AT_ONCE])
    return inputs


def input_width(kind: Kind) -> int:
    """Return how many inputs there are."""
    return 2 * (_SCALARS + _CEPSTRA) if kind == "statistics" else 3 * (_SCALARS + _BANDS + _CEPSTRA)


def frame_values(kind: Kind, features: Float32) -> Float32 | Float64:
    """Return what the statistics are made of: the features, or better ones made from them.

    Returns
    -------
    np.ndarray [shape=(n, 21)], float32, or [shape=(n, 53)], float64
        Of `bands`: the eight first features, of them energy in dB and the natural logarithm of the
        flux, then 32 mel bands in dB, then the cepstra.
    """
    if kind == "statistics":
        return features
    values = np.empty((len(features), _SCALARS + _BANDS + _CEPSTRA))
    values[:, :_SCALARS] = features[:, :_SCALARS]
    energy, flux = _LOGARITHMIC
    values[:, energy] = 10.0 * np.log10(np.maximum(values[:, energy], 0.0) + _FLOOR)
    values[:, flux] = np.log(np.maximum(values[:, flux], 0.0) + _FLOOR)
    values[:, _SCALARS:-_CEPSTRA] = bands_of(features[:, _SCALARS:])
    values[:, -_CEPSTRA:] = features[:, _SCALARS:]
    return values


def bands_of(cepstra: Float32) -> Float64:
    """Turn mel cepstra back into 32 bands in dB, smoothed by the cepstra that are not there."""
    return rowwise_matmul(cepstra.astype(np.float64), dct_weights().T)


@cache
def dct_weights() -> Float64:
    """Orthonormal DCT-II of 32 mel bands, its first 13 coefficients (the first is the level)."""
    band = np.arange(_BANDS)[:, np.newaxis]
    order = np.arange(_CEPSTRA)
    weights = np.sqrt(2.0 / _BANDS) * np.cos(np.pi / _BANDS * (band + 0.5) * order)
    weights[:, 0] /= np.sqrt(2.0)
    return weights


def successive(values: NDArray[Any], length: int) -> list[NDArray[Any]]:
    """Return the first rows of all windows of so many successive rows, the second ones, and so on.

    Parameters
    ----------
    values : np.ndarray [shape=(n, d)]
    length : int
    """
    count = len(values) - length + 1
    return [values[place : place + count] for place in range(length)]


def mean_and_std(frames: Sequence[NDArray[Any]]) -> tuple[Float64, Float64]:
    """Reduce windows to mean and standard deviation, in float64.

    Frame after frame for many windows at once: what is summed stays in the cache.

    Parameters
    ----------
    frames : sequence of np.ndarray [shape=(n, d)]
        The first frames of all windows, the second ones, and so on.
    """
    mean = _sum(frames) / len(frames)
    square = np.zeros_like(mean)
    deviation = np.empty_like(mean)
    for values in frames:
        np.subtract(values, mean, out=deviation)
        np.square(deviation, out=deviation)
        square += deviation
    return mean, np.sqrt(square / len(frames))


def _reduce(
    kind: Kind, frames: Sequence[NDArray[Any]], changes: Sequence[NDArray[Any]], out: Float32
) -> None:
    """Put the statistics of windows into rows."""
    parts = [*mean_and_std(frames)]
    if kind == "bands":
        parts.append(_sum(changes) / len(changes))
    np.concatenate(parts, axis=1, out=out, casting="same_kind")


def _sum(frames: Sequence[NDArray[Any]]) -> Float64:
    total = frames[0].astype(np.float64)
    for values in frames[1:]:
        total += values
    return total
