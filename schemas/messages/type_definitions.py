"""Message types from definitions in files, and CDR layouts of their messages.

Payloads of a channel with the same string and sequence lengths have the same field offsets,
so one numpy record type describes all of them.
"""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype
from rosbags.typesys import TypesysError, get_types_from_idl, get_types_from_msg
from rosbags.typesys.msg import normalize_msgtype

from hearthlog.schemas.errors import LogError
from hearthlog.schemas.messages.message_types import (
    APPENDED,
    PACKAGE,
    definition,
    number_type,
    store_of,
)

START = 4  # offset of the first field: alignment counts from here
_ENCAPSULATION = {"<": b"\x00\x01", ">": b"\x00\x00"}  # plain CDR, by byte order
ORDERS = {value: order for order, value in _ENCAPSULATION.items()}
_FORMATS = {
    "int8": "i1", "uint8": "u1", "byte": "u1", "char": "u1", "bool": "?",
    "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8",
}  # fmt: skip
TEXTS = {"string", "wstring"}
_STAMPS = {"builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration"}
_FIELDS_LIMIT = 10_000
_DEPTH_LIMIT = 32


class Leaf(NamedTuple):
    """Field without nested messages: a number, a text, a stamp, or an array of these.

    `names` are its fields in the layout: one, or one per element of an array of texts.
    """

    path: str
    kind: Literal["number", "text", "texts", "stamp"]
    names: tuple[str, ...]


class MessageArray(NamedTuple):
    """Field that is an array of messages, with the leaves of each message."""

    path: str
    elements: tuple[tuple["AnyLeaf", ...], ...]


class Default(NamedTuple):
    """Field that is absent in the messages of a file, with the row of its default value."""

    path: str
    row: NDArray[Any]


AnyLeaf = Leaf | MessageArray | Default


class Layout(NamedTuple):
    """Field offsets of messages with given lengths of strings and sequences."""

    # type of the payload. Fields are named by their paths. The length word before a string or a
    # sequence has the name of the field and " length"
    dtype: np.dtype[np.void]
    leaves: tuple[AnyLeaf, ...]
    # values common to all payloads of this layout: byte order, lengths, ends of strings
    fixed: dict[str, Any]

    def fits(self, rows: NDArray[np.void]) -> NDArray[np.bool_]:
        """Return whether each payload [shape=(n,)] has this layout."""
        fitting = np.ones(len(rows), bool)
        for name, value in self.fixed.items():
            fitting &= rows[name] == value
        return fitting


class Growth(NamedTuple):
    """Difference between a file's definition of a hearthlog type and that of this version."""

    later: frozenset[str]  # fields appended by a later version, which are not read
    absent: Sequence[tuple[str, Any]]  # fields appended since, with defaults


_SAME = Growth(frozenset(), ())


def default_rows(name: str, fields: Sequence[tuple[str, Any]], prefix: str = "") -> list[Default]:
    """Return the default values of fields, for messages without them."""
    appended = APPENDED.get(name, {})
    return [
        leaf
        for field, (node, kind) in fields
        for leaf in _defaults(
            f"{prefix}{field}", node, kind, appended[field].default if field in appended else None
        )
    ]


def _defaults(path: str, node: Nodetype, kind: Any, value: float | str | None) -> Iterator[Default]:
    if node is Nodetype.NAME and kind not in _STAMPS:
        yield from default_rows(kind, store_of(kind).fielddefs[kind][1], f"{path}.")
        return
    row: NDArray[Any]
    if node is Nodetype.NAME:
        row = np.zeros(1, np.int64)
    elif node is Nodetype.BASE and kind[0] in TEXTS:
        row = np.array([value or ""], object)
    elif node is Nodetype.BASE:
        row = np.array([value or 0], number_type(kind[0]))
    else:
        (element, base), count = kind
        length = count if node is Nodetype.ARRAY else 0
        if element is Nodetype.NAME:
            row = np.empty(1, object)
            row[0] = []
        elif base[0] in TEXTS:
            row = np.full((1, length), "", object)
        else:
            row = np.zeros((1, length), number_type(base[0]))
    yield Default(path, row)


class TypeDefinition(NamedTuple):
    """Message type defined in a file, with the types of its fields."""

    name: str
    types: Mapping[str, Any]  # fields and descriptions by type name, as in rosbags
    growth: Mapping[str, Growth]  # by type name, for types of another version


