"""Messages as columns, and with them what their fields are."""

from collections.abc import Iterable, Iterator, Mapping
from functools import lru_cache
from typing import Any, NamedTuple

from rosbags.interfaces import Nodetype

from hearthlog.schemas.chunks import RawMessages
from hearthlog.schemas.columns import Columns, decode
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.layout import MessageType, message_type

TIME = "builtin_interfaces/msg/Time"
DURATION = "builtin_interfaces/msg/Duration"
_DEPTH_LIMIT = 32
_FIELDS_LIMIT = 10_000


class Field(NamedTuple):
    """One field, as `Columns` has it.

    Attributes
    ----------
    type : str
        Of a number, or "string", or `TIME`, or `DURATION`, or empty for a message.
    size : int or None
        Of an array: how many elements it has, 0 if that differs between messages; None for a
        field that is no array.
    elements : mapping of str to Field
        The fields of each element of an array of messages.
    """

    type: str
    size: int | None = None
    elements: Mapping[str, "Field"] = {}


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


@lru_cache(64)
def fields_of(kind: MessageType) -> dict[str, Field]:
    """List the fields of a message type by path, those of messages in it among them.

    Raises
    ------
    LogError
        If it contains itself, or is too large.
    """
    found: dict[str, Field] = {}
    for path, field in _fields(kind, kind.name, "", 0):
        found[path] = field
        if len(found) > _FIELDS_LIMIT:
            raise LogError(f"{kind.name}: has too many fields")
    return found


def _fields(kind: MessageType, name: str, prefix: str, depth: int) -> Iterator[tuple[str, Field]]:
    if depth > _DEPTH_LIMIT or name not in kind.types:
        raise LogError(f"{kind.name}: contains itself, or {name}, which is not defined")
    for field, (node, about) in kind.types[name]:
        path = f"{prefix}{field}"
        if node is Nodetype.BASE:
            yield path, Field(about[0])
        elif node is Nodetype.NAME and about in {TIME, DURATION}:
            yield path, Field(about)
        elif node is Nodetype.NAME:
            yield from _fields(kind, about, f"{path}.", depth + 1)
        else:
            (element, base), count = about
            size = count if node is Nodetype.ARRAY else 0
            if element is Nodetype.NAME:
                yield path, Field("", size, dict(_fields(kind, base, "", depth + 1)))
            else:
                yield path, Field(base[0], size)
