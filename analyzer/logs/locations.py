"""The logs of a folder or a store: their locations, sizes and times, and an index of them."""

import hashlib
import os
import re
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from datetime import datetime
from functools import cache
from itertools import accumulate, chain, groupby
from operator import attrgetter
from pathlib import Path
from time import time_ns
from types import MappingProxyType
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.extras import remedy
from hearthlog.schemas.arrays import Bool, Int64
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.files import is_local, open_file, store_errors
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.files import (
    CATALOG_INDEX,
    ENROLLED,
    SUFFIX,
    find_logs,
    log_readers,
    look_into,
)
from hearthlog.schemas.logs.merged_reading import time_spans
from hearthlog.schemas.mcap.logfile import ACTIVE_SUFFIX
from hearthlog.schemas.new_files import replaced_file

_URL = re.compile(r"([A-Za-z][A-Za-z0-9+.-]*)://(.*)", re.DOTALL)
_FILES = {"file", "local"}
_OURS = {"fsspec", "s3fs", "upath", ""}  # what the extra `cluster` installs, or nobody knows
# A listing that is kept hides what others put there since.
_FRESH: dict[str, Any] = {"use_listings_cache": False}
# botocore waits longer each time where a store says that it is asked too often. s3fs tries five
# times whatever botocore tried: a silent server is given up after four minutes.
_S3 = _FRESH | {
    "config_kwargs": {"retries": {"mode": "standard", "total_max_attempts": 5}, "read_timeout": 10}
}
_OPTIONS: dict[str, dict[str, Any]] = {
    "s3": _S3,
    "s3a": _S3,
    **dict.fromkeys(("gs", "gcs", "az", "abfs", "adl"), _FRESH),
}


def location(text: str) -> Path:
    """Read the name of a log or a folder, on this machine or in a store that fsspec knows.

    Raise `LogError` if there is no such kind of store, or its package is not installed.
    """
    url = _URL.fullmatch(text)
    if url is None:
        return Path(text)
    scheme, rest = url[1].lower(), url[2]
    return Path(rest) if scheme in _FILES else _stored(scheme, rest)


def _stored(scheme: str, rest: str) -> Path:
    text = f"{scheme}://{rest}"
    try:
        with store_errors(text):
            import fsspec  # noqa: PLC0415  part of the extra `cluster`
            from upath import UPath  # noqa: PLC0415  part of the extra `cluster`

            options = _OPTIONS.get(scheme, {}) | fsspec.config.conf.get(scheme, {})
            path = UPath(text, **options)
            path.fs.root_marker  # noqa: B018  makes it
    except ImportError as error:
        raise LogError(f"{text}: {error}; {_remedy(error)}") from error
    # It does all that is asked of a Path here, but is none for the type checker.
    return cast("Path", path)


def _remedy(error: ImportError) -> str:
    """Say how to install what could not be imported: our extra, or a package of fsspec's."""
    missing = error if error.__cause__ is None else error.__cause__
    name = getattr(missing, "name", None) or ""
    return f"try: pip install {name}" if name not in _OURS else remedy("fsspec")


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


NEVER = -1
SPAN = np.dtype(
    [("start", "<i8"), ("end", "<i8"), ("size", "<i8"), ("mtime", "<i8"), ("finished", "?")]
)  # of a log; times are ns of UTC, `NEVER` if not known
_FOLDER = np.dtype([("changed", "<i8"), ("logs", "<i8")])  # and the number of its logs
_HEAD = struct.Struct("<24s4Q")  # folders, logs, bytes of the names of both
_MAGIC = b"hearthlog index of logs\x01"  # the number stands for all that follows
_DIGEST = hashlib.sha256().digest_size
_LIMIT = 1 << 30  # bytes of a file: those of ten million logs
_CODING = "utf-8", "surrogateescape"  # names of files are bytes
_END = b"\0"  # of a name


