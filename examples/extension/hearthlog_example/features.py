"""Feature set `octaves`: the level of each frame, and of seven octaves of its spectrum, in dB."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hearthlog.models.features import FeatureSet, WindowStatistics
from hearthlog.schemas.frames import FRAME_SAMPLES, SAMPLE_RATE

WINDOW_FRAMES = 24
_OCTAVES = tuple(8000 >> i for i in range(7, 0, -1))  # where they begin, in Hz: 62 to 4000
_FLOOR = 1e-10  # -100 dBFS
_LOUDEST = 1e3  # full scale is 1


class OctaveLevels:
    """The features of one stream of frames; no frame depends on another."""

    def restart(self) -> None:
        """Forget nothing."""

    def __call__(self, frames: NDArray[np.float32]) -> NDArray[np.float32]:
        """Compute the features of frames [shape=(n, FRAME_SAMPLES)]."""
        samples = np.nan_to_num(frames.astype(np.float64), posinf=0.0, neginf=0.0)
        np.clip(samples, -_LOUDEST, _LOUDEST, out=samples)
        power = np.abs(np.fft.rfft(samples, axis=1)) ** 2 * (2.0 / FRAME_SAMPLES**2)
        edges = [hertz * FRAME_SAMPLES // SAMPLE_RATE for hertz in _OCTAVES]
        octaves = np.add.reduceat(power[:, :-1], edges, axis=1)
        levels = np.column_stack([np.vecdot(samples, samples) / FRAME_SAMPLES, octaves])
        return (10.0 * np.log10(levels + _FLOOR)).astype(np.float32)


def _themselves(features: NDArray[np.float32]) -> NDArray[np.float32]:
    return features


def _power(features: NDArray[Any]) -> NDArray[Any]:
    power: NDArray[Any] = 10.0 ** (features[..., 0].astype(np.float64) / 10.0)
    return power


_NAMES = ("level", *(f"octave_{hertz}" for hertz in _OCTAVES))
OCTAVES = FeatureSet(
    name="octaves",
    version=1,
    feature_names=_NAMES,
    units=("dBFS",) * len(_NAMES),
    window_frames=WINDOW_FRAMES,
    extractor=OctaveLevels,
    inputs={"statistics": WindowStatistics(WINDOW_FRAMES, _themselves, len(_NAMES))},
    power=_power,
)
