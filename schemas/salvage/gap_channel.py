"""The channel for the gaps that a recovered log has where frames could not be saved."""

from mcap.records import Channel, Schema

from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.log_stream import ENCODING, SCHEMA_ENCODING
from hearthlog.schemas.logs.rosbag2 import channel_metadata
from hearthlog.schemas.mcap.definitions import Definitions
from hearthlog.schemas.messages.message_types import GAP, definition, type_hash
from hearthlog.schemas.messages.topics import Quality, topic
from hearthlog.schemas.messages.type_definitions import message_type

_LAST = 0xFFFF  # number of a schema or a channel


def gap_channel(definitions: Definitions, microphone: str) -> int | None:
    """Find the channel for the gaps of a microphone, or define it.

    Parameters
    ----------
    definitions : Definitions
        Are added to if there is none.

    Returns
    -------
    int or None
        Number of the channel; None if the topic has one for messages of another type.
    """
    name = topic(microphone, "gap")
    for number, channel in definitions.channels.items():
        if channel.topic == name:
            is_ours = definitions.defines(number) and _is_ours(definitions, channel)
            return number if is_ours else None
    number = _free(definitions.channels)
    metadata = channel_metadata(type_hash(GAP), Quality())
    definitions.add(Channel(number, name, ENCODING, metadata, _schema(definitions)))
    return number


def _is_ours(definitions: Definitions, channel: Channel) -> bool:
    schema = definitions.schemas.get(channel.schema_id)
    if schema is None or schema.name != GAP or channel.message_encoding != ENCODING:
        return False
    try:
        kind = message_type(schema.name, schema.encoding, schema.data)
    except LogError:
        return False
    return kind.types[GAP] == message_type(GAP).types[GAP]


def _schema(definitions: Definitions) -> int:
    """Return the number of the schema of gaps, which is defined if there is none."""
    data = definition(GAP).encode()
    for number, schema in definitions.schemas.items():
        if (schema.name, schema.encoding, schema.data) == (GAP, SCHEMA_ENCODING, data):
            return number
    number = _free(definitions.schemas)
    definitions.add(Schema(number, data, SCHEMA_ENCODING, GAP))
    return number


def _free(numbers: dict[int, Channel] | dict[int, Schema]) -> int:
    """Return a number that a definition further on in the file hardly has."""
    return next(number for number in range(_LAST, 0, -1) if number not in numbers)
