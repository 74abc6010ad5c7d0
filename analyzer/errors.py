"""Errors of the analyzer."""

from schemas.errors import HearthlogError


class DataError(HearthlogError):
    """Logs or labelled sounds cannot be used, or what is made of them cannot be written."""
