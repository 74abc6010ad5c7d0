"""The methods that are installed."""

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.training.layer_methods import LOGISTIC, PERCEPTRON
from hearthlog.analyzer.training.method import Method
from hearthlog.analyzer.training.svm_method import BANDS, PAPER, ROOM, ROOM21, network_method
from hearthlog.analyzer.training.tree_methods import BOOSTING, EXTRA_TREES, FOREST
from hearthlog.analyzer.training.vector_methods import NEIGHBOURS_VOTE, ONE_CLASS_MACHINES
from hearthlog.models.extensions import Extensions
from hearthlog.models.features.installed import is_network

DEFAULT: Method = ROOM
OTHERS: tuple[Method, ...] = (
    LOGISTIC,
    PERCEPTRON,
    NEIGHBOURS_VOTE,
    FOREST,
    EXTRA_TREES,
    BOOSTING,
    ONE_CLASS_MACHINES,
)
_INSTALLED = [ROOM, ROOM21, BANDS, PAPER, *OTHERS]
_METHODS = Extensions("hearthlog.methods", Method, "method", _INSTALLED, DataError)  # type: ignore[type-abstract]


def method_named(name: str) -> Method:
    """Return the method of a name.

    Parameters
    ----------
    name : str
        `room`, `room21`, `bands`, `paper`, one of `OTHERS`, the name of an entry point in the group
        `hearthlog.methods`, or that of a network that has a card.

    Raises
    ------
    DataError
        If there is no method of this name, or a network and a method of this name.
    ModelError
        If the entry point cannot be imported, or is no method of this name, or if the card says
        what cannot be.
    """
    if is_network(name):
        if _METHODS.has(name):
            raise DataError(f"{name} is a method, and a network: give its card another name")
        return network_method(name)
    return _METHODS.get(name)
