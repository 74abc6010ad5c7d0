"""Merged reading of several logs, ordered by time and in bounded memory."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from hearthlog.schemas.files import map_logs, prefetch
from hearthlog.schemas.logs.files import stated_span, time_span
from hearthlog.schemas.mcap.chunks import (
    OnDamage,
    TopicChoice,
    in_parts,
    is_chosen,
    read_chunks,
    read_sound,
    repeated_chunks,
)
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.mcap.raw_messages import RawMessages
from hearthlog.schemas.mcap.records import LIMIT, not_empty

_BATCH = 5 << 20  # bytes per batch, compressed plus decompressed
_READERS = 2  # threads: more would wait for each other's Python code
_WALKED = 4  # unfinished logs that stay open after the scan for their spans
_WALKED_ROWS = 1 << 18  # rows of their tables together: about 20 MB
_FIRST, _LAST = 0, (1 << 63) - 1  # log times


class Messages(Protocol):
    """Messages of one channel or topic, in order of log time, encoded or decoded."""

    def __len__(self) -> int: ...

    def between(self, start: int | None, end: int | None) -> Self:
        """Return the messages with start <= log time < end.

        Parameters
        ----------
        start, end : int or None
            Log times, in nanoseconds of UTC; None for no limit on that side.
        """


Piece = TypeVar("Piece", bound=Messages)


def time_spans(
    logs: Iterable[Path], span_of: Callable[[Path], tuple[int, int] | None] = time_span
) -> list[tuple[int, int, Path]]:
    """Return the first and the last log time of each log with messages, in nanoseconds of UTC.

    `span_of` returns those of a log, or None. Raise `LogError` if a log cannot be read, is not an
    MCAP file, or is damaged.
    """
    paths = list(logs)
    pairs = zip(map_logs(span_of, paths), paths, strict=True)
    spans = [(*span, path) for span, path in pairs if span is not None]
    # Local paths and paths in a store are not comparable; their parts are.
    return sorted(spans, key=lambda span: (*span[:2], tuple(span[2].parts)))


class _Log:
    """Open log with its requested chunks, sorted by start time."""

    def __init__(self, file: LogFile, query: "_Query") -> None:
        self.file = file
        self.chunks = query.chunks(self.file)
        sizes = self.chunks["size"] + self.chunks["length"]
        self._ends = np.cumsum(np.clip(sizes, 0, LIMIT))
        self._position = 0

    @property
    def start(self) -> int:
        """Start of the next chunk; `_LAST` at the end."""
        if self._position == len(self.chunks):
            return _LAST
        return int(self.chunks["start"][self._position])

    def next_chunks(self, until: int, size: int) -> NDArray[np.void]:
        """Return chunks that start up to a time, limited by size, but at least one."""
        first = self._position
        read = int(self._ends[first - 1]) if first else 0
        last = min(
            np.searchsorted(self.chunks["start"], until, side="right"),
            np.searchsorted(self._ends, read + size),
        )
        self._position = max(int(last), first + 1)
        return self.chunks[first : self._position]


class _Query(NamedTuple):
    """Topics and range of log times, from `start` on, before `end`."""

    topics: TopicChoice | None
    start: int
    end: int
    every: int = 1
    on_damage: OnDamage | None = None
    once: bool = False  # whether to skip repeated chunks

    def chunks(self, file: LogFile) -> NDArray[np.void]:
        """Return the chunks that may hold requested messages."""
        chunks = self._in_span(not_empty(file.chunks))[:: self.every]
        if self.once:
            chunks = chunks[~repeated_chunks(file, chunks)]
        chosen = self._of_topics(file, chunks)
        parts = in_parts(file, chosen, self.on_damage)
        return chosen if parts is chosen else self._of_topics(file, self._in_span(parts))

    def _in_span(self, chunks: NDArray[np.void]) -> NDArray[np.void]:
        return chunks[(chunks["end"] >= self.start) & (chunks["start"] < self.end)]

    def _of_topics(self, file: LogFile, chunks: NDArray[np.void]) -> NDArray[np.void]:
        if self.topics is None:
            return chunks
        others = {
            i for i, channel in file.channels.items() if not is_chosen(channel.topic, self.topics)
        }
        return file.with_channels(chunks, frozenset().union(*file.channel_sets) - others)

    def read(self, batch: "_Batch") -> list[RawMessages]:
        """Read the requested messages of a batch."""
        messages: list[RawMessages] = []
        for file, chunks in batch.parts:
            messages += _between(self._messages(file, chunks), self.start, self.end)
        return messages

    def _messages(self, file: LogFile, chunks: NDArray[np.void]) -> list[RawMessages]:
        if self.on_damage is None:
            return read_chunks(file, chunks, self.topics)
        return read_sound(file, chunks, self.topics, self.on_damage)


class _Batch(NamedTuple):
    """Chunks that are read at once."""

    parts: list[tuple[LogFile, NDArray[np.void]]]  # chunks by log
    until: int  # no later batch has an earlier message
    finished: list[LogFile]  # logs without further chunks


def iterate_messages(  # noqa: PLR0913
    logs: Iterable[Path],
    topics: TopicChoice | None = None,
    start: int | None = None,
    end: int | None = None,
    *,
    on_damage: OnDamage | None = None,
    once: bool = False,
) -> Iterator[list[RawMessages]]:
    """Yield the messages of several logs by spans of time, one or more items for each channel.

    No message is older than those yielded before. Log times are from `start` on, before `end`, in
    nanoseconds of UTC. With `once`, chunks that repeat an earlier one of their log byte for byte
    are skipped. Raise `LogError` if a log cannot be read, is not an MCAP file, or is damaged.
    """
    query = _query(topics, start, end)._replace(on_damage=on_damage, once=once)
    return _iterate(logs, query, list)


def iterate_pieces(  # noqa: PLR0913
    logs: Iterable[Path],
    topics: TopicChoice | None,
    start: int | None,
    end: int | None,
    function: Callable[[list[RawMessages]], list[Piece]],
    *,
    every: int = 1,
    on_damage: OnDamage | None = None,
) -> Iterator[list[Piece]]:
    """Yield results of a function of the messages of each span, computed in the reader threads.

    No result is older than those yielded before. `topics` has names, or is a predicate; None for
    all. Log times are from `start` on, before `end`, in nanoseconds of UTC. One of `every` chunks
    of a log is read, as a sample. Raise `LogError` if a log cannot be read, is not an MCAP file, or
    is damaged; also any error of `function`.
    """
    query = _query(topics, start, end)._replace(every=every, on_damage=on_damage)
    return _iterate(logs, query, function)


def _query(topics: TopicChoice | None, start: int | None, end: int | None) -> _Query:
    return _Query(topics, _FIRST if start is None else start, _LAST if end is None else end)


def _iterate(
    logs: Iterable[Path], query: _Query, function: Callable[[list[RawMessages]], list[Piece]]
) -> Iterator[list[Piece]]:
    def read(batch: _Batch) -> tuple[_Batch, list[Piece]]:
        return batch, function(query.read(batch))

    pending: list[Piece] = []
    with (
        _Queue(logs, query) as queue,
        closing(prefetch(read, queue.batches(), _READERS)) as batches,
    ):
        for batch, pieces in batches:
            pending += pieces
            ready = _between(pending, _FIRST, batch.until)
            if ready:
                yield ready
            pending = _between(pending, batch.until, _LAST)
            queue.close(batch.finished)


def _between(pieces: list[Piece], start: int, end: int) -> list[Piece]:
    return [part for part in (piece.between(start, end) for piece in pieces) if len(part)]


class _Queue:
    """Chunks of several logs by start time; each log is open only while it is needed."""

    def __init__(self, logs: Iterable[Path], query: _Query) -> None:
        self._query = query
        self._open: list[_Log] = []
        self._finished: list[LogFile] = []
        self._files: set[LogFile] = set()
        self._walked = _WalkedLogs(partial=query.on_damage is not None)
        try:
            self._closed = [
                (first, path)
                for first, last, path in reversed(time_spans(logs, self._walked.span))
                if last >= query.start and first < query.end
            ]
            self._open_next()
        except BaseException:
            self.__exit__()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close(self._files)
        self._walked.close()

    @property
    def start(self) -> int:
        """Lower limit of the start times of all further chunks."""
        return min((log.start for log in self._open), default=_LAST)

    def batches(self) -> Iterator["_Batch"]:
        """Yield the chunks in batches of a few megabytes."""
        while self._open:
            picked: dict[LogFile, list[NDArray[np.void]]] = {}
            size = 0
            while self._open and size < _BATCH:
                log = min(self._open, key=attrgetter("start"))
                others = [other.start for other in self._open if other is not log]
                until = min([*others, *(first for first, _ in self._closed[-1:])], default=_LAST)
                chunks = log.next_chunks(until, _BATCH - size)
                picked.setdefault(log.file, []).append(chunks)
                size += int(chunks["size"].sum())
                self._open_next()
            parts = [(file, np.concatenate(parts)) for file, parts in picked.items()]
            finished, self._finished = self._finished, []
            yield _Batch(parts, self.start, finished)

    def close(self, files: Iterable[LogFile]) -> None:
        """Close logs without further chunks."""
        for file in list(files):
            file.close()
            self._files.remove(file)

    def _open_next(self) -> None:
        """Open the logs that may have the next chunk, and remove exhausted ones."""
        self._finished += [log.file for log in self._open if log.start == _LAST]
        self._open = [log for log in self._open if log.start < _LAST]
        while self._closed and (not self._open or self._closed[-1][0] <= self.start):
            file = self._walked.open(self._closed.pop()[1])
            self._files.add(file)
            log = _Log(file, self._query)
            if log.start == _LAST:
                self._finished.append(log.file)
            else:
                self._open.append(log)


class _WalkedLogs:
    """Cache of a few unfinished logs that were scanned for their spans, to scan them only once."""

    def __init__(self, *, partial: bool) -> None:
        self._partial = partial
        self._logs: dict[Path, LogFile] = {}
        self._rows = 0

    def span(self, path: Path) -> tuple[int, int] | None:
        """Return the first and the last log time of a log, as `time_span` does."""
        stated = stated_span(path)
        if stated is not None:
            return stated[0]
        log = LogFile(path, partial=self._partial)
        rows = len(log.chunks) + sum(map(len, log.channel_sets))
        is_full = len(self._logs) == _WALKED or self._rows + rows > _WALKED_ROWS
        if log.complete or is_full or path in self._logs:
            log.close()
        else:
            self._logs[path] = log
            self._rows += rows
        return log.span

    def open(self, path: Path) -> LogFile:
        """Open a log, including data written since its scan."""
        log = self._logs.pop(path, None)
        if log is None:
            return LogFile(path, partial=self._partial)
        try:
            log.scan_new()
        except BaseException:
            log.close()
            raise
        return log

    def close(self) -> None:
        """Close the unused logs."""
        for log in self._logs.values():
            log.close()
