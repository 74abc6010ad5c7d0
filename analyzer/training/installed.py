"""The methods that are installed."""

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.training.method import Method
from hearthlog.analyzer.training.svm_method import BANDS, PAPER, ROOM, ROOM21
from hearthlog.models.extensions import Extensions

DEFAULT: Method = ROOM
_INSTALLED = [ROOM, ROOM21, BANDS, PAPER]
_METHODS = Extensions("hearthlog.methods", Method, "method", _INSTALLED, DataError)  # type: ignore[type-abstract]


def method_named(name: str) -> Method:
    """Return the method of a name.

    Parameters
    ----------
    name : str
        `room`, `room21`, `bands`, `paper`, or the name of an entry point in the group
        `hearthlog.methods`.

    Raises
    ------
    DataError
        If there is no method of this name.
    ModelError
        If the entry point cannot be imported, or is no method of this name.
    """
    return _METHODS.get(name)
