"""Catalogue of a folder of homes: one SQLite file with a row for each log."""

import hashlib
import os
import re
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, fields
from heapq import merge
from itertools import groupby, islice
from pathlib import Path
from typing import Any

from hearthlog.analyzer.logs.locations import UNSURE, ListedLog, Listing, list_logs, size_and_time
from hearthlog.analyzer.logs.spans import EVENT_PAUSE
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.files import is_local, open_file, store_errors
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS
from hearthlog.schemas.logs.files import CATALOG, find_logs, log_readers
from hearthlog.schemas.logs.merged_reading import time_spans
from hearthlog.schemas.mcap.logfile import ACTIVE_SUFFIX
from hearthlog.schemas.new_files import new_file, replaced_file

_DIGEST = hashlib.sha256().digest_size
_LIMIT = 1 << 30  # bytes of a file: about three million logs
_EARLIER = "catalog.parquet", "catalog.index"  # of hearthlog 0.1
_LAST = (1 << 63) - 1  # the largest integer of SQLite
_LEAF = b"\x0d"  # kind of a page
_BATCH = 10_000  # rows
_AMOUNT = "label", "minutes", "segments", "events", "first", "last"  # of a class in a file
_MOMENTS = "mtime", "start", "end", "first_stamp", "last_stamp"
_HOME = re.compile(r"(?:(.*?)/)?\d{4}/\d{2}/\d{2}", re.DOTALL)

LOG = "log"  # kind of a file that is not a layer
FINISHED, UNFINISHED, DAMAGED = "finished", "unfinished", "damaged"
SpanOf = Callable[[Path], tuple[int, int] | None]
LogSpan = tuple[int, int, Path]  # log times of the first and the last message (ns of UTC), the log


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


_FILE = fields(CatalogRow)[2:-2]  # the last columns of `files`
_KINDS: dict[Any, str] = {
    str: "TEXT NOT NULL", str | None: "TEXT", Sequence[str]: "TEXT NOT NULL",
    int: "INTEGER NOT NULL", int | None: "INTEGER", float: "REAL NOT NULL",
}  # fmt: skip
# `PRAGMA integrity_check` verifies types and constraints of the rows of a file from elsewhere.
_SCHEMA = f"""
CREATE TABLE folders (
    folder INTEGER PRIMARY KEY,
    path TEXT NOT NULL UNIQUE CHECK (
        path NOT GLOB '/*' AND '/' || path || '/' NOT GLOB '*/../*' AND instr(path, char(0)) = 0
    ),
    home TEXT NOT NULL,
    changed INTEGER NOT NULL
) STRICT;
CREATE TABLE files (
    file INTEGER PRIMARY KEY,
    folder INTEGER NOT NULL,
    name TEXT NOT NULL CHECK (name NOT GLOB '*/*' AND name <> '..' AND instr(name, char(0)) = 0),
    {", ".join(f'"{column.name}" {_KINDS[column.type]}' for column in _FILE)},
    CHECK ((start IS NULL) = ("end" IS NULL))
) STRICT;
CREATE TABLE labels (
    file INTEGER NOT NULL,
    scenario TEXT NOT NULL,
    label TEXT NOT NULL,
    model TEXT,
    minutes REAL NOT NULL,
    segments INTEGER NOT NULL,
    events INTEGER NOT NULL,
    first INTEGER NOT NULL,
    last INTEGER NOT NULL,
    PRIMARY KEY (file, scenario, label)
) STRICT, WITHOUT ROWID;
CREATE VIEW catalog AS
SELECT ltrim(folders.path || '/' || name, '/') AS path, home, changed, files.*,
    state = 'finished' AND name NOT GLOB '*{ACTIVE_SUFFIX}' AS finished
FROM files JOIN folders USING (folder);
"""  # noqa: S608  no values
_TABLES = "folders", "files", "labels"