class SpanIndex:
    """The logs that a catalogue knows, by number, and the folders that they are in.

    Parameters
    ----------
    names : bytes
        Names of the logs, each with a zero behind it.
    """

    def __init__(
        self, folders: Mapping[str, KnownFolder], spans: NDArray[np.void], names: bytes
    ) -> None:
        self.folders = folders
        self.spans = spans
        self._names = names
        self._ends = _ends(names)
        self._order = list(folders)
        counts = [folder.logs for folder in folders.values()]
        self._lasts: Int64 = np.cumsum(counts, dtype=np.int64)
        self._firsts = dict(zip(folders, (self._lasts - counts).tolist(), strict=True))
        self._logs_of = cache(self._named)

    def path(self, root: Path, log: int) -> Path:
        """Return the path of a log; `root` is the folder of the catalogue."""
        folder = self._order[int(np.searchsorted(self._lasts, log, side="right"))]
        return root.joinpath(*folder.split("/") if folder else (), self._name(log))

    def logs_in(self, folders: Iterable[str]) -> Int64:
        """Return the numbers of the logs in some folders, without those of folders inside."""
        logs = [
            range(self._firsts[name], self._firsts[name] + self.folders[name].logs)
            for name in folders
        ]
        return np.fromiter(chain.from_iterable(logs), np.int64)

    def find(self, listed: ListedLog) -> int | None:
        """Return the number of a log; None if there is none, or the log was changed since."""
        folder, _, name = listed.name.rpartition("/")
        log = self._logs_of(folder).get(name)
        return log if log is not None and self.is_as(log, *listed[1:]) else None

    def is_as(self, log: int, size: int, mtime: int) -> bool:
        """Tell whether a log has the size and the time of change that it had."""
        return (self.spans["size"][log], self.spans["mtime"][log]) == (size, mtime)

    def _named(self, folder: str) -> dict[str, int]:
        logs = self.logs_in({folder} & self.folders.keys()).tolist()
        return {self._name(log): log for log in logs}

    def _name(self, log: int) -> str:
        begin = self._ends[log - 1] + 1 if log else 0
        return self._names[begin : self._ends[log]].decode(*_CODING)


def _ends(names: bytes) -> Int64:
    return np.flatnonzero(np.frombuffer(names, np.uint8) == ord(_END))


def write_index(folder: Path, listing: Listing, spans: NDArray[np.void]) -> None:
    """Write the index of a catalogue, beside it.

    Raise `LogError` if it cannot be written.
    """
    logs_of: dict[str, list[int]] = {name: [] for name in listing.folders}
    names = []
    for number, log in enumerate(listing.logs):
        parent, _, name = log.name.rpartition("/")
        logs_of.setdefault(parent, []).append(number)
        names.append(name)
    rows = [(listing.folders.get(name, UNSURE), len(logs)) for name, logs in logs_of.items()]
    order = [log for logs in logs_of.values() for log in logs]
    texts = _joined(logs_of), _joined(names[log] for log in order)
    head = _HEAD.pack(_MAGIC, len(rows), len(order), *map(len, texts))
    data = b"".join([head, np.array(rows, _FOLDER).tobytes(), spans[order].tobytes(), *texts])
    put = replaced_file(folder / CATALOG_INDEX, readers=log_readers(folder))
    with put as temporary, temporary.open("wb") as stream:
        stream.writelines([data, hashlib.sha256(data).digest()])


def _joined(names: Iterable[str]) -> bytes:
    return b"".join(name.encode(*_CODING) + _END for name in names)


def read_index(folder: Path) -> SpanIndex | None:
    """Read the index of the catalogue of a folder; None if there is none that can be used."""
    read = _read(folder)
    return read if isinstance(read, SpanIndex) else None


def what_is_wrong(folder: Path) -> str | None:
    """Say why the index of a catalogue cannot be used; None if it can be, or there is none."""
    read = _read(folder)
    return read if isinstance(read, str) else None


