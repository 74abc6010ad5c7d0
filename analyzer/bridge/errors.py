"""Errors of the bridge."""

from hearthlog.schemas.errors import HearthlogError


class BridgeError(HearthlogError):
    """The bridge cannot do what it is configured for."""
