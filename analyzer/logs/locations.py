"""Locations of logs in folders and stores: listings, sizes, times and a span index."""

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
_OURS = {"fsspec", "s3fs", "upath", ""}  # packages of the extra `cluster`; empty if unknown
# A cached listing hides files that other programs added since.
_FRESH: dict[str, Any] = {"use_listings_cache": False}
# botocore backs off where a store throttles requests. s3fs tries five times on top of
# botocore's retries: a silent server fails after four minutes.
_S3 = _FRESH | {
    "config_kwargs": {"retries": {"mode": "standard", "total_max_attempts": 5}, "read_timeout": 10}
}
_OPTIONS: dict[str, dict[str, Any]] = {
    "s3": _S3,
    "s3a": _S3,
    **dict.fromkeys(("gs", "gcs", "az", "abfs", "adl"), _FRESH),
}


def location(text: str) -> Path:
    """Parse the path of a log or a folder, local or in a store supported by fsspec.

    Raise `LogError` if the kind of store is unknown or its package is not installed.
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
            path.fs.root_marker  # noqa: B018  creates the file system
    except ImportError as error:
        raise LogError(f"{text}: {error}; {_remedy(error)}") from error
    # UPath behaves like a Path here, but is none for the type checker.
    return cast("Path", path)


def _remedy(error: ImportError) -> str:
    """Return how to install the missing package: our extra, or a package that fsspec needs."""
    missing = error if error.__cause__ is None else error.__cause__
    name = getattr(missing, "name", None) or ""
    return f"try: pip install {name}" if name not in _OURS else remedy("fsspec")


_TIMES = ("mtime", "LastModified", "last_modified", "updated", "created")  # keys vary by store
_NAME = attrgetter("name")
UNSURE = -1
_YOUNG = 5 * NANOSECONDS  # since a folder changed: a disk's clock may be this coarse


class ListedLog(NamedTuple):
    """A log file as listed by its folder."""

    name: str  # path within the folder, with `/`
    size: int  # bytes
    mtime: int  # nanoseconds of UTC


class KnownFolder(NamedTuple):
    """State of a folder when it was last listed."""

    changed: int  # ns of UTC; `UNSURE` if this time cannot reveal a later change
    inner: Sequence[str]  # names of its subfolders
    logs: int  # number of logs


class Listing(NamedTuple):
    """Logs and folders found in a folder."""

    logs: list[ListedLog]  # sorted by name
    folders: dict[str, int]  # change times of the listed folders, as in `KnownFolder`
    unchanged: list[str]  # known folders that were not listed again


def list_logs(folder: Path, known: Mapping[str, KnownFolder] = MappingProxyType({})) -> Listing:
    """List the logs in a folder with size and modification time, without opening them.

    Parameters
    ----------
    known : mapping of str to KnownFolder
        By name, as in `Listing`; local folders only. Logs of unchanged folders are not listed.

    Raises
    ------
    LogError
        As `find_logs` does.
    """
    found = _list_local(folder, known) if is_local(folder) else _list_stored(folder)
    if not found.logs and not any(known[name].logs for name in found.unchanged):
        find_logs(folder)  # raises the error with its reason
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
        except OSError:  # deleted, or no permission
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
    except OSError:  # deleted, or reading it will report the error
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
    # Folders of a store are only name prefixes, without a change time.
    return Listing([log for log in logs if ENROLLED not in log.name.split("/")[:-1]], {}, [])


def size_and_time(path: Path) -> tuple[int, int]:
    """Return size (bytes) and modification time (ns) of a file, to detect changes.

    Raise `LogError` if there is no such file, or its store cannot be used.
    """
    with store_errors(path):
        if is_local(path):
            status = path.stat()
            return status.st_size, status.st_mtime_ns
        stored: Any = path
        return _stored_size_and_time(stored.fs.info(stored.path))


def _stored_size_and_time(about: Mapping[str, Any]) -> tuple[int, int]:
    """Return size and time from a store's metadata; objects are replaced, never modified."""
    time = next((about[name] for name in _TIMES if about.get(name) is not None), 0)
    if isinstance(time, str):
        time = datetime.fromisoformat(time)
    if isinstance(time, datetime):
        time = time.timestamp()
    return int(about["size"] or 0), int(time * NANOSECONDS)


def catalogued_name(name: str) -> str:
    """Return a file name as text for the catalogue; undecodable bytes are replaced."""
    if name.isascii():
        return name
    return name.encode(errors="surrogateescape").decode(errors="replace")


NEVER = -1
SPAN = np.dtype(
    [("start", "<i8"), ("end", "<i8"), ("size", "<i8"), ("mtime", "<i8"), ("finished", "?")]
)  # of a log; times are ns of UTC, `NEVER` if unknown
_FOLDER = np.dtype([("changed", "<i8"), ("logs", "<i8")])  # change time and number of logs
_HEAD = struct.Struct("<24s4Q")  # magic; counts of folders and logs; bytes of the names of both
_MAGIC = b"hearthlog index of logs\x01"  # the last byte is the version of the format
_DIGEST = hashlib.sha256().digest_size
_LIMIT = 1 << 30  # bytes of a file: about ten million logs
_CODING = "utf-8", "surrogateescape"  # file names are bytes
_END = b"\0"  # terminator of a name


