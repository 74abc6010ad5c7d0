"""The channels of a server, and what is said in them: messages as the log has them."""

from foxglove import Channel, Context, Schema
from mcap import records

from hearthlog.schemas.mcap.raw_messages import RawMessages
from hearthlog.schemas.messages.message_types import STREAM_INFO


class Publisher:
    """Publishes messages, and repeats the last description of each stream when it is asked to."""

    def __init__(self) -> None:
        self.context = Context()
        self._channels: dict[str, Channel] = {}
        self._descriptions: dict[int, tuple[bytes, int]] = {}  # by the number of the channel

    def advertise(self, channel: records.Channel, schema: records.Schema | None) -> bool:
        """Tell viewers of a topic; one whose type grew is told anew."""
        known = self._channels.get(channel.topic)
        if known is not None:
            if _is_of(known, channel, schema):
                return False
            self._descriptions.pop(known.id(), None)
            known.close()
        self._channels[channel.topic] = Channel(
            channel.topic,
            message_encoding=channel.message_encoding,
            schema=None if schema is None else _of_sdk(schema),
            metadata=dict(channel.metadata),
            context=self.context,
        )
        return True

    def publish(self, messages: RawMessages, row: int) -> None:
        """Send a message to those who subscribed to its topic."""
        self.advertise(messages.channel, messages.schema)
        channel = self._channels[messages.channel.topic]
        describes = messages.schema is not None and messages.schema.name == STREAM_INFO
        if describes or channel.has_sinks():
            payload, time = messages.payload(row), int(messages.log_times[row])
            if describes:  # first, so that who subscribes meanwhile gets it one way or the other
                self._descriptions[channel.id()] = payload, time
            channel.log(payload, log_time=time)

    def repeat(self, number: int, topic: str) -> None:
        """Send the last description of a stream again, for one who came after it."""
        last = self._descriptions.get(number)
        channel = self._channels.get(topic)
        if last is not None and channel is not None:
            channel.log(last[0], log_time=last[1])


def _is_of(known: Channel, channel: records.Channel, schema: records.Schema | None) -> bool:
    """Tell whether a channel that viewers know has messages of this type."""
    theirs = known.schema()
    same = (theirs and (theirs.name, theirs.data)) == (schema and (schema.name, schema.data))
    return same and known.message_encoding == channel.message_encoding


def _of_sdk(schema: records.Schema) -> Schema:
    return Schema(name=schema.name, encoding=schema.encoding, data=schema.data)
