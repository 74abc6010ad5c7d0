"""Catalogue of a log folder: one Parquet file per home with one row per log."""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple
from urllib.parse import quote

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from hearthlog.analyzer.logs.locations import (
    ListedLog,
    catalogued_name,
    size_and_time,
    what_is_wrong,
)
from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.files import is_local, map_logs, store_errors
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS
from hearthlog.schemas.logs.files import CATALOG, log_readers
from hearthlog.schemas.new_files import private_folder, replaced_file

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
    metadata={"hearthlog_catalog": "2"},  # version of the columns and their meaning
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
_DIGEST = hashlib.sha256().digest_size
_VALUE = 16  # bytes in memory
_LIMIT = 1 << 30  # bytes of a file: about three million logs
_ROOM = 1 << 20  # bytes of memory
_GROWTH = 100  # bytes of memory per byte of file; our own files take up to 15


def table_of(rows: Sequence[Mapping[str, Any]]) -> pa.Table:
    """Build the catalogue table from its rows.

    Parameters
    ----------
    rows : sequence of mapping of str to object
        Values by column of `SCHEMA`; times are int, in nanoseconds of UTC.
    """
    return pa.Table.from_pylist(rows, SCHEMA)


def without_times(table: pa.Table) -> pa.Table:
    """Replace timestamps by int64 nanoseconds of UTC; Python times have no nanoseconds."""
    plain = [
        column.cast(pa.int64()) if column.type == _MOMENT else column for column in table.columns
    ]
    return pa.table(plain, table.column_names)


def write_table(table: pa.Table, stream: BinaryIO) -> None:
    """Write a catalogue table as Parquet, with a digest."""
    buffer = pa.BufferOutputStream()
    pq.write_table(table, buffer, compression="none")
    stream.writelines(sealed(memoryview(buffer.getvalue())))


def sealed(data: memoryview) -> tuple[memoryview, bytes, memoryview]:
    """Insert a digest before the footer of a Parquet file, where readers ignore it.

    Parquet has no checksum of its footer, and Arrow may abort the process on a damaged one.

    Parameters
    ----------
    data : memoryview
        The complete Parquet file.
    """
    footer = _footer(data)
    return data[:footer], _digest(data[:footer], data[footer:]), data[footer:]


