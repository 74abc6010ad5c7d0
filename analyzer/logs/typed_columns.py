"""The messages of a log that are of types this version knows, as columns."""

import warnings
from collections.abc import Collection, Iterable, Mapping
from functools import lru_cache
from pathlib import Path

from mcap.records import Channel, Schema

from hearthlog.schemas.errors import HearthlogWarning, LogError
from hearthlog.schemas.logs.columns import Columns, decode
from hearthlog.schemas.logs.writer import ENCODING
from hearthlog.schemas.mcap.chunks import RawMessages
from hearthlog.schemas.messages.cdr_layout import message_type
from hearthlog.schemas.messages.fields import lacking


def decode_known(
    path: Path, batch: Iterable[RawMessages], wanted: Mapping[str, Collection[str]]
) -> list[Columns]:
    """Decode the messages of some types; all others are left out.

    Parameters
    ----------
    path : Path
        The log they are from.
    batch : iterable of RawMessages
    wanted : mapping of str to collection of str
        Paths of the fields that are wanted, by type; `is_of_type` says which they may be.

    Raises
    ------
    LogError
        If a message is not of the type that its channel says.
    """
    decoded: list[Columns] = []
    try:
        for kind, fields in wanted.items():
            same = [raw for raw in batch if is_of_type(raw.channel, raw.schema, kind, fields)]
            decoded += decode(same, fields)
    except LogError as error:
        raise LogError(f"{path}: {error}") from error
    return decoded


def is_of_type(channel: Channel, schema: Schema | None, kind: str, fields: Collection[str]) -> bool:
    """Tell whether a channel has messages of a type, of which some fields can be read.

    Whatever version of a type of ours a log has, they can: there are defaults for those that were
    appended since. A definition that is none of any version gives a `HearthlogWarning`.

    Parameters
    ----------
    channel : Channel
    schema : Schema or None
    kind : str
    fields : collection of str
        Paths of the fields that the reader needs.
    """
    if schema is None or schema.name != kind or channel.message_encoding != ENCODING:
        return False
    missing = _lacking(kind, schema.encoding, schema.data, frozenset(fields))
    if missing:
        text = f"{kind} is defined without {missing} as hearthlog has it: not read"
        warnings.warn(HearthlogWarning(text, channel.topic), stacklevel=2)
    return not missing


@lru_cache
def _lacking(kind: str, encoding: str, text: bytes, fields: frozenset[str]) -> str:
    """Say which fields cannot be read; empty if all can."""
    try:
        return ", ".join(lacking(message_type(kind, encoding, text), fields))
    except LogError:
        return "any field"
