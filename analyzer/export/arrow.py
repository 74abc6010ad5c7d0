"""Export by Arrow: Parquet and CSV."""

import json
from collections.abc import Sequence
from itertools import zip_longest
from typing import Any, BinaryIO

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray
from pyarrow import csv

from hearthlog.analyzer.export.exporter import MOST_COLUMNS, Table, table_exporter
from hearthlog.analyzer.export.text import json_texts
from hearthlog.analyzer.logs.selection import LogSelection, TypedColumns, array_names
from hearthlog.analyzer.logs.text_files import FORMULA, NUMBER
from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import Columns
from hearthlog.schemas.messages.fields import DURATION, TIME, Field

_MOMENT = pa.timestamp("ns", "UTC")
_TYPES = {
    "bool": pa.bool_(), "byte": pa.uint8(), "char": pa.uint8(), "string": pa.string(),
    "int8": pa.int8(), "uint8": pa.uint8(), "int16": pa.int16(), "uint16": pa.uint16(),
    "int32": pa.int32(), "uint32": pa.uint32(), "int64": pa.int64(), "uint64": pa.uint64(),
    "float32": pa.float32(), "float64": pa.float64(), TIME: _MOMENT, DURATION: pa.duration("ns"),
}  # fmt: skip
_BYTES = {"byte", "char", "uint8"}  # arrays of these types become binary
_HEADS = {"log_time": _MOMENT, "publish_time": _MOMENT, "sequence": pa.uint32()}


def schema_of(table: Table, selection: LogSelection) -> pa.Schema:
    """Return the Arrow schema of a table: log time, publish time, sequence, then the fields.

    The schema metadata hold the channel metadata that are equal in all logs, and the `hearthlog`
    records of the logs of `selection` as a JSON list.
    """
    first, *others = [channel.metadata for channel, _ in table.channels]
    agreed = {k: v for k, v in first.items() if all(other.get(k) == v for other in others)}
    own = {"topic": table.topic, "hearthlog": json.dumps(selection.metadata)}
    columns = _HEADS | {column_name(path): type_of(field) for path, field in table.fields.items()}
    return pa.schema(columns.items(), metadata=agreed | own)


def column_name(path: str) -> str:
    """Return the column name of a field: its path, after `message.` if a time column has it."""
    return f"message.{path}" if path in _HEADS else path


def type_of(field: Field) -> pa.DataType:
    """Return the Arrow type of a field; stamps are timestamp[ns, UTC], durations duration[ns].

    Arrays become lists; arrays of bytes, such as images, become binary.
    """
    if _is_binary(field):
        return pa.binary(field.size or -1)
    if field.type:
        element = _TYPES[field.type]
    elif field.elements:
        element = pa.struct([(path, type_of(part)) for path, part in field.elements.items()])
    else:
        element = pa.null()
    if field.size is None:
        return element
    return pa.list_(element, field.size or -1)


def _is_binary(field: Field) -> bool:
    return field.size is not None and field.type in _BYTES


def batch_of(pieces: Sequence[TypedColumns], table: Table, schema: pa.Schema) -> pa.RecordBatch:
    """Convert messages of one table, at least one piece, to a record batch in log-time order.

    The schema is from `schema_of`; fields that a piece lacks are null.
    """
    batches = [
        pa.RecordBatch.from_arrays(
            [*head_arrays(piece.columns).values(), *_arrays(piece, table)], schema=schema
        )
        for piece in pieces
    ]
    return in_order_of_time(batches)


def _arrays(piece: TypedColumns, table: Table) -> list[pa.Array]:
    """Return the field columns by name; nulls for fields missing from the messages."""
    found = piece.columns.fields
    return [
        array_of(found[path], field)
        if path in found
        else pa.nulls(len(piece.columns), type_of(field))
        for path, field in table.fields.items()
    ]


def in_order_of_time(batches: Sequence[pa.RecordBatch]) -> pa.RecordBatch:
    """Concatenate batches of one schema, sorted by log time."""
    if len(batches) == 1:
        return batches[0]
    (joined,) = pa.Table.from_batches(batches).combine_chunks().to_batches()
    times = joined["log_time"].cast(pa.int64()).to_numpy()
    return joined.take(pa.array(np.argsort(times, kind="stable")))


