"""Feature set `home33`: the paper's 21 values for every frame, and the shape of its spectrum."""

from typing import Any

from numpy.typing import NDArray

from hearthlog.models.features.auros21 import AUROS21
from hearthlog.models.features.feature_set import FeatureSet
from hearthlog.models.features.home33.extractor import SHAPE_NAMES, HomeExtractor
from hearthlog.models.features.home33.inputs import INPUTS, band_powers


def _energy(features: NDArray[Any]) -> NDArray[Any]:
    return AUROS21.power(features)


HOME33 = FeatureSet(
    name="home33",
    version=1,
    feature_names=(*AUROS21.feature_names, *SHAPE_NAMES),
    units=(*AUROS21.units, *("dB" for _ in SHAPE_NAMES)),
    window_frames=AUROS21.window_frames,
    extractor=HomeExtractor,
    inputs=INPUTS,
    power=_energy,
    band_powers=band_powers,
)
