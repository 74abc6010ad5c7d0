"""Schemas and channels of a file, by number."""

from mcap.records import Channel, Schema

Definition = Schema | Channel


class Definitions:
    """Schemas and channels by number, wherever a file defines them.

    Notes which numbers have contradictory definitions.
    """

    def __init__(self) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self._doubtful: set[tuple[type, int]] = set()

    def add(self, record: Definition) -> bool:
        """Add a definition, unless its number is taken."""
        if isinstance(record, Schema):
            return self.schemas.setdefault(record.id, record) == record
        return self.channels.setdefault(record.id, record) == record

    def doubt(self, record: Definition) -> None:
        """Note that a definition contradicts another one of its number."""
        self._doubtful.add((type(record), record.id))

    def defines(self, number: int) -> bool:
        """Tell whether it is certain what the messages of a channel are.

        Returns
        -------
        bool
            Whether the channel and its schema, if it has one, are defined without contradiction.
        """
        channel = self.channels.get(number)
        if channel is None or (Channel, number) in self._doubtful:
            return False
        schema = channel.schema_id
        is_defined = schema == 0 or schema in self.schemas
        return is_defined and (Schema, schema) not in self._doubtful

    def topic(self, number: int) -> str:
        """Name the topic of a channel."""
        return self.channels[number].topic if self.defines(number) else f"channel {number}"