class LayoutWalk:
    """Walk through the fields of a message that records their layout.

    `order` is the byte order, "<" or ">"; `size` is the maximum bytes of the message, `end` those
    walked through. `length_at` maps the path of a string or sequence and the byte offset of its
    length word to its length: for a string in bytes, with its end; for a wstring in UTF-16 units.
    """

    def __init__(
        self,
        definition: TypeDefinition,
        order: str,
        length_at: Callable[[str, int], int],
        size: int,
    ) -> None:
        self.end = START
        self._name, self._types, self._growth = definition
        self._order = order
        self._length_at = length_at
        self._size = size
        self._depth = 0
        self._steps = 0
        self._fields: dict[str, tuple[Any, int]] = {"encapsulation": ("V2", 0)}
        self._fixed: dict[str, Any] = {"encapsulation": np.void(_ENCAPSULATION[order])}

    def layout(self, leaves: tuple[AnyLeaf, ...], size: int) -> Layout:
        """Return the recorded layout of a payload of `size` bytes."""
        fields = {
            "names": list(self._fields),
            "formats": [form for form, _ in self._fields.values()],
            "offsets": [offset for _, offset in self._fields.values()],
            "itemsize": size,
        }
        return Layout(np.dtype(fields), leaves, self._fixed)  # type: ignore[call-overload]

    def message(self, name: str, prefix: str = "") -> tuple[AnyLeaf, ...]:
        """Walk through the fields of a message and return their leaves.

        Raise `LogError` if the type is not defined, contains itself, or has a field of an
        unsupported type; if the message ends before one of its fields, or has too many fields.
        """
        if name not in self._types:
            raise LogError(f"{self._name}: builds on {name}, which is not defined")
        self._step()
        self._depth += 1
        if self._depth > _DEPTH_LIMIT:
            raise LogError(f"{self._name}: contains itself")
        growth = self._growth.get(name, _SAME)
        leaves: list[AnyLeaf] = []
        for field, description in self._types[name]:
            walked = self._field(f"{prefix}{field}", *description)
            leaves += walked if field not in growth.later else ()
        leaves += default_rows(name, growth.absent, prefix)
        self._depth -= 1
        return tuple(leaves)

    def _field(self, path: str, node: Nodetype, kind: Any) -> tuple[AnyLeaf, ...]:
        if node is Nodetype.NAME and kind in _STAMPS:
            self._add(path, [("sec", f"{self._order}i4"), ("nanosec", f"{self._order}u4")], 4)
            return (Leaf(path, "stamp", (path,)),)
        if node is Nodetype.NAME:
            return self.message(kind, f"{path}.")
        if node is Nodetype.BASE:
            if kind[0] in TEXTS:
                self._text(path, kind[0])
                return (Leaf(path, "text", (path,)),)
            self._numbers(path, kind[0])
            return (Leaf(path, "number", (path,)),)
        (element, base), count = kind
        if node is Nodetype.SEQUENCE:
            count = self._length(path)
        return (self._array(path, element, base, count),)

    def _array(self, path: str, element: Nodetype, base: Any, count: int) -> Leaf | MessageArray:
        if element is Nodetype.NAME:
            elements = [self.message(base, f"{path}[{i}].") for i in self._range(path, count)]
            return MessageArray(path, tuple(elements))
        if base[0] in TEXTS:
            names = tuple(f"{path}[{i}]" for i in self._range(path, count))
            for name in names:
                self._text(name, base[0])
            return Leaf(path, "texts", names)
        self._numbers(path, base[0], count)
        return Leaf(path, "number", (path,))

    def _range(self, path: str, count: int) -> range:
        if count > _FIELDS_LIMIT:
            raise LogError(f"{self._name}: {count} elements in {path} are too many")
        return range(count)

    def _numbers(self, path: str, base: str, count: int | None = None) -> None:
        if base not in _FORMATS:
            raise LogError(f"{self._name}: {path} is of type {base}, which is not supported")
        form = self._order + _FORMATS[base]
        alignment = np.dtype(form).itemsize
        if count is None:
            self._add(path, form, alignment)
        elif count * alignment > self._size:
            raise LogError(f"{self._name}: a message ends before its field {path}")
        else:
            self._add(path, f"({count},){form}", alignment if count else 1)

    def _text(self, path: str, base: str) -> None:
        length = self._length(path)
        if length > self._size:
            raise LogError(f"{self._name}: a message ends before its field {path}")
        if base == "wstring":
            # As in the middlewares of ROS 2: UTF-16, four bytes per unit, no terminator.
            if length:
                self._add(path, f"({length},){self._order}u4", 4)
            return
        if length > 1:
            self._add(path, f"V{length - 1}", 1)
        if length:
            self._add(f"{path} end", "u1", 1)
            self._fixed[f"{path} end"] = 0

    def _length(self, path: str) -> int:
        name = f"{path} length"
        length = self._length_at(path, self._add(name, f"{self._order}u4", 4))
        self._fixed[name] = length
        return length

    def _add(self, name: str, form: Any, alignment: int) -> int:
        self._step()
        start = self.end + (START - self.end) % alignment
        self.end = start + np.dtype(form).itemsize
        if self.end > self._size:
            raise LogError(f"{self._name}: a message ends before its field {name}")
        self._fields[name] = form, start
        return start

    def _step(self) -> None:
        self._steps += 1
        if self._steps > _FIELDS_LIMIT:
            raise LogError(f"{self._name}: a message has too many fields")


