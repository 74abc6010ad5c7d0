"""Feature set `plp`: the level of each frame, and its cepstra by perceptual linear prediction."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hearthlog.models.features import FeatureSet, WindowStatistics
from hearthlog_feature_sets.frame_level import (
    LEVEL,
    LEVEL_UNIT,
    in_half_precision,
    levels,
    power,
    sane_samples,
    themselves,
)
from hearthlog_feature_sets.prediction import CEPSTRA, cepstra_of, critical_bands

WINDOW_FRAMES = 20
WIDTH = 1 + CEPSTRA


class PerceptualCepstra:
    """The features of one stream of frames; no frame depends on another."""

    def restart(self) -> None:
        """Forget nothing."""

    def __call__(self, frames: NDArray[np.float32]) -> NDArray[np.float32]:
        """Compute the features of frames [shape=(n, FRAME_SAMPLES)]."""
        samples = sane_samples(frames)
        return in_half_precision(levels(samples), cepstra_of(critical_bands(samples)))


def cepstral_set(name: str, extractor: Any) -> FeatureSet:
    """Make a feature set of the level and perceptual cepstra."""
    return FeatureSet(
        name=name,
        version=1,
        feature_names=(LEVEL, *(f"{name}_{number}" for number in range(CEPSTRA))),
        units=(LEVEL_UNIT, *("Np" for _ in range(CEPSTRA))),
        window_frames=WINDOW_FRAMES,
        extractor=extractor,
        inputs={"statistics": WindowStatistics(WINDOW_FRAMES, themselves, WIDTH)},
        power=power,
    )


PLP = cepstral_set("plp", PerceptualCepstra)
