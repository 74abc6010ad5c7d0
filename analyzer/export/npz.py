"""Export of a topic as NumPy arrays, in one file that loads without pickle."""

from collections import Counter
from collections.abc import Sequence
from typing import Any
from zipfile import ZipFile

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.export.exporter import (
    Exporter,
    OutputFiles,
    Table,
    with_numbers,
    write_tables,
)
from hearthlog.analyzer.export.text import json_texts
from hearthlog.analyzer.logs.selection import LogSelection, TypedColumns, array_names
from hearthlog.schemas.errors import LogError, Progress
from hearthlog.schemas.logs.columns import Columns, join
from hearthlog.schemas.messages.fields import DURATION, TIME, Field
from hearthlog.schemas.messages.message_types import number_type

_TEXTS_LIMIT = 1 << 30  # bytes
_MEMORY = 128 << 20  # bytes of all tables together; larger tables are read separately
_OBJECT = 100  # bytes, roughly


class NpzFile:
    """Table in memory, written as one array per field, named by the field path.

    Stamps are datetime64[ns], durations timedelta64[ns]. Arrays of different lengths are
    concatenated, with their lengths in `<field>.lengths`; arrays of messages are JSON. Element
    names from the channel are in `<field>_names`. An optional field holds only the values that are
    present, with their rows in `<field>.rows`. `sizes` is the shared count of bytes in memory by
    table, with the total under None.
    """

    def __init__(self, table: Table, files: OutputFiles, sizes: "Counter[NpzFile | None]") -> None:
        self._table = table
        self._files = files
        self._sizes = sizes
        self._pieces: list[Columns] | None = []  # None if deferred

    def write(self, pieces: Sequence[TypedColumns]) -> None:
        """Append messages; defer the largest table if memory is exceeded."""
        if self._pieces is None:
            return
        self._pieces += [piece.columns for piece in pieces]
        size = sum(_size(piece.columns) for piece in pieces)
        self._sizes[self] += size
        self._sizes[None] += size
        while self._sizes[None] > _MEMORY and len(self._sizes) > 2:
            _, (largest, _) = self._sizes.most_common(2)
            assert largest is not None
            largest.put_off()

    def put_off(self) -> None:
        """Drop the messages; they must be read again."""
        self._sizes[None] -= self._sizes.pop(self)
        self._pieces = None

    def finish(self) -> bool:
        """Write the file; return whether the table was deferred and must be read again."""
        if self._pieces is None:
            return True
        arrays = _arrays(self._pieces, self._table)
        self.put_off()
        with ZipFile(self._files.new(self._table.stem), "x") as archive:
            for key, array in arrays.items():  # np.savez reserves the name `file`
                with archive.open(f"{key}.npy", "w", force_zip64=True) as part:
                    np.lib.format.write_array(part, array, allow_pickle=False)
        return False


def _save(selection: LogSelection, files: OutputFiles, progress: Progress) -> None:
    sizes: Counter[NpzFile | None] = Counter()
    write_tables(selection, files, progress, lambda table: NpzFile(table, files, sizes))


def _size(columns: Columns) -> int:
    size = len(columns) * 24
    for values in columns.fields.values():
        size += values.nbytes
        if values.dtype == object and values.ndim == 1:
            size += sum(getattr(value, "nbytes", _OBJECT) for value in values)
    return size


def _arrays(pieces: Sequence[Columns], table: Table) -> dict[str, NDArray[Any]]:
    """Join the messages of a table in log-time order."""
    optional = set(table.optional)
    required = [path for path in table.fields if path not in optional]
    columns = join([with_numbers(piece, table, required) for piece in pieces])
    order = np.argsort(columns.log_times, kind="stable")
    is_sorted = (np.diff(columns.log_times) >= 0).all()
    columns = columns if is_sorted else columns.take(order)
    arrays: dict[str, NDArray[Any]] = {}
    for path in table.fields:
        if path in columns.fields:
            arrays |= _column(path, columns[path], table.fields[path])
        else:
            has = np.concatenate([np.full(len(piece), path in piece.fields) for piece in pieces])
            having = [piece for piece in pieces if path in piece.fields]
            if not having:
                continue
            values = join([with_numbers(piece, table, [path]) for piece in having])[path]
            values = values[(np.cumsum(has) - 1)[order[has[order]]]]
            arrays |= _column(path, values, table.fields[path])
            arrays[f"{path}.rows"] = np.flatnonzero(has[order])
        names = array_names(columns.metadata, path)
        if names:
            arrays[f"{path}_names"] = np.array(names)
    return arrays | {
        "log_time": columns.log_times.view("M8[ns]"),
        "publish_time": columns.publish_times.view("M8[ns]"),
        "sequence": columns.sequences,
    }


def _column(path: str, values: NDArray[Any], field: Field) -> dict[str, NDArray[Any]]:
    if field.size is None and field.type in {TIME, DURATION}:
        return {path: values.view("M8[ns]" if field.type == TIME else "m8[ns]")}
    if values.dtype != object:
        return {path: values}
    if field.type == "string" and (field.size is None or values.ndim == 2):
        return {path: _texts(path, values)}
    if field.elements or field.type == "string":
        return {path: _texts(path, np.array(json_texts(values, field), object))}
    lengths = np.array([len(row) for row in values])
    flat = np.concatenate(list(values))
    if field.type not in {TIME, DURATION}:
        flat = flat.astype(number_type(field.type), copy=False)
    return {path: flat, f"{path}.lengths": lengths}


def _texts(path: str, values: NDArray[Any]) -> NDArray[np.str_]:
    """Return texts as a fixed-width array, as NumPy stores them."""
    longest = max(map(len, values.reshape(-1).tolist()), default=0)
    if values.size * longest * 4 > _TEXTS_LIMIT:
        raise LogError(f"{path}: texts are too long for NPZ; choose parquet")
    return values.astype(f"U{max(longest, 1)}")


NPZ = Exporter(_save)