_MESSAGE_LIMIT = 100 << 20  # bytes
_DEFINITION_LIMIT = 256 << 10  # bytes of text
_LAYOUTS_KEPT = 256
_TYPES_KEPT = 256
_ESCAPED = re.compile(r"\\(?=x[0-9a-f]{2})")  # in a name that is not UTF-8
_LINE_END = re.compile(r"\r+\n?")
# The files of a type are separated by 80 signs; some writers use fewer, more, or blanks.
_SEPARATOR = re.compile(r"^[ \t]*={3,}[ \t]*$\n?", re.MULTILINE)
_FILE_NAME = re.compile(r"^[ \t]*(MSG|IDL):[ \t]*(\S+)[ \t]*$", re.MULTILINE)
# How MCAP's registry joins the files of a type, and lines that rosbags does not parse.
_IDL_FILE = re.compile(r"^={80}\nIDL: .*$", re.MULTILINE)
_INCLUDE = re.compile(r"^[ \t]*#.*$", re.MULTILINE)
_WSTRING_BOUND = re.compile(r"(?<=wstring)<=\d+")  # unsupported by rosbags, too


class EndlessTextError(LogError):
    """Error of a string that does not end at its stated length."""

    def __init__(self, text: str, layout: Layout) -> None:
        super().__init__(text)
        self.layout = layout


class MessageType:
    """ROS 2 message type defined in a file.

    For hearthlog types, the fields of this version are read, whichever version wrote them.
    """

    def __init__(
        self, name: str, types: Mapping[str, Any], growth: Mapping[str, Growth] | None = None
    ) -> None:
        self._definition = TypeDefinition(name, types, growth or {})
        self.name, self.types, self.growth = self._definition
        self._layouts: dict[int, list[Layout]] = {}
        self._made: dict[tuple[tuple[str, int], ...], Layout] = {}

    def read_fields(self, name: str) -> list[tuple[str, Any]]:
        """List the fields that are read of this type, or of a nested type."""
        if name not in self.growth:
            return list(self.types[name])
        later, absent = self.growth[name]
        return [*(field for field in self.types[name] if field[0] not in later), *absent]

    def layouts(self, size: int) -> list[Layout]:
        """Return the latest layouts of payloads of a size in bytes, not to be changed.

        They are empty before the first call of `layout_of`.
        """
        return self._layouts.get(size, [])

    def layout_of(self, payload: memoryview, words: dict[int, bytes] | None = None) -> Layout:
        """Find the layout of a message, CDR of either byte order.

        Raise `LogError` if the payload is not plain CDR, or not of this type.
        """
        words = {} if words is None else words
        words[0] = bytes(payload[:2])
        order = ORDERS.get(words[0])
        if order is None or len(payload) < START:
            raise LogError(f"{self.name}: a message is not encoded as plain CDR")

        def length_at(path: str, offset: int) -> int:
            word = words[offset] = bytes(payload[offset : offset + 4])
            if len(word) < 4:
                raise LogError(f"{self.name}: a message ends before its field {path}")
            return int.from_bytes(word, "little" if order == "<" else "big")

        walk = LayoutWalk(self._definition, order, length_at, len(payload))
        leaves = walk.message(self.name)
        if walk.end + 3 < len(payload):  # some middleware pads to four bytes
            raise LogError(f"{self.name}: a message is longer than its type")
        layout = walk.layout(leaves, len(payload))
        if not layout.fits(np.frombuffer(payload, layout.dtype)).all():
            raise EndlessTextError(f"{self.name}: a string in a message has no end", layout)
        if sum(map(len, self._layouts.values())) >= _LAYOUTS_KEPT:
            self._layouts.clear()
        self._layouts.setdefault(len(payload), []).append(layout)
        return layout

    def layout_for(self, lengths: Mapping[str, int]) -> Layout:
        """Return the layout of a little-endian message with given string and sequence lengths.

        They are, by field path, bytes of a string, with its end, or number of elements of a
        sequence. Raise `LogError` if the type is not defined, contains itself, or has a field of an
        unsupported type, or the message would be larger than 100 MiB or have too many fields.
        """
        key = tuple(lengths.items())
        if key not in self._made:
            walk = LayoutWalk(self._definition, "<", lambda path, _: lengths[path], _MESSAGE_LIMIT)
            leaves = walk.message(self.name)
            if len(self._made) >= _LAYOUTS_KEPT:
                self._made.clear()
            self._made[key] = walk.layout(leaves, walk.end)
        return self._made[key]


