"""Errors of models and their files."""

from hearthlog.schemas.errors import HearthlogError


class ModelError(HearthlogError):
    """A model file is missing, damaged, or incompatible."""
