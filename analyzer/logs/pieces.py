"""Messages as columns, and with them what their fields are."""

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from hearthlog.schemas.logs.columns import Columns, decode
from hearthlog.schemas.mcap.chunks import RawMessages
from hearthlog.schemas.messages.cdr_layout import message_type
from hearthlog.schemas.messages.fields import Field, fields_of


class Piece(NamedTuple):
    """Messages of one topic, and their fields by path."""

    columns: Columns
    fields: Mapping[str, Field]


def pieces(batch: Iterable[RawMessages]) -> list[Piece]:
    """Decode messages, those of one topic and definition together.

    Raises
    ------
    LogError
        If they are not of the type that their channel says, or not encoded as CDR.
    """
    groups: dict[Any, list[RawMessages]] = {}
    for raw in batch:
        definition = None if raw.schema is None else (raw.schema.name, raw.schema.data)
        groups.setdefault((raw.channel.topic, definition), []).append(raw)
    found = []
    for group in groups.values():
        decoded = decode(group)
        schema = group[0].schema
        assert schema is not None  # it was decoded
        fields = fields_of(message_type(schema.name, schema.encoding, schema.data))
        found += [Piece(columns, fields) for columns in decoded]
    return found
