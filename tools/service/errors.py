"""Errors of installing the service."""

from hearthlog.schemas.errors import HearthlogError


class ServiceError(HearthlogError):
    """The recorder cannot be made a service, as it is asked for."""