class Catalog:
    """The catalogue of a folder, from an SQLite file and its digest; empty by default.

    It has the rows of its logs, in memory, and `unusable`, errors of the file. Only `tables` are
    checked; the others must not be read. Raise `sqlite3.Error` or `ValueError` if the data is no
    catalogue, or is damaged.
    """

    def __init__(
        self,
        folder: Path,
        data: bytes | None = None,
        unusable: Sequence[str] = (),
        tables: Sequence[str] = _TABLES,
    ) -> None:
        self.folder = folder
        self.unusable = unusable
        self.database = sqlite3.connect(":memory:", check_same_thread=False)
        if data is not None:
            self._read(memoryview(data), tables)
        else:
            self.database.executescript(_SCHEMA)
        self.database.text_factory = os.fsdecode  # file names are bytes

    def __del__(self) -> None:
        self.database.close()  # or Python 3.13 warns

    def _read(self, data: memoryview, tables: Sequence[str]) -> None:
        """Raise ValueError unless the schema is ours, without triggers, and tables are intact."""
        content = data[:-_DIGEST]
        # Pages of a schema that is not on the first page may refer to each other without end.
        if hashlib.sha256(content).digest() != data[-_DIGEST:] or content[100:101] != _LEAF:
            raise ValueError("it is damaged, or was not made by hearthlog")
        self.database.deserialize(content)
        self.database.execute("PRAGMA trusted_schema = OFF")
        schema = "SELECT type, name, sql FROM sqlite_schema"
        empty = Catalog(self.folder)
        ours = empty.database.execute(schema).fetchall()
        if self.database.execute(schema).fetchall() != ours:
            raise ValueError("it is of another version of hearthlog")
        checks = [self.database.execute(f"PRAGMA integrity_check({table})") for table in tables]
        if any(check.fetchone() != ("ok",) for check in checks):
            raise ValueError("it is damaged, or was not made by hearthlog")

    def __len__(self) -> int:
        (count,) = self.database.execute("SELECT count(*) FROM files").fetchone()
        return int(count)

    def path(self, name: str) -> Path:
        """Return the path of a file, by its path within the folder."""
        return self.folder.joinpath(*name.split("/"))

    def current(self, path: Path) -> CatalogRow | None:
        """Return the row of a file; None if the file has no row or has changed."""
        try:
            name = path.relative_to(self.folder).as_posix()
            about = size_and_time(path)
        except (ValueError, LogError):
            return None
        same = "path = CAST(? AS TEXT) AND size = ? AND mtime = ?"
        return next(self.rows(same, os.fsencode(name), *about), None)

    def of_state(self, state: str) -> list[CatalogRow]:
        """Return the rows of the files in a state."""
        return list(self.rows("state = ?", state))

    def rows(self, condition: str = "TRUE", *values: object) -> Iterator[CatalogRow]:
        """Yield the rows that meet a condition in SQL, ordered by home and path."""
        query = f"SELECT * FROM catalog WHERE {condition} ORDER BY home, path"  # noqa: S608
        found = self.database.execute(query, values)
        names = [column[0] for column in found.description]
        for each in found:
            row = dict(zip(names, each, strict=True))
            path = text_of(row["path"])
            labels: list[dict[str, Any]] = []
            scenarios: list[dict[str, Any]] = []
            for scenario, model, *amounts in self.database.execute(
                f"SELECT scenario, model, {', '.join(_AMOUNT)} FROM labels WHERE file = ?",  # noqa: S608
                [row["file"]],
            ):
                amount = dict(zip(_AMOUNT, amounts, strict=True))
                if scenario:
                    scenarios.append({"scenario": scenario, "model": model, **amount})
                else:
                    labels.append(amount)
            row |= {"path": path, "labels": labels, "scenarios": scenarios}
            row["microphones"] = list(filter(None, row["microphones"].split("/")))
            if row["log"] is not None:
                row["log"] = path.removesuffix(text_of(row["name"])) + row["log"]
            yield CatalogRow(**{name: row[name] for name in CatalogRow.__match_args__})

    def spans(self, since: int, until: int) -> Iterator[LogSpan]:
        """Yield the logs that end at `since` or later and begin before `until`, latest first."""
        for start, end, name in self.database.execute(
            'SELECT start, "end", path FROM catalog WHERE "end" >= ? AND start < ? '
            'ORDER BY start DESC, "end" DESC',
            (since, until),
        ):
            yield start, end, self.path(name)

    def remove_changed(self, since: int, until: int) -> list[Path]:
        """Remove the rows of changed logs and of logs without a span; return these logs.

        Logs that are finished, and end before `since` or begin at `until` or later, count as
        unchanged if their folder has not changed.
        """
        changed = dict(self.database.execute("SELECT path, changed FROM folders"))
        listing = list_logs(
            self.folder, changed if is_local(self.folder) and _keeps_times(self.folder) else {}
        )
        self.database.executemany(
            "UPDATE folders SET changed = ? WHERE path = CAST(? AS TEXT)",
            [(UNSURE, os.fsencode(path)) for path in changed.keys() - listing.unchanged],
        )
        listed = {log.name: log for log in listing.logs}
        opened: list[Path] = []
        removed: list[tuple[int]] = []
        for file, name, size, mtime, start, is_listed in self.database.execute(
            "SELECT file, path, size, mtime, start, changed = ? FROM catalog "
            'WHERE changed = ? OR start IS NULL OR NOT finished OR "end" >= ? AND start < ?',
            (UNSURE, UNSURE, since, until),
        ):
            if is_listed:
                is_same = listed.get(name) == (name, size, mtime)
            else:
                is_same = _is_current(self.path(name), size, mtime)
            if is_same and start is not None:
                listed.pop(name, None)
                continue
            removed.append((file,))
            if not is_listed:
                opened.append(self.path(name))
        self.database.executemany("DELETE FROM files WHERE file = ?", removed)
        opened += map(self.path, listed)
        if not opened and not len(self):
            find_logs(self.folder)  # raises the error with its reason
        return opened

    def keep(self, listing: Listing) -> list[ListedLog]:
        """Keep only the rows of unchanged and undamaged files; return the files without a row."""
        self.database.execute("DELETE FROM files WHERE state = ?", [DAMAGED])  # may be mended
        files = self.database.execute("SELECT path, size, mtime, file FROM catalog")
        numbers = {ListedLog(*row[:3]): row[3] for row in files}
        gone = [(numbers[log],) for log in numbers.keys() - listing.logs]
        self.database.executemany("DELETE FROM files WHERE file = ?", gone)
        self.database.executemany("DELETE FROM labels WHERE file = ?", gone)
        paths = {log.name.rpartition("/")[0] for log in listing.logs} | listing.folders.keys()
        before = {path for (path,) in self.database.execute("SELECT path FROM folders")}
        self.database.executemany(
            "DELETE FROM folders WHERE path = CAST(? AS TEXT)",
            [(os.fsencode(path),) for path in before - paths],
        )
        self.database.executemany(
            "INSERT INTO folders (path, home, changed) VALUES (CAST(? AS TEXT), ?, ?) "
            "ON CONFLICT (path) DO UPDATE SET changed = excluded.changed "
            "WHERE changed <> excluded.changed",
            [
                (os.fsencode(path), home_of(path), listing.folders.get(path, UNSURE))
                for path in sorted(paths)
            ],
        )
        return [log for log in listing.logs if log not in numbers]

    def add(self, rows: Iterable[CatalogRow]) -> None:
        """Add the rows of files in known folders."""
        insert = (
            "INSERT INTO files VALUES (NULL, (SELECT folder FROM folders WHERE path = CAST(? AS "  # noqa: S608
            f"TEXT)), CAST(? AS TEXT){', ?' * len(_FILE)})"
        )
        for row in rows:
            folder, _, name = os.fsencode(row.path).rpartition(b"/")
            about = vars(row) | {"microphones": "/".join(row.microphones)}
            values = [folder, name, *(about[column.name] for column in _FILE)]
            file = self.database.execute(insert, values).lastrowid
            self.database.executemany(
                "INSERT INTO labels (file, scenario, model, label, minutes, segments, events, "
                "first, last) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)",
                [
                    (file, one.get("scenario", ""), one.get("model"), *map(one.get, _AMOUNT))
                    for one in (*row.labels, *row.scenarios)
                ],
            )

    def forget_times(self) -> None:
        """Let the next query list all folders, as some of their logs have no row."""
        self.database.execute("UPDATE folders SET changed = ?", [UNSURE])

    def write(self) -> None:
        """Write a changed catalogue into its folder, in one step.

        Raise `LogError` if it cannot be written.
        """
        if not self.database.total_changes:
            return
        self.database.commit()
        data = self.database.serialize()
        put = replaced_file(self.folder / CATALOG, readers=log_readers(self.folder))
        with put as temporary, temporary.open("wb") as stream:
            stream.writelines([data, hashlib.sha256(data).digest()])
        _remove_earlier(self.folder)


