"""State of the bridge that outlives it: one SQLite file of the state folder."""

import fcntl
import os
import sqlite3
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import closing, contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from threading import RLock
from typing import Generic, TypeVar

from pydantic import TypeAdapter, ValidationError

from hearthlog._version import __version__
from hearthlog.recorder.log.folder_lock import node_locks
from hearthlog.schemas.errors import HearthlogError
from hearthlog.schemas.files import read_limited
from hearthlog.schemas.logs.files import log_name, walk_logs
from hearthlog.schemas.logs.metadata import update_advice
from hearthlog.schemas.new_files import create_file, open_lock, private_folder

Report = Callable[[str], None]  # receives a line for the person who runs the bridge


class BridgeError(HearthlogError):
    """Error in the configuration or operation of the bridge."""


_OF_SYSTEMD = "STATE_DIRECTORY"  # one folder, or several with colons between them


def state_folder(configured: Path | None, logs: Path) -> Path:
    """Return the state folder, created if missing.

    It is the configured one, else the state directory of systemd, else `bridge` next to the logs.
    Raise `BridgeError` if the folder cannot be created.
    """
    given = os.environ.get(_OF_SYSTEMD, "").partition(":")[0]
    folder = configured or (Path(given) if given else logs.absolute().parent / "bridge")
    try:
        private_folder(folder)
    except OSError as error:
        raise BridgeError(
            f"{folder}: cannot be made ({error.strerror}); name another one: bridge.state"
        ) from error
    return folder


_NAME = "state.sqlite3"
_VERSION = 1  # of the tables; a bridge refuses a later one
_TABLE = """
    CREATE TABLE entries (
        node TEXT NOT NULL, name TEXT NOT NULL, content TEXT NOT NULL, PRIMARY KEY (node, name)
    ) WITHOUT ROWID
"""
# The first release that writes this version of the tables, for the error of an older release.
_WRITER_TABLE = "CREATE TABLE writer (hearthlog TEXT NOT NULL)"
_AGAIN_SECONDS = 60.0  # between attempts to open a file that could not be opened
_LARGEST = 4 << 20  # bytes of an entry
RETAINED = "mqtt"  # name of an entry; below it, with a slash, those of former recorder names
# Files of earlier versions in the state folder, as patterns, and their entries.
_FILES = {
    "alerts/rules.json": "rules",
    "alerts/lines.json": "addresses",
    "alerts/outbox/*.json": "outbox/",
    "totals.json": "totals",
    "mqtt-*.json": RETAINED,
}


