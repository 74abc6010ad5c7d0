"""Sound from features: as much of speech as can be made of what a log holds.

The smooth mel bands of the cepstra filter noise, or where a frame is voiced the pulses of a voice
of one pitch. Pitch and phase are in no feature set.
"""

from typing import NamedTuple

import numpy as np

from hearthlog.models.features import FeatureSet
from hearthlog.models.features.auros21 import (
    BINS,
    CEPSTRA,
    FEATURE_NAMES,
    bands_of,
    mel_bank,
    mel_centres,
)
from hearthlog.models.features.home33 import SHAPE_NAMES
from hearthlog.schemas.arrays import Float32, Float64
from hearthlog.schemas.frames import FRAME_SAMPLES, SAMPLE_RATE

_FRAME = FRAME_SAMPLES * 1000 // SAMPLE_RATE  # ms
_SHORT = 400  # samples of a window between two of which are less than 25 ms
_STEP, _WINDOW = 80, 320  # samples, of what is synthesised
_PITCH, _VIBRATO, _VIBRATO_HERTZ = 120.0, 0.03, 3.0
_VOICED_BELOW, _VOICED_EDGE = 4000.0, 300.0  # Hz: above it even voices are noise
_ZERO_CROSSINGS, _ZERO_CROSSINGS_EDGE = 0.12, 1 / 60  # of voiced frames, at most
_FLATNESS, _FLATNESS_EDGE = -4.0, 1 / 1.5  # dB, of voiced frames, at most
_RATE = FEATURE_NAMES.index("zero_crossing_rate")
_FLAT = slice(*(len(FEATURE_NAMES) + SHAPE_NAMES.index(f"flatness_{band}") for band in (1, 5)))


class Logged(NamedTuple):
    """Features of a sound, at some rate.

    Attributes
    ----------
    times : np.ndarray [shape=(n,)], float64
        Middles of what they are computed from, in seconds.
    values : np.ndarray [shape=(n, d)], float64
    """

    times: Float64
    values: Float64


def logged(sound: Float64, features: FeatureSet, milliseconds: int) -> Logged:
    """Compute the features of a sound at a rate.

    Parameters
    ----------
    sound : np.ndarray [shape=(n,)], float64
        Samples at 16 kHz.
    features : FeatureSet
    milliseconds : int
        From one frame to the next. With 50 they are those of a log. More, a multiple of 50, are
        means of frames. With less, frames overlap: they are of 25 ms, in a Hann window.
    """
    if milliseconds < _FRAME:
        return _overlapping(sound, features, milliseconds)
    frames = _cut(sound, FRAME_SAMPLES, FRAME_SAMPLES)
    values = _values(frames, features)
    count = milliseconds // _FRAME
    means = [values[start : start + count].mean(axis=0) for start in range(0, len(values), count)]
    return Logged((np.arange(len(means)) + 0.5) * milliseconds / 1000, np.stack(means))


def _overlapping(sound: Float64, features: FeatureSet, milliseconds: int) -> Logged:
    step = SAMPLE_RATE * milliseconds // 1000
    window = np.hanning(_SHORT + 2)[1:-1]
    window *= np.sqrt(FRAME_SAMPLES / np.square(window).sum())
    frames = _cut(sound, _SHORT, step) * window
    frames = np.pad(frames, ((0, 0), (0, FRAME_SAMPLES - _SHORT)))
    times = (np.arange(len(frames)) * step + _SHORT / 2) / SAMPLE_RATE
    return Logged(times, _values(frames, features))


def _values(frames: Float64, features: FeatureSet) -> Float64:
    single: Float32 = frames.astype(np.float32)
    return features.extractor()(single).astype(np.float64)


def _cut(sound: Float64, length: int, step: int) -> Float64:
    count = max(-(-(len(sound) - length) // step) + 1, 1)
    padded = np.pad(sound, (0, max(length + (count - 1) * step - len(sound), 0)))
    return padded[np.arange(length) + step * np.arange(count)[:, np.newaxis]]


def sound_of(features: Logged, samples: int, rng: np.random.Generator, *, voiced: bool) -> Float64:
    """Synthesise a sound from its features.

    Parameters
    ----------
    features : Logged
        Of a set that begins with the values of `auros21`.
    samples : int
        Length of the sound.
    rng : np.random.Generator
    voiced : bool
        Whether voiced frames are made of pulses; else all is noise.

    Returns
    -------
    np.ndarray [shape=(samples,)], float64
        At 16 kHz.
    """
    count = samples // _STEP + 1
    times = np.arange(count) * _STEP / SAMPLE_RATE
    bands = bands_of(features.values[:, CEPSTRA].astype(np.float32))
    bands -= 10.0 * np.log10(mel_bank().sum(axis=0) * FRAME_SAMPLES / BINS**2)  # noise of power 1
    bands = np.stack([np.interp(times, features.times, band) for band in bands.T], axis=1)
    hertz = np.fft.rfftfreq(_WINDOW, 1 / SAMPLE_RATE).astype(np.float64)
    gains = 10 ** (np.stack([np.interp(hertz, mel_centres(), row) for row in bands]) / 20)
    share: Float64 = np.zeros((count, len(hertz)))
    if voiced:
        voice: Float64 = np.interp(times, features.times, _voicing(features.values))
        share = voice[:, np.newaxis] * _edge(_VOICED_BELOW - hertz, _VOICED_EDGE)
    window = np.sqrt(np.hanning(_WINDOW + 1)[:-1] / 2)  # squared, four of them add up to 1
    places = np.arange(_WINDOW) + _STEP * np.arange(count)[:, np.newaxis]
    noise = np.fft.rfft(rng.standard_normal(samples + 2 * _WINDOW)[places] * window)
    pulses = np.fft.rfft(_pulses(samples + 2 * _WINDOW)[places] * window)
    spectra = (np.sqrt(share) * pulses + np.sqrt(1.0 - share) * noise) * gains
    sound = np.zeros(samples + 2 * _WINDOW)
    for place, part in zip(places, np.fft.irfft(spectra) * window, strict=True):
        sound[place] += part
    return sound[_WINDOW // 2 : _WINDOW // 2 + samples]


def _pulses(samples: int) -> Float64:
    """Make the pulses of a voice, of power 1."""
    time = np.arange(samples) / SAMPLE_RATE
    pitch = _PITCH * (1.0 + _VIBRATO * np.sin(2.0 * np.pi * _VIBRATO_HERTZ * time))
    pulses = np.zeros(samples)
    pulses[np.flatnonzero(np.diff(np.floor(np.cumsum(pitch) / SAMPLE_RATE)))] = 1.0
    return pulses * np.sqrt(SAMPLE_RATE / _PITCH)


def _voicing(values: Float64) -> Float64:
    """Tell how voiced frames are, 0 to 1: by the flatness of the low bands, if it is logged."""
    if values.shape[1] > len(FEATURE_NAMES):
        return _edge(_FLATNESS - values[:, _FLAT].mean(axis=1), _FLATNESS_EDGE)
    return _edge(_ZERO_CROSSINGS - values[:, _RATE], _ZERO_CROSSINGS_EDGE)


def _edge(value: Float64, width: float) -> Float64:
    return 1.0 / (1.0 + np.exp(-value / width))
