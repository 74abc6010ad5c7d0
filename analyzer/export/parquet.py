"""A topic as a Parquet file: a column a field, arrays as lists."""

from collections.abc import Sequence
from typing import BinaryIO

import pyarrow as pa
import pyarrow.parquet as pq

from hearthlog.analyzer.export.arrow import batch_of, schema_of
from hearthlog.analyzer.export.exporter import Table, table_exporter
from hearthlog.analyzer.logs.selection import LogSelection, TypedColumns

_ROW_GROUP = 32 << 20  # bytes


class ParquetFile:
    """A Parquet file being written, row group by row group.

    Stamps are of type timestamp[ns, UTC]; the metadata are those of `schema_of`.
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
        """Write what is left, and the index."""
        self._write_group().close()

    def _write_group(self) -> pq.ParquetWriter:
        """Write a row group; the writer is made late, for there may be thousands of tables."""
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


EXPORTER = table_exporter(ParquetFile)
