"""Embeddings of one stream of frames, after subtraction of the room's steady noise."""

from functools import cache

import numpy as np

from hearthlog.models.embedding import (
    HOP_FRAMES,
    NO_EMBEDDINGS,
    WINDOW_FRAMES,
    Embeddings,
)
from hearthlog.models.embedding.networks import Embedder
from hearthlog.schemas.arrays import Bool, Float32, Float64, Int64
from hearthlog.schemas.frames import FRAME_SAMPLES

LEFT_DBFS = -75.0  # level of the noise behind the clips that heads are trained on
_FRAME, _HOP = 1600, 800  # samples: the noise of long frames is the least audible
_LEAST_GAIN = 0.01
_MOST_WINDOWS = 10  # windows in the running mean: five seconds


class SteadyNoise:
    """Estimates the steady noise of one stream of windows, and subtracts it from other windows.

    The mean power of the noise is subtracted from each bin, as in Boll, "Suppression of acoustic
    noise in speech using spectral subtraction" (1979), down to the noise level of the heads'
    training data: the noise falls by 7 dB. Stronger subtraction removed more of the cues that the
    network uses. The noise is the sound while nothing is above the floor of the room.
    """

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Reset the state."""
        self._power: Float64 | None = None  # power of each bin
        self._windows = 0

    def learn(self, window: Float32) -> None:
        """Add a window [shape=(n, FRAME_SAMPLES)] of only the room, of at least two frames."""
        frames = np.lib.stride_tricks.sliding_window_view(window.reshape(-1), _FRAME)[::_HOP]
        power = np.square(np.abs(np.fft.rfft(frames * _taper(), axis=1))).mean(axis=0)
        self._windows = min(self._windows + 1, _MOST_WINDOWS)
        if self._power is None:
            self._power = power
        self._power = self._power + (power - self._power) / self._windows

    def reduced(self, window: Float32) -> Float32:
        """Return a window [shape=(n, FRAME_SAMPLES)] without its noise, unless negligible."""
        if self._power is None:
            return window
        left = 10.0 ** (LEFT_DBFS / 10.0) * np.square(_taper()).sum()
        least = np.clip(np.sqrt(left / np.maximum(self._power, left * 1e-9)), _LEAST_GAIN, 1.0)
        if least.min() >= 1.0:
            return window
        samples = np.pad(window.reshape(-1).astype(np.float64), _HOP)
        frames = np.lib.stride_tricks.sliding_window_view(samples, _FRAME)[::_HOP]
        spectrum = np.fft.rfft(frames * _taper(), axis=1)
        power = _smoothed(np.square(np.abs(spectrum)))
        share = 1.0 - self._power / np.maximum(power, left * 1e-9)
        spectrum *= np.maximum(np.sqrt(np.maximum(share, 0.0)), least)
        parts = np.fft.irfft(spectrum, _FRAME, axis=1) * _taper()
        halves = parts.reshape(len(parts), 2, _HOP)
        total = halves[1:, 0] + halves[:-1, 1]
        return total.astype(np.float32).reshape(window.shape)


@cache
def _taper() -> Float64:
    """Return the square root of a Hann window: squares of two that overlap by half sum to 1."""
    taper: Float64 = np.sin(np.pi * (np.arange(_FRAME) + 0.5) / _FRAME)
    return taper


def _smoothed(power: Float64) -> Float64:
    """Average over three frames and three bins: single noise bins are far above the mean."""
    padded = np.pad(power, 1, mode="edge")
    rows = 0.25 * padded[:-2] + 0.5 * padded[1:-1] + 0.25 * padded[2:]
    smooth: Float64 = 0.25 * rows[:, :-2] + 0.5 * rows[:, 1:-1] + 0.25 * rows[:, 2:]
    return smooth


_SOUND_FROM = 4  # frame of a window; earlier sound is more than half a second from the middle


class EmbeddingStream:
    """Embeds the windows of one stream of frames that contain sound.

    Windows begin at frames whose number is a multiple of ten. A window is embedded if there is
    sound within half a second of its middle; the noise of windows without sound is subtracted
    first.
    """

    def __init__(self, embedder: Embedder) -> None:
        self._embedder = embedder
        self._noise = SteadyNoise()
        self.restart()

    def restart(self) -> None:
        """Reset the state; the next frame does not follow the previous frame."""
        self._noise.restart()
        self._frames = np.empty((0, FRAME_SAMPLES), np.float32)
        self._sound = np.empty(0, bool)
        self._stamps = np.empty(0, np.int64)

    def push(self, frames: Float32, sound: Bool, first: int, stamps: Int64) -> Embeddings:
        """Add successive frames [shape=(n, FRAME_SAMPLES)].

        `sound` [shape=(n,)]: whether the sound that ends with each frame, at most 0.4 s, is above
        the room floor. `stamps` [shape=(n,)] are the starts of the frames in nanoseconds of UTC.
        """
        samples = np.clip(np.nan_to_num(frames, posinf=0.0, neginf=0.0), -1.0, 1.0)
        samples = np.concatenate([self._frames, samples])
        sound = np.concatenate([self._sound, sound])
        stamps = np.concatenate([self._stamps, stamps])
        first -= len(self._frames)
        begins = np.arange(-first % HOP_FRAMES, len(samples) - WINDOW_FRAMES + 1, HOP_FRAMES)
        chosen, values = [], []
        for begin in begins.tolist():
            window, above = samples[begin : begin + WINDOW_FRAMES], sound[begin:][:WINDOW_FRAMES]
            if above[_SOUND_FROM:].any():
                chosen.append(begin)
                values.append(self._embedder(self._noise.reduced(window)))
            elif not above.any():
                self._noise.learn(window)
        self._frames = samples[1 - WINDOW_FRAMES :].copy()
        self._sound, self._stamps = sound[1 - WINDOW_FRAMES :], stamps[1 - WINDOW_FRAMES :]
        if not chosen:
            return NO_EMBEDDINGS
        places = np.array(chosen, np.int64)
        return Embeddings(first + places, stamps[places], np.stack(values))
