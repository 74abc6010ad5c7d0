"""What a classifier looks at: one row of numbers for every window of 20 frames.

`statistics` are the paper's (section 3.2): mean and standard deviation of the 21 features.
`bands` uses the same features better: energy and flux as logarithms, besides the 13 cepstra the 32
smooth mel bands they stand for, and besides mean and deviation how much a value changes from frame
to frame.
"""

from functools import cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from models.rowwise import rowwise_matmul

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
            part = values[start : start + _FRAMES_AT_ONCE + WINDOW_FRAMES - 1]
            windows = np.lib.stride_tricks.sliding_window_view(part, WINDOW_FRAMES, axis=0)
            inputs[start : start + _FRAMES_AT_ONCE] = _reduced(
                self._kind, windows.transpose(0, 2, 1)
            )
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
        reduced = _reduced(kind, values.reshape(len(part), WINDOW_FRAMES, -1))
        inputs[start : start + _FRAMES_AT_ONCE] = reduced
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


def mean_and_std(windows: Float32 | Float64) -> tuple[Float64, Float64]:
    """Reduce windows of shape (n, frames, d) along their frames, in float64."""
    frames = windows.shape[1]
    mean = windows.sum(axis=1, dtype=np.float64) / frames
    deviation = windows - mean[:, np.newaxis]
    np.square(deviation, out=deviation)
    return mean, np.sqrt(deviation.sum(axis=1) / frames)


def _reduced(kind: Kind, windows: Float32 | Float64) -> Float64:
    """Statistics of windows of shape (n, 20, d)."""
    parts = [*mean_and_std(windows)]
    if kind == "bands":
        parts.append(np.abs(np.diff(windows, axis=1)).sum(axis=1) / (WINDOW_FRAMES - 1))
    return np.concatenate(parts, axis=1)
