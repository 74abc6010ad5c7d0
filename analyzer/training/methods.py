"""The methods that are installed."""

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.training.method import Method
from hearthlog.analyzer.training.svm_method import BANDS, PAPER
from hearthlog.models.extensions import Extensions

DEFAULT = BANDS
METHODS = Extensions("hearthlog.methods", Method, [BANDS, PAPER])  # type: ignore[type-abstract]


def method_named(name: str) -> Method:
    """Return a method by its name.

    Raises
    ------
    DataError
        If there is none of this name.
    ModelError
        If it cannot be imported.
    """
    method = METHODS.get(name)
    if method is None:
        installed = ", ".join(METHODS.names())
        raise DataError(f"method {name[:64]!r} is not installed; there is {installed}")
    return method
