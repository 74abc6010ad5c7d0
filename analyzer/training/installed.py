"""The methods that are installed."""

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.training.method import Method
from hearthlog.analyzer.training.svm_method import BANDS, PAPER
from hearthlog.models.extensions import Extensions

DEFAULT = BANDS
_METHODS = Extensions("hearthlog.methods", Method, "method", [BANDS, PAPER], DataError)  # type: ignore[type-abstract]


def method_named(name: str) -> Method:
    """Return a method by its name.

    Raises
    ------
    DataError
        If there is none of this name.
    ModelError
        If it cannot be imported.
    """
    return _METHODS.get(name)
