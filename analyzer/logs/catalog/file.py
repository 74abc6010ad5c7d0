"""A Parquet file of a catalogue: its columns, and how it is read, wherever it may come from."""

import hashlib
from collections.abc import Mapping, Sequence
from typing import Any, BinaryIO

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

_MOMENT = pa.timestamp("ns", "UTC")
_LABELS = {"label": pa.string(), "minutes": pa.float64(), "segments": pa.int64()}
_SCENARIOS = {"scenario": pa.string(), "model": pa.string(), **_LABELS}
_ALWAYS = {
    "path": pa.string(), "home": pa.string(), "kind": pa.string(), "state": pa.string(),
    "size": pa.int64(), "mtime": _MOMENT, "frames": pa.int64(),
    "gaps": pa.int64(), "gap_seconds": pa.float64(),
    "labels": pa.list_(pa.struct(_LABELS.items())),
    "scenarios": pa.list_(pa.struct(_SCENARIOS.items())), "microphones": pa.list_(pa.string()),
}  # fmt: skip
_IF_KNOWN = {
    "error": pa.string(), "log": pa.string(), "node": pa.string(),
    "start": _MOMENT, "end": _MOMENT, "first_frame": pa.uint64(), "first_stamp": _MOMENT,
    "last_frame": pa.uint64(), "last_stamp": _MOMENT, "feature_set": pa.string(),
    "model": pa.string(), "model_sha256": pa.string(), "input_sha256": pa.string(),
    "version": pa.string(),
}  # fmt: skip
SCHEMA = pa.schema(
    [
        *(pa.field(name, kind, nullable=False) for name, kind in _ALWAYS.items()),
        *(pa.field(name, kind) for name, kind in _IF_KNOWN.items()),
    ],
    metadata={"hearthlog_catalog": "2"},  # the number stands for the columns and their meaning
)
_TEXTS = [
    *(field.name for field in SCHEMA if field.type == pa.string()),
    "labels.list.element.label",
    *(f"scenarios.list.element.{name}" for name in ("scenario", "model", "label")),
    "microphones.list.element",
]
_LEAVES = {
    *(field.name for field in SCHEMA if not pa.types.is_list(field.type)),
    *(f"labels.list.element.{name}" for name in _LABELS),
    *(f"scenarios.list.element.{name}" for name in _SCENARIOS),
    "microphones.list.element",
}
_BATCH = 1000  # rows
_DIGEST = hashlib.sha256().digest_size
_VALUE = 16  # bytes in memory
_LIMIT = 1 << 30  # bytes of a file: those of three million logs
_ROOM = 1 << 20  # bytes in memory, and
_GROWTH = 100  # for each one in the file; ours takes up to 15


def table_of(rows: Sequence[Mapping[str, Any]]) -> pa.Table:
    """Make the table of a catalogue from its rows.

    Parameters
    ----------
    rows : sequence of mapping of str to object
        Values by column of `SCHEMA`; times are int, in nanoseconds of UTC.
    """
    return pa.Table.from_pylist(rows, SCHEMA)


def without_times(table: pa.Table) -> pa.Table:
    """Replace timestamps by numbers, because Python has no times with nanoseconds.

    Returns
    -------
    pa.Table
        The same columns; times are int64, in nanoseconds of UTC.
    """
    plain = [
        column.cast(pa.int64()) if column.type == _MOMENT else column for column in table.columns
    ]
    return pa.table(plain, table.column_names)


def write_table(table: pa.Table, stream: BinaryIO) -> None:
    """Write the table of a catalogue as Parquet, with a digest."""
    buffer = pa.BufferOutputStream()
    pq.write_table(table, buffer, compression="none")
    stream.writelines(sealed(memoryview(buffer.getvalue())))


def sealed(data: memoryview) -> tuple[memoryview, bytes, memoryview]:
    """Put a digest before the footer of a Parquet file, where readers do not look.

    Parquet has no checksum of its footer, and Arrow may abort the process on a damaged one.

    Parameters
    ----------
    data : memoryview
        All bytes of a Parquet file.
    """
    footer = _footer(data)
    return data[:footer], _digest(data[:footer], data[footer:]), data[footer:]


def read_table(stream: BinaryIO) -> pa.Table:
    """Read the table of a part of a catalogue, and check it.

    Parameters
    ----------
    stream : binary file
        Is read from where it is, up to 1 GiB.

    Raises
    ------
    ValueError, pa.ArrowException
        If the file is no catalogue, of another version, damaged or compressed, if a value is
        missing, or if the table would take too much memory.
    """
    data = memoryview(stream.read(_LIMIT))
    footer = _footer(data)
    digest = data[footer - _DIGEST : footer]
    if _digest(data[: footer - _DIGEST], data[footer:]) != digest:
        raise ValueError("it is damaged, or was not made by hearthlog")
    parquet = pq.read_metadata(pa.BufferReader(data))
    leaves = {parquet.schema.column(number).path for number in range(parquet.num_columns)}
    version = parquet.schema.to_arrow_schema().metadata
    if leaves != _LEAVES or version != SCHEMA.metadata:
        raise ValueError("it is of another version of hearthlog")
    room = _ROOM + _GROWTH * len(data)
    _check_size(parquet, room)
    tables = [SCHEMA.empty_table()]
    with pq.ParquetFile(pa.BufferReader(data), metadata=parquet, read_dictionary=_TEXTS) as file:
        for batch in file.iter_batches(_BATCH):
            room -= _size(batch)
            if room < 0:
                raise ValueError("it is too large")
            always = [batch.column(name) for name in _ALWAYS]
            if any(part.null_count for part in [*always, *_parts(batch)]):
                raise ValueError("a value is missing")
            tables.append(pa.Table.from_batches([batch]).select(SCHEMA.names).cast(SCHEMA))
    return pa.concat_tables(tables)


def _footer(data: memoryview) -> int:
    """Tell where the footer of a Parquet file begins: 8 bytes at the end say how long it is."""
    return len(data) - 8 - int.from_bytes(data[-8:-4], "little")


def _digest(body: memoryview, footer: memoryview) -> bytes:
    digest = hashlib.sha256(body)
    digest.update(footer)
    return digest.digest()


def _check_size(parquet: pq.FileMetaData, room: int) -> None:
    """Raise ValueError if the file would not have room in memory."""
    for group in map(parquet.row_group, range(parquet.num_row_groups)):
        for column in map(group.column, range(group.num_columns)):
            room -= column.num_values * _VALUE
            if column.compression != "UNCOMPRESSED":
                raise ValueError("it is compressed")
    if room < 0:
        raise ValueError("it holds more than a file of its size can")


def _size(batch: pa.RecordBatch) -> int:
    """Return the bytes of rows when their texts are no longer indices of a dictionary."""
    columns = [*batch.columns, *_parts(batch)]
    texts = [column for column in columns if pa.types.is_dictionary(column.type)]
    lengths = [pc.binary_length(text.dictionary).take(text.indices) for text in texts]
    return batch.nbytes + sum(pc.sum(length, min_count=0).as_py() for length in lengths)


def _parts(batch: pa.RecordBatch) -> list[pa.Array]:
    """Return what is in the lists."""
    lists = [batch.column(name).flatten() for name in ("labels", "scenarios")]
    parts = [part for each in lists for part in (each, *each.flatten())]
    return [*parts, batch.column("microphones").flatten()]
