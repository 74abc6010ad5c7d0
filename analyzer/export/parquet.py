"""A topic as a Parquet file: a column a field, arrays as lists."""

from typing import BinaryIO

import pyarrow as pa
import pyarrow.parquet as pq

from hearthlog.analyzer.export.arrow import batch_of, schema_of
from hearthlog.analyzer.export.exporter import stream_exporter
from hearthlog.analyzer.logs.selection import Selection
from hearthlog.analyzer.logs.typed_columns import TypedColumns

_ROW_GROUP = 32 << 20  # bytes


class ParquetFile:
    """A Parquet file being written, row group by row group.

    Stamps are of type timestamp[ns, UTC]; the metadata are those of `schema_of`.

    Parameters
    ----------
    stream : binary file
        Is written to.
    topic : str
        Such as `/mic/segment`.
    selection : Selection
        Has the topic.
    """

    def __init__(self, stream: BinaryIO, topic: str, selection: Selection) -> None:
        self._stream = stream
        self._topic = topic
        self._selection = selection
        self._writer: pq.ParquetWriter | None = None
        self._batches: list[pa.RecordBatch] = []
        self._size = 0

    def write(self, piece: TypedColumns) -> None:
        """Append messages.

        Parameters
        ----------
        piece : TypedColumns
            Messages of the topic. The type of those of the first call decides the columns.

        Raises
        ------
        LogError
            If the messages are of a type that is defined otherwise.
        """
        if self._writer is None:
            schema = schema_of(self._topic, piece.fields, self._selection)
            texts = [field.name for field in schema if field.type == pa.string()]
            self._writer = pq.ParquetWriter(
                self._stream, schema, compression="zstd", use_dictionary=texts
            )
        batch = batch_of(piece, self._writer.schema)
        self._batches.append(batch)
        self._size += batch.nbytes
        if self._size >= _ROW_GROUP:
            self._write_group(self._writer)

    def finish(self) -> None:
        """Write what is left, and the index."""
        if self._writer is not None:
            self._write_group(self._writer)
            self._writer.close()

    def _write_group(self, writer: pq.ParquetWriter) -> None:
        if self._batches:
            writer.write_table(pa.Table.from_batches(self._batches))
        self._batches.clear()
        self._size = 0


EXPORTER = stream_exporter(ParquetFile)
