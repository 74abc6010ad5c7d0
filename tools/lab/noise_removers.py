"""Noise removed from sound before its features are computed, as a recorder could do it.

Windows of 32 ms, 16 ms apart, get a gain for each bin of their spectrum and are added up again. The
noise is the least power of the last seconds, as in Martin, "Noise power spectral density estimation
based on optimal smoothing and minimum statistics", 2001, with a fixed smoothing.
"""

from collections import deque
from collections.abc import Callable
from functools import cache
from typing import NamedTuple, Protocol

import numpy as np
from scipy import fft
from scipy.signal import get_window

from hearthlog.schemas.arrays import Float32
from hearthlog.schemas.frames import SAMPLE_RATE

WINDOW = 512
HOP = WINDOW // 2
_HOPS_A_SECOND = SAMPLE_RATE / HOP
_SMOOTHING = 0.9  # of the power, from window to window
_SETTLING = 10  # windows, whose mean is no least power yet
_PARTS = 8  # of the memory of the least power
_CALIBRATION_SECONDS = 60
_SILENT = 1e-12  # power
_DECISION = 0.98  # weight of the last window in the ratio of signal to noise
_LEAST_GAIN = 10 ** (-15 / 20)
_SPECTRAL_FLOOR = 0.02  # of the noise, Berouti's beta


class Gain(Protocol):
    """Decides how much of each bin is kept."""

    def __call__(self, power: Float32, noise: Float32) -> Float32:
        """Return the gains of the next window, 0 to 1.

        Parameters
        ----------
        power, noise : np.ndarray [shape=(b, bins)], float32
            Of the window, and of the noise in it.
        """


class Remover(NamedTuple):
    """A way to remove noise.

    Attributes
    ----------
    gain : callable
        Makes a `Gain`.
    memory : float
        Seconds in which the power of a bin must once be that of the noise.
    """

    gain: Callable[[], Gain]
    memory: float

    def __call__(self, sounds: Float32) -> Float32:
        """Remove the noise of sounds; no sample depends on those more than 32 ms behind it.

        Parameters
        ----------
        sounds : np.ndarray [shape=(b, n)], float32
            Samples at 16 kHz of b streams.

        Returns
        -------
        np.ndarray [shape=(b, n)], float32
            At the same times.
        """
        count = -(-sounds.shape[1] // HOP) + 1
        padded = np.zeros((len(sounds), (count + 1) * HOP), np.float32)
        padded[:, HOP : HOP + sounds.shape[1]] = sounds
        window = np.sqrt(get_window("hann", WINDOW)).astype(np.float32)
        kept = np.zeros_like(padded)
        track, gain = MinimumStatistics(self.memory), self.gain()
        for start in range(0, count * HOP, HOP):
            place = slice(start, start + WINDOW)
            spectrum = fft.rfft(padded[:, place] * window)
            power = np.square(spectrum.real) + np.square(spectrum.imag)
            spectrum *= gain(power, track(power))
            kept[:, place] += fft.irfft(spectrum) * window
        return kept[:, HOP : HOP + sounds.shape[1]]


class MinimumStatistics:
    """Tracks the power of the noise in each bin.

    Parameters
    ----------
    memory : float
        In seconds.
    bias : float, optional
        By how much the mean of noise is above its least power; by default that of white noise.
    """

    def __init__(self, memory: float, bias: float | None = None) -> None:
        self._bias = np.float32(_bias(memory) if bias is None else bias)
        self._part = round(memory * _HOPS_A_SECOND / _PARTS)
        self._least: deque[Float32] = deque(maxlen=_PARTS)
        self._smooth: Float32 | None = None
        self._windows = 0

    def __call__(self, power: Float32) -> Float32:
        """Return the power of the noise after the next window.

        Parameters
        ----------
        power : np.ndarray [shape=(b, bins)], float32
        """
        before = power if self._smooth is None else self._smooth
        share = np.float32(min(_SMOOTHING, self._windows / (self._windows + 1)))
        self._smooth = share * before + (1 - share) * power
        if self._windows < _SETTLING:
            self._least = deque([self._smooth], _PARTS)
        elif self._windows % self._part == 0:
            self._least.append(self._smooth)
        else:
            self._least[-1] = np.minimum(self._least[-1], self._smooth)
        self._windows += 1
        return self._bias * np.minimum.reduce(list(self._least)) + np.float32(_SILENT)


@cache
def _bias(memory: float) -> float:
    """Measure how far the mean of white noise is above its least power."""
    rng = np.random.default_rng(0)
    track = MinimumStatistics(memory, 1.0)
    count = round((memory + _CALIBRATION_SECONDS) * _HOPS_A_SECOND)
    # Windows that overlap by half are not independent: made of one stream, as those of sound are.
    stream = rng.standard_normal((count + 1) * HOP).astype(np.float32)
    window = np.sqrt(get_window("hann", WINDOW)).astype(np.float32)
    total, tracked, late = 0.0, 0.0, round(memory * _HOPS_A_SECOND)
    for number in range(count):
        spectrum = fft.rfft(stream[number * HOP : number * HOP + WINDOW] * window)[np.newaxis, 2:-2]
        power = np.square(spectrum.real) + np.square(spectrum.imag)
        least = track(power)
        if number >= late:
            total, tracked = total + power.mean(), tracked + least.mean()
    return float(total / tracked)


class SpectralSubtraction:
    """Subtracts more than the noise where little is above it, and leaves a spectral floor.

    Berouti, Schwartz and Makhoul, "Enhancement of speech corrupted by acoustic noise", 1979.
    """

    def __call__(self, power: Float32, noise: Float32) -> Float32:
        """Return the gains of the next window."""
        ratio = power.sum(axis=1, keepdims=True) / noise.sum(axis=1, keepdims=True)
        decibels = np.clip(10.0 * np.log10(ratio + 1e-9), -5.0, 20.0)
        rest = power - (4.0 - 0.15 * decibels) * noise
        kept = np.maximum(rest, np.minimum(_SPECTRAL_FLOOR * noise, power))
        return np.sqrt(kept / (power + np.float32(_SILENT)))


class Wiener:
    """A Wiener filter, whose ratio of signal to noise follows the last window.

    Ephraim and Malah, "Speech enhancement using a minimum mean-square error short-time spectral
    amplitude estimator", 1984; Scalart and Filho, "Speech enhancement based on a priori signal to
    noise estimation", 1996.
    """

    def __init__(self) -> None:
        self._last: Float32 | None = None

    def __call__(self, power: Float32, noise: Float32) -> Float32:
        """Return the gains of the next window."""
        above = np.maximum(power / noise - 1.0, 0.0)
        ratio = above
        if self._last is not None:
            ratio = _DECISION * self._last / noise + (1.0 - _DECISION) * above
        gain = np.maximum(ratio / (1.0 + ratio), _LEAST_GAIN).astype(np.float32)
        self._last = np.square(gain) * power
        return gain
