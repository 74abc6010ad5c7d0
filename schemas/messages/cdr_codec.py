"""Batch conversion between arrays and CDR payloads of one message type."""

from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from hearthlog.schemas.arrays import Bytes, Indices, Int64, gather
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.messages.message_types import APPENDED
from hearthlog.schemas.messages.type_definitions import (
    AnyLeaf,
    Default,
    EndlessTextError,
    Layout,
    Leaf,
    MessageArray,
    MessageType,
    default_rows,
    message_type,
)

Column = NDArray[Any] | Sequence[str] | str
Fields = dict[str, NDArray[Any]]
UndecodableText = Literal["strict", "replace"]
_LAST_UNIT = 0xFFFF  # of UTF-16
_TRIED = 64  # number of layouts tried before rows are inspected one by one


def encode_groups(
    typename: str, columns: Mapping[str, Column], count: int
) -> Iterator[tuple[Indices, NDArray[np.void]]]:
    """Encode messages; yield indices [shape=(m,)] and payloads of those with equal string lengths.

    `columns` maps field paths, such as "header.frame_id", to arrays of shape (count,) for a number,
    or a stamp in nanoseconds; (count, k) for an array of numbers, and (count, 0) for an array of
    messages, which must be empty; for a string, one value for all messages or a sequence of
    `count`. Fields appended to the type are optional. Payloads have a structured dtype, and are
    identical to those of the typestore. Raise `LogError` if the type is unknown, an array of
    messages in it is not empty, or a message would be larger than 100 MiB.
    """
    kind = message_type(typename)
    arrays: dict[str, NDArray[Any]] = {}
    texts: dict[str, _Texts] = {}
    for path, values in _completed(typename, columns, count).items():
        if isinstance(values, np.ndarray) and values.dtype != object:
            arrays[path] = values
        else:
            texts[path] = _Texts(values, count)
    widths = {k: v.shape[1] for k, v in arrays.items() if v.ndim > 1}
    for rows in _same_lengths(texts.values(), count):
        lengths = {k: text.length(rows[0]) for k, text in texts.items()}
        layout = kind.layout_for(lengths | widths)
        block = np.zeros(len(rows), layout.dtype)
        for name, value in layout.fixed.items():
            block[name] = value
        for leaf in layout.leaves:
            _fill(block, leaf, arrays, texts, rows)
        yield rows, block


def encode_rows(typename: str, columns: Mapping[str, Column], count: int) -> list[bytes]:
    """Encode each message to `bytes`; raise `LogError` as `encode_groups` does."""
    payloads: list[bytes] = [b""] * count
    for rows, block in encode_groups(typename, columns, count):
        raw, size = block.tobytes(), block.dtype.itemsize
        for position, row in enumerate(rows.tolist()):
            payloads[row] = raw[position * size : (position + 1) * size]
    return payloads


def _completed(typename: str, columns: Mapping[str, Column], count: int) -> Mapping[str, Column]:
    """Add the defaults of missing fields that were appended to a type."""
    appended = APPENDED.get(typename)
    if not appended:
        return columns
    fields = [field for field in message_type(typename).types[typename] if field[0] in appended]
    defaults: dict[str, Column] = {}
    for path, row in default_rows(typename, fields):
        is_empty = row.dtype == object and not isinstance(row[0], str)
        defaults[path] = np.empty((count, 0)) if is_empty else np.repeat(row, count, axis=0)
    return defaults | dict(columns)


def _fill(
    block: NDArray[np.void],
    leaf: AnyLeaf,
    arrays: Mapping[str, NDArray[Any]],
    texts: Mapping[str, "_Texts"],
    rows: Indices,
) -> None:
    if leaf.path in arrays and arrays[leaf.path].shape[1:] == (0,):
        return
    if not isinstance(leaf, Leaf) or leaf.kind == "texts":
        raise LogError(f"{leaf.path}: arrays of texts or messages are encoded one by one")
    if leaf.kind == "text":
        if block.dtype.fields and leaf.path in block.dtype.fields:
            block[leaf.path] = texts[leaf.path].encoded(rows)
        return
    values = arrays[leaf.path]
    values = values if len(rows) == len(values) else values[rows]
    if leaf.kind == "stamp":
        block[leaf.path]["sec"] = values // NANOSECONDS
        block[leaf.path]["nanosec"] = values % NANOSECONDS
    else:
        block[leaf.path] = values


