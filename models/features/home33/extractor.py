"""The values of `home33`: those of `auros21`, and the peakiness and flatness of six bands.

They are rounded to what a classifier can feel, since noise in their last digits does not compress.
Rounded values also agree where processors compute the exact ones differently in the last place.
"""

import numpy as np

from hearthlog.models.features.auros21.extractor import BINS, FeatureExtractor
from hearthlog.models.features.auros21.names import ENERGY, FEATURE_NAMES, FLUX
from hearthlog.schemas.arrays import Float32, Float64

SHAPE_NAMES = tuple(
    f"{name}_{number}" for name in ("peakiness", "flatness") for number in range(1, 7)
)
_WIDTH = len(FEATURE_NAMES)
_EDGES = np.array([3, 13, 25, 50, 100, 200, 400])  # bins of 20 Hz: 60, 260, 500 Hz, 1 … 8 kHz
_FLOOR = 1e-9  # power; a full-scale sine has 1
_DIGITS = 11  # binary, as of half precision, in which models know what they have learned from
_LEAST_EXPONENTS = np.full(_WIDTH + len(SHAPE_NAMES), -13, np.int32)
_LEAST_EXPONENTS[[ENERGY, FLUX]] = -40


class HomeExtractor(FeatureExtractor):
    """Features of one stream of frames."""

    width = _WIDTH + len(SHAPE_NAMES)

    def _compute(self, frames: Float32, out: Float32) -> None:
        power = self._paper_values(frames, out[:, :_WIDTH])
        out[:, _WIDTH:] = shape(power / BINS**2)
        out[:] = rounded(out)


def shape(power: Float64) -> Float64:
    """Compute how the power of each band is spread over its bins.

    Peakiness is the highest bin over the mean, flatness the geometric mean over the mean. They tell
    voices, music and rings from water, engines and noise.

    Parameters
    ----------
    power : np.ndarray [shape=(n, 400)], float64
        Of the bins of a frame's spectrum; a full-scale sine has 1.

    Returns
    -------
    np.ndarray [shape=(n, 12)], float64
        Peakiness of six bands, then their flatness, in dB.
    """
    power = power + _FLOOR
    counts = np.diff(_EDGES)
    highest = np.maximum.reduceat(power, _EDGES[:-1], axis=1)
    mean = np.add.reduceat(power, _EDGES[:-1], axis=1) / counts
    geometric = np.add.reduceat(np.log10(power), _EDGES[:-1], axis=1) / counts
    level = np.log10(mean)
    return 10.0 * np.concatenate([np.log10(highest) - level, geometric - level], axis=1)


def rounded(values: Float32) -> Float32:
    """Round features to 11 binary digits, as half precision does.

    Parameters
    ----------
    values : np.ndarray [shape=(n, 33)], float32
        Finite.

    Returns
    -------
    np.ndarray [shape=(n, 33)], float32
        Like half precision they have no digits behind the 24th of the point, but for energy and
        flux, which are small.
    """
    exponent = np.maximum(np.frexp(values)[1], _LEAST_EXPONENTS)
    return np.ldexp(np.rint(np.ldexp(values, _DIGITS - exponent)), exponent - _DIGITS)