class BridgeState:
    """Persistent entries of one recorder's bridge: JSON texts by name; thread-safe.

    An entry that was written survives a kill and a power cut. While the file cannot be used, as on
    a full disk, entries are kept in memory, and the file is tried again every minute. Recorders may
    share a folder. `report` is called with a line about a file that cannot be used.
    """

    def __init__(self, folder: Path, node: str, report: Report) -> None:
        self.folder = folder
        self.path = folder / _NAME
        self.node = node
        self._report = report
        self._lock = RLock()
        self._opened: sqlite3.Connection | None = None
        self._is_in_memory = False
        self._removed: set[str] = set()  # entries removed while they are kept in memory
        self._due = 0.0  # of the next attempt to open the file, by CLOCK_MONOTONIC
        self._descriptor: int | None = None

    def claim(self, logs: Path) -> None:
        """Lock the entries of the recorder, and adopt those of its former names.

        The folder of the recorder's logs tells whether it was renamed. Raise `BridgeError` if
        another bridge of the recorder uses the folder, or the file is of a later version.
        """
        with suppress(OSError):  # a disk that cannot be written: entries stay in memory
            private_folder(self.folder)
            self._descriptor = _locked(self.folder, self.node)
            if self._descriptor is None:
                raise BridgeError(
                    f"{self.folder}: is used by another bridge of {self.node}; stop that bridge, "
                    "or give each its own `state` in [bridge]"
                )
        with self._database() as database:
            nodes = {node for (node,) in database.execute("SELECT DISTINCT node FROM entries")}
        for former in sorted(nodes - {self.node}):
            if is_renamed(logs, self.node, former, is_first=self.node not in nodes):
                self._adopt(former)

    def read(self, name: str) -> str | None:
        """Return an entry; None if there is none."""
        query = "SELECT content FROM entries WHERE node = ? AND name = ?"
        with self._database() as database:
            row = database.execute(query, (self.node, name)).fetchone()
        return None if row is None else str(row[0])

    def names(self, prefix: str) -> list[str]:
        """Return the names of the entries that begin with a prefix, sorted."""
        query = "SELECT name FROM entries WHERE node = ? AND substr(name, 1, ?) = ? ORDER BY name"
        with self._database() as database:
            return [
                str(row[0]) for row in database.execute(query, (self.node, len(prefix), prefix))
            ]

    def write(self, name: str, content: str, obsolete: Collection[str] = ()) -> None:
        """Write an entry, and remove obsolete ones; on disk on return.

        Raise `sqlite3.Error` on a failure: nothing has changed then.
        """
        with self._database() as database, _transaction(database):
            database.execute(
                "INSERT OR REPLACE INTO entries VALUES (?, ?, ?)", (self.node, name, content)
            )
            self._remove(database, obsolete)

    def remove(self, names: Collection[str]) -> None:
        """Remove entries; raise `sqlite3.Error` on a failure."""
        with self._database() as database, _transaction(database):
            self._remove(database, names)

    def close(self) -> None:
        """Close the file, and release the lock."""
        with self._lock:
            if self._opened is not None:
                self._opened.close()
            self._opened = None
            if self._descriptor is not None:
                os.close(self._descriptor)
            self._descriptor = None

    def __del__(self) -> None:  # Python 3.13 warns of a connection that nobody closed
        if self._opened is not None:
            self._opened.close()

    def _remove(self, database: sqlite3.Connection, names: Collection[str]) -> None:
        database.executemany(
            "DELETE FROM entries WHERE node = ? AND name = ?", [(self.node, name) for name in names]
        )
        if self._is_in_memory:
            self._removed.update(names)

    @contextmanager
    def _database(self) -> Iterator[sqlite3.Connection]:
        with self._lock:
            if self._opened is None or (self._is_in_memory and time.monotonic() >= self._due):
                self._open()
            assert self._opened is not None
            yield self._opened

    def _open(self) -> None:
        """Open the file, or begin to keep entries in memory."""
        try:
            database = self._open_file()
            if self._opened is not None:
                self._carry_over(self._opened, database)
        except (OSError, sqlite3.Error) as error:
            self._due = time.monotonic() + _AGAIN_SECONDS
            self._report(
                f"{self.path}: cannot be used ({getattr(error, 'strerror', None) or error}); "
                "entries stay in memory until it can be"
            )
            if self._opened is None:
                self._opened, self._is_in_memory = self._copy(), True
            return
        self._is_in_memory = False
        self._opened = database
        self._take_files()

    def _carry_over(self, memory: sqlite3.Connection, database: sqlite3.Connection) -> None:
        """Bring the entries that were kept in memory into the file; close what is not used."""
        try:
            with _transaction(database):
                rows = memory.execute("SELECT * FROM entries WHERE node = ?", (self.node,))
                database.executemany("INSERT OR REPLACE INTO entries VALUES (?, ?, ?)", rows)
                self._remove(database, tuple(self._removed))
        except sqlite3.Error:
            database.close()
            raise
        memory.close()

    def _open_file(self) -> sqlite3.Connection:
        private_folder(self.folder)
        if self.path.is_symlink():
            raise OSError(0, "is a link")
        with suppress(FileExistsError):
            create_file(self.path).close()  # private; SQLite gives its other files the same mode
        try:
            return _open_database(self.path)
        except sqlite3.OperationalError:
            raise
        except sqlite3.DatabaseError as error:
            aside = self._set_aside()
            self._report(
                f"{self.path}: is damaged ({error}) and now called {aside}; the bridge starts "
                "over: muted classes are published, and alerts may come twice"
            )
            create_file(self.path).close()
            return _open_database(self.path)

    def _set_aside(self) -> str:
        stamp = f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}"
        for suffix in ("", "-wal", "-shm"):
            with suppress(FileNotFoundError):
                Path(f"{self.path}{suffix}").replace(f"{self.path}.damaged-{stamp}{suffix}")
        return f"{self.path.name}.damaged-{stamp}"

    def _copy(self) -> sqlite3.Connection:
        """Return the entries of a file that can only be read, if it can, in memory."""
        memory = sqlite3.connect(":memory:", check_same_thread=False, isolation_level=None)
        # Without a write-ahead log nothing needs to be created to read the file.
        has_log = self.path.with_name(f"{_NAME}-wal").is_file()
        address = f"{self.path.absolute().as_uri()}?{'mode=ro' if has_log else 'immutable=1'}"
        with suppress(sqlite3.Error), closing(sqlite3.connect(address, uri=True)) as source:
            source.backup(memory)
        with suppress(sqlite3.OperationalError):  # the table is there
            memory.execute(_TABLE)
        return memory

    def _take_files(self) -> None:
        """Move files of earlier versions into the database.

        A file whose entry is there is newer: a bridge of an earlier version has run since.
        """
        for pattern, name in _FILES.items():
            for path in sorted(self.folder.glob(pattern)):
                node = path.stem.partition("-")[2] if name == RETAINED else self.node
                own = f"{name}{path.stem}" if name.endswith("/") else name
                try:
                    content = read_limited(path, "file of the bridge", _LARGEST, BridgeError)
                    row = node, own, content.decode()
                    assert self._opened is not None
                    self._opened.execute("INSERT OR REPLACE INTO entries VALUES (?, ?, ?)", row)
                    path.unlink()
                except (HearthlogError, OSError, ValueError, sqlite3.Error) as error:
                    self._report(f"{path}: cannot be read ({error}) and is left there; remove it")
        for path in self.folder.glob(".mqtt-*.lock"):
            with suppress(OSError):
                path.unlink()
        for folder in ("alerts/outbox", "alerts"):
            with suppress(OSError):  # missing, or something else is in it
                (self.folder / folder).rmdir()

    def _adopt(self, former: str) -> None:
        """Take over the entries of a former name, unless its bridge runs; own entries are kept."""
        with suppress(OSError):
            descriptor = _locked(self.folder, former)
            if descriptor is None:
                return
            try:
                with self._database() as database, _transaction(database):
                    database.execute(
                        "UPDATE OR REPLACE entries SET name = ? WHERE node = ? AND name = ?",
                        (f"{RETAINED}/{former}", former, RETAINED),
                    )
                    database.execute(
                        "UPDATE OR IGNORE entries SET node = ? WHERE node = ?", (self.node, former)
                    )
                    database.execute("DELETE FROM entries WHERE node = ?", (former,))
            finally:
                os.close(descriptor)


