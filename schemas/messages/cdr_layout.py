"""Where the fields of an encoded message lie.

The payloads of a channel differ only in their numbers as long as their strings and sequences
keep their lengths, so one numpy record type describes all rows of the same lengths.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype

from hearthlog.schemas.errors import LogError
from hearthlog.schemas.messages.message_types import number_type, store_of
from hearthlog.schemas.messages.versions import APPENDED

START = 4  # of the fields: alignment counts from here
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
    """One field that holds no message: a number, a text, a stamp, or an array of them.

    `names` are the fields of the layout that make it up: one, or one each for an array of texts.
    """

    path: str
    kind: Literal["number", "text", "texts", "stamp"]
    names: tuple[str, ...]


class MessageArray(NamedTuple):
    """One field that is an array of messages, and the leaves of each of them."""

    path: str
    elements: tuple[tuple["AnyLeaf", ...], ...]


class Default(NamedTuple):
    """One field that the messages of a file do not have, and the row that stands for it."""

    path: str
    row: NDArray[Any]


AnyLeaf = Leaf | MessageArray | Default


class Layout(NamedTuple):
    """Where the fields of a message lie whose strings and sequences have certain lengths.

    Attributes
    ----------
    dtype : np.dtype
        Of the whole payload. A field has its path as its name. The word before a string or a
        sequence, which holds its length, has that name and " length".
    fixed : dict of str to int or np.void
        What every payload of this layout has in common: byte order, lengths, ends of strings.
    """

    dtype: np.dtype[np.void]
    leaves: tuple[AnyLeaf, ...]
    fixed: dict[str, Any]

    def fits(self, rows: NDArray[np.void]) -> NDArray[np.bool_]:
        """Tell which payloads have this layout.

        Parameters
        ----------
        rows : np.ndarray [shape=(n,)], of the dtype of the layout

        Returns
        -------
        np.ndarray [shape=(n,)], bool
        """
        fitting = np.ones(len(rows), bool)
        for name, value in self.fixed.items():
            fitting &= rows[name] == value
        return fitting


class Growth(NamedTuple):
    """How a file's definition of one of our types is an older or a newer one."""

    later: frozenset[str]  # fields that a later version appended, which are not read
    absent: Sequence[tuple[str, Any]]  # fields that were appended since: they have defaults


_SAME = Growth(frozenset(), ())


def default_rows(name: str, fields: Sequence[tuple[str, Any]], prefix: str = "") -> list[Default]:
    """Make the default values of fields, for messages that do not have these fields."""
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
    """A message type as a file defines it, and the types that it builds on."""

    name: str
    types: Mapping[str, Any]  # by name: fields and their descriptions, as rosbags has them
    growth: Mapping[str, Growth]  # by name, where the file has another version of the type


class LayoutWalk:
    """One way through the fields of a message, on which the layout is noted.

    Parameters
    ----------
    order : str
        Byte order, as numpy has it: "<" or ">".
    length_at : callable
        Told the path of a string or sequence and the offset of its length word in bytes; returns
        its length. That of a string is in bytes, with its end; that of a wstring in UTF-16 units.
    size : int
        Bytes of the message, at most.

    Attributes
    ----------
    end : int
        Bytes so far.
    """

    def __init__(
        self,
        definition: TypeDefinition,
        order: str,
        length_at: Callable[[str, int], int],
        size: int,
    ) -> None:
        self.end = START  # bytes so far
        self._name, self._types, self._growth = definition
        self._order = order
        self._length_at = length_at
        self._size = size
        self._depth = 0
        self._steps = 0
        self._fields: dict[str, tuple[Any, int]] = {"encapsulation": ("V2", 0)}
        self._fixed: dict[str, Any] = {"encapsulation": np.void(_ENCAPSULATION[order])}

    def layout(self, leaves: tuple[AnyLeaf, ...], size: int) -> Layout:
        """Return the layout that was noted.

        Parameters
        ----------
        size : int
            Bytes of a payload.
        """
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
        unsupported type; if the message ends before one of its fields, or has too many of them.
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
            # As the middlewares of ROS 2 have it: UTF-16, a word of four bytes a unit, no end.
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
