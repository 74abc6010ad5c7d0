"""Perceptual linear prediction: from the spectrum of sound to cepstra of what is heard of it.

After Hermansky, "Perceptual linear predictive (PLP) analysis of speech", 1990. The library spafe
0.3.3 is not used: it weights bands for loudness by their powers in the place of their frequencies,
and takes half a spectrum for a whole one.
"""

from functools import cache

import numpy as np
from numpy.typing import NDArray

from hearthlog.models.batch_invariant import rowwise_matmul
from hearthlog.schemas.frames import SAMPLE_RATE

Float64 = NDArray[np.float64]

BANDS = 21  # less than a bark apart, from 0 to 8 kHz
ORDER = 12
CEPSTRA = ORDER + 1
_TINY = 1e-12


def critical_bands(samples: Float64) -> Float64:
    """Compute the powers in critical bands.

    Parameters
    ----------
    samples : np.ndarray [shape=(n, length)], float64

    Returns
    -------
    np.ndarray [shape=(n, BANDS)], float64
        Of a tapered frame; full scale is about 1.
    """
    length = samples.shape[1]
    spectrum = np.abs(np.fft.rfft(samples * np.hamming(length), axis=1)) ** 2
    return rowwise_matmul(spectrum, _critical_bank(length)) + _TINY


def cepstra_of(bands: Float64) -> Float64:
    """Compute the cepstra of an all-pole model of what is heard in critical bands.

    Parameters
    ----------
    bands : np.ndarray [shape=(n, BANDS)], float64
        Powers, above 0.

    Returns
    -------
    np.ndarray [shape=(n, CEPSTRA)], float64
        The logarithm of the gain, then the coefficients from 1 on.
    """
    heard = np.cbrt(bands * _equal_loudness())
    heard[:, 0], heard[:, -1] = heard[:, 1], heard[:, -2]  # they reach beyond what is sampled
    correlation = np.fft.irfft(heard, axis=1)[:, :CEPSTRA]
    return _cepstra(*prediction(correlation))


def prediction(correlation: Float64) -> tuple[Float64, Float64]:
    """Solve for the linear prediction of many signals at once, by the recursion of Levinson.

    Parameters
    ----------
    correlation : np.ndarray [shape=(n, p + 1)], float64
        Autocorrelations at lags from 0 on.

    Returns
    -------
    coefficients : np.ndarray [shape=(n, p)], float64
        Of the filter 1 + a_1 z^-1 + … + a_p z^-p that leaves the least.
    error : np.ndarray [shape=(n,)], float64
        Power of what it leaves.
    """
    count, order = len(correlation), correlation.shape[1] - 1
    filters = np.zeros((count, order + 1))
    filters[:, 0] = 1.0
    error = correlation[:, 0] * (1.0 + 1e-9)
    for step in range(1, order + 1):
        left = np.vecdot(filters[:, :step], correlation[:, step:0:-1])
        reflection = -(left / error)[:, np.newaxis]
        filters[:, 1 : step + 1] += reflection * filters[:, step - 1 :: -1][:, :step]
        error = error * (1.0 - reflection[:, 0] ** 2)
    return filters[:, 1:], error


def _cepstra(coefficients: Float64, error: Float64) -> Float64:
    """Turn all-pole models into cepstra, by the recursion of Atal."""
    cepstra = np.empty((len(error), coefficients.shape[1] + 1))
    cepstra[:, 0] = np.log(error)
    for order in range(1, cepstra.shape[1]):
        before = np.arange(1, order)
        known = cepstra[:, before] * (before / order) * coefficients[:, order - before - 1]
        cepstra[:, order] = -coefficients[:, order - 1] - np.einsum("ij->i", known)
    return cepstra


def _bark(hertz: Float64) -> Float64:
    return 6.0 * np.arcsinh(hertz / 600.0)


def _centres() -> Float64:
    """Return the centres of the bands in bark."""
    return np.linspace(0.0, _bark(np.array([SAMPLE_RATE / 2]))[0], BANDS)


@cache
def _critical_bank(length: int) -> Float64:
    """Return how much of each bin a band hears [shape=(bins, BANDS)]: more of those below it."""
    bins = _bark(np.fft.rfftfreq(length, 1.0 / SAMPLE_RATE))
    distance = _centres() - bins[:, np.newaxis]
    slopes = np.minimum(2.5 * (distance + 0.5), -(distance - 0.5))
    curve = 10.0 ** np.minimum(slopes, 0.0)
    curve[(distance < -1.3) | (distance > 2.5)] = 0.0
    return curve * (2.0 / length / np.square(np.hamming(length)).sum())


@cache
def _equal_loudness() -> Float64:
    """Return how sensitive hearing is in each band, at 40 dB; 1 where it is most."""
    square = (2.0 * np.pi * 600.0 * np.sinh(_centres() / 6.0)) ** 2
    curve = (square + 56.8e6) * square**2
    curve /= (square + 6.3e6) ** 2 * (square + 0.38e9) * (square**3 + 9.58e26)
    loudness: Float64 = curve / curve.max()
    return loudness
