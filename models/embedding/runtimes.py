"""The runtimes of networks: which one a file is for, and whether it is installed."""

from collections.abc import Callable
from importlib.util import find_spec

from hearthlog.models.embedding.onnx_session import OnnxSession
from hearthlog.models.embedding.session import Session, TfliteSession
from hearthlog.models.errors import ModelError

_TYPES: dict[str, Callable[[bytes, int, int, int], Session]] = {
    ".tflite": TfliteSession,
    ".onnx": OnnxSession,
}
_MODULES = {".tflite": ("ai_edge_litert",), ".onnx": ("onnx", "onnxruntime")}


def session_type(suffix: str) -> Callable[[bytes, int, int, int], Session]:
    """Return what makes a session of a file's bytes, window, width and number of names.

    Raise `ModelError` if there is no runtime for it.
    """
    if suffix not in _TYPES:
        raise ModelError(f"is no network that can be used: it ends in none of {', '.join(_TYPES)}")
    return _TYPES[suffix]


def missing_modules(suffix: str) -> list[str]:
    """Return the modules for files of a suffix that are not installed, without importing any."""
    return [module for module in _MODULES.get(suffix, ()) if find_spec(module) is None]
