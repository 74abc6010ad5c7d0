"""Sound as another room and another microphone would give it.

Reverberation is exponentially decaying noise behind the direct sound, as in Moorer, "About this
reverberation business", 1979; a microphone has tilt, bumps and band limits.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from hearthlog.models.features.feature_set import FeatureSet
from hearthlog.models.features.floor import low_power
from hearthlog.schemas.arrays import Float32, Float64
from hearthlog.schemas.frames import FRAME_SAMPLES, SAMPLE_RATE

_SHARE = 0.5  # of the copies are in a reverberant room, and as many by another microphone
_REVERBERATION_SECONDS = (0.1, 0.6)  # until it has fallen by 60 dB
_DIRECT_DB = (-6.0, 12.0)  # direct sound above the reverberation
_DIRECT_SAMPLES = 48  # 3 ms without an echo
_TILT_SHARE, _TILT = 0.6, (-3.0, 3.0)  # dB an octave
_BUMPS, _BUMP_DB, _BUMP_OCTAVES, _BUMP_WIDTH = 3, (-6.0, 6.0), (-4.0, 3.0), (0.3, 1.0)
_LIMITS_SHARE, _LOW_HERTZ, _HIGH_HERTZ = 0.5, (50.0, 300.0), (3000.0, 8000.0)
_LIMITS_ORDER = 4  # of a Butterworth filter
_SETTLING = 4000  # samples
_GAIN_DB = (-20.0, 20.0)
_SIGNAL_TO_NOISE_DB = (5.0, 30.0)
_SILENCE_DBFS = (-85.0, -40.0)  # noise in a room where nothing happens
_NOISE_DBFS = (-100.0, -30.0)  # limits of all noise
_STEADY_DBFS = (-85.0, -32.0)
_SLOPES = (0.0, 0.25, 0.5, 0.75, 1.0)  # amplitude falls with the frequency to this power
_LOWEST_HERTZ = 20.0
_FLOOR_ERROR_DB = 1.5  # of a tracked floor, in each band
_STEADY_SECONDS = 5


class RoomCopy(NamedTuple):
    """Features of a sound in a room.

    Attributes
    ----------
    features : np.ndarray [shape=(n, d)], float32
    floor : np.ndarray [shape=(b,)], float64
        Floor of the room, as a tracker would have it; powers of the bands of the feature set.
    """

    features: Float32
    floor: Float64


def in_room(
    frames: Float32, features: FeatureSet, rng: np.random.Generator, *, silence: bool
) -> RoomCopy:
    """Compute the features of a sound in a room with steady noise, by any microphone.

    Parameters
    ----------
    frames : np.ndarray [shape=(n, FRAME_SAMPLES)], float32
        At least one frame.
    """
    sound, level = other_room(frames, rng, silence=silence)
    return in_noise(sound, level, features, rng, silence=silence)


def other_room(
    frames: Float32, rng: np.random.Generator, *, silence: bool
) -> tuple[Float64, float]:
    """Put a sound into another room, before another microphone, without the noise there.

    Parameters
    ----------
    frames : np.ndarray [shape=(n, FRAME_SAMPLES)], float32
        At least one frame.

    Returns
    -------
    sound : np.ndarray [shape=(n * FRAME_SAMPLES,)], float64
    level : float
        Of the noise, in dBFS.
    """
    sound = frames.ravel().astype(np.float64) * 10.0 ** (rng.uniform(*_GAIN_DB) / 20.0)
    if rng.random() < _SHARE:
        seconds, direct = rng.uniform(*_REVERBERATION_SECONDS), rng.uniform(*_DIRECT_DB)
        sound = reverberated(sound, seconds, direct, rng)
    if rng.random() < _SHARE:
        sound = filtered(sound, _microphone(rng))
    noise_level = level_of(sound) - rng.uniform(*_SIGNAL_TO_NOISE_DB)
    if silence:
        noise_level = rng.uniform(*_SILENCE_DBFS)
    return sound, float(np.clip(noise_level, *_NOISE_DBFS))


def in_noise(
    sound: Float64, level: float, features: FeatureSet, rng: np.random.Generator, *, silence: bool
) -> RoomCopy:
    """Compute the features of a sound in steady noise.

    Parameters
    ----------
    sound : np.ndarray [shape=(n,)], float64
        Samples of whole frames at 16 kHz, at least one frame.
    level : float
        Of the noise, in dBFS.
    """
    noise = steady_noise(len(sound), level, rng)
    copy = captured(sound + noise, features)
    assert features.band_powers is not None
    if silence:
        floor = low_power(features.band_powers(copy))
    else:
        floor = features.band_powers(captured(noise, features)).mean(axis=0)
    return RoomCopy(copy, floor * _error(len(floor), rng))


def level_of(sound: Float64) -> float:
    """Return the mean level of a sound in dBFS, not below -120.

    Parameters
    ----------
    sound : np.ndarray [shape=(n,)], float64
    """
    return float(10.0 * np.log10(np.mean(np.square(sound, dtype=np.float64)) + 1e-12))


def empty_room(features: FeatureSet, rng: np.random.Generator) -> RoomCopy:
    """Compute the features of some seconds of steady noise."""
    level = rng.uniform(*_STEADY_DBFS)
    noise = steady_noise(_STEADY_SECONDS * SAMPLE_RATE, level, rng)
    copy = captured(noise, features)
    assert features.band_powers is not None
    floor = low_power(features.band_powers(copy), rng.uniform(0.05, 0.5))
    return RoomCopy(copy, floor * _error(len(floor), rng))


def reverberated(
    sound: Float64, seconds: float, direct: float, rng: np.random.Generator
) -> Float64:
    """Put a sound into a reverberant room.

    Parameters
    ----------
    sound : np.ndarray [shape=(n,)], float64
        Samples at 16 kHz.
    seconds : float
        Until the reverberation has fallen by 60 dB (RT60).
    direct : float
        Direct sound above the reverberation, in dB.

    Returns
    -------
    np.ndarray [shape=(n,)], float64
        Of the same power.
    """
    from scipy.signal import fftconvolve  # noqa: PLC0415  what reads a home needs no rooms

    time = np.arange(int(seconds * SAMPLE_RATE)) / SAMPLE_RATE
    response = rng.standard_normal(len(time)) * 10.0 ** (-3.0 * time / seconds)
    response[:_DIRECT_SAMPLES] = 0.0
    response *= 10.0 ** (-direct / 20.0) / np.sqrt(np.square(response).sum())
    response[0] = 1.0
    return _of_power(fftconvolve(sound, response)[: len(sound)], sound)


def filtered(sound: Float64, response: Callable[[Float64], Float64]) -> Float64:
    """Change the spectrum of a sound.

    Parameters
    ----------
    sound : np.ndarray [shape=(n,)], float64
        Samples at 16 kHz.
    response : callable
        Maps frequencies in hertz to dB.

    Returns
    -------
    np.ndarray [shape=(n,)], float64
        Of the same power.
    """
    count = len(sound) + _SETTLING + len(sound) % 2
    frequencies = np.linspace(0.0, SAMPLE_RATE / 2, count // 2 + 1)
    gain = 10.0 ** (response(frequencies) / 20.0)
    return _of_power(np.fft.irfft(np.fft.rfft(sound, count) * gain, count)[: len(sound)], sound)


def band_limits(frequencies: Float64, low: float, high: float) -> Float64:
    """Return the response of a microphone that is deaf below and above, in dB.

    Parameters
    ----------
    frequencies : np.ndarray [shape=(n,)], float64
        In hertz.
    low, high : float
        In hertz; there the response is -3 dB.
    """
    frequencies = np.maximum(frequencies, 1.0)
    order = 2 * _LIMITS_ORDER
    below, above = 1.0 + (low / frequencies) ** order, 1.0 + (frequencies / high) ** order
    limits: Float64 = -10.0 * np.log10(below * above)
    return limits


def octaves_of(frequencies: Float64) -> Float64:
    """Return how many octaves frequencies are above 1 kHz.

    Parameters
    ----------
    frequencies : np.ndarray [shape=(n,)], float64
        In hertz; those below 30 count as 30.
    """
    octaves: Float64 = np.log2(np.maximum(frequencies, 30.0) / 1000.0)
    return octaves


def _microphone(rng: np.random.Generator) -> Callable[[Float64], Float64]:
    """Draw the response of a microphone."""
    tilt = rng.uniform(*_TILT) * (rng.random() < _TILT_SHARE)
    count = _BUMPS if rng.random() < _TILT_SHARE else 0
    bumps = [
        (rng.uniform(*_BUMP_DB), rng.uniform(*_BUMP_OCTAVES), rng.uniform(*_BUMP_WIDTH))
        for _ in range(count)
    ]
    limited = rng.random() < _LIMITS_SHARE
    low = float(np.exp(rng.uniform(*np.log(_LOW_HERTZ))))
    high = rng.uniform(*_HIGH_HERTZ)

    def response(frequencies: Float64) -> Float64:
        octaves = octaves_of(frequencies)
        decibels = tilt * octaves
        for height, place, width in bumps:
            decibels = decibels + height * np.exp(-0.5 * ((octaves - place) / width) ** 2)
        return decibels + band_limits(frequencies, low, high) if limited else decibels

    return response


def _of_power(changed: Float64, sound: Float64) -> Float64:
    """Give a changed sound the power of the original."""
    factor: float = np.sqrt(np.square(sound).mean() / (np.square(changed).mean() + 1e-20))
    return changed * factor


def steady_noise(count: int, level: float, rng: np.random.Generator) -> Float64:
    """Make Gaussian noise whose spectrum falls by 0 to 6 dB an octave.

    Parameters
    ----------
    level : float
        In dBFS.

    Returns
    -------
    np.ndarray [shape=(count,)], float64
    """
    spectrum = np.fft.rfft(rng.standard_normal(count))
    frequencies = np.maximum(np.fft.rfftfreq(count, 1.0 / SAMPLE_RATE), _LOWEST_HERTZ)
    noise = np.fft.irfft(spectrum / frequencies ** rng.choice(_SLOPES), count)
    scaled: Float64 = noise * (10.0 ** (level / 20.0) / np.sqrt(np.mean(np.square(noise))))
    return scaled


def captured(sound: Float64, features: FeatureSet) -> Float32:
    """Compute the features of a sound as a microphone of 16 bits captures it.

    Parameters
    ----------
    sound : np.ndarray [shape=(n,)], float64
        Samples of whole frames at 16 kHz in full scale; those beyond it are clipped.

    Returns
    -------
    np.ndarray [shape=(n / FRAME_SAMPLES, d)], float32
    """
    samples = np.clip(np.rint(sound * 32767.0), -32768, 32767) / 32768.0
    return features.extractor()(samples.astype(np.float32).reshape(-1, FRAME_SAMPLES))


def _error(bands: int, rng: np.random.Generator) -> Float64:
    error: Float64 = 10.0 ** (rng.normal(0.0, _FLOOR_ERROR_DB, bands) / 10.0)
    return error