def _open_database(path: Path) -> sqlite3.Connection:
    database = sqlite3.connect(path, check_same_thread=False, isolation_level=None)
    try:
        _prepare(database, path)
    except BaseException:
        database.close()
        raise
    return database


def _prepare(database: sqlite3.Connection, path: Path) -> None:
    """Create the table in a new database; raise `sqlite3.DatabaseError` if it is damaged."""
    database.execute("PRAGMA journal_mode = WAL")
    database.execute("PRAGMA synchronous = FULL")  # else a power cut undoes what was written
    (version,) = database.execute("PRAGMA user_version").fetchone()
    if version > _VERSION:
        raise BridgeError(
            f"{path}: was written by a later version of hearthlog; "
            f"{update_advice(_written_by(database))}, or name another folder with `state` in "
            "[bridge]"
        )
    (problem,) = database.execute("PRAGMA quick_check(1)").fetchone()
    if problem != "ok":
        raise sqlite3.DatabaseError(problem)
    if version < _VERSION:
        with _transaction(database):
            database.execute(_TABLE)
            database.execute(_WRITER_TABLE)
            database.execute("INSERT INTO writer VALUES (?)", (__version__,))
            database.execute(f"PRAGMA user_version = {_VERSION}")


def _written_by(database: sqlite3.Connection) -> object:
    """Return the release that the database names; None if it names none."""
    with suppress(sqlite3.Error):
        return next(iter(database.execute("SELECT hearthlog FROM writer").fetchone() or ()), None)
    return None


