"""Which files a catalogue speaks of as they are now."""

from collections.abc import Sequence
from pathlib import Path

import pyarrow as pa

from hearthlog.analyzer.logs.catalog.file import without_times
from hearthlog.analyzer.logs.listing import ListedLog, catalogued_name, size_and_time
from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.errors import LogError


class KnownFiles:
    """Files by name, with sizes and times of change."""

    def __init__(self, table: pa.Table) -> None:
        plain = without_times(table.select(["path", "size", "mtime"]))
        self._numbers = {path: number for number, path in enumerate(plain["path"].to_pylist())}
        self._sizes: Int64 = plain["size"].to_numpy()
        self._times: Int64 = plain["mtime"].to_numpy()

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
            return self.rows_of([ListedLog(name, *size_and_time(path))])[0]
        except (ValueError, LogError):
            return None
