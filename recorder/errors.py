"""Errors of the recorder."""

from hearthlog.schemas.errors import HearthlogError


class SourceError(HearthlogError):
    """An audio file cannot be read, or a microphone cannot be opened."""


class ConfigurationError(HearthlogError):
    """The configuration is unknown, wrong or contradicts itself."""

    status = 2


class DeviceError(SourceError):
    """A microphone is not there, or cannot be opened now."""