class _Texts:
    """Column of strings: distinct values, encoded, and the code of each row."""

    def __init__(self, values: Column, count: int) -> None:
        if isinstance(values, str):
            values = [values] * min(count, 1)
        numbers = {text: number for number, text in enumerate(dict.fromkeys(values))}
        self._values = [text.encode() for text in numbers]
        self._codes: Indices | None = None  # None if all are equal
        self.lengths: Indices | None = None
        if len(numbers) > 1:
            self._codes = np.fromiter(map(numbers.__getitem__, values), np.intp, count)
            self.lengths = np.array([len(value) for value in self._values])[self._codes]

    def length(self, row: np.intp) -> int:
        """Return the byte length of the string of a row, including its end."""
        return len(self._values[0 if self._codes is None else self._codes[row]]) + 1

    def encoded(self, rows: Indices) -> NDArray[np.void] | np.void:
        """Return the strings of some rows of equal length."""
        if self._codes is None:
            return np.void(self._values[0])
        codes = self._codes[rows]
        size = len(self._values[codes[0]])
        # Strings of other lengths are unused, but keep the indices valid.
        return np.array([value[:size] for value in self._values], f"V{size}")[codes]


def _same_lengths(texts: Collection[_Texts], count: int) -> list[Indices]:
    """Group the rows by string lengths."""
    varying = [text.lengths for text in texts if text.lengths is not None]
    if not varying:
        return [np.arange(count)] if count else []
    group = np.zeros(count, np.intp)
    for lengths in varying:
        _, group = np.unique(group * (lengths.max() + 1) + lengths, return_inverse=True)
    order = np.argsort(group, kind="stable")
    return np.split(order, np.cumsum(np.bincount(group))[:-1])


def decode_rows(  # noqa: PLR0913
    kind: MessageType,
    buffer: Bytes,
    offsets: Int64,
    sizes: Int64,
    fields: Collection[str] | None = None,
    *,
    undecodable: UndecodableText = "strict",
) -> Fields:
    """Decode messages of one type into one column [shape=(n, ...)] per field, as in `Columns`.

    `offsets` and `sizes` [shape=(n,)] are those of the payloads in `buffer` [shape=(b,)], in bytes.
    Strings that are not UTF-8 raise an error if `undecodable` is "strict"; "replace" puts U+FFFD in
    place of invalid bytes. Arrays of any length have no elements if n is 0. Raise `LogError` if a
    payload does not match the type, or a string in it is not UTF-8.
    """
    parts = [
        (rows, _decode(layout.leaves, block, fields, undecodable))
        for layout, rows, block in rows_by_layout(kind, buffer, offsets, sizes)
    ]
    if not parts:
        layout = kind.layout_for(defaultdict(int))
        return _decode(layout.leaves, np.empty(0, layout.dtype), fields, undecodable)
    return _scattered(parts, len(sizes))


def unreadable_rows(
    kind: MessageType, buffer: Bytes, offsets: Int64, sizes: Int64
) -> dict[int, LogError]:
    """Return the errors of messages that do not match their type."""
    errors: dict[int, LogError] = {}
    for _ in rows_by_layout(kind, buffer, offsets, sizes, errors):
        pass
    return errors


