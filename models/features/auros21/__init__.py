"""Feature set `auros21`: the paper's 21 values for every frame."""

from typing import Any

from numpy.typing import NDArray

from hearthlog.models.features.auros21.augmentation import augmented
from hearthlog.models.features.auros21.extractor import FeatureExtractor
from hearthlog.models.features.auros21.inputs import INPUTS, WINDOW_FRAMES, band_powers
from hearthlog.models.features.auros21.names import ENERGY, FEATURE_NAMES, UNITS
from hearthlog.models.features.feature_set import FeatureSet


def _energy(features: NDArray[Any]) -> NDArray[Any]:
    energy: NDArray[Any] = features[..., ENERGY]
    return energy


AUROS21 = FeatureSet(
    name="auros21",
    version=1,
    feature_names=FEATURE_NAMES,
    units=UNITS,
    window_frames=WINDOW_FRAMES,
    extractor=FeatureExtractor,
    inputs=INPUTS,
    power=_energy,
    band_powers=band_powers,
    augmented=augmented,
)
