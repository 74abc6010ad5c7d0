"""The feature sets that are installed."""

from hearthlog.models.extensions import Extensions
from hearthlog.models.features.auros21 import AUROS21
from hearthlog.models.features.feature_set import FeatureSet
from hearthlog.models.features.home33 import HOME33

DEFAULT = HOME33
FEATURE_SETS = Extensions("hearthlog.feature_sets", FeatureSet, "feature set", [HOME33, AUROS21])


def feature_set(name: str = DEFAULT.name) -> FeatureSet:
    """Return a feature set by its name.

    Parameters
    ----------
    name : str
        Such as "home33".

    Raises
    ------
    ModelError
        If there is none of this name, or it cannot be imported.
    """
    return FEATURE_SETS.get(name)
