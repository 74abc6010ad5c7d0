"""A topic as CSV: a column for each number, with the name that the channel gives it."""

from itertools import zip_longest
from typing import Any, BinaryIO

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray
from pyarrow import csv

from hearthlog.analyzer.export.arrow import array_of, column_name, head_arrays, type_of
from hearthlog.analyzer.export.exporter import stream_exporter
from hearthlog.analyzer.export.text import json_texts
from hearthlog.analyzer.logs.channel_names import array_names
from hearthlog.analyzer.logs.selection import Selection
from hearthlog.analyzer.logs.typed_columns import TypedColumns
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.messages.fields import DURATION, Field
from hearthlog.schemas.times import NANOSECONDS

_OPTIONS = csv.WriteOptions(quoting_style="needed")
_CONTROLS = r"[\x00-\x08\x0b-\x1f\x7f-\x9f]"  # CSV has tabs and the ends of lines alone
_IN_THEIR_PLACE = "\ufffd"


class CsvFile:
    """A CSV file being written.

    Arrays are spread into columns, such as `mean.energy` where the channel has names for the
    elements, otherwise `values[0]`; arrays of messages are JSON, and bytes are in base64. Stamps
    are UTC, durations are in seconds. Control characters of texts become U+FFFD.

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
        self._metadata = [channel.metadata for channel, _ in selection.channels[topic]]
        self._schema: pa.Schema | None = None
        self._writer: csv.CSVWriter | None = None

    def write(self, piece: TypedColumns) -> None:
        """Append messages.

        Parameters
        ----------
        piece : TypedColumns
            Messages of the topic. Those of the first call decide which columns there are.

        Raises
        ------
        LogError
            If there is no column for a value, or not one name for each element of an array.
        """
        columns = self._columns(piece)
        if self._writer is None:
            self._schema = pa.schema([(name, array.type) for name, array in columns.items()])
            self._writer = csv.CSVWriter(self._stream, self._schema, write_options=_OPTIONS)
        assert self._schema is not None
        more = columns.keys() - set(self._schema.names)
        if more:
            raise LogError(
                f"{piece.columns.topic}: {min(more)} is not in all messages, which CSV has no "
                "column for; choose ndjson or parquet"
            )
        count = len(piece.columns)
        arrays = [
            _harmless(columns[field.name]) if field.name in columns else pa.nulls(count, field.type)
            for field in self._schema
        ]
        self._writer.write_batch(pa.RecordBatch.from_arrays(arrays, schema=self._schema))

    def finish(self) -> None:
        """Complete the file."""
        if self._writer is not None:
            self._writer.close()

    def _columns(self, piece: TypedColumns) -> dict[str, pa.Array]:
        columns = piece.columns
        arrays = head_arrays(columns)
        for path, values in columns.fields.items():
            field = piece.fields[path]
            name = column_name(path)
            if field.elements or (field.size is not None and field.type == "uint8"):
                arrays[name] = pa.array(json_texts(values, field), pa.string())
            elif field.size is not None:
                arrays |= self._spread(piece, path)
            elif field.type == DURATION:
                arrays[name] = pa.array(values / NANOSECONDS)
            else:
                arrays[name] = array_of(values, field)
        return arrays

    def _spread(self, piece: TypedColumns, path: str) -> dict[str, pa.Array]:
        """Make a column for each element of an array, and for those that only other logs have."""
        elements = _elements(piece.columns[path], piece.fields[path])
        own = array_names(piece.columns.metadata, path)
        if not own:
            return {f"{path}[{i}]": element for i, element in enumerate(elements)}
        if len(own) != len(elements):
            raise LogError(f"{piece.columns.topic}: {len(elements)} {path}, but {len(own)} names")
        all_names = dict.fromkeys(
            name for each in self._metadata for name in array_names(each, path)
        )
        named = dict(zip(own, elements, strict=True))
        missing = pa.nulls(len(piece.columns), elements[0].type)
        return {f"{path}.{name}": named.get(name, missing) for name in all_names}


def _harmless(column: pa.Array) -> pa.Array:
    """Replace control characters, which would steer a terminal."""
    if not pa.types.is_string(column.type):
        return column
    return pc.replace_substring_regex(column, _CONTROLS, _IN_THEIR_PLACE)


def _elements(values: NDArray[Any], field: Field) -> list[pa.Array]:
    """Make a column for each element of an array field."""
    element = field._replace(size=None)
    if values.ndim == 2:
        return [array_of(column, element) for column in np.ascontiguousarray(values.T)]
    rows = [list(row) for row in values]
    columns = zip_longest(*rows)  # None where a row is shorter
    return [pa.array(column, type_of(element)) for column in columns]


EXPORTER = stream_exporter(CsvFile)
