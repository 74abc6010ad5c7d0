"""Messages as columns, of the types that a reader asks for or with what their fields are."""

import warnings
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from mcap.records import Channel, Schema

from hearthlog.schemas.errors import HearthlogWarning, LogError
from hearthlog.schemas.logs.columns import Columns, decode, decode_readable
from hearthlog.schemas.logs.writer import ENCODING
from hearthlog.schemas.mcap.raw_messages import RawMessages
from hearthlog.schemas.messages.fields import Field, fields_of, missing_fields
from hearthlog.schemas.messages.type_definitions import message_type


class TypedColumns(NamedTuple):
    """Messages of one topic, and their fields by path."""

    columns: Columns
    fields: Mapping[str, Field]


def decode_types(
    path: Path, batch: Iterable[RawMessages], types: Mapping[str, Collection[str]]
) -> list[Columns]:
    """Decode the messages of some types, and leave out all others.

    Parameters
    ----------
    types : mapping of str to collection of str
        Paths of the fields to decode, by name of the type; `is_compatible` says which fields a
        type may have.

    Raises
    ------
    LogError
        If a message is not of the type that its channel says.
    """
    decoded: list[Columns] = []
    try:
        for type_, fields in types.items():
            same = [raw for raw in batch if is_compatible(raw.channel, raw.schema, type_, fields)]
            decoded += decode(same, fields)
    except LogError as error:
        raise LogError(f"{path}: {error}") from error
    return decoded


def decode_all(batch: Iterable[RawMessages]) -> list[TypedColumns]:
    """Decode messages of any type with all of their fields.

    Parameters
    ----------
    batch : iterable of RawMessages
        Messages, still encoded.

    Returns
    -------
    list of TypedColumns
        Messages of one topic and definition are together. What cannot be decoded is left out, with
        a `HearthlogWarning`, as `decode_readable` does.
    """
    groups: dict[Any, list[RawMessages]] = {}
    for raw in batch:
        definition = None if raw.schema is None else (raw.schema.name, raw.schema.data)
        groups.setdefault((raw.channel.topic, definition), []).append(raw)
    decoded: list[TypedColumns] = []
    for group in groups.values():
        schema = group[0].schema
        if parts := decode_readable(group):
            assert schema is not None  # it was decoded
            fields = fields_of(message_type(schema.name, schema.encoding, schema.data))
            decoded += [TypedColumns(columns, fields) for columns in parts]
    return decoded


def is_compatible(
    channel: Channel, schema: Schema | None, type_: str, fields: Collection[str]
) -> bool:
    """Tell whether a channel has messages of a type, from which some fields can be read.

    Any version of a type of ours can be read: fields that were appended later have defaults. If a
    definition is of no version of the type, a `HearthlogWarning` says so.

    Parameters
    ----------
    schema : Schema or None
        Of the channel; None if it has none.

    Returns
    -------
    bool
        False also if the channel is of another type, or not encoded as CDR.
    """
    if schema is None or schema.name != type_ or channel.message_encoding != ENCODING:
        return False
    missing = missing_fields(type_, schema.encoding, schema.data, frozenset(fields))
    if missing:
        text = f"{type_} is defined without {missing} as hearthlog has it: not read"
        warnings.warn(HearthlogWarning(text, channel.topic), stacklevel=2)
    return not missing
