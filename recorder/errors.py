"""Errors of the recorder."""

from hearthlog.schemas.errors import HearthlogError


class SourceError(HearthlogError):
    """An unreadable audio file, or a microphone that cannot be opened."""


class ConfigurationError(HearthlogError):
    """An unknown, invalid or contradictory configuration."""

    status = 2

    def __init__(self, *lines: str) -> None:
        super().__init__("; ".join(lines))
        self.lines = lines


class DeviceError(SourceError):
    """A missing microphone, or one that cannot be opened now."""