class SpanIndex:
    """Index of a catalogue: logs by number, with their folders and time spans.

    Parameters
    ----------
    names : bytes
        Names of the logs, each terminated by a zero byte.
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
        """Return the numbers of the logs directly in some folders."""
        logs = [
            range(self._firsts[name], self._firsts[name] + self.folders[name].logs)
            for name in folders
        ]
        return np.fromiter(chain.from_iterable(logs), np.int64)

    def find(self, listed: ListedLog) -> int | None:
        """Return the number of a log; None if the log is unknown or has changed."""
        folder, _, name = listed.name.rpartition("/")
        log = self._logs_of(folder).get(name)
        return log if log is not None and self.is_as(log, *listed[1:]) else None

    def is_as(self, log: int, size: int, mtime: int) -> bool:
        """Whether a log still has the indexed size and modification time."""
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
    """Write the index of a catalogue, next to the catalogue.

    Raise `LogError` if the index cannot be written.
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
    """Read the index of a folder's catalogue; None if there is no usable index."""
    read = _read(folder)
    return read if isinstance(read, SpanIndex) else None


def what_is_wrong(folder: Path) -> str | None:
    """Return why the index of a catalogue cannot be used; None if usable or missing."""
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
    """Whether adding a file updates the folder's change time; some mounts do not."""
    return index.stat().st_mtime_ns <= index.parent.stat().st_ctime_ns


def _parsed(data: bytes, *, is_timed: bool) -> SpanIndex:
    """Parse an index; raise ValueError if it is not valid."""
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
    """Split the folder names of an index."""
    names = paths.decode(*_CODING).split("\0")[:-1]
    if len({*names}) != count or any(".." in name.split("/") for name in names):
        raise ValueError("its parts do not fit")
    return names


def _tree(
    paths: Sequence[str], times: Sequence[int], counts: Sequence[int]
) -> dict[str, KnownFolder]:
    """Build the known folders, each with the names of its subfolders."""
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
    """Logs of a folder with spans in the index of its catalogue."""

    folder: Path
    by: SpanIndex
    logs: Int64

    def path(self, number: int) -> Path:
        return self.by.path(self.folder, int(self.logs[number]))


class LogSpans:
    """Spans of many logs; paths are the dominant cost, so they are built only when needed."""

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
        """Return the logs with messages in a span of time, without duplicates, in order of time."""
        return self._in_time(np.flatnonzero(overlaps(self._firsts, self._lasts, start, end)))

    def before(self, time: int) -> Iterator[Path]:
        """Yield the logs with messages before a time, without duplicates, latest first."""
        numbers = np.flatnonzero(self._firsts < time)
        order = numbers[np.lexsort((self._lasts[numbers], self._firsts[numbers]))[::-1]]
        for _, same in groupby(order, lambda number: (self._firsts[number], self._lasts[number])):
            yield from (path for _, _, path in reversed(self._in_time(sorted(same))))

    def _in_time(self, numbers: Iterable[int]) -> list[LogSpan]:
        spans = ((int(self._firsts[n]), int(self._lasts[n]), self._path(n)) for n in numbers)
        once = {str(span[2].resolve()): span for span in spans}  # a log may have several names
        # Local paths and paths of a store do not compare; their parts do.
        return sorted(once.values(), key=lambda span: (*span[:2], span[2].parts))

    def _path(self, number: int) -> Path:
        group = int(np.searchsorted(self._begins, number, side="right"))
        if group == 0:
            return self._opened[number][2]
        return self._known[group - 1].path(number - int(self._begins[group - 1]))


def overlaps(firsts: Int64, lasts: Int64, start: int | None, end: int | None) -> Bool:
    """Return which spans overlap the span from `start` on, before `end`."""
    chosen = np.ones(len(firsts), bool)
    if start is not None:
        chosen &= lasts >= start
    if end is not None:
        chosen &= firsts < end
    return chosen


def find_spans(
    paths: Iterable[Path], span_of: SpanOf, start: int | None = None, end: int | None = None
) -> LogSpans:
    """Find the logs of some folders with their first and last log times.

    Parameters
    ----------
    span_of : callable
        Returns first and last log time of a log without a current catalogue entry; None drops the
        log.
    start, end : int, optional
        Log times in nanoseconds of UTC, from `start` on, before `end`: outside of this span,
        catalogue entries of finished logs are trusted without a check.

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
    """Divide the logs of a folder into logs with known spans and logs to open."""
    listing = list_logs(folder, index.folders)
    logs = index.logs_in(listing.unchanged)
    spans = index.spans[logs]
    timed = spans["start"] != NEVER
    doubtful = timed & (overlaps(spans["start"], spans["end"], start, end) | ~spans["finished"])
    known: list[int] = logs[timed & ~doubtful].tolist()
    untimed = [index.path(folder, log) for log in logs[~timed].tolist()]
    for log in logs[doubtful].tolist():
        path = index.path(folder, log)
        if _is_current(index, log, path):
            known.append(log)
        else:
            untimed.append(path)
    for listed in listing.logs:
        found = index.find(listed)
        if found is None or index.spans["start"][found] == NEVER:
            untimed.append(folder.joinpath(*listed.name.split("/")))
        else:
            known.append(found)
    return _Known(folder, index, np.array(known, np.int64)), untimed


def _is_current(index: SpanIndex, log: int, path: Path) -> bool:
    try:
        return index.is_as(log, *size_and_time(path))
    except LogError:
        return False
