"""Conversion of messages to Arrow record batches and Parquet files."""

import json
from collections.abc import Sequence
from typing import Any, BinaryIO

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from hearthlog.analyzer.export.exporter import Table, table_exporter
from hearthlog.analyzer.logs.selection import LogSelection, TypedColumns
from hearthlog.schemas.arrays import Int64
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
