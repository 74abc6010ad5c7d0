"""Calls and replies as bytes, for other processes."""

import pickle
import traceback
from collections.abc import Callable
from typing import Any

from hearthlog.analyzer.errors import WorkerError
from hearthlog.schemas.errors import HearthlogError


def pack_call(function: Callable[..., Any], args: tuple[Any, ...]) -> bytes:
    """Pickle a call."""
    return pickle.dumps((function, args))


def attempt(call: bytes) -> bytes:
    """Do a call, and pickle its result or its exception."""
    try:
        function, args = pickle.loads(call)  # noqa: S301  sent by our own parent or client
        return pickle.dumps((function(*args), None))
    except Exception as error:  # noqa: BLE001  raised again where the reply is read
        return pickle.dumps((None, _portable(error)))


def read_reply(reply: bytes) -> Any:
    """Return what the call returned, or raise what it raised.

    Raises
    ------
    Exception
        What the call raised; with its traceback as a note, unless it is an error of hearthlog.
    WorkerError
        If the call raised something that cannot be pickled.
    """
    value, error = pickle.loads(reply)  # noqa: S301  sent by our own worker
    if error is not None:
        raise error
    return value


def _portable(error: Exception) -> Exception:
    """Return the error with its traceback as a note; a WorkerError if it cannot be pickled."""
    if not isinstance(error, HearthlogError):
        error.add_note("in a worker:\n" + "".join(traceback.format_exception(error)))
    try:
        pickle.loads(pickle.dumps(error))  # noqa: S301  made here
    except Exception:  # noqa: BLE001  an error of any library, with anything in it
        return WorkerError(f"{type(error).__name__}: {error}")
    return error