def rows_by_layout(
    kind: MessageType,
    buffer: Bytes,
    offsets: Int64,
    sizes: Int64,
    errors: dict[int, LogError] | None = None,
) -> Iterator[tuple[Layout, Indices, NDArray[np.void]]]:
    """Group messages by layout; yield it, their indices [shape=(m,)] and copies of the messages.

    `offsets` and `sizes` [shape=(n,)] are those of the payloads in `buffer` [shape=(b,)], in bytes.
    `errors` receives the error of each message that does not match the type, by row, and the
    message is skipped; without it, raise the first error, a `LogError`.
    """
    for size, rows in _by_size(sizes):
        payloads = gather(buffer, offsets[rows], size)
        wrong: dict[int, LogError] | None = None if errors is None else {}
        for layout, same in _by_layout(kind, payloads, wrong):
            block = (payloads if len(same) == len(payloads) else payloads[same]).view(layout.dtype)
            yield layout, rows[same], block
        if errors is not None and wrong:
            errors |= {int(rows[row]): error for row, error in wrong.items()}


def _by_size(sizes: Int64) -> list[tuple[int, Indices]]:
    if len(sizes) and (sizes == sizes[0]).all():  # the most frequent case, and faster
        return [(int(sizes[0]), np.arange(len(sizes)))]
    # np.unique is not faster, and imports a megabyte of masked arrays.
    return [(size, np.flatnonzero(sizes == size)) for size in sorted(set(sizes.tolist()))]


def _by_layout(
    kind: MessageType, payloads: NDArray[np.void], errors: dict[int, LogError] | None
) -> Iterator[tuple[Layout, Indices]]:
    """Group payloads of one size by layout, without invalid ones."""
    rest = np.arange(len(payloads))
    for layout in kind.layouts(payloads.dtype.itemsize)[:_TRIED]:
        left = payloads if len(rest) == len(payloads) else payloads[rest]
        fitting = layout.fits(left.view(layout.dtype))
        if fitting.all():
            yield layout, rest
            return
        if fitting.any():
            yield layout, rest[fitting]
            rest = rest[~fitting]
    for _ in range(_TRIED):
        words: dict[int, bytes] = {}
        found = _layout_of(kind, payloads, int(rest[0]), errors, words)
        if found is None:
            assert errors is not None
            error = errors[int(rest[0])]
            alike = _alike(payloads[rest], words, error)
            errors.update(dict.fromkeys(rest[alike].tolist(), error))
            rest = rest[~alike]
        else:
            fitting = found.fits(payloads[rest].view(found.dtype))
            yield found, rest[fitting]
            rest = rest[~fitting]
        if not len(rest):
            return
    rows_of: dict[tuple[Any, ...], tuple[Layout, list[int]]] = {}
    for row in rest.tolist():  # too many layouts to try each on all rows
        if (found := _layout_of(kind, payloads, row, errors, {})) is not None:
            rows_of.setdefault(tuple(found.fixed.items()), (found, []))[1].append(row)
    yield from ((layout, np.array(same)) for layout, same in rows_of.values())


def _alike(
    payloads: NDArray[np.void], words: Mapping[int, bytes], error: LogError
) -> NDArray[np.bool_]:
    """Find the payloads with the same fault as the first one, by the bytes that cause it."""
    alike = np.ones(len(payloads), bool)
    raw = payloads.view(np.uint8).reshape(len(payloads), payloads.dtype.itemsize)
    for place, word in words.items():
        alike &= (raw[:, place : place + len(word)] == np.frombuffer(word, np.uint8)).all(axis=1)
    if isinstance(error, EndlessTextError):
        alike &= ~error.layout.fits(payloads.view(error.layout.dtype))
    return alike


def _layout_of(
    kind: MessageType,
    payloads: NDArray[np.void],
    row: int,
    errors: dict[int, LogError] | None,
    words: dict[int, bytes],
) -> Layout | None:
    """Find the layout of one payload; None, and a new error, if there is none."""
    try:
        return kind.layout_of(memoryview(payloads[row].tobytes()), words)
    except LogError as error:
        if errors is None:
            raise
        errors[row] = error
        return None


def _decode(
    leaves: Sequence[AnyLeaf],
    block: NDArray[np.void],
    fields: Collection[str] | None,
    undecodable: UndecodableText,
) -> Fields:
    return {
        leaf.path: _values(leaf, block, undecodable)
        for leaf in leaves
        if fields is None or leaf.path in fields
    }


