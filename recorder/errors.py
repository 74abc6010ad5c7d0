"""Errors of the recorder."""

from hearthlog.schemas.errors import HearthlogError


class SourceError(HearthlogError):
    """An audio file or a microphone cannot be heard."""


class ConfigurationError(HearthlogError):
    """What the recorder was asked to do makes no sense."""