def _read(folder: Path) -> SpanIndex | str | None:
    path = folder / CATALOG_INDEX
    try:
        with store_errors(path):
            if not path.exists():
                return None
        with closing(open_file(path)) as file:
            data = file.read(0, min(file.size, _LIMIT))
        return _parsed(data, is_timed=is_local(path) and _keeps_times(path))
    except (LogError, OSError, ValueError) as error:
        reason = str(error).removeprefix(f"{path}: ")
        return f"{path}: cannot be used as the index of a catalogue ({reason})"


def _keeps_times(index: Path) -> bool:
    """Tell whether a folder changes when a file comes: not all that can be mounted does so."""
    return index.stat().st_mtime_ns <= index.parent.stat().st_ctime_ns


def _parsed(data: bytes, *, is_timed: bool) -> SpanIndex:
    """Take an index apart; raise ValueError if it is not sound."""
    rest = memoryview(data)[:-_DIGEST]
    if len(rest) < _HEAD.size or hashlib.sha256(rest).digest() != data[-_DIGEST:]:
        raise ValueError("it is damaged, or was not made by hearthlog")
    magic, folders, logs, *lengths = _HEAD.unpack_from(rest)
    if magic != _MAGIC:
        raise ValueError("it is of another version of hearthlog")
    sizes = folders * _FOLDER.itemsize, logs * SPAN.itemsize, *lengths
    *places, end = accumulate(sizes, initial=_HEAD.size)
    if end != len(rest):
        raise ValueError("its parts do not fit")
    about = np.frombuffer(rest, _FOLDER, folders, places[0])
    spans = np.frombuffer(rest, SPAN, logs, places[1])
    texts = bytes(rest[places[2] : places[3]]), bytes(rest[places[3] :])
    counts = about["logs"].tolist()
    paths = _split(texts[0], folders)
    if sum(counts) != logs or min(counts) < 0 or texts[1].count(_END) != logs or b"/" in texts[1]:
        raise ValueError("its parts do not fit")
    times = about["changed"].tolist() if is_timed else [UNSURE] * folders
    return SpanIndex(_tree(paths, times, counts), spans, texts[1])


def _split(paths: bytes, count: int) -> list[str]:
    """Take the names of folders apart."""
    names = paths.decode(*_CODING).split("\0")[:-1]
    if len({*names}) != count or any(".." in name.split("/") for name in names):
        raise ValueError("its parts do not fit")
    return names


def _tree(
    paths: Sequence[str], times: Sequence[int], counts: Sequence[int]
) -> dict[str, KnownFolder]:
    """Tell of each folder which ones are in it."""
    inner: dict[str, list[str]] = {path: [] for path in paths}
    for path in paths:
        parent, _, name = path.rpartition("/")
        if path and parent in inner:
            inner[parent].append(name)
    return {
        path: KnownFolder(time, inner[path], count)
        for path, time, count in zip(paths, times, counts, strict=True)
    }


SpanOf = Callable[[Path], tuple[int, int] | None]
LogSpan = tuple[int, int, Path]  # log times of the first and the last message (ns of UTC), the log


class _Known(NamedTuple):
    """Logs of a folder of which the index of its catalogue knows the spans."""

    folder: Path
    by: SpanIndex
    logs: Int64

    def path(self, number: int) -> Path:
        return self.by.path(self.folder, int(self.logs[number]))


