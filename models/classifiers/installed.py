"""The kinds of classifiers that are installed."""

from hearthlog.models.classifiers.classifier_kind import ClassifierKind
from hearthlog.models.classifiers.landmarks import RBF_LANDMARKS
from hearthlog.models.classifiers.names import NAMES
from hearthlog.models.classifiers.svm_rbf import SVM_RBF
from hearthlog.models.extensions import Extensions

CLASSIFIERS = Extensions(
    "hearthlog.classifiers",
    ClassifierKind,  # type: ignore[type-abstract]
    "classifier kind",
    [RBF_LANDMARKS, SVM_RBF, NAMES],
)


def classifier_kind(name: str) -> ClassifierKind:
    """Return a kind of classifier by its name.

    Raise `ModelError` if there is none of this name, or it cannot be imported.
    """
    return CLASSIFIERS.get(name)
