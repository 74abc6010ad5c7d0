"""Export of messages as text: one line each, readable or JSON."""

import json
import math
import re
from base64 import b64encode
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.logs.selection import TypedColumns
from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.frames import NANOSECONDS, seconds_text
from hearthlog.schemas.messages.fields import DURATION, TIME, Field

_SHOWN = 4  # array elements
_LENGTH = 120  # characters of a field
_NOT_FINITE = re.compile("-?inf|nan")
_MINUS_ZERO = re.compile(r"(?<![\w])-0(?![.\d])")  # many readers parse it as an integer


def in_order(
    pieces: Iterable[TypedColumns], lines: Callable[[TypedColumns], list[str]]
) -> list[str]:
    """Return one line per message, in log-time order."""
    texts: list[str] = []
    times: list[Int64] = []
    for piece in pieces:
        texts += lines(piece)
        times.append(piece.columns.log_times)
    order = np.argsort(np.concatenate(times) if times else np.empty(0), kind="stable")
    return [texts[i] for i in order.tolist()]


def json_lines(piece: TypedColumns) -> list[str]:
    """Return one JSON object per message, in the form of `mcap cat --json`.

    Times are seconds with nine decimals, bytes are base64, and non-finite values are null.
    """
    columns = piece.columns
    texts = [
        columns.sequences.tolist(),
        _seconds(columns.log_times),
        _seconds(columns.publish_times),
        *(json_texts(values, piece.fields[path]) for path, values in columns.fields.items()),
    ]
    topic = json.dumps(columns.topic).replace("%", "%%")
    head = f'{{"topic":{topic},"sequence":%d,"log_time":%s,"publish_time":%s,"data":'
    line = head + _nested(columns.fields) + "}"
    return [line % row for row in zip(*texts, strict=True)]


def text_lines(piece: TypedColumns) -> list[str]:
    """Return a short line per message: time, topic, fields.

    Times are UTC to the millisecond, durations seconds; `header.stamp` is omitted where all
    stamps equal the log times.
    """
    columns = piece.columns
    fields = dict(columns.fields)
    stamp = fields.get("header.stamp")
    if stamp is not None and np.array_equal(stamp, columns.log_times):
        del fields["header.stamp"]
    texts = [_moments(columns.log_times)]
    texts += [_short_texts(values, piece.fields[path]) for path, values in fields.items()]
    names = [path.removeprefix("header.") for path in fields]
    topic = quoted(columns.topic).replace("%", "%%")
    line = " ".join(["%s", topic, *(f"{name}=%s" for name in names)])
    return [line % row for row in zip(*texts, strict=True)]


def quoted(text: str) -> str:
    """Quote a text that is empty, has spaces or quotes, or could steer a terminal."""
    harmless = text.isprintable()
    plain = harmless and text and not set(text) & set(' "')
    return text if plain else json.dumps(text, ensure_ascii=not harmless)


def json_texts(values: NDArray[Any], field: Field) -> list[str]:
    """Return the JSON of every value of a column, in the format of `Columns`, one text per row.

    Times are seconds with nine decimals, bytes are base64, and non-finite values are null. Times of
    a column are int64 nanoseconds; arrays are one row each, or objects if their lengths differ.
    """
    if field.size is None and field.type in {TIME, DURATION}:
        return _seconds(values)
    if field.size is None and field.type == "string":
        return _each(json.dumps, values)
    if values.dtype == object or (field.size is not None and field.type == "uint8"):
        return [_json(value, field) for value in values]
    texts = _numbers(values, "%.9g" if values.dtype == np.float32 else "%r", ",")
    if values.dtype.kind == "f" and not np.isfinite(values).all():
        texts = [_NOT_FINITE.sub("null", text) for text in texts]
    if values.dtype == np.float32 and np.signbit(values[values == 0]).any():
        texts = [_MINUS_ZERO.sub("-0.0", text) for text in texts]
    return texts


def _json(value: Any, field: Field) -> str:
    """Return the JSON of one value: an array of any length, or a part of one."""
    if isinstance(value, dict):
        parts = [_json(part, field.elements[path]) for path, part in value.items()]
        return _nested(value) % tuple(parts)
    if field.size is not None:
        if field.type == "uint8":
            return f'"{b64encode(bytes(value)).decode()}"'
        element = field._replace(size=None)
        return f"[{','.join(_json(part, element) for part in value)}]"
    if field.type in {TIME, DURATION}:
        return _seconds(np.array([value]))[0]
    if isinstance(value, float | np.floating):
        return repr(float(value)) if math.isfinite(value) else "null"
    return json.dumps(value.item() if isinstance(value, np.generic) else value)


def _short_texts(values: NDArray[Any], field: Field) -> list[str]:
    """Return a short text for every value of a column."""
    if field.size is None and field.type == TIME:
        return _moments(values)
    if field.size is None and field.type == DURATION:
        return [f"{value / NANOSECONDS:.3f}s" for value in values.tolist()]
    if field.size is None and field.type == "string":
        return [_cut(text) for text in _each(quoted, values)]
    if values.dtype == object:
        return [_cut(_json(value, field)) for value in values]
    count = values.shape[1] if values.ndim == 2 else 0
    if count <= _SHOWN:
        return _numbers(values, "%.4g", " ")
    return [f"{text[:-1]} … {count}]" for text in _numbers(values[:, :_SHOWN], "%.4g", " ")]


def _cut(text: str) -> str:
    return text if len(text) <= _LENGTH else f"{text[:_LENGTH]}…"


def _each(text: Callable[[str], str], values: NDArray[Any]) -> list[str]:
    """Return a text per string, converting each distinct string once."""
    strings = values.tolist()
    made = {value: text(value) for value in set(strings)}
    return [made[value] for value in strings]


def _numbers(values: NDArray[Any], of_floats: str, separator: str) -> list[str]:
    """Return texts of numbers, or of rows of numbers."""
    if values.dtype == bool:
        values = np.where(values, "true", "false")
    each = {"f": of_floats, "U": "%s"}.get(values.dtype.kind, "%d")
    if values.ndim == 1:
        return [each % value for value in values.tolist()]
    row = f"[{separator.join([each] * values.shape[1])}]"
    return [row % tuple(value) for value in values.tolist()]


def _seconds(values: Int64) -> list[str]:
    return list(map(seconds_text, values.tolist()))


def _moments(values: Int64) -> list[str]:
    """Format times as `millisecond_text` does, in bulk."""
    texts: list[str] = np.datetime_as_string(values.astype("M8[ns]"), unit="ms").tolist()
    return [f"{text}Z" for text in texts]


def _nested(paths: Iterable[str]) -> str:
    """Return the template of a JSON object with possibly nested fields."""
    tree: dict[str, Any] = {}
    for path in paths:
        *parents, name = path.split(".")
        node = tree
        for parent in parents:
            node = node.setdefault(parent, {})
        node[name] = "%s"
    return _pattern(tree)


def _pattern(node: dict[str, Any] | str) -> str:
    if isinstance(node, str):
        return node
    inner = (f'"{name}":{_pattern(child)}' for name, child in node.items())
    return "{" + ",".join(inner) + "}"
