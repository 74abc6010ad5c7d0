"""Errors of the analyzer."""

from hearthlog.schemas.errors import HearthlogError


class DataError(HearthlogError):
    """Logs or labelled sounds cannot be used, or what is made of them cannot be written."""


class WorkerError(HearthlogError):
    """A task was not done, through no fault of its own, or there is nothing to run it."""


class LostClusterError(WorkerError):
    """The Dask cluster is gone, with all tasks that were not done."""