def read_table(stream: BinaryIO) -> pa.Table:
    """Read and check the table of one catalogue part.

    Parameters
    ----------
    stream : binary file
        Read from its current position, up to 1 GiB.

    Raises
    ------
    ValueError, pa.ArrowException
        If the file is no catalogue, has another version, is damaged or compressed, lacks a value,
        or if the table would take too much memory.
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
    """Return the offset of the footer; its length is in the last 8 bytes of a Parquet file."""
    return len(data) - 8 - int.from_bytes(data[-8:-4], "little")


def _digest(body: memoryview, footer: memoryview) -> bytes:
    digest = hashlib.sha256(body)
    digest.update(footer)
    return digest.digest()


def _check_size(parquet: pq.FileMetaData, room: int) -> None:
    """Raise ValueError if the table would not fit into memory."""
    for group in map(parquet.row_group, range(parquet.num_row_groups)):
        for column in map(group.column, range(group.num_columns)):
            room -= column.num_values * _VALUE
            if column.compression != "UNCOMPRESSED":
                raise ValueError("it is compressed")
    if room < 0:
        raise ValueError("it holds more than a file of its size can")


def _size(batch: pa.RecordBatch) -> int:
    """Return the bytes of a batch with its dictionary-encoded texts expanded."""
    columns = [*batch.columns, *_parts(batch)]
    texts = [column for column in columns if pa.types.is_dictionary(column.type)]
    lengths = [pc.binary_length(text.dictionary).take(text.indices) for text in texts]
    return batch.nbytes + sum(pc.sum(length, min_count=0).as_py() for length in lengths)


def _parts(batch: pa.RecordBatch) -> list[pa.Array]:
    """Return the flattened values of the list columns."""
    lists = [batch.column(name).flatten() for name in ("labels", "scenarios")]
    parts = [part for each in lists for part in (each, *each.flatten())]
    return [*parts, batch.column("microphones").flatten()]


class IndexedFiles:
    """Index of catalogued files by name, with size and modification time."""

    def __init__(self, table: pa.Table) -> None:
        plain = without_times(table.select(["path", "size", "mtime"]))
        self._numbers = {path: number for number, path in enumerate(plain["path"].to_pylist())}
        self._sizes: Int64 = plain["size"].to_numpy()
        self._times: Int64 = plain["mtime"].to_numpy()

    def rows_of(self, logs: Sequence[ListedLog]) -> list[int | None]:
        """Return the row number of each file; None if the file has no row or has changed."""
        sizes, times = self._sizes.tolist(), self._times.tolist()
        numbers = [self._numbers.get(catalogued_name(log.name)) for log in logs]
        return [
            number if number is not None and (sizes[number], times[number]) == log[1:3] else None
            for number, log in zip(numbers, logs, strict=True)
        ]

    def find(self, path: Path, folder: Path) -> int | None:
        """Return the row number of a file on disk, as `rows_of` does."""
        try:
            name = path.relative_to(folder).as_posix()
            return self.rows_of([ListedLog(name, *size_and_time(path))])[0]
        except (ValueError, LogError):
            return None


_SUFFIX = ".parquet"
_LONGEST = 150  # bytes of the home's name in the name of its part


class Parts(NamedTuple):
    """Tables and errors of a catalogue."""

    tables: dict[str, pa.Table]  # by the name of the part
    unusable: list[str]  # problems of the other parts


def part_of(home: str) -> str:
    """Return the file name of a home's part."""
    name = quote(home, safe="")  # the prefix `home-` keeps pyarrow from hiding it
    if len(name) > _LONGEST:
        name = f"{name[:_LONGEST]}-{hashlib.sha256(name.encode()).hexdigest()[:16]}"
    return f"home-{name}{_SUFFIX}"


def read_parts(folder: Path) -> Parts | None:
    """Read the catalogue of a folder; None if there is none.

    An older catalogue, which is a single file, counts as one part.

    Raise `LogError` if the folder cannot be listed.
    """
    catalog = folder / CATALOG
    with store_errors(catalog):
        older = catalog.is_file()
        paths = [catalog] if older else [catalog / name for name in _names(catalog)]
    if not paths:
        return None
    parts = Parts({}, [])
    for path, read in zip(paths, map_logs(_read, paths), strict=True):
        if isinstance(read, str):
            parts.unusable.append(f"{path}: cannot be used as a catalogue ({read})")
        else:
            parts.tables[path.name] = read
    return parts


def _read(path: Path) -> pa.Table | str:
    try:
        with path.open("rb") as stream:
            return read_table(stream)
    except (pa.ArrowException, OSError, ValueError) as error:
        return str(error).partition("\n")[0]


def write_parts(
    folder: Path, parts: Mapping[str, pa.Table], before: Mapping[str, pa.Table]
) -> None:
    """Write new and changed catalogue parts, each atomically, and delete obsolete ones.

    Raise `LogError` if the catalogue cannot be written or is a link.
    """
    catalog = folder / CATALOG
    if is_local(catalog) and catalog.is_symlink():
        raise LogError(f"{catalog}: is a link, and what it leads to is not hearthlog's: delete it")
    with store_errors(catalog):
        if catalog.is_file():  # older, single-file catalogue
            catalog.unlink()
        if is_local(catalog):
            private_folder(catalog, readers=log_readers(folder))
        there = set(_names(catalog))
        for gone in there - parts.keys():
            (catalog / gone).unlink(missing_ok=True)
    for name, table in parts.items():
        if name not in there or table != before.get(name):
            put = replaced_file(catalog / name, readers=log_readers(folder))
            with put as temporary, temporary.open("wb") as stream:
                write_table(table, stream)


