"""Encode many messages of one type at once.

The payloads of a channel differ only in their numbers as long as their strings and sequences
keep their lengths, so one numpy record type describes them all.
"""

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype

from schemas.messages import typestore

_ENCAPSULATION = b"\x00\x01\x00\x00"  # CDR, little-endian
_START = len(_ENCAPSULATION)
_DTYPES = {
    "int8": "i1", "uint8": "u1", "byte": "u1", "bool": "?",
    "int16": "<i2", "uint16": "<u2", "int32": "<i4", "uint32": "<u4",
    "int64": "<i8", "uint64": "<u8", "float32": "<f4", "float64": "<f8",
}  # fmt: skip

Column = NDArray[Any] | Sequence[str] | str


def encode_rows(typename: str, columns: Mapping[str, Column], count: int) -> list[bytes]:
    """Encode `count` messages, each field given as one column.

    Parameters
    ----------
    typename : str
    columns : mapping from field path, such as "header.stamp.sec", to its values
        An array of shape (count,) for a number, of shape (count, k) for a sequence of numbers;
        for a string, one string for all messages or a sequence of `count` strings.
    count : int

    Returns
    -------
    list of bytes
        Equal to what the typestore gives for each message.
    """
    constant = {k: v.encode() for k, v in columns.items() if isinstance(v, str)}
    numbers = {k: v for k, v in columns.items() if isinstance(v, np.ndarray)}
    texts = {
        k: [text.encode() for text in v]
        for k, v in columns.items()
        if k not in constant and not isinstance(v, np.ndarray)
    }
    rows: list[bytes] = [b""] * count
    for chosen, same in _groups(texts, count):
        strings = constant | same
        lengths = {k: len(v) for k, v in strings.items()}
        lengths |= {k: v.shape[1] for k, v in numbers.items() if v.ndim > 1}
        dtype = _dtype(typename, tuple(sorted(lengths.items())))
        block = np.zeros(len(chosen), dtype)
        block["encapsulation"] = np.void(_ENCAPSULATION)
        for path, text in strings.items():
            block[path] = text
            block[f"{path} length"] = len(text) + 1
        for path, values in numbers.items():
            block[path] = values[chosen]
            if values.ndim > 1:
                block[f"{path} length"] = values.shape[1]
        raw, size = block.tobytes(), dtype.itemsize
        for position, row in enumerate(chosen):
            rows[row] = raw[position * size : (position + 1) * size]
    return rows


def _groups(
    texts: Mapping[str, list[bytes]], count: int
) -> list[tuple[NDArray[np.intp], dict[str, bytes]]]:
    """Group the rows whose strings are the same."""
    if not texts:
        return [(np.arange(count), {})]
    found: dict[tuple[bytes, ...], list[int]] = {}
    for row, values in enumerate(zip(*texts.values(), strict=True)):
        found.setdefault(values, []).append(row)
    return [
        (np.array(rows), dict(zip(texts, values, strict=True))) for values, rows in found.items()
    ]


@cache
def _dtype(typename: str, lengths: tuple[tuple[str, int], ...]) -> np.dtype[np.void]:
    """Lay out a message whose strings and sequences have the given lengths."""
    known = dict(lengths)
    names, formats, offsets = ["encapsulation"], [f"V{_START}"], [0]
    end = _START

    def add(name: str, form: str, alignment: int) -> None:
        nonlocal end
        start = end + (_START - end) % alignment
        names.append(name)
        formats.append(form)
        offsets.append(start)
        end = start + np.dtype(form).itemsize

    def walk(name: str, prefix: str) -> None:
        for field, (node, kind) in typestore().fielddefs[name][1]:
            path = f"{prefix}{field}"
            if node is Nodetype.NAME:
                walk(str(kind), f"{path}.")
            elif node is Nodetype.BASE and kind[0] == "string":
                add(f"{path} length", "<u4", 4)
                add(path, f"S{known[path] + 1}", 1)
            elif node is Nodetype.BASE:
                form = _DTYPES[str(kind[0])]
                add(path, form, np.dtype(form).itemsize)
            else:
                form = _DTYPES[str(kind[0][1][0])]
                add(f"{path} length", "<u4", 4)
                add(path, f"({known[path]},){form}", np.dtype(form).itemsize)

    walk(typename, "")
    layout = {"names": names, "formats": formats, "offsets": offsets, "itemsize": end}
    return np.dtype(layout)  # type: ignore[call-overload]
