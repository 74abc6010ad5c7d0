"""What all sets share: the level of each frame, which comes first, and values of half precision."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hearthlog.schemas.frames import FRAME_SAMPLES

LEVEL = "level"
LEVEL_UNIT = "dBFS"
_FLOOR = 1e-10  # -100 dBFS
_LOUDEST = 1e3  # full scale is 1


def sane_samples(frames: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return frames in double precision; what is not finite is 0, what is absurd is clipped."""
    samples = np.nan_to_num(frames.astype(np.float64), posinf=0.0, neginf=0.0)
    return np.clip(samples, -_LOUDEST, _LOUDEST)


def levels(samples: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the level of each frame [shape=(n, FRAME_SAMPLES)] in dBFS."""
    return 10.0 * np.log10(np.vecdot(samples, samples) / FRAME_SAMPLES + _FLOOR)


def power(features: NDArray[Any]) -> NDArray[Any]:
    """Return the mean square of the samples of each frame."""
    mean_square: NDArray[Any] = 10.0 ** (features[..., 0].astype(np.float64) / 10.0)
    return mean_square


def in_half_precision(*columns: NDArray[np.float64]) -> NDArray[np.float32]:
    """Join the values of frames, rounded to what a classifier feels: the rest does not compress."""
    return np.column_stack(columns).astype(np.float16).astype(np.float32)


def themselves(features: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the features."""
    return features
