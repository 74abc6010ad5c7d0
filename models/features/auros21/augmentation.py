"""Augmentation: the features of the same sound through another microphone, in another room.

Gain, tilt and bumps of the spectrum, and the noise of a microphone, act on the mel bands that the
cepstra represent, so the sound itself is not needed.
"""

import numpy as np

from hearthlog.models.features.auros21.extractor import mel_centres
from hearthlog.models.features.auros21.inputs import bands_of, dct_weights
from hearthlog.models.features.auros21.names import CEPSTRA, ENERGY
from hearthlog.schemas.arrays import Float32, Float64

_SHARE = 0.6  # of the segments get each of gain, tilt and bump
_GAIN = 12.0  # dB, at most
_TILT = 3.0  # dB an octave
_BUMPS, _BUMP = 3, 6.0  # dB
_BUMP_OCTAVES = (0.3, 1.0)  # width
_NOISE_SHARE = 0.5
_NOISE = (-95.0, -55.0)  # dB in each band
_NEPER = 10.0 / np.log(10.0)  # dB of a factor e in power


def augmented(windows: Float32, rng: np.random.Generator) -> Float32:
    """Return each window as another microphone might have captured it.

    Parameters
    ----------
    windows : np.ndarray [shape=(n, 20, 21)], float32
        Features of the set `auros21`.

    Returns
    -------
    np.ndarray [shape=(n, 20, 21)], float32
        Energy and cepstra are changed; the other features hardly depend on a microphone.
    """
    gain, curve = _curves(len(windows), rng)
    cepstra = windows[:, :, CEPSTRA]
    before = bands_of(cepstra.reshape(-1, cepstra.shape[2])).reshape(*cepstra.shape[:2], -1)
    after = before + (gain + curve)[:, np.newaxis]
    noisy = rng.random((len(windows), 1, 1)) < _NOISE_SHARE
    noise = rng.uniform(*_NOISE, (len(windows), 1, 1))
    after = np.where(noisy, _power_sum(after, noise), after)
    changed = windows.astype(np.float64)
    changed[:, :, CEPSTRA] += (after - before) @ dct_weights()
    changed[:, :, ENERGY] *= 10.0 ** (gain / 10.0)
    return changed.astype(np.float32)


def _power_sum(first: Float64, second: Float64) -> Float64:
    """Add the powers of two levels in dB."""
    return np.logaddexp(first / _NEPER, second / _NEPER) * _NEPER


def _curves(count: int, rng: np.random.Generator) -> tuple[Float64, Float64]:
    """Draw a gain, shape (n, 1), and a frequency response, shape (n, bands), in dB."""

    def some(values: Float64) -> Float64:
        return values * (rng.random((count, 1)) < _SHARE)

    octaves = np.log2(mel_centres() / 1000.0)
    gain = some(rng.normal(0.0, _GAIN / 2, (count, 1)).clip(-_GAIN, _GAIN))
    curve = some(rng.uniform(-_TILT, _TILT, (count, 1))) * octaves
    for _ in range(_BUMPS):
        height = some(rng.uniform(-_BUMP, _BUMP, (count, 1)))
        distance = octaves - rng.uniform(octaves[0], octaves[-1], (count, 1))
        curve += height * np.exp(-0.5 * (distance / rng.uniform(*_BUMP_OCTAVES, (count, 1))) ** 2)
    return gain, curve
