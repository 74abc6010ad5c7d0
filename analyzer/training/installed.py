"""The methods that are installed."""

from importlib.util import find_spec

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.training.clip_embeddings import ClipEmbedder, network_embedder
from hearthlog.analyzer.training.landmark_method import EMBEDDING, ROOM, ROOM21
from hearthlog.analyzer.training.method import Method
from hearthlog.analyzer.training.svm_method import BANDS, PAPER, SVM, network_method
from hearthlog.models.embedding.networks import find_network
from hearthlog.models.extensions import Extensions
from hearthlog.models.features.installed import is_network

DEFAULT: Method = ROOM
_INSTALLED = [ROOM, EMBEDDING, ROOM21, BANDS, PAPER, SVM]
_METHODS = Extensions("hearthlog.methods", Method, "method", _INSTALLED, DataError)  # type: ignore[type-abstract]


def default_method() -> Method:
    """Return the method that is best with what is installed: with a network where there is one."""
    runtime = find_spec("ai_edge_litert") is not None
    return EMBEDDING if runtime and find_network(EMBEDDING.network) is not None else DEFAULT


def clip_embedder(method: Method) -> ClipEmbedder | None:
    """Return what hears the clips that a method learns from; None if it takes no embeddings.

    Parameters
    ----------
    method : Method

    Raises
    ------
    ModelError
        If its network is not known, not there, another file, or cannot be used.
    """
    return network_embedder(method.network, method.seed) if method.network else None


def method_named(name: str) -> Method:
    """Return the method of a name.

    Parameters
    ----------
    name : str
        `embedding`, `room`, `room21`, `bands`, `paper`, `svm`, the name of an entry point in the
        group `hearthlog.methods`, or that of a network that has a card.

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