def _names(catalog: Path) -> list[str]:
    if not catalog.is_dir():  # a store has no empty folders
        return []
    return sorted(part.name for part in catalog.iterdir() if part.name.endswith(_SUFFIX))


def divided(table: pa.Table) -> Iterator[tuple[str, pa.Table]]:
    """Yield the rows of each home with the name of its part."""
    ordered = table.sort_by([("home", "ascending"), ("path", "ascending")])
    first = 0
    runs = pc.run_end_encode(ordered["home"].combine_chunks())
    for home, end in zip(runs.values.to_pylist(), runs.run_ends.to_pylist(), strict=True):
        yield part_of(home), ordered.slice(first, end - first)
        first = end


LOG = "log"  # kind of a file that is not a layer
FINISHED, UNFINISHED, DAMAGED = "finished", "unfinished", "damaged"
_BATCH = 1000  # rows


@dataclass(frozen=True)
class CatalogRow:
    """Catalogue row of one file; docs/catalog.md explains the columns.

    Times are nanoseconds of UTC. Values missing in the file are None or empty.
    """

    path: str
    home: str
    node: str | None
    kind: str
    log: str | None
    size: int
    mtime: int
    state: str = DAMAGED
    error: str | None = None
    microphones: Sequence[str] = ()
    start: int | None = None
    end: int | None = None
    frames: int = 0
    first_frame: int | None = None
    first_stamp: int | None = None
    last_frame: int | None = None
    last_stamp: int | None = None
    feature_set: str | None = None
    model: str | None = None
    model_sha256: str | None = None
    input_sha256: str | None = None
    version: str | None = None
    gaps: int = 0
    gap_seconds: float = 0.0
    labels: Sequence[Mapping[str, Any]] = ()
    scenarios: Sequence[Mapping[str, Any]] = ()

    @property
    def span(self) -> tuple[int, int] | None:
        """First and last log time, in nanoseconds of UTC; None if there are no messages."""
        return None if self.start is None or self.end is None else (self.start, self.end)


class Catalog:
    """The catalogue of a folder."""

    def __init__(self, folder: Path, table: pa.Table, unusable: Sequence[str] = ()) -> None:
        self.folder = folder
        self.table = table
        self.unusable = unusable
        self.files = IndexedFiles(table)
        self._plain = without_times(table)

    def __len__(self) -> int:
        return len(self.table)

    def current(self, path: Path) -> CatalogRow | None:
        """Return the row of a file; None if the file has no row or has changed."""
        number = self.files.find(path, self.folder)
        return None if number is None else next(self.rows(number, 1))

    def rows(self, first: int = 0, count: int | None = None) -> Iterator[CatalogRow]:
        """Yield rows of the catalogue.

        Parameters
        ----------
        first : int
            Number of the first row, from 0.
        count : int, optional
            Maximum number of rows; by default all from `first` on.
        """
        for batch in self._plain.slice(first, count).to_batches(_BATCH):
            for values in batch.to_pylist():
                yield CatalogRow(**values)

    def of_state(self, state: str) -> list[CatalogRow]:
        """Return the rows of the files in a state."""
        chosen = self._plain.filter(pc.equal(self._plain["state"], state))
        return [CatalogRow(**values) for values in chosen.to_pylist()]


def read_catalog(folder: Path) -> Catalog | None:
    """Read the usable parts of a folder's catalogue, ordered by home and path.

    Returns
    -------
    Catalog or None
        None if there is no catalogue.

    Raises
    ------
    LogError
        If the folder cannot be listed.
    """
    parts = read_parts(folder)
    if parts is None:
        return None
    table = pa.concat_tables([SCHEMA.empty_table(), *parts.tables.values()])
    wrong = what_is_wrong(folder)
    return Catalog(folder, table, parts.unusable if wrong is None else [*parts.unusable, wrong])


