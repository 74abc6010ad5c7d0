"""Inputs of classifiers from the features of `auros21`.

`statistics` are those of the paper (section 3.2.1): mean and standard deviation of the features.
`bands` makes more of the same features: logarithms of energy and flux, the smooth mel bands that
the cepstra represent, and the mean change of all values from frame to frame.
"""

from functools import cache

import numpy as np

from hearthlog.models.batch_invariant import rowwise_matmul
from hearthlog.models.features.auros21.names import CEPSTRA, ENERGY, FEATURE_NAMES, FLUX, MEL_BANDS
from hearthlog.models.features.window_inputs import WindowStatistics
from hearthlog.schemas.arrays import Float32, Float64

WINDOW_FRAMES = 20
_SCALARS, _WIDTH = CEPSTRA.start, len(FEATURE_NAMES)
VALUES = _WIDTH + MEL_BANDS
_FLOOR = 1e-7
_OVERSUBTRACTION = 1.5
_TINY = 1e-12
_NEPERS = np.log(10.0) / 10.0  # of power in a decibel
_MOST_DB = 300.0  # no frame has so much; powers and their squares stay finite
LABEL_FRAMES = 8
# Means over quiet stretches of household recordings, in the order of the features before the
# cepstra, with the logarithm of the flux; the first is not used.
_OF_SILENCE = np.array([0.0, 0.17, 3.1, 0.24, 0.2, 1.28, -5.94, 0.26])


def band_values(features: Float32) -> Float64:
    """Compute the values behind the inputs `bands` from the features of each frame.

    Parameters
    ----------
    features : np.ndarray [shape=(n, 21)], float32

    Returns
    -------
    np.ndarray [shape=(n, 53)], float64
        The features before the cepstra, with energy in dB and the natural logarithm of the flux,
        then 32 mel bands in dB, then the cepstra.
    """
    cepstra = features[:, CEPSTRA]
    values = np.empty((len(features), _WIDTH + MEL_BANDS))
    values[:, :_SCALARS] = features[:, :_SCALARS]
    values[:, ENERGY] = 10.0 * np.log10(np.maximum(values[:, ENERGY], 0.0) + _FLOOR)
    values[:, FLUX] = np.log(np.maximum(values[:, FLUX], 0.0) + _FLOOR)
    values[:, _SCALARS : _SCALARS + MEL_BANDS] = bands_of(cepstra)
    values[:, _SCALARS + MEL_BANDS :] = cepstra
    return values


def band_powers(features: Float32) -> Float64:
    """Compute the powers of the mel bands and of the frame.

    Parameters
    ----------
    features : np.ndarray [shape=(n, 21)], float32

    Returns
    -------
    np.ndarray [shape=(n, 33)], float64
        Of the 32 bands that the cepstra represent, without the constant inside their logarithm,
        and the energy; not below 0.
    """
    powers = np.empty((len(features), MEL_BANDS + 1))
    level = np.minimum(bands_of(features[:, CEPSTRA]), _MOST_DB)
    powers[:, :MEL_BANDS] = np.exp(_NEPERS * level) - _FLOOR  # six times as fast as 10.0 ** …
    powers[:, MEL_BANDS] = features[:, ENERGY]
    return np.maximum(powers, 0.0, out=powers)


def values_above_floor(features: Float32, floors: Float64 | None) -> Float64:
    """Compute the values behind the inputs `above_floor` from the features of each frame.

    Parameters
    ----------
    features : np.ndarray [shape=(n, 21)], float32
    floors : np.ndarray [shape=(n, 33)], float64
        In the order of `band_powers`.

    Returns
    -------
    np.ndarray [shape=(n, 53)], float64
        Like those of `band_values`.

    Raises
    ------
    TypeError
        If there are no floors.
    """
    return above_floor(features, floors)[0]


def above_floor(features: Float32, floors: Float64 | None) -> tuple[Float64, Float64]:
    """Compute what of each frame is above the floor of the room, and how much of its energy.

    The floor is subtracted from the powers (Berouti, Schwartz and Makhoul, "Enhancement of speech
    corrupted by acoustic noise", 1979). The other values cannot be changed so; the less of the
    energy is above the floor, the nearer they are to those of silence.

    Parameters
    ----------
    features : np.ndarray [shape=(n, 21)], float32
    floors : np.ndarray [shape=(n, 33)], float64
        In the order of `band_powers`.

    Returns
    -------
    values : np.ndarray [shape=(n, 53)], float64
        As of `values_above_floor`.
    share : np.ndarray [shape=(n, 1)], float64
        From 0 to 1.

    Raises
    ------
    TypeError
        If there are no floors.
    """
    if floors is None:
        raise TypeError("these inputs need the floor of the room")
    powers = band_powers(features)
    energy, floor = powers[:, MEL_BANDS:], floors[:, MEL_BANDS:]
    share = np.maximum(energy - floor, 0.0) / np.maximum(energy, _TINY)
    level = 10.0 * np.log10(np.maximum(powers - _OVERSUBTRACTION * floors, 0.0) + _FLOOR)
    scalars = features[:, :_SCALARS].astype(np.float64)
    scalars[:, FLUX] = np.log(np.maximum(scalars[:, FLUX], 0.0) + _FLOOR)
    scalars = _OF_SILENCE + share * (scalars - _OF_SILENCE)
    scalars[:, ENERGY] = level[:, MEL_BANDS]
    bands = level[:, :MEL_BANDS]
    values = np.concatenate([scalars, bands, rowwise_matmul(bands, dct_weights())], axis=1)
    return values, share


def bands_of(cepstra: Float32) -> Float64:
    """Turn mel cepstra back into mel bands, which are smooth since the higher cepstra are left out.

    Parameters
    ----------
    cepstra : np.ndarray [shape=(n, 13)], float32
        In dB, the features `mfcc_1` to `mfcc_13`.

    Returns
    -------
    np.ndarray [shape=(n, 32)], float64
        In dB.
    """
    return rowwise_matmul(cepstra.astype(np.float64), dct_weights().T)


@cache
def dct_weights() -> Float64:
    """Return the weights of an orthonormal DCT-II from mel bands to cepstra.

    Returns
    -------
    np.ndarray [shape=(32, 13)], float64
        One column for each of the first 13 coefficients; its transpose turns cepstra into bands.
    """
    band = np.arange(MEL_BANDS)[:, np.newaxis]
    order = np.arange(_WIDTH - _SCALARS)
    weights = np.sqrt(2.0 / MEL_BANDS) * np.cos(np.pi / MEL_BANDS * (band + 0.5) * order)
    weights[:, 0] /= np.sqrt(2.0)
    return weights


INPUTS = {
    "statistics": WindowStatistics(WINDOW_FRAMES, np.asarray, _WIDTH),
    "bands": WindowStatistics(WINDOW_FRAMES, band_values, VALUES, changes=True),
    "above_floor": WindowStatistics(
        LABEL_FRAMES, values_above_floor, VALUES, changes=True, needs_floor=True
    ),
}
