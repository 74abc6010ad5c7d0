"""Feature set `sai`: the stabilised auditory image of each frame, by its two profiles.

After Patterson, Allerhand and Giguère, "Time-domain modeling of peripheral auditory processing",
1995, as Janvier et al., "Sound-event recognition with a companion humanoid", 2012, use it for the
sounds of a house. A bank of gammatone filters is rectified and compressed; in each channel the
highest peaks are strobes, and what follows them is laid over one another. The mean over strobes is
the image, of 24 channels and 35 ms. Its profiles are the means along either side.
"""

from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from hearthlog.models.features import FeatureSet, WindowStatistics
from hearthlog.schemas.frames import FRAME_SAMPLES, SAMPLE_RATE
from hearthlog_feature_sets.frame_level import (
    LEVEL,
    LEVEL_UNIT,
    in_half_precision,
    levels,
    power,
    sane_samples,
    themselves,
)

Float64 = NDArray[np.float64]

CHANNELS = 24
DELAYS = 16
WINDOW_FRAMES = 20
WIDTH = 1 + CHANNELS + DELAYS
_LOWEST_HERTZ, _HIGHEST_HERTZ = 80.0, 7000.0
_ORDER = 4
_REACH = 560  # samples, 35 ms, that are laid over one another
_STROBE_EVERY = 160  # samples, 10 ms, of which the highest is a strobe
_STROBES = FRAME_SAMPLES // _STROBE_EVERY
_COMPRESSION = 0.5
_TINY = 1e-5  # of an image of full scale
_FRAMES_AT_ONCE = 32


class AuditoryImages:
    """The features of one stream of frames.

    The state is that of the filters, and the last 35 ms: the strobes of a frame are those whose
    35 ms end in it.
    """

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Forget the past: the next frame does not follow the last one."""
        self._states = np.zeros((CHANNELS, _ORDER), np.complex128)
        self._recent: Float64 = np.zeros((CHANNELS, _REACH))

    def __call__(self, frames: NDArray[np.float32]) -> NDArray[np.float32]:
        """Compute the features of frames [shape=(n, FRAME_SAMPLES)]."""
        values = np.empty((len(frames), WIDTH), np.float32)
        for start in range(0, len(frames), _FRAMES_AT_ONCE):
            block = slice(start, start + _FRAMES_AT_ONCE)
            samples = sane_samples(frames[block])
            pattern = np.concatenate([self._recent, self._activity(samples.ravel())], axis=1)
            self._recent = pattern[:, -_REACH:].copy()
            values[block] = in_half_precision(levels(samples), *profiles(stabilised(pattern)))
        return values

    def _activity(self, samples: Float64) -> Float64:
        """Return what the nerves of each channel tell [shape=(CHANNELS, n)]."""
        activity = np.empty((CHANNELS, len(samples)))
        for channel, (gain, filter_) in enumerate(_gammatone_bank()):
            heard, self._states[channel] = lfilter(gain, filter_, samples, zi=self._states[channel])
            activity[channel] = np.maximum(heard.real, 0.0) ** _COMPRESSION
        return activity


def stabilised(pattern: Float64) -> Float64:
    """Lay what follows the strobes of each frame over one another.

    Parameters
    ----------
    pattern : np.ndarray [shape=(CHANNELS, 560 + 800 n)], float64
        Activity of successive samples.

    Returns
    -------
    np.ndarray [shape=(n, CHANNELS, 560)], float64
        By the delay after the strobe: the means over the five strobes of a frame.
    """
    candidates = pattern[:, :-_REACH].reshape(CHANNELS, -1, _STROBE_EVERY)
    places = candidates.argmax(axis=2) + _STROBE_EVERY * np.arange(candidates.shape[1])
    following = np.lib.stride_tricks.sliding_window_view(pattern, _REACH, axis=1)
    channels = np.arange(CHANNELS)[:, np.newaxis]
    image = np.zeros((CHANNELS, candidates.shape[1] // _STROBES, _REACH))
    for strobe in range(_STROBES):
        image += following[channels, places[:, strobe::_STROBES]]
    return image.swapaxes(0, 1) / _STROBES


def profiles(images: Float64) -> tuple[Float64, Float64]:
    """Reduce images to their two profiles.

    Parameters
    ----------
    images : np.ndarray [shape=(n, CHANNELS, 560)], float64

    Returns
    -------
    spectral : np.ndarray [shape=(n, CHANNELS)], float64
        Mean of each channel, in dB.
    temporal : np.ndarray [shape=(n, DELAYS)], float64
        Mean of all channels at delays that grow by about a half, in dB above the mean of all.
    """
    edges = _delay_edges()
    by_delay = np.add.reduceat(images, edges[:-1], axis=2)
    channels = np.einsum("ijk->ij", by_delay) / _REACH
    delays = np.einsum("ijk->ik", by_delay) / (CHANNELS * np.diff(edges))
    mean = np.einsum("ij->i", channels) / CHANNELS
    spectral = 20.0 * np.log10(channels + _TINY)
    return spectral, 20.0 * np.log10((delays + _TINY) / (mean + _TINY)[:, np.newaxis])


@cache
def _delay_edges() -> NDArray[np.intp]:
    edges = np.unique(np.geomspace(4, _REACH, DELAYS).round().astype(np.intp))
    return np.concatenate([[0], edges])


@cache
def _gammatone_bank() -> list[tuple[Float64, NDArray[np.complex128]]]:
    """Return the gain and the filter of each channel: four complex poles in one place.

    Centres are evenly spaced in equivalent rectangular bandwidths (Glasberg and Moore, 1990).
    """
    ends = 21.4 * np.log10(1.0 + 0.00437 * np.array([_LOWEST_HERTZ, _HIGHEST_HERTZ]))
    centres = (10.0 ** (np.linspace(*ends, CHANNELS) / 21.4) - 1.0) / 0.00437
    bandwidths = 1.019 * 24.7 * (1.0 + 0.00437 * centres)
    poles = np.exp(2.0 * np.pi / SAMPLE_RATE * (1j * centres - bandwidths))
    gains = 2.0 * (1.0 - np.abs(poles)) ** _ORDER  # a sine at the centre keeps its amplitude
    return [(np.array([g]), np.poly([p] * _ORDER)) for g, p in zip(gains, poles, strict=True)]


SAI = FeatureSet(
    name="sai",
    version=1,
    feature_names=(
        LEVEL,
        *(f"channel_{number}" for number in range(1, CHANNELS + 1)),
        *(f"delay_{number}" for number in range(1, DELAYS + 1)),
    ),
    units=(LEVEL_UNIT, *("dB" for _ in range(CHANNELS + DELAYS))),
    window_frames=WINDOW_FRAMES,
    extractor=AuditoryImages,
    inputs={"statistics": WindowStatistics(WINDOW_FRAMES, themselves, WIDTH)},
    power=power,
)
