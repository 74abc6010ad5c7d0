"""The messages of a log that are of types this version knows, as columns."""

from collections.abc import Collection, Iterable, Mapping
from functools import lru_cache
from pathlib import Path

from mcap.records import Channel, Schema

from hearthlog.schemas.chunks import RawMessages
from hearthlog.schemas.columns import Columns, decode
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.layout import message_type
from hearthlog.schemas.writer import ENCODING


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
        Paths of the fields that are wanted, by type.

    Raises
    ------
    LogError
        If a message is not of the type that its channel says.
    """
    found: list[Columns] = []
    try:
        for kind, fields in wanted.items():
            same = [raw for raw in batch if is_of_type(raw.channel, raw.schema, kind)]
            found += decode(same, fields)
    except LogError as error:
        raise LogError(f"{path}: {error}") from error
    return found


def is_of_type(channel: Channel, schema: Schema | None, kind: str) -> bool:
    """Tell whether a channel has messages of a type as this version knows it, or extended."""
    return (
        schema is not None
        and schema.name == kind
        and channel.message_encoding == ENCODING
        and _has_its_fields(kind, schema.encoding, schema.data)
    )


@lru_cache
def _has_its_fields(kind: str, encoding: str, text: bytes) -> bool:
    """Compare a definition from a file with ours, and all that it may build on."""
    try:
        theirs = message_type(kind, encoding, text).types
    except LogError:
        return False
    ours = message_type(kind).types
    return all(set(fields) <= set(theirs[name]) for name, fields in ours.items())
