"""The files in a folder, by name, size and time of change: what is compared with a catalogue."""

import os
from collections.abc import Mapping, Sequence
from datetime import datetime
from operator import attrgetter
from pathlib import Path
from time import time_ns
from types import MappingProxyType
from typing import Any, NamedTuple

from hearthlog.schemas.files import is_local, store_errors
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.files import ENROLLED, SUFFIX, find_logs, look_into
from hearthlog.schemas.mcap.logfile import ACTIVE_SUFFIX

_TIMES = ("mtime", "LastModified", "last_modified", "updated", "created")  # of different stores
_NAME = attrgetter("name")
UNSURE = -1
_YOUNG = 5 * NANOSECONDS  # since a folder changed: the clock of a disk may stand still for so long


class ListedLog(NamedTuple):
    """A file as its folder lists it."""

    name: str  # path within the folder, with `/`
    size: int  # bytes
    mtime: int  # nanoseconds of UTC


class KnownFolder(NamedTuple):
    """A folder as it was when it was looked into."""

    changed: int  # ns of UTC; `UNSURE` if a change since then could not be told by that
    inner: Sequence[str]  # names of the folders in it
    logs: int  # how many


class Listing(NamedTuple):
    """What there is in a folder."""

    logs: list[ListedLog]  # by name
    folders: dict[str, int]  # when those that were looked into had changed, as in `KnownFolder`
    unchanged: list[str]  # known folders into which nobody needed to look


def list_logs(folder: Path, known: Mapping[str, KnownFolder] = MappingProxyType({})) -> Listing:
    """List the logs in a folder, with what tells that they have changed, and open none of them.

    Parameters
    ----------
    known : mapping of str to KnownFolder
        By name, as in `Listing`; of this machine only. Logs of those that did not change are not
        listed.

    Raises
    ------
    LogError
        As `find_logs` does.
    """
    found = _list_local(folder, known) if is_local(folder) else _list_stored(folder)
    if not found.logs and not any(known[name].logs for name in found.unchanged):
        find_logs(folder)  # says why
    found.logs.sort(key=_NAME)
    return found


def _list_local(folder: Path, known: Mapping[str, KnownFolder]) -> Listing:
    found = Listing([], {}, [])
    sure = time_ns() - _YOUNG
    waiting = [""]
    while waiting:
        name = waiting.pop()
        path, prefix = (f"{folder}/{name}", f"{name}/") if name else (str(folder), "")
        try:
            changed = os.stat(path).st_ctime_ns  # noqa: PTH116  no Path for each folder
        except OSError:  # it has gone, or must not be looked into
            continue
        before = known.get(name)
        if before and before.changed == changed and os.access(path, os.R_OK):
            found.unchanged.append(name)
            waiting += [prefix + inner for inner in before.inner]
            continue
        inside = look_into(path)
        found.folders[name] = changed if inside.is_all and changed < sure else UNSURE
        found.logs.extend(_listed(prefix + entry.name, entry) for entry in inside.logs)
        waiting += [prefix + entry.name for entry in inside.folders if entry.name != ENROLLED]
    return found


def _listed(name: str, entry: "os.DirEntry[str]") -> ListedLog:
    try:
        about = entry.stat()
    except OSError:  # it has gone, or reading it will say what is wrong
        return ListedLog(name, -1, -1)
    return ListedLog(name, about.st_size, about.st_mtime_ns)


def _list_stored(folder: Any) -> Listing:
    with store_errors(folder):
        files: Mapping[str, Mapping[str, Any]] = folder.fs.find(folder.path, detail=True)
    start = len(folder.path.rstrip("/")) + 1
    logs = [
        ListedLog(path[start:], *_stored_size_and_time(about))
        for path, about in files.items()
        if path.endswith((SUFFIX, ACTIVE_SUFFIX))
    ]
    # Folders of a store are parts of names: nothing tells that one has changed.
    return Listing([log for log in logs if ENROLLED not in log.name.split("/")[:-1]], {}, [])


def size_and_time(path: Path) -> tuple[int, int]:
    """Return bytes and time of change (ns) of a file, by which a changed one is known.

    Raise `LogError` if there is no such file, or its store cannot be used.
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
