"""Export of a topic as CSV: one column per number, named by the channel."""

from collections.abc import Sequence
from itertools import zip_longest
from typing import Any, BinaryIO

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray
from pyarrow import csv

from hearthlog.analyzer.export.arrow import (
    array_of,
    column_name,
    head_arrays,
    in_order_of_time,
    type_of,
)
from hearthlog.analyzer.export.exporter import MOST_COLUMNS, Table, table_exporter
from hearthlog.analyzer.export.text import json_texts
from hearthlog.analyzer.logs.selection import LogSelection, TypedColumns, array_names
from hearthlog.analyzer.logs.text_files import FORMULA, NUMBER
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.messages.fields import DURATION, Field

_CONTROLS = r"[\x00-\x08\x0b-\x1f\x7f-\x9f]"  # CSV allows only tabs and line ends
_IN_THEIR_PLACE = "\ufffd"


class CsvFile:
    """Writer of a CSV file.

    Arrays are spread over columns, such as `mean.energy` if the channel names the elements,
    otherwise `values[0]`; arrays of messages and very long arrays are JSON, and bytes are
    base64. Stamps are UTC, durations are seconds. Control characters become U+FFFD, and an
    apostrophe precedes texts that a spreadsheet would take for a formula.
    """

    def __init__(self, stream: BinaryIO, table: Table, selection: LogSelection) -> None:  # noqa: ARG002
        self._stream = stream
        self._table = table
        self._names: dict[str, list[str]] = {}  # element names of arrays, from any log
        self._widths: dict[str, int | None] = {}  # without names; None: as JSON
        self._schema: pa.Schema | None = None

    def write(self, pieces: Sequence[TypedColumns]) -> None:
        """Append messages; the first call fixes the number of columns of each array.

        Raise `LogError` if a value has no column, or the names do not match the elements of an
        array.
        """
        is_first = self._schema is None
        if is_first:
            self._measure_arrays(pieces)
        batches = [pa.RecordBatch.from_pydict(self._columns(piece)) for piece in pieces]
        if self._schema is None:
            self._schema = batches[0].schema
        batch = in_order_of_time(batches)
        columns = [_harmless(column) for column in batch.columns]
        text = pa.BufferOutputStream()
        csv.write_csv(
            pa.RecordBatch.from_arrays(columns, schema=self._schema),
            text,
            csv.WriteOptions(include_header=is_first, quoting_style="needed"),
        )
        self._stream.write(text.getvalue())

    def finish(self) -> None:
        """Do nothing: the file is complete after each write."""

    def _measure_arrays(self, pieces: Sequence[TypedColumns]) -> None:
        """Choose the columns of each array."""
        for path, field in self._table.fields.items():
            if field.size is None or field.elements or field.type == "uint8":
                continue
            names = (array_names(channel.metadata, path) for channel, _ in self._table.channels)
            self._names[path] = list(dict.fromkeys(name for each in names for name in each))
            arrays = [
                piece.columns[path]
                for piece in pieces
                if path in piece.fields and not array_names(piece.columns.metadata, path)
            ]
            widths = [
                array.shape[1] if array.ndim == 2 else max(map(len, array), default=0)
                for array in arrays
            ]
            width = max(widths, default=0)
            is_unknown = not arrays and not self._names[path]  # only later messages have this field
            self._widths[path] = None if is_unknown or width > MOST_COLUMNS else width

    def _columns(self, piece: TypedColumns) -> dict[str, pa.Array]:
        columns = piece.columns
        arrays = head_arrays(columns)
        for path, field in self._table.fields.items():
            name, values = column_name(path), columns.fields.get(path)
            if path in self._widths:
                arrays |= self._spread(piece, path, field)
            elif field.elements or field.size is not None:
                arrays[name] = _json_column(piece, path)
            elif values is None:
                kind = pa.float64() if field.type == DURATION else type_of(field)
                arrays[name] = pa.nulls(len(columns), kind)
            elif field.type == DURATION:
                arrays[name] = pa.array(values / NANOSECONDS)
            else:
                arrays[name] = array_of(values, field)
        return arrays

    def _spread(self, piece: TypedColumns, path: str, field: Field) -> dict[str, pa.Array]:
        """Return a column per array element, including elements that only other logs have."""
        width, own = self._widths[path], array_names(piece.columns.metadata, path)
        missing = pa.nulls(len(piece.columns), type_of(field._replace(size=None)))
        columns = {f"{path}.{name}": missing for name in self._names[path]}
        if width is None:
            texts = pa.nulls(len(piece.columns), pa.string()) if own else _json_column(piece, path)
            columns[column_name(path)] = texts
            if not own:
                return columns
        columns |= {f"{path}[{i}]": missing for i in range(width or 0)}
        if path not in piece.fields:
            return columns
        elements = _elements(piece.columns[path], field)
        if own and len(own) != len(elements):
            raise LogError(f"{piece.columns.topic}: {len(elements)} {path}, but {len(own)} names")
        names = [f"{path}.{name}" for name in own] or [f"{path}[{i}]" for i in range(len(elements))]
        if not columns.keys() >= set(names):
            raise LogError(
                f"{piece.columns.topic}: {names[width or 0]} is not in all messages, which CSV has "
                "no column for; choose ndjson or parquet"
            )
        return columns | dict(zip(names, elements, strict=True))


def _json_column(piece: TypedColumns, path: str) -> pa.Array:
    if path not in piece.fields:
        return pa.nulls(len(piece.columns), pa.string())
    return pa.array(json_texts(piece.columns[path], piece.fields[path]), pa.string())


def _harmless(column: pa.Array) -> pa.Array:
    """Replace control characters, which would steer a terminal, and disarm formulas."""
    if not pa.types.is_string(column.type):
        return column
    column = pc.replace_substring_regex(column, _CONTROLS, _IN_THEIR_PLACE)
    is_formula = pc.match_substring_regex(column, FORMULA)
    if not pc.any(is_formula).as_py():
        return column
    is_formula = pc.and_not(is_formula, pc.match_substring_regex(column, NUMBER))
    return pc.if_else(is_formula, pc.binary_join_element_wise("'", column, ""), column)


def _elements(values: NDArray[Any], field: Field) -> list[pa.Array]:
    """Return a column per element of an array field."""
    element = field._replace(size=None)
    if values.ndim == 2:
        return [array_of(column, element) for column in np.ascontiguousarray(values.T)]
    rows = [list(row) for row in values]
    columns = zip_longest(*rows)  # None where a row is shorter
    return [pa.array(column, type_of(element)) for column in columns]


CSV = table_exporter(CsvFile)
