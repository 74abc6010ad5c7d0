"""Message types as files define them, and how their messages are laid out."""

import re
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import TypesysError, get_types_from_idl, get_types_from_msg
from rosbags.typesys.msg import normalize_msgtype

from hearthlog.schemas.errors import LogError
from hearthlog.schemas.messages.cdr_layout import (
    ORDERS,
    START,
    Growth,
    Layout,
    LayoutWalk,
    TypeDefinition,
)
from hearthlog.schemas.messages.message_types import PACKAGE, definition, store_of
from hearthlog.schemas.messages.versions import APPENDED

_MESSAGE_LIMIT = 100 << 20  # bytes
_DEFINITION_LIMIT = 256 << 10  # bytes of text
_LAYOUTS_KEPT = 256
_TYPES_KEPT = 256
_ESCAPED = re.compile(r"\\(?=x[0-9a-f]{2})")  # in a name that is not UTF-8
_LINE_END = re.compile(r"\r+\n?")
# Between the files of a type stand 80 signs; some writers have fewer or more, or blanks there.
_SEPARATOR = re.compile(r"^[ \t]*={3,}[ \t]*$\n?", re.MULTILINE)
_FILE_NAME = re.compile(r"^[ \t]*(MSG|IDL):[ \t]*(\S+)[ \t]*$", re.MULTILINE)
# How MCAP's registry joins the files of a type, and lines of them that rosbags does not read.
_IDL_FILE = re.compile(r"^={80}\nIDL: .*$", re.MULTILINE)
_INCLUDE = re.compile(r"^[ \t]*#.*$", re.MULTILINE)
_WSTRING_BOUND = re.compile(r"(?<=wstring)<=\d+")  # which rosbags does not read either


class EndlessTextError(LogError):
    """A string in a message does not end where its length says."""

    def __init__(self, text: str, layout: Layout) -> None:
        super().__init__(text)
        self.layout = layout


class MessageType:
    """A ROS 2 message type as a file defines it.

    Of our own types, the fields of this version are read, whichever version wrote them.
    """

    def __init__(
        self, name: str, types: Mapping[str, Any], growth: Mapping[str, Growth] | None = None
    ) -> None:
        self._definition = TypeDefinition(name, types, growth or {})
        self.name, self.types, self.growth = self._definition
        self._layouts: dict[int, list[Layout]] = {}
        self._made: dict[tuple[tuple[str, int], ...], Layout] = {}

    def read_fields(self, name: str) -> list[tuple[str, Any]]:
        """List the fields that are read of this type, or of one that it builds on."""
        if name not in self.growth:
            return list(self.types[name])
        later, absent = self.growth[name]
        return [*(field for field in self.types[name] if field[0] not in later), *absent]

    def layouts(self, size: int) -> list[Layout]:
        """Return the layouts that were found last for payloads of one size.

        Parameters
        ----------
        size : int
            Bytes of a payload.

        Returns
        -------
        list of Layout
            Empty before `layout_of` has found one. The caller must not change it.
        """
        return self._layouts.get(size, [])

    def layout_of(self, payload: memoryview, words: dict[int, bytes] | None = None) -> Layout:
        """Find the layout of an encoded message.

        Parameters
        ----------
        payload : memoryview
            CDR of either byte order.

        Raises
        ------
        LogError
            If the payload is not plain CDR, or not of this type.
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
        """Lay out a little-endian message with strings and sequences of given lengths.

        Parameters
        ----------
        lengths : mapping of str to int
            By field path: bytes of a string, with its end, and number of elements of a sequence.

        Raises
        ------
        LogError
            If the type is not defined, contains itself, or has a field of an unsupported type, or
            if the message would be larger than 100 MiB or have too many fields.
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
    """Read the definition of a message type.

    Parameters
    ----------
    encoding : str
        `ros2msg` or `ros2idl`; empty for the definition of ROS 2 or hearthlog.
    text : bytes
        The definition in that encoding, in UTF-8; what is not may only be in comments.

    Raises
    ------
    LogError
        If the encoding is another one, or the text is larger than 256 KiB or cannot be understood.
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
    """Read a message type, and those that it builds on, as a file defines them.

    Returns
    -------
    dict of str to (list, list)
        Constants and fields by ROS 2 name, as rosbags has them; empty for the definition of ROS 2
        or hearthlog.

    Raises
    ------
    LogError
        As `message_type`.
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
    name = _usual_name(name)  # which is how its definition is named
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
    """Write the name of a type as rosbags reads it, also one that is not UTF-8."""
    return normalize_msgtype(_ESCAPED.sub("_", name))


def _with_usual_lines(text: str) -> str:
    """Write ends of lines, separators and names of files as rosbags reads them."""
    text = _LINE_END.sub("\n", text.removeprefix("\ufeff"))
    text = _SEPARATOR.sub(f"{'=' * 80}\n", text)
    return _FILE_NAME.sub(r"\1: \2", text)


def _types_from_msg(text: str, name: str) -> dict[str, Any]:
    """Read a definition; a wstring, which rosbags takes for a message, is a wstring."""
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
    """Compare a definition of one of our types with that of this version."""
    appended = APPENDED.get(name, {})
    there = {field for field, _ in theirs}
    later = theirs[len(ours) :] if theirs[: len(ours)] == ours else []
    absent = [field for field in ours if field[0] not in there and field[0] in appended]
    return Growth(frozenset(field for field, _ in later), absent)
