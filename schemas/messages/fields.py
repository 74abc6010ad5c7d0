"""Fields of message types, and their comparison with the definitions in files."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

from hearthlog.schemas.errors import LogError
from hearthlog.schemas.messages.message_types import APPENDED, PACKAGE
from hearthlog.schemas.messages.type_definitions import TEXTS, MessageType, message_type

TIME = "builtin_interfaces/msg/Time"
DURATION = "builtin_interfaces/msg/Duration"
_DEPTH_LIMIT = 32
_FIELDS_LIMIT = 10_000


class Field(NamedTuple):
    """Field of a message type, as in `Columns`."""

    type: str  # name of a number type, "string", `TIME`, `DURATION`, or empty for a message
    # number of elements of an array, 0 if it differs between messages; None for a field that is no
    # array
    size: int | None = None
    elements: Mapping[str, "Field"] = {}  # fields of each element of an array of messages


@lru_cache(256)
def fields_of(kind: MessageType) -> dict[str, Field]:
    """List all fields of a message type by path, including fields of nested messages.

    Raise `LogError` if the type contains itself, refers to an undefined type, or has too many
    fields.
    """
    return dict(_fields(kind, kind.name, "", 0, iter(range(_FIELDS_LIMIT))))


def _fields(
    kind: MessageType, name: str, prefix: str, depth: int, left: Iterator[int]
) -> Iterator[tuple[str, Field]]:
    if name not in kind.types:
        raise LogError(f"{kind.name}: builds on {name}, which is not defined")
    if depth > _DEPTH_LIMIT:
        raise LogError(f"{kind.name}: contains itself")
    for field, (node, details) in kind.read_fields(name):
        if next(left, None) is None:
            raise LogError(f"{kind.name}: has too many fields")
        path = f"{prefix}{field}"
        if node is Nodetype.BASE:
            yield path, Field(_type(details[0]))
        elif node is Nodetype.NAME and details in {TIME, DURATION}:
            yield path, Field(details)
        elif node is Nodetype.NAME:
            yield from _fields(kind, details, f"{path}.", depth + 1, left)
        else:
            (element, base), count = details
            size = count if node is Nodetype.ARRAY else 0
            if element is Nodetype.NAME:
                yield path, Field("", size, dict(_fields(kind, base, "", depth + 1, left)))
            else:
                yield path, Field(_type(base[0]), size)


def _type(base: str) -> str:
    return "string" if base in TEXTS else base


def common_fields(definitions: Sequence[Mapping[str, Field]]) -> dict[str, Field]:
    """Return the union of the fields of at least one definition, widened to fit all.

    Fields of the first definition come in its order, then additional ones of others. Raise
    `LogError` if no number type holds all values of a field, or the kinds of a field differ.
    """
    common = dict(definitions[0])
    for fields in definitions[1:]:
        for path, field in fields.items():
            common[path] = _wide(path, common[path], field) if path in common else field
    return common


def optional_fields(definitions: Sequence[Mapping[str, Field]]) -> list[str]:
    """List the paths of fields that some definitions lack, such as `points[].x` in arrays."""
    found: list[str] = []
    for path in dict.fromkeys(path for fields in definitions for path in fields):
        having = [fields[path] for fields in definitions if path in fields]
        if len(having) < len(definitions):
            found.append(path)
        else:
            within = optional_fields([field.elements for field in having])
            found += [f"{path}[].{part}" for part in within]
    return found


def _wide(path: str, one: Field, other: Field) -> Field:
    """Return a field that holds all values of two fields."""
    size = one.size if one.size == other.size else 0
    if (one.size is None) != (other.size is None) or bool(one.elements) != bool(other.elements):
        raise LogError(f"{path} is not always of the same kind")
    if one.elements:
        return Field("", size, common_fields([one.elements, other.elements]))
    if _plain(one.type) == _plain(other.type):
        return one._replace(size=size)
    if not {one.type, other.type} & {*TEXTS, "bool", TIME, DURATION}:
        types = np.dtype(_plain(one.type)), np.dtype(_plain(other.type))
        wide = np.promote_types(*types)
        if wide.kind != "f" or all(each.kind == "f" or each.itemsize < 8 for each in types):
            return Field(wide.name, size)
    raise LogError(f"{path} is {one.type} and {other.type}")


def lacking(kind: MessageType, paths: Collection[str]) -> list[str]:
    """List, sorted, the paths of fields that a file's definition lacks, or defines differently.

    Fields appended to hearthlog types do not count: they have defaults. Raise `LogError` if the
    definition contains itself, refers to an undefined type, or is too large, or ROS 2 and hearthlog
    have no type of this name.
    """
    theirs, ours = fields_of(kind), fields_of(message_type(kind.name))
    return sorted(p for p in paths if p not in theirs or not _fits(theirs[p], ours.get(p)))


@lru_cache
def missing_fields(type_: str, encoding: str, text: bytes, paths: frozenset[str]) -> str:
    """Return which fields cannot be read with a definition; empty if all can."""
    try:
        return ", ".join(lacking(message_type(type_, encoding, text), paths))
    except LogError:
        return "any field"


def _fits(theirs: Field, ours: Field | None) -> bool:
    """Return whether values of one field can be read as the other field."""
    return (
        ours is not None
        and (_plain(theirs.type), theirs.size) == (_plain(ours.type), ours.size)
        and all(
            p in theirs.elements and _fits(theirs.elements[p], ours.elements[p])
            for p in ours.elements
        )
    )


def _plain(name: str) -> str:
    """Return the canonical name of a type: ROS 2 has three names for a byte."""
    return "uint8" if name in {"byte", "char"} else name


def difference(kind: MessageType, version: int) -> str:
    """Return an error text if a file's definition differs from every released one; else empty.

    ROS 2 or hearthlog must have a type of this name. Fields appended up to `version`, the schema
    version of the file's messages, are required; more may follow, as appended by a later version.
    """
    ours = message_type(kind.name).types
    for name in _built_on(ours, kind.name):
        own, theirs = ours[name], kind.types[name]
        grows = name.startswith(f"{PACKAGE}/")
        appended = APPENDED.get(name, {})
        least = sum(f not in appended or appended[f].since <= version for f, _ in own)
        for place, (field, other) in enumerate(zip(own, theirs, strict=False)):
            if field != other:
                return f"field {place + 1} of {name} is {_words(*other)}, not {_words(*field)}"
        if len(theirs) < least:
            return f"{name} has no field {_words(*own[len(theirs)])}"
        if not grows and len(theirs) != len(own):
            return f"{name} has {len(theirs)} fields, not {len(own)}"
    return ""


def _built_on(types: Mapping[str, Any], name: str) -> dict[str, None]:
    """List a type and its nested types."""
    names = {name: None}
    for _, (node, details) in types[name]:
        element, base = (node, details) if node in {Nodetype.BASE, Nodetype.NAME} else details[0]
        if element is Nodetype.NAME and base not in names:
            names |= _built_on(types, base)
    return names


def _words(name: str, described: tuple[Nodetype, Any]) -> str:
    """Format a field as in message definitions."""
    node, details = described
    if node is Nodetype.BASE:
        return f"{_base(details)} {name}"
    if node is Nodetype.NAME:
        return f"{details.replace('/msg/', '/')} {name}"
    (element, base), count = details
    limit = "" if not count else f"{count}" if node is Nodetype.ARRAY else f"<={count}"
    return f"{_words('', (element, base)).strip()}[{limit}] {name}"


def _base(details: tuple[str, int]) -> str:
    name, limit = details
    return f"{name}<={limit}" if limit else name


def type_hash_of(kind: MessageType) -> str:
    """Return the RIHS01 hash of a type defined in a file.

    Raise `LogError` if the type contains itself, or refers to an undefined type.
    """
    store = get_typestore(Stores.EMPTY)
    store.fielddefs.update({name: ([], list(fields)) for name, fields in kind.types.items()})
    try:
        return store.hash_rihs01(kind.name)
    except (KeyError, RecursionError) as error:
        raise LogError(f"{kind.name}: contains itself, or what is not defined") from error
