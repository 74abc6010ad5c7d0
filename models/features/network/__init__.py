"""Feature sets of networks that the user brings: an ONNX file, and a card beside it."""

from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hearthlog.models.embedding.folders import network_folders
from hearthlog.models.features.feature_set import FeatureSet
from hearthlog.models.features.network.card import (
    INPUTS,
    NetworkCard,
    card_names,
    find_card,
    has_card,
    read_card,
)
from hearthlog.models.features.network.extractor import NetworkExtractor
from hearthlog.models.features.network.inputs import LastEmbedding
from hearthlog.schemas.arrays import Float32, Float64

__all__ = ["INPUTS", "card_names", "has_card", "network_features", "network_folders"]


def network_features(name: str) -> FeatureSet:
    """Return the feature set of a network.

    Raise `ModelError` if the card cannot be read, or says what cannot be.
    """
    return _features(read_card(find_card(name)))


@lru_cache(maxsize=8)
def _features(card: NetworkCard) -> FeatureSet:
    return FeatureSet(
        name=card.name,
        version=card.version,
        feature_names=("level", *card.names),
        units=("dBFS", *("1" for _ in card.names)),
        window_frames=card.window_frames,
        extractor=partial(NetworkExtractor, card),
        inputs={INPUTS: LastEmbedding(card.window_frames, len(card.names))},
        power=_power,
        band_powers=_band_powers,
        digest=card.sha256,
    )


def _power(features: NDArray[Any]) -> NDArray[Any]:
    power: NDArray[Any] = 10.0 ** (features[..., 0].astype(np.float64) / 10.0)
    return power


def _band_powers(features: Float32) -> Float64:
    """Return the power of the only band, and that of the frame, which is the same."""
    power: Float64 = _power(features)
    return np.stack([power, power], axis=1)
