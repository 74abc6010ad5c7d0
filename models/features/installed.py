"""The feature sets that are installed."""

from hearthlog.models.errors import ModelError
from hearthlog.models.extensions import Extensions
from hearthlog.models.features.auros21 import AUROS21
from hearthlog.models.features.feature_set import FeatureSet

DEFAULT = AUROS21
FEATURE_SETS = Extensions("hearthlog.feature_sets", FeatureSet, [AUROS21])


def feature_set(name: str = DEFAULT.name) -> FeatureSet:
    """Return a feature set by its name; raises ModelError if it cannot be used."""
    features = FEATURE_SETS.get(name)
    if features is None:
        installed = ", ".join(FEATURE_SETS.names())
        raise ModelError(f"feature set {name[:64]!r} is not installed; there is {installed}")
    return features
