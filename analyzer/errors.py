"""Errors of the analyzer."""

from collections.abc import Iterator
from contextlib import contextmanager

from hearthlog.schemas.errors import HearthlogError


class DataError(HearthlogError):
    """Logs or labelled sounds cannot be used, or a result cannot be written."""


class WorkerError(HearthlogError):
    """A worker failed before finishing its task, or no worker is available."""


class LostClusterError(WorkerError):
    """The connection to the Dask cluster is lost, with all unfinished tasks."""


@contextmanager
def collect_errors(messages: list[str], *kinds: type[Exception]) -> Iterator[None]:
    """Suppress errors of some kinds, and add their messages to a list."""
    try:
        yield
    except kinds as error:
        messages.append(str(error))
