"""Inputs of classifiers from the features of `home33`."""

import numpy as np

from hearthlog.models.features.auros21 import inputs as auros21
from hearthlog.models.features.auros21.names import FEATURE_NAMES
from hearthlog.models.features.window_inputs import WindowStatistics
from hearthlog.schemas.arrays import Float32, Float64

_WIDTH = len(FEATURE_NAMES)
# Means over quiet stretches of household recordings.
_PEAKINESS = (4.6, 4.4, 5.1, 5.6, 5.4, 2.6)
_FLATNESS = (-2.6, -1.8, -1.6, -1.4, -1.2, -0.2)
_OF_SILENCE = np.array([*_PEAKINESS, *_FLATNESS])


def band_powers(features: Float32) -> Float64:
    """Compute the powers of the mel bands and of the frame, as those of `auros21`.

    Parameters
    ----------
    features : np.ndarray [shape=(n, 33)], float32

    Returns
    -------
    np.ndarray [shape=(n, 33)], float64
    """
    return auros21.band_powers(features[:, :_WIDTH])


def values_above_floor(features: Float32, floors: Float64 | None) -> Float64:
    """Compute the values behind the inputs `above_floor` from the features of each frame.

    Parameters
    ----------
    features : np.ndarray [shape=(n, 33)], float32
    floors : np.ndarray [shape=(n, 33)], float64
        In the order of `band_powers`.

    Returns
    -------
    np.ndarray [shape=(n, 65)], float64
        Those of `auros21`, then peakiness and flatness, which are the nearer to those of silence
        the less of the energy is above the floor.

    Raises
    ------
    TypeError
        If there are no floors.
    """
    values, share = auros21.above_floor(features[:, :_WIDTH], floors)
    shape = _OF_SILENCE + share * (features[:, _WIDTH:] - _OF_SILENCE)
    return np.concatenate([values, shape], axis=1)


INPUTS = {
    "statistics": WindowStatistics(auros21.WINDOW_FRAMES, np.asarray, _WIDTH + len(_OF_SILENCE)),
    "above_floor": WindowStatistics(
        auros21.LABEL_FRAMES,
        values_above_floor,
        auros21.VALUES + len(_OF_SILENCE),
        changes=True,
        needs_floor=True,
    ),
}
