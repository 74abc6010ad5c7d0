"""Feature set `home33`: the paper's 21 values for every frame, and the shape of its spectrum."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hearthlog.models.features import FeatureSet, WindowStatistics, auros21
from hearthlog.models.features.auros21 import (
    AUROS21,
    BINS,
    ENERGY,
    FEATURE_NAMES,
    FLUX,
    FeatureExtractor,
)
from hearthlog.schemas.arrays import Float32, Float64

SHAPE_NAMES = tuple(
    f"{name}_{number}" for name in ("peakiness", "flatness") for number in range(1, 7)
)
_WIDTH = len(FEATURE_NAMES)
_EDGES = np.array([3, 13, 25, 50, 100, 200, 400])  # bins of 20 Hz: 60, 260, 500 Hz, 1 … 8 kHz
_FLOOR = 1e-9  # power; a full-scale sine has 1
_DIGITS = 11  # binary digits of half precision, in which models store training features
_LEAST_EXPONENTS = np.full(_WIDTH + len(SHAPE_NAMES), -13, np.int32)
np.put(_LEAST_EXPONENTS, [ENERGY, FLUX], -40)


class HomeExtractor(FeatureExtractor):
    """Features of one stream of frames."""

    width = _WIDTH + len(SHAPE_NAMES)

    def _compute(self, frames: Float32, out: Float32) -> None:
        power = self._paper_values(frames, out[:, :_WIDTH])
        out[:, _WIDTH:] = shape(power / BINS**2)
        out[:] = rounded(out)


def shape(power: Float64) -> Float64:
    """Compute the spread of each band's power over its bins, in dB [shape=(n, 12)].

    It is the peakiness of six bands, then their flatness. Peakiness is the highest bin over the
    mean, flatness the geometric mean over the mean. They distinguish voices, music and rings from
    water, engines and noise. `power` [shape=(n, 400)] is that of the bins; a full-scale sine has 1.
    """
    power = power + _FLOOR
    counts = np.diff(_EDGES)
    highest = np.maximum.reduceat(power, _EDGES[:-1], axis=1)
    mean = np.add.reduceat(power, _EDGES[:-1], axis=1) / counts
    geometric = np.add.reduceat(np.log10(power), _EDGES[:-1], axis=1) / counts
    level = np.log10(mean)
    return 10.0 * np.concatenate([np.log10(highest) - level, geometric - level], axis=1)


def rounded(values: Float32) -> Float32:
    """Round finite features [shape=(n, 33)] to 11 binary digits, as half precision does.

    There are no digits after the 24th binary place, except for energy and flux, which are small. No
    classifier needs more digits, and noise in the last digits does not compress. Rounded values
    also agree across processors whose exact values differ in the last place.
    """
    exponent = np.maximum(np.frexp(values)[1], _LEAST_EXPONENTS)
    return np.ldexp(np.rint(np.ldexp(values, _DIGITS - exponent)), exponent - _DIGITS)


# Means over quiet stretches of household recordings.
_PEAKINESS = (4.6, 4.4, 5.1, 5.6, 5.4, 2.6)
_FLATNESS = (-2.6, -1.8, -1.6, -1.4, -1.2, -0.2)
_OF_SILENCE = np.array([*_PEAKINESS, *_FLATNESS])


def band_powers(features: Float32) -> Float64:
    """Compute powers of mel bands and frame [shape=(n, 33)], as in `auros21`."""
    return auros21.band_powers(features[:, :_WIDTH])


def values_above_floor(features: Float32, floors: Float64 | None) -> Float64:
    """Compute the values of the inputs `above_floor` [shape=(n, 65)].

    They are the values of `auros21`, then peakiness and flatness, which are closer to their values
    in silence the smaller the share of energy above the floor. `floors` [shape=(n, 33)] are in the
    order of `band_powers`. Raise `TypeError` if there are no floors.
    """
    values, share = auros21.above_floor(features[:, :_WIDTH], floors)
    shape = _OF_SILENCE + share * (features[:, _WIDTH:] - _OF_SILENCE)
    return np.concatenate([values, shape], axis=1)


INPUTS = {
    "statistics": WindowStatistics(auros21.WINDOW_FRAMES, np.asarray, _WIDTH + len(_OF_SILENCE)),
    "above_floor": WindowStatistics(
        auros21.LABEL_FRAMES,
        values_above_floor,
        auros21.VALUES + len(_OF_SILENCE),
        changes=True,
        needs_floor=True,
    ),
}


def _energy(features: NDArray[Any]) -> NDArray[Any]:
    return AUROS21.power(features)


HOME33 = FeatureSet(
    name="home33",
    version=1,
    feature_names=(*AUROS21.feature_names, *SHAPE_NAMES),
    units=(*AUROS21.units, *("dB" for _ in SHAPE_NAMES)),
    window_frames=AUROS21.window_frames,
    extractor=HomeExtractor,
    inputs=INPUTS,
    power=_energy,
    band_powers=band_powers,
    method="room",
)