def text_of(name: str) -> str:
    """Return a file name as text; undecodable bytes are replaced."""
    return os.fsencode(name).decode(errors="replace")


def home_of(folder: str) -> str:
    """Return the home of the logs in a folder: the folder that holds its `YYYY/MM/DD`."""
    found = _HOME.fullmatch(folder)
    return text_of(found[1] or "") if found else ""


def _remove_earlier(folder: Path) -> None:
    """Delete the catalogue of an earlier version, but no table that a person exported."""
    for path in (folder / name for name in _EARLIER):
        if is_local(path) and path.is_symlink():
            continue  # what it leads to is not ours
        with suppress(OSError):
            if path.is_dir():
                for part in path.glob("home-*.parquet"):
                    part.unlink()
                path.rmdir()
            elif path.suffix != ".parquet":
                path.unlink()


def _keeps_times(folder: Path) -> bool:
    """Whether writing the catalogue changed the time of its folder; on some mounts it does not."""
    return (folder / CATALOG).stat().st_mtime_ns <= folder.stat().st_ctime_ns


def _is_current(path: Path, size: int, mtime: int) -> bool:
    try:
        return size_and_time(path) == (size, mtime)
    except LogError:
        return False


def read_catalog(folder: Path, tables: Sequence[str] = _TABLES) -> Catalog | None:
    """Read the catalogue of a folder; None if there is none.

    A catalogue that cannot be used is empty. `tables` are those to check, as of `Catalog`.
    """
    path = folder / CATALOG
    try:
        with store_errors(path):
            if not path.exists():
                older = [folder / name for name in _EARLIER if (folder / name).exists()]
                lines = [f"{older[0]}: is of an earlier version of hearthlog"] if older else []
                return Catalog(folder, unusable=lines) if older else None
        with closing(open_file(path)) as file:
            data = file.read(0, min(file.size, _LIMIT))
        return Catalog(folder, data, tables=tables)
    except (LogError, OSError, ValueError, sqlite3.Error) as error:
        reason = str(error).removeprefix(f"{path}: ")
        return Catalog(folder, unusable=[f"{path}: cannot be used as a catalogue ({reason})"])


