"""Lookup of installed feature sets."""

from hearthlog.models.embedding.networks import network_folders
from hearthlog.models.extensions import Extensions
from hearthlog.models.features import FeatureSet
from hearthlog.models.features.auros21 import AUROS21
from hearthlog.models.features.home33 import HOME33
from hearthlog.models.features.network import (
    card_names,
    has_card,
    network_features,
)
from hearthlog.schemas.errors import ModelError
from hearthlog.schemas.logs.metadata import feature_entries

DEFAULT = HOME33
BUILT_IN = (HOME33, AUROS21)
FEATURE_SETS = Extensions("hearthlog.feature_sets", FeatureSet, "feature set", BUILT_IN)


def feature_set(name: str = DEFAULT.name) -> FeatureSet:
    """Return a feature set: built in, such as "home33", of a distribution, or a network's card.

    Raise `ModelError` if there is no such feature set, it cannot be imported, or its card is
    invalid.
    """
    if is_network(name):
        return network_features(name)
    try:
        return FEATURE_SETS.get(name)
    except ModelError as error:
        if FEATURE_SETS.has(name):
            raise
        networks = ", ".join(card_names()) or "none"
        folder = network_folders()[0]
        raise ModelError(f"{error}; networks with a card in {folder}: {networks}") from error


def is_network(name: str) -> bool:
    """Return whether a name is a network's, not an installed feature set's."""
    return not FEATURE_SETS.has(name) and has_card(name)


def entries_of(features: FeatureSet) -> dict[str, str]:
    """Return the entries about the feature set in the metadata record of a log."""
    source = "" if features.digest else FEATURE_SETS.distribution(features.name)
    return feature_entries(features.name, features.version, features.digest, source)