@lru_cache(_TYPES_KEPT)
def message_type(name: str, encoding: str = "", text: bytes = b"") -> MessageType:
    """Parse the definition of a message type.

    `encoding` is `ros2msg` or `ros2idl`; empty for the built-in definition of ROS 2 or hearthlog.
    `text` is UTF-8; other bytes are allowed in comments only. Raise `LogError` if the encoding is
    unknown, or the text is larger than 256 KiB or cannot be parsed.
    """
    ours = {key: fields for key, (_, fields) in store_of(name).fielddefs.items()}
    theirs = {key: fields for key, (_, fields) in defined_types(name, encoding, text).items()}
    growth = {
        key: _growth(key, fields, ours[key])
        for key, fields in theirs.items()
        if key.startswith(f"{PACKAGE}/") and key in ours and fields != ours[key]
    }
    return MessageType(name if name in ours else _usual_name(name), ours | theirs, growth)


def defined_types(name: str, encoding: str, text: bytes) -> dict[str, Any]:
    """Parse a message type and its nested types to constants and fields, as in rosbags.

    They are empty for the built-in definition of ROS 2 or hearthlog. Raise `LogError` as
    `message_type`.
    """
    ours = store_of(name).fielddefs
    if name in ours and (not encoding or text == definition(name).encode()):
        return {}
    if not encoding:
        raise LogError(f"the log does not define {name}")
    if encoding not in {"ros2msg", "ros2idl"}:
        raise LogError(f"{name} is defined as {encoding!r}, not as a ROS 2 message")
    if len(text) > _DEFINITION_LIMIT:
        raise LogError(f"the definition of {name} is too long")
    name = _usual_name(name)  # the name in the parsed definition
    if not text.strip():
        if name not in ours:
            raise LogError(f"the log does not define {name}")
        return {}
    try:
        plain = _with_usual_lines(text.decode(errors="replace"))
        types = _types_from_msg(plain, name) if encoding == "ros2msg" else _types_from_idl(plain)
    except (TypesysError, RecursionError, ValueError, KeyError) as error:
        raise LogError(f"the definition of {name} cannot be read") from error
    return types


def _usual_name(name: str) -> str:
    """Return a type name in the form that rosbags parses, also for names that are not UTF-8."""
    return normalize_msgtype(_ESCAPED.sub("_", name))


def _with_usual_lines(text: str) -> str:
    """Return a definition with line ends, separators and file names that rosbags parses."""
    text = _LINE_END.sub("\n", text.removeprefix("\ufeff"))
    text = _SEPARATOR.sub(f"{'=' * 80}\n", text)
    return _FILE_NAME.sub(r"\1: \2", text)


def _types_from_msg(text: str, name: str) -> dict[str, Any]:
    """Parse a definition; restore wstrings, which rosbags takes for messages."""
    types = get_types_from_msg(_WSTRING_BOUND.sub("", text), name)
    return {
        key: (constants, [(field, _with_wstring(*described)) for field, described in fields])
        for key, (constants, fields) in types.items()
    }


def _with_wstring(node: Nodetype, details: Any) -> tuple[Nodetype, Any]:
    if node is Nodetype.NAME and details.endswith("/wstring"):
        return Nodetype.BASE, ("wstring", 0)
    if node in {Nodetype.ARRAY, Nodetype.SEQUENCE}:
        return node, (_with_wstring(*details[0]), details[1])
    return node, details


def _types_from_idl(text: str) -> dict[str, Any]:
    types: dict[str, Any] = {}
    for file in _IDL_FILE.split(text):
        if file.strip():
            types |= get_types_from_idl(_INCLUDE.sub("", file))
    return types


def _growth(name: str, theirs: Sequence[Any], ours: Sequence[Any]) -> Growth:
    """Compare a file's definition of a hearthlog type with that of this version."""
    appended = APPENDED.get(name, {})
    there = {field for field, _ in theirs}
    later = theirs[len(ours) :] if theirs[: len(ours)] == ours else []
    absent = [field for field in ours if field[0] not in there and field[0] in appended]
    return Growth(frozenset(field for field, _ in later), absent)