class LogSpans:
    """Spans of many logs: of opened logs, in order of time, and of the logs of catalogues."""

    def __init__(self, opened: Sequence[LogSpan], catalogs: Sequence[Catalog]) -> None:
        self._opened = opened
        self._catalogs = catalogs

    def within(self, start: int | None, end: int | None) -> list[LogSpan]:
        """Return the logs with messages in a span of time, without duplicates, in order of time."""
        return _in_time(self._latest_first(*_limits(start, end)))

    def before(self, time: int) -> Iterator[Path]:
        """Yield the logs with messages before a time, without duplicates, latest first."""
        found = self._latest_first(*_limits(None, time))
        for _, same in groupby(found, key=lambda span: span[:2]):
            yield from (path for _, _, path in reversed(_in_time(same)))

    def _latest_first(self, since: int, until: int) -> Iterator[LogSpan]:
        opened = (one for one in reversed(self._opened) if one[1] >= since and one[0] < until)
        listed = [catalog.spans(since, until) for catalog in self._catalogs]
        return merge(opened, *listed, key=lambda span: span[:2], reverse=True)


def _limits(start: int | None, end: int | None) -> tuple[int, int]:
    """Return log times that SQLite can compare: from the first on, before the second."""
    since = -_LAST if start is None else max(start, -_LAST)
    return min(since, _LAST), _LAST if end is None else max(min(end, _LAST), -_LAST)


def _in_time(spans: Iterable[LogSpan]) -> list[LogSpan]:
    once = {str(span[2].resolve()): span for span in spans}  # a log may have several names
    # Local paths and paths of a store do not compare; their parts do.
    return sorted(once.values(), key=lambda span: (*span[:2], span[2].parts))


def find_spans(
    paths: Iterable[Path], span_of: SpanOf, start: int | None, end: int | None
) -> LogSpans:
    """Find the logs of some folders with their first and last log times.

    `span_of` returns first and last log time of a log without a current catalogue row; None drops
    the log. Outside of the span from `start` on, before `end` (log times in nanoseconds of UTC),
    catalogue rows of finished logs are trusted without a check. Raise `LogError` if there is no
    such log, or none in a folder.
    """
    catalogs: list[Catalog] = []
    opened: dict[str, Path] = {}
    for path in paths:
        catalog = read_catalog(path, _TABLES[:2])
        if catalog is None or catalog.unusable:
            logs = find_logs(path)
        else:
            logs = catalog.remove_changed(*_limits(start, end))
            catalogs.append(catalog)
        opened |= {str(log.resolve()): log for log in logs}
    return LogSpans(time_spans(opened.values(), span_of), catalogs)


