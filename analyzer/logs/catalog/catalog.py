"""The rows of a catalogue: made from the files, and asked for them."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.catalog.contents import Contents, read_contents
from hearthlog.analyzer.logs.catalog.file import (
    SCHEMA,
    read_table,
    table_of,
    without_times,
    write_table,
)
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.files import CATALOG, find_logs, log_name, log_of_layer
from hearthlog.schemas.messages.topics import LIVE, RELABEL, REVIEW
from hearthlog.schemas.progress import Progress, ignore_progress
from hearthlog.schemas.storage.byte_ranges import map_logs, store_errors
from hearthlog.schemas.storage.new_files import replaced_file
from hearthlog.schemas.times import NANOSECONDS

LOG = "log"  # the kind of a file that is no layer
FINISHED, UNFINISHED, DAMAGED = "finished", "unfinished", "damaged"
_HOME = re.compile(r"(?:(.*?)/)?\d{4}/\d{2}/\d{2}/[^/]*", re.DOTALL)
_BATCH = 1000  # rows
_NEVER = -1


@dataclass(frozen=True)
class CatalogRow:
    """What a catalogue says of one file; docs/catalog.md explains the columns.

    Times are nanoseconds of UTC. What a file does not say is None, or empty.
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

    @property
    def span(self) -> tuple[int, int] | None:
        """First and last log time, in nanoseconds of UTC; None if there are no messages."""
        return None if self.start is None or self.end is None else (self.start, self.end)


class Catalog:
    """The catalogue of a folder.

    Parameters
    ----------
    folder : Path
    table : pa.Table
        Of `SCHEMA`.
    """

    def __init__(self, folder: Path, table: pa.Table) -> None:
        self.folder = folder
        self.table = table
        self._plain = without_times(table)
        self._numbers = {path: number for number, path in enumerate(table["path"].to_pylist())}
        self._sizes, self._times = (self._plain[name].to_numpy() for name in ("size", "mtime"))
        self._starts, self._ends = (
            pc.fill_null(self._plain[name], _NEVER).to_numpy() for name in ("start", "end")
        )

    def __len__(self) -> int:
        return len(self.table)

    def current(self, path: Path) -> CatalogRow | None:
        """Return the row of a file; None if it has none, or the file was changed since."""
        number = self.find(path)
        return None if number is None else next(self.rows(number, 1))

    def span(self, path: Path) -> tuple[int, int] | None:
        """Return the time span that the catalogue has for a file.

        Returns
        -------
        tuple of int, or None
            First and last log time, in nanoseconds of UTC; None where `current` is None, or where
            the row has no times.
        """
        number = self.find(path)
        if number is None or self._starts[number] == _NEVER:
            return None
        return int(self._starts[number]), int(self._ends[number])

    def find(self, path: Path) -> int | None:
        """Return the number of a file's row, from 0; None where `current` is None."""
        try:
            number = self._numbers.get(_relative(path, self.folder))
            size_and_time = None if number is None else _size_and_time(path)
        except (ValueError, LogError):
            return None
        if number is None or (self._sizes[number], self._times[number]) != size_and_time:
            return None
        return number

    def rows(self, first: int = 0, count: int | None = None) -> Iterator[CatalogRow]:
        """Read rows of the catalogue.

        Parameters
        ----------
        first : int
            Number of the first row, from 0.
        count : int, optional
            How many rows at most; by default all that follow.

        Yields
        ------
        CatalogRow
            In the order of the table.
        """
        for batch in self._plain.slice(first, count).to_batches(_BATCH):
            for values in batch.to_pylist():
                yield CatalogRow(**values)

    def of_state(self, state: str) -> list[CatalogRow]:
        """Return the rows of the files in one state.

        Parameters
        ----------
        state : str
            `FINISHED`, `UNFINISHED` or `DAMAGED`.
        """
        states = self.table["state"].to_pylist()
        return [row for n, same in enumerate(states) if same == state for row in self.rows(n, 1)]


def read_catalog(folder: Path) -> Catalog | None:
    """Read the catalogue of a folder if there is one that can be used.

    Returns
    -------
    Catalog or None
        None if there is no catalogue, or `load_catalog` refuses it.

    Raises
    ------
    LogError
        If the folder cannot be looked into.
    """
    try:
        return load_catalog(folder)
    except DataError:
        return None


def load_catalog(folder: Path) -> Catalog | None:
    """Read the catalogue of a folder; None if there is none.

    Raises
    ------
    DataError
        If the catalogue is damaged, or not of this version.
    LogError
        If the folder cannot be looked into.
    """
    path = folder / CATALOG
    with store_errors(path):
        exists = path.is_file()
    if not exists:
        return None
    try:
        with path.open("rb") as stream:
            return Catalog(folder, read_table(stream))
    except (pa.ArrowException, OSError, ValueError) as error:
        what = str(error).partition("\n")[0]
        raise DataError(f"{path}: cannot be used as a catalogue ({what})") from error