class LogSpans:
    """The spans of many logs: a path costs more than all else here, so few are made."""

    def __init__(self, opened: Sequence[LogSpan], known: Sequence[_Known]) -> None:
        self._opened = opened
        self._known = known
        spans = [each.by.spans[each.logs] for each in known]
        firsts, lasts = [first for first, _, _ in opened], [last for _, last, _ in opened]
        self._firsts: Int64 = np.concatenate(
            [np.array(firsts, np.int64), *(s["start"] for s in spans)]
        )
        self._lasts: Int64 = np.concatenate([np.array(lasts, np.int64), *(s["end"] for s in spans)])
        self._begins = np.cumsum([len(opened), *(len(each.logs) for each in known)])

    def within(self, start: int | None, end: int | None) -> list[LogSpan]:
        """Return the logs with messages in a span of time, each once, in the order of time."""
        return self._in_time(np.flatnonzero(overlaps(self._firsts, self._lasts, start, end)))

    def before(self, time: int) -> Iterator[Path]:
        """Return the logs with messages before a time, each once, the last first."""
        numbers = np.flatnonzero(self._firsts < time)
        order = numbers[np.lexsort((self._lasts[numbers], self._firsts[numbers]))[::-1]]
        for _, same in groupby(order, lambda number: (self._firsts[number], self._lasts[number])):
            yield from (path for _, _, path in reversed(self._in_time(sorted(same))))

    def _in_time(self, numbers: Iterable[int]) -> list[LogSpan]:
        spans = ((int(self._firsts[n]), int(self._lasts[n]), self._path(n)) for n in numbers)
        once = {str(span[2].resolve()): span for span in spans}  # a log may have several names
        # Paths of this machine and of a store do not compare; their parts do.
        return sorted(once.values(), key=lambda span: (*span[:2], span[2].parts))

    def _path(self, number: int) -> Path:
        group = int(np.searchsorted(self._begins, number, side="right"))
        if group == 0:
            return self._opened[number][2]
        return self._known[group - 1].path(number - int(self._begins[group - 1]))


def overlaps(firsts: Int64, lasts: Int64, start: int | None, end: int | None) -> Bool:
    """Tell of spans of time whether they have a part in another one."""
    chosen = np.ones(len(firsts), bool)
    if start is not None:
        chosen &= lasts >= start
    if end is not None:
        chosen &= firsts < end
    return chosen


def find_spans(
    paths: Iterable[Path], span_of: SpanOf, start: int | None = None, end: int | None = None
) -> LogSpans:
    """Find the logs of some folders, and when they begin and end.

    Parameters
    ----------
    span_of : callable
        Returns first and last log time of a log of which no catalogue knows them as it is now; None
        leaves it out.
    start, end : int, optional
        Log times in nanoseconds of UTC, from `start` on, before `end`: of finished logs outside of
        them the catalogue is believed.

    Raises
    ------
    LogError
        If there is no such log, or none in a folder.
    """
    known: list[_Known] = []
    unknown: dict[str, Path] = {}
    for path in paths:
        index = read_index(path)
        if index is None:
            logs = find_logs(path)
        else:
            found, logs = _looked_up(path, index, start, end)
            known.append(found)
        unknown |= {str(log.resolve()): log for log in logs}
    return LogSpans(time_spans(unknown.values(), span_of), known)


def _looked_up(
    folder: Path, index: SpanIndex, start: int | None, end: int | None
) -> tuple[_Known, list[Path]]:
    """Divide the logs of a folder into those whose spans are known, and those to be asked."""
    listing = list_logs(folder, index.folders)
    logs = index.logs_in(listing.unchanged)
    spans = index.spans[logs]
    timed = spans["start"] != NEVER
    doubtful = timed & (overlaps(spans["start"], spans["end"], start, end) | ~spans["finished"])
    known: list[int] = logs[timed & ~doubtful].tolist()
    asked = [index.path(folder, log) for log in logs[~timed].tolist()]
    for log in logs[doubtful].tolist():
        path = index.path(folder, log)
        if _is_current(index, log, path):
            known.append(log)
        else:
            asked.append(path)
    for listed in listing.logs:
        found = index.find(listed)
        if found is None or index.spans["start"][found] == NEVER:
            asked.append(folder.joinpath(*listed.name.split("/")))
        else:
            known.append(found)
    return _Known(folder, index, np.array(known, np.int64)), asked


def _is_current(index: SpanIndex, log: int, path: Path) -> bool:
    try:
        return index.is_as(log, *size_and_time(path))
    except LogError:
        return False