_HOUR = 3600 * NANOSECONDS // FRAME_NANOSECONDS  # frames


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
    """Minutes, segments and events of one label in one home."""

    home: str
    kind: str  # kind of the source files: `log`, `relabel`, `review`
    model: str | None
    label: str
    minutes: float
    segments: int
    events: int  # of all microphones of a recorder; pauses of at most ten seconds
    scenario: str = ""  # empty for the sounds of the home


def homes(catalog: Catalog) -> list[HomeTotals]:
    """Return the totals of each home."""
    rows = catalog.database.execute(
        "SELECT home, sum(kind = 'log'), sum(kind <> 'log'), sum(state = 'unfinished'), "
        "sum(state = 'damaged'), sum(size), sum(frames * (kind = 'log')), "
        "min(CASE kind WHEN 'log' THEN start END), max(CASE kind WHEN 'log' THEN \"end\" END), "
        "sum(gaps), sum(gap_seconds) FROM catalog GROUP BY home ORDER BY home"
    )
    return [HomeTotals(*row) for row in rows]


def label_amounts(catalog: Catalog) -> list[LabelAmount]:
    """Return the label totals of each home, by kind of labelling, scenario and model.

    The sounds of the homes come first, then the scenarios; each sorted by home, kind, scenario,
    model and descending minutes.
    """
    rows = catalog.database.execute(
        # An event may go on in the next log of its recorder.
        "WITH logs AS (SELECT file, home, kind, model, "
        "lag(file) OVER (PARTITION BY home, node, kind, model ORDER BY start) AS earlier "
        "FROM files JOIN folders USING (folder)) "
        "SELECT home, kind, iif(own.scenario = '', logs.model, own.model) AS by_model, own.label, "
        "sum(own.minutes) AS total, sum(own.segments), "
        "sum(own.events - coalesce(own.first <= before.last + ?, 0)), own.scenario "
        "FROM logs JOIN labels AS own USING (file) LEFT JOIN labels AS before ON "
        "before.file = earlier AND before.scenario = own.scenario AND before.label = own.label "
        "AND before.model IS own.model "
        "GROUP BY home, kind, by_model, own.label, own.scenario "
        "ORDER BY own.scenario <> '', home, kind, own.scenario, by_model, total DESC, own.label",
        (EVENT_PAUSE,),
    )
    return [LabelAmount(*row) for row in rows]


def export_parquet(catalog: Catalog, path: Path) -> None:
    """Write the rows of a catalogue to a new Parquet file.

    Raise `LogError` if the file exists, or cannot be written.
    """
    import pyarrow as pa  # noqa: PLC0415  only for this
    import pyarrow.parquet as pq  # noqa: PLC0415  only for this

    amount = [("label", pa.string()), ("minutes", pa.float64())]
    amount += [(name, pa.int64()) for name in ("segments", "events")]
    scenario = [("scenario", pa.string()), ("model", pa.string()), *amount]
    own = {"labels": pa.list_(pa.struct(amount)), "scenarios": pa.list_(pa.struct(scenario))}
    own |= dict.fromkeys(("first_frame", "last_frame"), pa.uint64())
    own |= dict.fromkeys(_MOMENTS, pa.timestamp("ns", "UTC"))
    kinds: dict[Any, pa.DataType] = {str: pa.string(), str | None: pa.string()}
    kinds |= {int: pa.int64(), int | None: pa.int64(), float: pa.float64()}
    kinds |= {Sequence[str]: pa.list_(pa.string())}
    schema = pa.schema(
        (field.name, own.get(field.name) or kinds[field.type]) for field in fields(CatalogRow)
    )
    rows = catalog.rows()
    with new_file(path) as temporary, pq.ParquetWriter(temporary, schema) as writer:
        while batch := list(islice(rows, _BATCH)):
            writer.write_table(pa.Table.from_pylist([vars(row) for row in batch], schema))