_HOUR = 3600 * NANOSECONDS // FRAME_NANOSECONDS  # frames
_FUNCTIONS = {"start": "min", "end": "max"}


@dataclass(frozen=True)
class HomeTotals:
    """Totals over the files of one home."""

    home: str
    logs: int
    layers: int
    unfinished: int
    damaged: int
    size: int  # bytes
    frames: int  # in logs, without layers
    start: int | None  # first and last log time of the logs
    end: int | None
    gaps: int
    gap_seconds: float

    @property
    def hours(self) -> float:
        """Hours of recorded frames."""
        return self.frames / _HOUR


@dataclass(frozen=True)
class LabelAmount:
    """Minutes and segments of one label in one home."""

    home: str
    kind: str  # kind of the source files: `log`, `relabel`, `review`
    model: str | None
    label: str
    minutes: float
    segments: int
    scenario: str = ""  # empty for the sounds of the home


def homes(catalog: Catalog) -> list[HomeTotals]:
    """Return the totals of each home."""
    table = catalog.table
    logs = pc.equal(table["kind"], LOG)
    counted = pa.table(
        {
            "home": table["home"],
            "logs": logs.cast(pa.int64()),
            "layers": pc.invert(logs).cast(pa.int64()),
            "unfinished": pc.equal(table["state"], UNFINISHED).cast(pa.int64()),
            "damaged": pc.equal(table["state"], DAMAGED).cast(pa.int64()),
            "size": table["size"],
            "frames": pc.if_else(logs, table["frames"], 0),
            "gaps": table["gaps"],
            "gap_seconds": table["gap_seconds"],
            "start": pc.if_else(logs, table["start"], None).cast(pa.int64()),
            "end": pc.if_else(logs, table["end"], None).cast(pa.int64()),
        }
    )
    functions = [(name, _FUNCTIONS.get(name, "sum")) for name in counted.column_names[1:]]
    return [HomeTotals(**row) for row in _grouped(counted, ["home"], functions)]


def label_amounts(catalog: Catalog) -> list[LabelAmount]:
    """Return the label totals of each home, by kind of labelling and by model.

    Returns
    -------
    list of LabelAmount
        Sorted by home, kind, model and descending minutes.
    """
    return _amounts(catalog.table, "labels", ["home", "kind", "model"], ["label"])


def scenario_amounts(catalog: Catalog) -> list[LabelAmount]:
    """Return the label totals of each home's scenarios, by kind, scenario and model.

    Returns
    -------
    list of LabelAmount
        Sorted by home, kind, scenario, model and descending minutes.
    """
    return _amounts(catalog.table, "scenarios", ["home", "kind"], ["scenario", "model", "label"])


def _amounts(
    table: pa.Table, column: str, keys: Sequence[str], own: Sequence[str]
) -> list[LabelAmount]:
    """Sum the entries of a list column, grouped by table columns `keys` and entry fields `own`."""
    lists = table[column].combine_chunks()
    labels = pa.Table.from_struct_array(lists.flatten())
    for name in keys:
        labels = labels.append_column(name, table[name].take(pc.list_parent_indices(lists)))
    values = [("minutes", "sum"), ("segments", "sum")]
    amounts = [LabelAmount(**row) for row in _grouped(labels, [*keys, *own], values)]
    return sorted(
        amounts,
        key=lambda one: (one.home, one.kind, one.scenario, one.model or "", -one.minutes),
    )


def _grouped(
    table: pa.Table, keys: Sequence[str], functions: Sequence[tuple[str, str]]
) -> list[dict[str, Any]]:
    """Aggregate rows with equal key columns; the result is sorted by these columns."""
    grouped = table.group_by(keys, use_threads=False).aggregate(functions)
    names = [*keys, *(name for name, _ in functions)]
    sums = grouped.select([*keys, *map("_".join, functions)]).rename_columns(names)
    return sums.sort_by([(key, "ascending") for key in keys]).to_pylist()
