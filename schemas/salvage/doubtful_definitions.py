"""The schemas and channels of a damaged file, of which some may contradict each other."""

from mcap.records import Channel, Schema

from hearthlog.schemas.mcap.definitions import Definition, Definitions


class DoubtfulDefinitions(Definitions):
    """Schemas and channels, by number, and which numbers have more than one meaning."""

    def __init__(self) -> None:
        super().__init__()
        self._doubtful: set[tuple[type, int]] = set()

    def doubt(self, record: Definition) -> None:
        """Note that the number of a definition has another meaning, too."""
        self._doubtful.add((type(record), record.id))

    def defines(self, number: int) -> bool:
        """Tell whether it is certain what the messages of a channel are."""
        channel = self.channels.get(number)
        if channel is None or (Channel, number) in self._doubtful:
            return False
        schema = channel.schema_id
        is_defined = schema == 0 or schema in self.schemas
        return is_defined and (Schema, schema) not in self._doubtful

    def topic(self, number: int) -> str:
        """Name the topic of a channel, or the channel if that is not certain."""
        return self.channels[number].topic if self.defines(number) else f"channel {number}"
