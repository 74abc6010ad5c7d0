"""Errors of the recorder."""

from hearthlog.schemas.errors import HearthlogError


class SourceError(HearthlogError):
    """An audio file cannot be read, or a microphone cannot be opened."""


class ConfigurationError(HearthlogError):
    """The configuration is unknown, wrong or contradicts itself."""

    status = 2

    def __init__(self, *lines: str) -> None:
        super().__init__("; ".join(lines))
        self.lines = lines


class DeviceError(SourceError):
    """A microphone is not there, or cannot be opened now."""
