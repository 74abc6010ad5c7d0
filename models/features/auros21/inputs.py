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
_FLOOR = 1e-7


def features_themselves(features: Float32) -> Float32:
    """Return the features as they are.

    Parameters
    ----------
    features : np.ndarray [shape=(n, 21)], float32

    Returns
    -------
    np.ndarray [shape=(n, 21)], float32
        The same array.
    """
    return features


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
    "statistics": WindowStatistics(WINDOW_FRAMES, features_themselves, _WIDTH),
    "bands": WindowStatistics(WINDOW_FRAMES, band_values, _WIDTH + MEL_BANDS, changes=True),
}