def _values(leaf: AnyLeaf, block: NDArray[np.void], undecodable: UndecodableText) -> NDArray[Any]:
    if isinstance(leaf, Default):
        return np.repeat(leaf.row, len(block), axis=0)
    if isinstance(leaf, MessageArray):
        return _messages(leaf, block, undecodable)
    if leaf.kind == "texts":
        rows = [_texts(block, name, undecodable) for name in leaf.names]
        return np.stack(rows, axis=1) if rows else np.empty((len(block), 0), object)
    if leaf.kind == "text":
        return _texts(block, leaf.path, undecodable)
    values = block[leaf.path]
    if leaf.kind == "stamp":
        return values["sec"].astype(np.int64) * NANOSECONDS + values["nanosec"]
    return np.ascontiguousarray(values, values.dtype.newbyteorder("="))


def _texts(block: NDArray[np.void], name: str, undecodable: UndecodableText) -> NDArray[np.object_]:
    """Decode strings of one length; equal ones become one object."""
    assert block.dtype.names is not None
    texts = np.empty(len(block), object)
    if name not in block.dtype.names:
        texts.fill("")
        return texts
    raw, encoding = np.ascontiguousarray(block[name]), "utf-8"
    if raw.dtype.kind == "u":  # wstring
        raw, encoding = _utf16(raw, name, undecodable), "utf-16-le"
    if (raw == raw[:1]).all():
        texts.fill(_text(raw[0], name, encoding, undecodable))
        return texts
    distinct, which = np.unique(raw, return_inverse=True)
    decoded = [_text(value, name, encoding, undecodable) for value in distinct]
    return np.array(decoded, object)[which]


def _utf16(units: NDArray[Any], name: str, undecodable: UndecodableText) -> NDArray[np.void]:
    """Convert rows of four-byte words with one unit each to UTF-16."""
    wrong = units > _LAST_UNIT
    if wrong.any():
        if undecodable == "strict":
            raise LogError(f"{name}: a wstring is not UTF-16 in words of four bytes")
        units = np.where(wrong, ord("\ufffd"), units)
    return np.ascontiguousarray(units, "<u2").view(f"V{2 * units.shape[1]}")[:, 0]


def _text(value: np.void, name: str, encoding: str, undecodable: UndecodableText) -> str:
    try:
        return value.tobytes().decode(encoding, undecodable)
    except UnicodeDecodeError as error:
        raise LogError(f"{name}: a string is not {error.encoding.upper()}") from error


def _messages(
    array: MessageArray, block: NDArray[np.void], undecodable: UndecodableText
) -> NDArray[np.object_]:
    """Convert an array of messages to one list of dicts per row."""
    elements = []
    for leaves in array.elements:
        columns = {
            leaf.path.rpartition("].")[2]: _values(leaf, block, undecodable) for leaf in leaves
        }
        lists = [column.tolist() for column in columns.values()]
        elements.append([dict(zip(columns, row, strict=True)) for row in zip(*lists, strict=True)])
    rows = zip(*elements, strict=True) if elements else iter([()] * len(block))
    return np.fromiter(map(list, rows), object, len(block))


def _scattered(parts: Sequence[tuple[Indices, Fields]], count: int) -> Fields:
    """Merge separately decoded rows in their original order."""
    if len(parts) == 1:
        return parts[0][1]
    columns_by_path: Fields = {}
    for path in parts[0][1]:
        columns = [(rows, fields[path]) for rows, fields in parts]
        like = columns[0][1]
        if all(c.dtype == like.dtype and c.shape[1:] == like.shape[1:] for _, c in columns):
            values = np.empty((count, *like.shape[1:]), like.dtype)
        else:
            values = np.empty(count, object)
            columns = [(rows, ragged(column)) for rows, column in columns]
        for rows, column in columns:
            values[rows] = column
        columns_by_path[path] = values
    return columns_by_path


def ragged(column: NDArray[Any]) -> NDArray[np.object_]:
    """Convert each row of an array [shape=(n, ...)] to a separate object [shape=(n,)]."""
    return np.fromiter(column, object, len(column))
