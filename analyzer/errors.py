"""Errors of the analyzer."""

from hearthlog.schemas.errors import HearthlogError


class DataError(HearthlogError):
    """Logs or labelled sounds cannot be used, or a result cannot be written."""


class WorkerError(HearthlogError):
    """A worker failed before finishing its task, or no worker is available."""


class LostClusterError(WorkerError):
    """The connection to the Dask cluster is lost, with all unfinished tasks."""