def write_catalog(
    folder: Path, before: Catalog | None = None, progress: Progress = ignore_progress
) -> Catalog:
    """Make the catalogue of a folder, and replace an older one in one step.

    Parameters
    ----------
    folder : Path
    before : Catalog, optional
        An older catalogue: files that are as it says are not read again, damaged ones excepted.
        By default all files are read.
    progress : callable, optional
        Is told the share of the files that is done, 0 to 1.

    Returns
    -------
    Catalog
        What was written.

    Raises
    ------
    LogError
        If there is no log, or the catalogue cannot be written.
    KeyboardInterrupt
        If interrupted; the catalogue then has what was read so far.
    """
    logs = find_logs(folder)
    kept, new = _divided(logs, before)
    tables = [SCHEMA.empty_table() if before is None else before.table.take(kept)]
    rows: list[CatalogRow] = []
    interrupt: KeyboardInterrupt | None = None
    with replaced_file(folder / CATALOG) as temporary, temporary.open("wb") as stream:
        try:
            for done, read in enumerate(map_logs(partial(_read_row, folder), new), 1):
                rows += read
                if len(rows) == _BATCH:
                    tables.append(table_of([vars(row) for row in rows]))
                    rows = []
                progress((len(kept) + done) / len(logs))
        except KeyboardInterrupt as error:
            interrupt = error
        table = pa.concat_tables([*tables, table_of([vars(row) for row in rows])]).sort_by("path")
        write_table(table, stream)
    if interrupt is not None:
        raise interrupt
    return Catalog(folder, table)


def _divided(logs: Sequence[Path], before: Catalog | None) -> tuple[list[int], list[Path]]:
    """Tell which rows are still true, and which files are to be read."""
    if before is None:
        return [], list(logs)
    kept: list[int] = []
    new: list[Path] = []
    states = before.table["state"].to_pylist()
    for path, number in zip(logs, map_logs(before.find, logs), strict=True):
        # What could not be read then may be readable now, though the file is the same.
        if number is None or states[number] == DAMAGED:
            new.append(path)
        else:
            kept.append(number)
    return kept, new


def _read_row(folder: Path, path: Path) -> list[CatalogRow]:
    """Make the row of a file; none if the file has gone."""
    name = log_name(path)
    kind = name.layer.partition("-")[0]
    if kind not in {RELABEL, REVIEW}:  # sound is no labelling
        kind = LOG
    home = _HOME.fullmatch(_relative(path, folder))
    try:
        size, mtime = _size_and_time(path)
    except LogError:
        return []
    row = CatalogRow(
        path=_relative(path, folder),
        home="" if home is None else home[1] or "",
        node=name.node or None,
        kind=kind,
        log=None if kind == LOG else _relative(log_of_layer(path), folder),
        size=size,
        mtime=mtime,
    )
    try:
        return [_filled(row, read_contents(path, LIVE if kind == LOG else kind))]
    except LogError as error:
        if not path.exists():  # a recorder has completed it, and given it another name
            return []
        return [replace(row, error=str(error).removeprefix(f"{path}: "))]


def _filled(row: CatalogRow, contents: Contents) -> CatalogRow:
    """Add what was found in a file to its row."""
    record = {name: value for name, value in contents.record.items() if value}
    start, end = contents.span or (None, None)
    first, last = contents.first or (None, None), contents.last or (None, None)
    return replace(
        row,
        node=record.get("node", row.node),
        state=FINISHED if contents.complete else UNFINISHED,
        microphones=contents.microphones,
        start=start,
        end=end,
        frames=contents.frames,
        first_frame=first[0],
        first_stamp=first[1],
        last_frame=last[0],
        last_stamp=last[1],
        feature_set=record.get("feature_set"),
        model=record.get("model"),
        model_sha256=record.get("model_sha256"),
        input_sha256=record.get("input_sha256"),
        version=record.get("version"),
        gaps=contents.gaps,
        gap_seconds=contents.gap_seconds,
        labels=[
            {"label": label, "minutes": contents.seconds[label] / 60, "segments": count}
            for label, count in sorted(contents.segments.items())
        ],
    )


def _relative(path: Path, folder: Path) -> str:
    """Name a file as the catalogue does; raise ValueError if it is not in the folder."""
    name = path.relative_to(folder).as_posix()
    return name.encode(errors="surrogateescape").decode(errors="replace")  # names are bytes


def _size_and_time(path: Path) -> tuple[int, int]:
    """Return bytes and time of change (ns), by which a changed file is known."""
    with store_errors(path):
        status = path.stat()
    made = getattr(status, "st_birthtime", 0)  # an object is not changed, but made anew
    return status.st_size, status.st_mtime_ns or int(made * NANOSECONDS)
