"""The messages of several logs as one series, in the order of time and within bounded memory."""

from collections.abc import Collection, Iterable, Iterator
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from schemas.chunks import RawMessages, read_chunks
from schemas.logfile import LogFile, time_span

_BATCH = 2 << 20  # bytes, uncompressed, that are read at once
_FIRST, _LAST = 0, (1 << 63) - 1  # log times


class _Log:
    """A log that is open, and the chunks of it that are wanted, by their start times."""

    def __init__(self, path: Path, query: "_Query") -> None:
        self.file = LogFile(path)
        self.chunks = query.wanted(self.file)
        self._ends = np.cumsum(self.chunks["size"])
        self._position = 0

    @property
    def start(self) -> int | None:
        """Start of the next chunk; None at the end."""
        if self._position == len(self.chunks):
            return None
        return int(self.chunks["start"][self._position])

    def next_chunks(self, until: int, size: int) -> NDArray[np.void]:
        """Hand out chunks that start up to a time, until they are of some size, at least one."""
        first = self._position
        read = int(self._ends[first - 1]) if first else 0
        last = min(
            np.searchsorted(self.chunks["start"], until, side="right"),
            np.searchsorted(self._ends, read + size),
        )
        self._position = max(int(last), first + 1)
        return self.chunks[first : self._position]


class _Query(NamedTuple):
    """What is wanted: topics, and log times from `start` on, before `end`."""

    topics: Collection[str] | None
    start: int
    end: int

    def wanted(self, file: LogFile) -> NDArray[np.void]:
        """Return the chunks that may hold a wanted message."""
        chunks = file.chunks[(file.chunks["end"] >= self.start) & (file.chunks["start"] < self.end)]
        if self.topics is None:
            return chunks
        others = {i for i, channel in file.channels.items() if channel.topic not in self.topics}
        wanted = [not ids or not ids <= others for ids in file.channel_sets]
        return chunks[np.array(wanted, bool)[chunks["channels"]]]


def iterate_messages(
    logs: Iterable[Path],
    topics: Collection[str] | None = None,
    start: int | None = None,
    end: int | None = None,
) -> Iterator[list[RawMessages]]:
    """Read the messages of some logs, still encoded.

    Parameters
    ----------
    logs : iterable of Path
    topics : collection of str, optional
        All by default.
    start, end : int, optional
        Log times, in nanoseconds: from `start` on, before `end`.

    Yields
    ------
    list of RawMessages
        Those of the next span of time, one or more for every channel that speaks in it. None
        is older than any that was yielded before.

    Raises
    ------
    LogError
        If a log is damaged.
    """
    query = _Query(topics, _FIRST if start is None else start, _LAST if end is None else end)
    pending: list[RawMessages] = []
    with closing(_Queue(logs, query)) as queue:
        while (until := queue.start) < _LAST or pending:
            ready = _between(pending, _FIRST, until)
            if ready:
                yield ready
            pending = _between(pending, until, _LAST)
            for file, chunks in queue.next_chunks():
                pending += _between(read_chunks(file, chunks, topics), query.start, query.end)


def _between(messages: list[RawMessages], start: int, end: int) -> list[RawMessages]:
    return [part for part in (m.between(start, end) for m in messages) if len(part)]


class _Queue:
    """The chunks of several logs by their start times; a log is open while it is needed."""

    def __init__(self, logs: Iterable[Path], query: _Query) -> None:
        self._query = query
        spans = sorted((*span, path) for path in logs if (span := time_span(path)) is not None)
        self._closed = [
            (first, path)
            for first, last, path in reversed(spans)
            if last >= query.start and first < query.end
        ]
        self._open: list[_Log] = []
        self._read: list[_Log] = []
        self._open_next()

    @property
    def start(self) -> int:
        """No chunk that is still to come starts earlier."""
        return min((_start(log) for log in self._open), default=_LAST)

    def next_chunks(self) -> list[tuple[LogFile, NDArray[np.void]]]:
        """Hand out the next chunks, together of a few megabytes, by log."""
        self._close_read()
        picked: dict[LogFile, list[NDArray[np.void]]] = {}
        size = 0
        while self._open and size < _BATCH:
            log = min(self._open, key=_start)
            others = [_start(other) for other in self._open if other is not log]
            until = min([*others, *(first for first, _ in self._closed[-1:])], default=_LAST)
            chunks = log.next_chunks(until, _BATCH - size)
            picked.setdefault(log.file, []).append(chunks)
            size += int(chunks["size"].sum())
            self._open_next()
        return [(file, np.concatenate(parts)) for file, parts in picked.items()]

    def close(self) -> None:
        """Close all logs."""
        self._read += self._open
        self._close_read()

    def _open_next(self) -> None:
        """Open the logs that may have the next chunk, and put aside those that have no more."""
        self._read += [log for log in self._open if log.start is None]
        self._open = [log for log in self._open if log.start is not None]
        while self._closed and (not self._open or self._closed[-1][0] <= self.start):
            log = _Log(self._closed.pop()[1], self._query)
            (self._read if log.start is None else self._open).append(log)

    def _close_read(self) -> None:
        for log in self._read:
            log.file.close()
        self._read.clear()


def _start(log: _Log) -> int:
    return _LAST if log.start is None else log.start
