"""Which files a catalogue speaks of as they are now, and the spans of time that it has for them."""

from collections.abc import Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc

from hearthlog.analyzer.logs.catalog.file import without_times
from hearthlog.analyzer.logs.catalog.listing import ListedLog, catalogued_name, size_and_time
from hearthlog.analyzer.logs.catalog.parts import read_parts
from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.errors import LogError

COLUMNS = ("path", "size", "mtime", "start", "end")
_NEVER = -1


class KnownFiles:
    """Files by name, with sizes, times of change, and spans of time.

    Parameters
    ----------
    table : pa.Table
        With the columns `COLUMNS` of a catalogue.
    """

    def __init__(self, table: pa.Table) -> None:
        plain = without_times(table.select(COLUMNS))
        self._numbers = {path: number for number, path in enumerate(plain["path"].to_pylist())}
        self._sizes: Int64 = plain["size"].to_numpy()
        self._times: Int64 = plain["mtime"].to_numpy()
        self._starts: Int64 = pc.fill_null(plain["start"], _NEVER).to_numpy()
        self._ends: Int64 = pc.fill_null(plain["end"], _NEVER).to_numpy()

    def rows_of(self, logs: Sequence[ListedLog]) -> list[int | None]:
        """Return the numbers of the files' rows; None if one has none, or was changed since."""
        sizes, times = self._sizes.tolist(), self._times.tolist()
        numbers = [self._numbers.get(catalogued_name(log.name)) for log in logs]
        return [
            number if number is not None and (sizes[number], times[number]) == log[1:3] else None
            for number, log in zip(numbers, logs, strict=True)
        ]

    def find(self, path: Path, folder: Path) -> int | None:
        """Return the number of a file's row, as `rows_of` does, having looked at the file."""
        try:
            name = path.relative_to(folder).as_posix()
            return self.rows_of([ListedLog(name, *size_and_time(path), is_link=False)])[0]
        except (ValueError, LogError):
            return None

    def spans(self) -> list[tuple[int, int] | None]:
        """Return first and last log time (ns of UTC) of the file of each row; None if unknown."""
        pairs = zip(self._starts.tolist(), self._ends.tolist(), strict=True)
        return [None if pair[0] == _NEVER else pair for pair in pairs]


def read_known_files(folder: Path) -> KnownFiles | None:
    """Read which files the catalogue of a folder speaks of; None if there is none.

    Raises
    ------
    LogError
        If the folder cannot be looked into.
    """
    parts = read_parts(folder, COLUMNS)
    if parts is None or not parts.tables:
        return None
    return KnownFiles(pa.concat_tables(parts.tables.values()))
