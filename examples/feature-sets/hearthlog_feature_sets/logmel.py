"""Feature set `logmel`: the level of each frame, and of forty mel bands of its spectrum, in dB."""

from functools import cache

import numpy as np
from numpy.typing import NDArray

from hearthlog.models.batch_invariant import rowwise_matmul
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

BANDS = 40
WINDOW_FRAMES = 20
_FLOOR = 1e-10
_LOWEST_HERTZ = 50.0


class LogMelBands:
    """The features of one stream of frames; no frame depends on another."""

    def restart(self) -> None:
        """Forget nothing."""

    def __call__(self, frames: NDArray[np.float32]) -> NDArray[np.float32]:
        """Compute the features of frames [shape=(n, FRAME_SAMPLES)]."""
        samples = sane_samples(frames)
        spectrum = np.fft.rfft(samples * np.hanning(FRAME_SAMPLES), axis=1)
        bands = rowwise_matmul(np.abs(spectrum) ** 2, _mel_bank())
        return in_half_precision(levels(samples), 10.0 * np.log10(bands + _FLOOR))


@cache
def _mel_bank() -> NDArray[np.float64]:
    """Return triangles on O'Shaughnessy's mel scale [shape=(bins, BANDS)].

    Their weights are such that the powers of all bands of white noise add up to its mean square.
    """
    hertz = np.fft.rfftfreq(FRAME_SAMPLES, 1.0 / SAMPLE_RATE)
    ends = 2595.0 * np.log10(1.0 + np.array([_LOWEST_HERTZ, SAMPLE_RATE / 2]) / 700.0)
    corners = 700.0 * (10.0 ** (np.linspace(*ends, BANDS + 2) / 2595.0) - 1.0)
    rising = (hertz[:, np.newaxis] - corners[:-2]) / np.diff(corners)[:-1]
    falling = (corners[2:] - hertz[:, np.newaxis]) / np.diff(corners)[1:]
    taper = np.square(np.hanning(FRAME_SAMPLES)).sum()
    return np.maximum(np.minimum(rising, falling), 0.0) * (2.0 / FRAME_SAMPLES / taper)


def _band_powers(features: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the powers of the bands, then that of the frame [shape=(n, BANDS + 1)]."""
    powers = 10.0 ** (features[:, [*range(1, BANDS + 1), 0]].astype(np.float64) / 10.0)
    return np.maximum(powers - _FLOOR, 0.0)


def _names() -> tuple[str, ...]:
    return (LEVEL, *(f"mel_{number}" for number in range(1, BANDS + 1)))


LOGMEL = FeatureSet(
    name="logmel",
    version=1,
    feature_names=_names(),
    units=(LEVEL_UNIT,) * (BANDS + 1),
    window_frames=WINDOW_FRAMES,
    extractor=LogMelBands,
    inputs={"statistics": WindowStatistics(WINDOW_FRAMES, themselves, BANDS + 1)},
    power=power,
    band_powers=_band_powers,
)
