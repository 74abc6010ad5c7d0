"""The files in a folder, by name, size and time of change: what is compared with a catalogue."""

from collections.abc import Mapping
from datetime import datetime
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

from hearthlog.schemas.logs.files import ENROLLED, SUFFIX, find_logs, walk_logs
from hearthlog.schemas.mcap.logfile import ACTIVE_SUFFIX
from hearthlog.schemas.storage.byte_ranges import is_local, store_errors
from hearthlog.schemas.times import NANOSECONDS

_TIMES = ("mtime", "LastModified", "last_modified", "updated", "created")  # of different stores
_NAME = attrgetter("name")


class ListedLog(NamedTuple):
    """A file as its folder lists it."""

    name: str  # path within the folder, with `/`
    size: int  # bytes
    mtime: int  # nanoseconds of UTC
    is_link: bool


def list_logs(folder: Path) -> list[ListedLog]:
    """List the logs in a folder, with what tells that they have changed, and open none of them.

    Parameters
    ----------
    folder : Path
        On this machine, or a `upath.UPath` of a store.

    Returns
    -------
    list of ListedLog
        Those that `find_logs` finds, by name.

    Raises
    ------
    LogError
        As `find_logs` does.
    """
    listed = _list_local(folder) if is_local(folder) else _list_stored(folder)
    logs = [log for log in listed if ENROLLED not in log.name.split("/")[:-1]]
    if not logs:
        find_logs(folder)  # says why
    return sorted(logs, key=_NAME)


def _list_local(folder: Path) -> list[ListedLog]:
    start = len(str(folder / "x")) - 1
    logs = []
    for entry in walk_logs(folder):
        try:
            about = entry.stat()
        except OSError:  # it has gone, or reading it will say what is wrong
            size_and_time = -1, -1
        else:
            size_and_time = about.st_size, about.st_mtime_ns
        name = entry.path[start:] if str(folder) != "." else entry.path.removeprefix("./")
        logs.append(ListedLog(name, *size_and_time, entry.is_symlink()))
    return logs


def _list_stored(folder: Any) -> list[ListedLog]:
    with store_errors(folder):
        files: Mapping[str, Mapping[str, Any]] = folder.fs.find(folder.path, detail=True)
    start = len(folder.path.rstrip("/")) + 1
    return [
        ListedLog(path[start:], *_stored_size_and_time(about), is_link=False)
        for path, about in files.items()
        if path.endswith((SUFFIX, ACTIVE_SUFFIX))
    ]


def size_and_time(path: Path) -> tuple[int, int]:
    """Return bytes and time of change (ns) of a file, by which a changed one is known.

    Raises
    ------
    LogError
        If there is no such file, or its store cannot be used.
    """
    with store_errors(path):
        if is_local(path):
            status = path.stat()
            return status.st_size, status.st_mtime_ns
        stored: Any = path
        return _stored_size_and_time(stored.fs.info(stored.path))


def _stored_size_and_time(about: Mapping[str, Any]) -> tuple[int, int]:
    """Take size and time from what a store says; an object is not changed, but made anew."""
    time = next((about[name] for name in _TIMES if about.get(name) is not None), 0)
    if isinstance(time, str):
        time = datetime.fromisoformat(time)
    if isinstance(time, datetime):
        time = time.timestamp()
    return int(about["size"] or 0), int(time * NANOSECONDS)


def catalogued_name(name: str) -> str:
    """Write a name as a catalogue does: names of files are bytes, those in a table are text."""
    if name.isascii():
        return name
    return name.encode(errors="surrogateescape").decode(errors="replace")
