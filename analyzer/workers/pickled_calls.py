"""How a call travels to another process and what came of it comes back."""

import pickle
import traceback
from collections.abc import Callable
from typing import Any

from hearthlog.analyzer.errors import WorkerError
from hearthlog.schemas.errors import HearthlogError


def pack_call(function: Callable[..., Any], args: tuple[Any, ...]) -> bytes:
    """Turn a call into bytes; the function must be one that a module has at its top."""
    return pickle.dumps((function, args))


def attempt(call: bytes) -> bytes:
    """Do a call; what it returns or raises is the reply."""
    try:
        function, args = pickle.loads(call)  # noqa: S301  what our own parent or client has sent
        return pickle.dumps((function(*args), None))
    except Exception as error:  # noqa: BLE001  raised anew where the reply is read
        return pickle.dumps((None, _portable(error)))


def read_reply(reply: bytes) -> Any:
    """Return what the call returned, or raise what it raised."""
    value, error = pickle.loads(reply)  # noqa: S301  what our own worker has sent
    if error is not None:
        raise error
    return value


def _portable(error: Exception) -> Exception:
    """Return the error with its traceback as a note, or, if it cannot travel, one that can."""
    if not isinstance(error, HearthlogError):
        error.add_note("in a worker:\n" + "".join(traceback.format_exception(error)))
    try:
        pickle.loads(pickle.dumps(error))  # noqa: S301  made here
    except Exception:  # noqa: BLE001  an error of any library, with anything in it
        return WorkerError(f"{type(error).__name__}: {error}")
    return error