@contextmanager
def _transaction(database: sqlite3.Connection) -> Iterator[None]:
    database.execute("BEGIN IMMEDIATE")
    with database:
        yield


def _locked(folder: Path, node: str) -> int | None:
    """Lock the entries of a recorder; None if another bridge has the lock."""
    descriptor = open_lock(folder / f".bridge-{node}.lock")
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        return None
    return descriptor


Content = TypeVar("Content")


class StateEntry(Generic[Content]):
    """An entry of the bridge's state, checked by pydantic against `kind` when it is read.

    `damaged` and `unsaved` are the consequence, for `report`, of an entry that cannot be read, or
    written.
    """

    def __init__(  # noqa: PLR0913, PLR0917
        self,
        state: BridgeState,
        name: str,
        kind: type[Content],
        report: Report,
        damaged: str,
        unsaved: str,
    ) -> None:
        self._state = state
        self.name = name
        self._kind = TypeAdapter(kind)
        self._report = report
        self._damaged, self._unsaved = damaged, unsaved

    def load(self) -> Content | None:
        """Return the content; None if there is none, or it is reported to be damaged."""
        try:
            content = self._state.read(self.name)
            return None if content is None else self._kind.validate_json(content)
        except (ValidationError, sqlite3.Error):
            self.report_damage()
            return None

    def report_damage(self) -> None:
        """Report that the entry is damaged."""
        self._report(f"{self._state.path}, {self.name}: {self._damaged}")

    def save(self, content: Content, obsolete: Collection[str] = ()) -> bool:
        """Write the content, on disk on return; return False if the failure is reported.

        Obsolete entries are removed, by name, at the same moment.
        """
        try:
            self._state.write(self.name, self._kind.dump_json(content).decode(), obsolete)
        except sqlite3.Error as error:
            self._report(f"{self._state.path}: cannot be written ({error}); {self._unsaved}")
            return False
        return True


_RESTART_SECONDS = 2.0  # overlap up to which two logs do not count as simultaneous


def is_renamed(logs: Path, node: str, former: str, *, is_first: bool) -> bool:
    """Whether a former recorder of a folder was renamed to this one.

    True if the former recorder wrote logs there and no longer records, and this recorder wrote no
    log during that time, but later ones, or writes now. Two different recorders of one folder would
    write at the same time. It `is_first` if no bridge of this recorder ran before, so that it may
    have no log yet.
    """
    if former == node:
        return False
    locks = {each.node: each.is_held for each in node_locks(logs)}
    if locks.get(former, False) is not False:
        return False
    spans = _log_spans(logs, {node, former})
    own, theirs = spans[node], spans[former]
    if not theirs:  # the former recorder may write to another folder
        return False
    if not own:
        return is_first
    first, last = min(start for start, _ in theirs), max(end for _, end in theirs)
    is_since = max(start for start, _ in own) > last or bool(locks.get(node, False))
    return is_since and not any(start <= last and end >= first for start, end in own)


def _log_spans(folder: Path, nodes: Collection[str]) -> dict[str, list[tuple[str, str]]]:
    """Return the start and last write time of nodes' logs, formatted as in log names."""
    spans: dict[str, list[tuple[str, str]]] = {node: [] for node in nodes}
    for entry in walk_logs(folder):
        name = log_name(Path(entry.name))
        if name.node in spans and not name.layer:
            with suppress(OSError, ValueError, OverflowError):  # deleted, or an invalid time
                end = datetime.fromtimestamp(entry.stat().st_mtime - _RESTART_SECONDS, UTC)
                spans[name.node].append((name.time, max(name.time, f"{end:%Y%m%dT%H%M%SZ}")))
    return spans