def head_arrays(columns: Columns) -> dict[str, pa.Array]:
    """Return log times, publish times and sequence numbers by column name."""
    return {
        "log_time": pa.array(columns.log_times).cast(_MOMENT),
        "publish_time": pa.array(columns.publish_times).cast(_MOMENT),
        "sequence": pa.array(columns.sequences),
    }


def array_of(values: NDArray[Any], field: Field) -> pa.Array:
    """Convert a message column, in the format of `Columns`, to an Arrow array.

    Times are int64 nanoseconds; arrays are one row each, or objects if their lengths differ.
    """
    kind = type_of(field)
    if not field.type:
        return pa.array([_with_bytes(value, field) for value in values.tolist()], kind)
    if field.size is not None and field.type == "string":
        return pa.array(values.tolist(), kind)
    if field.size is None:
        is_time = field.type in {TIME, DURATION}
        return pa.array(values).cast(kind) if is_time else pa.array(values, kind)
    return _array_of_arrays(values, field, kind) if len(values) else pa.array([], kind)


def _array_of_arrays(values: NDArray[Any], field: Field, kind: pa.DataType) -> pa.Array:
    """Convert a column of numeric arrays to an Arrow array."""
    if values.dtype == object:
        ends = np.cumsum([len(row) for row in values])
        flat = np.concatenate(list(values))
    else:
        ends = np.arange(1, len(values) + 1) * values.shape[1]
        flat = values.reshape(-1)
    if _is_binary(field):
        data = pa.py_buffer(np.ascontiguousarray(flat, np.uint8))
        starts = [] if field.size else [_offsets(ends).buffers()[1]]
        return pa.Array.from_buffers(kind, len(values), [None, *starts, data])
    if field.size:
        return pa.FixedSizeListArray.from_arrays(pa.array(flat, kind.value_type), type=kind)
    return pa.ListArray.from_arrays(_offsets(ends), pa.array(flat, kind.value_type))


def _offsets(ends: Int64) -> pa.Array:
    """Return the start offset of each list row, and the end of the last row."""
    return pa.array(np.concatenate([[0], ends]), pa.int32())


def _with_bytes(value: Any, field: Field) -> Any:
    """Convert byte arrays in messages to bytes, and messages without fields to nulls."""
    if isinstance(value, dict):
        parts = {path: _with_bytes(part, field.elements[path]) for path, part in value.items()}
        return parts or None
    if _is_binary(field):
        return bytes(value)
    return [_with_bytes(part, field) for part in value] if not field.type else value


_ROW_GROUP = 32 << 20  # bytes


class ParquetFile:
    """Writer of a Parquet file, one row group at a time.

    Stamps have type timestamp[ns, UTC]; the metadata come from `schema_of`.
    """

    def __init__(self, stream: BinaryIO, table: Table, selection: LogSelection) -> None:
        self._stream = stream
        self._table = table
        self._schema = schema_of(table, selection)
        self._writer: pq.ParquetWriter | None = None
        self._batches: list[pa.RecordBatch] = []
        self._size = 0

    def write(self, pieces: Sequence[TypedColumns]) -> None:
        """Append messages."""
        batch = batch_of(pieces, self._table, self._schema)
        self._batches.append(batch)
        self._size += batch.nbytes
        if self._size >= _ROW_GROUP:
            self._write_group()

    def finish(self) -> None:
        """Write the remaining rows and the index."""
        self._write_group().close()

    def _write_group(self) -> pq.ParquetWriter:
        """Write a row group; opens the writer late because there may be thousands of tables."""
        if self._writer is None:
            texts = [field.name for field in self._schema if field.type == pa.string()]
            self._writer = pq.ParquetWriter(
                self._stream, self._schema, compression="zstd", use_dictionary=texts
            )
        if self._batches:
            self._writer.write_table(pa.Table.from_batches(self._batches))
        self._batches.clear()
        self._size = 0
        return self._writer


PARQUET = table_exporter(ParquetFile)


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
