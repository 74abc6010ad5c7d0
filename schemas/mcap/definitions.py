"""Schemas and channels of a file, by number."""

from mcap.records import Channel, Schema

Definition = Schema | Channel


class Definitions:
    """Schemas and channels, by number, wherever a file defines them.

    Attributes
    ----------
    schemas : dict of int to mcap.records.Schema
    channels : dict of int to mcap.records.Channel
    """

    def __init__(self) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}

    def add(self, record: Definition) -> bool:
        """Add a definition; return False if its number has another meaning already."""
        if isinstance(record, Schema):
            return self.schemas.setdefault(record.id, record) == record
        return self.channels.setdefault(record.id, record) == record
