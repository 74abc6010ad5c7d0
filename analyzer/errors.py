"""Errors of the analyzer."""

from schemas.errors import HearthlogError


class DataError(HearthlogError):
    """Labelled data cannot be learned from as it is."""
