"""The rows of a catalogue, read and asked for."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from hearthlog.analyzer.logs.catalog.file import SCHEMA, without_times
from hearthlog.analyzer.logs.catalog.known_files import KnownFiles
from hearthlog.analyzer.logs.catalog.parts import read_parts
from hearthlog.analyzer.logs.span_index import what_is_wrong

LOG = "log"  # the kind of a file that is no layer
FINISHED, UNFINISHED, DAMAGED = "finished", "unfinished", "damaged"
_BATCH = 1000  # rows


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
        self.files = KnownFiles(table)
        self._plain = without_times(table)

    def __len__(self) -> int:
        return len(self.table)

    def current(self, path: Path) -> CatalogRow | None:
        """Return the row of a file; None if it has none, or the file was changed since."""
        number = self.files.find(path, self.folder)
        return None if number is None else next(self.rows(number, 1))

    def rows(self, first: int = 0, count: int | None = None) -> Iterator[CatalogRow]:
        """Read rows of the catalogue.

        Parameters
        ----------
        first : int
            Number of the first row, from 0.
        count : int, optional
            How many rows at most; by default all that follow.
        """
        for batch in self._plain.slice(first, count).to_batches(_BATCH):
            for values in batch.to_pylist():
                yield CatalogRow(**values)

    def of_state(self, state: str) -> list[CatalogRow]:
        """Return the rows of the files in one state."""
        chosen = self._plain.filter(pc.equal(self._plain["state"], state))
        return [CatalogRow(**values) for values in chosen.to_pylist()]


def read_catalog(folder: Path) -> Catalog | None:
    """Read the catalogue of a folder, as far as it can be used.

    Returns
    -------
    Catalog or None
        None if there is no catalogue; its rows are by home and path.

    Raises
    ------
    LogError
        If the folder cannot be looked into.
    """
    parts = read_parts(folder)
    if parts is None:
        return None
    table = pa.concat_tables([SCHEMA.empty_table(), *parts.tables.values()])
    wrong = what_is_wrong(folder)
    return Catalog(folder, table, parts.unusable if wrong is None else [*parts.unusable, wrong])
