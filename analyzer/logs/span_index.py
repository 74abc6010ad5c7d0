"""The index of a catalogue: when logs of all homes begin and end, read as arrays in one piece."""

import hashlib
import struct
from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing
from functools import cache
from itertools import accumulate, chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.logs.listing import UNSURE, KnownFolder, ListedLog, Listing
from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.files import is_local, open_file, store_errors
from hearthlog.schemas.logs.files import CATALOG_INDEX, log_readers
from hearthlog.schemas.new_files import replaced_file

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
