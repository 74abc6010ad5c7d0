"""Following of logs that are being written, from file to file."""

import os
import sys
import time
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from threading import Event
from typing import Any

from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS, read_time
from hearthlog.schemas.logs.columns import Columns, decode
from hearthlog.schemas.logs.files import ENROLLED, SUFFIX, is_active, is_log, log_name, stem
from hearthlog.schemas.logs.merged_reading import iterate_messages
from hearthlog.schemas.mcap.chunks import (
    TopicChoice,
    read_chunks,
    read_definitions,
    read_in_batches,
)
from hearthlog.schemas.mcap.logfile import ACTIVE_SUFFIX, LogFile
from hearthlog.schemas.mcap.raw_messages import RawMessages

_SETTLES = 10  # milliseconds to collect the events of one change


class FolderChanges:
    """Watcher of files that are created, written, renamed or removed in folders.

    Without inotify, or on a file system without events, such as a network one, `wait` always
    lasts its full time.
    """

    def __init__(self) -> None:
        self._inotify: Any = None
        self._mask = 0
        self._watches: dict[Path, int] = {}
        if sys.platform == "linux":
            from inotify_simple import INotify, flags  # noqa: PLC0415  exists on Linux only

            with suppress(OSError):  # the number of instances per machine is limited
                self._inotify = INotify()
            changes = flags.CREATE | flags.MODIFY | flags.MOVED_TO
            self._mask = changes | flags.DELETE_SELF | flags.MOVE_SELF | flags.ONLYDIR

    @property
    def has_events(self) -> bool:
        """Whether the system reports changes."""
        return self._inotify is not None

    def watch(self, folders: Iterable[Path]) -> None:
        """Watch more folders, and folders that have replaced watched ones."""
        if self._inotify is None:
            return
        for folder in set(folders):
            with suppress(OSError):  # the folder was removed, or there are too many
                # Repeated each time: no event reports a disk mounted over a watched folder.
                watch = self._inotify.add_watch(folder, self._mask)
                before = self._watches.get(folder, watch)
                self._watches[folder] = watch
                if before != watch:
                    self._inotify.rm_watch(before)  # if it was moved away

    def wait(self, seconds: float, stop: Event) -> bool:
        """Wait for a change, some seconds or `stop`; return whether there was a change."""
        if self._inotify is None:
            stop.wait(seconds)
            return False
        return not stop.is_set() and bool(self._inotify.read(round(1000 * seconds), _SETTLES))

    def close(self) -> None:
        """Stop watching."""
        if self._inotify is not None:
            self._inotify.close()


_POLL_SECONDS = 0.2
_LOOK_SECONDS = 1.0  # polling interval if the file system reports changes
_MOST_MISSED = 3  # number of changes without event before polling speeds up
_SETTLED = 2_000_000_000  # ns after which another change alters the modification time of a folder
_LONGEST = 2 * 86_400 * NANOSECONDS  # a log lasts a day at most, but the clock may be set
_NAME_TIME = len("20260301T120000Z")
_NO_LOGS = {ENROLLED, "lost+found"}  # on many disks, only root may read lost+found


def follow(
    folder: Path,
    topics: TopicChoice | None = None,
    start: int | None = None,
    fields: Collection[str] | None = None,
    stop: Event | None = None,
) -> Iterator[list[Columns]]:
    """Read the logs of a folder, recursively, across files and recorder restarts.

    Latency after a recorder's write is a fraction of a second. With `start`, a log time in
    nanoseconds of UTC, existing files that are not being written are read first; by default only
    messages written from now on. Reading ends when `stop` is set. Raise `LogError` if the folder
    does not exist or disappears, the folder or a log in it cannot be read, a log is damaged, or its
    messages do not match their stated type.
    """
    for _, messages in follow_messages(folder, topics, start, stop):
        if messages:
            yield decode(messages, fields)


Damaged = Callable[[LogError], None]


def _refuse(error: LogError) -> None:
    raise error


def follow_messages(  # noqa: PLR0913
    folder: Path,
    topics: TopicChoice | None = None,
    start: int | None = None,
    stop: Event | None = None,
    damaged: Damaged = _refuse,
    *,
    infos: bool = False,
    ticks: bool = False,
) -> Iterator[tuple[Path, list[RawMessages]]]:
    """Read the encoded messages of logs as they are written; as `follow` does.

    Raise `LogError` if the folder does not exist, or any error that `damaged` raises.

    Parameters
    ----------
    start : int, optional
        Log time, in nanoseconds of UTC, of the first messages to read; by default only messages
        written from now on.
    stop : threading.Event, optional
        Ends the reading when set; by default it never ends.
    damaged : callable
        Called with the error of a damaged log, which is not read further; and once per incident
        with that of a log or a folder that is unreadable or missing, which is retried. By default
        the error is raised.
    infos : bool
        Whether to start with the `AudioStreamInfo` messages of active logs, including those
        written before.
    ticks : bool
        Whether to yield the folder with an empty list five times a second while there is no new
        data, for callers that measure time since the last data.

    Yields
    ------
    messages : list of RawMessages
        Messages written to the log since the last time; possibly empty, as after each log that is
        not being written, to return control to the caller.
    """
    stop = stop or Event()
    if not folder.is_dir():
        raise LogError(f"{folder}: no such folder")
    watch = _Folder(folder, damaged)
    present = watch.new_logs()
    if start is not None:
        finished = [path for path in present if not is_active(path)]
        yield from _read_finished(finished, topics, start, stop, damaged)
    active = [path for path in present if is_active(path)]
    before = set(map(_name, active))
    growing: list[_Growing] = []
    with ExitStack() as opened:
        opened.callback(lambda: _close(growing))
        news = opened.enter_context(closing(_News(folder)))
        growing.extend(watch.open(active))
        yield from _begin(growing, start, damaged, infos=infos)
        while not stop.is_set():
            has_news = False
            for log in growing:
                for messages in log.read(topics, start, damaged):
                    has_news = True
                    yield log.file.path, messages
            growing = [log for log in growing if log.is_open()]
            count = len(growing)
            growing.extend(watch.open(watch.new_logs()))
            late = [log for log in growing[count:] if _name(log.file.path) in before]
            yield from _begin(late, start, damaged, infos=infos)
            news.expect(growing, has_news=has_news)
            is_due = has_news
            while not is_due:
                if ticks:
                    yield folder, []
                is_due = news.may_be_there(stop)


def _close(growing: "Iterable[_Growing]") -> None:
    for log in growing:
        log.file.close()


def _begin(
    growing: "Sequence[_Growing]", start: int | None, damaged: Damaged, *, infos: bool
) -> Iterator[tuple[Path, list[RawMessages]]]:
    """Skip messages of existing logs that are not requested."""
    if start is None:
        for log in growing:
            log.file.scan_new()
    if infos:
        yield from ((log.file.path, log.infos_before(start, damaged)) for log in growing)


def _read_finished(
    paths: list[Path], topics: TopicChoice | None, start: int, stop: Event, damaged: Damaged
) -> Iterator[tuple[Path, list[RawMessages]]]:
    for path in paths:
        if stop.is_set():
            return
        if not _may_reach(path, start):
            continue
        try:
            for messages in iterate_messages([path], topics, start):
                yield path, messages
        except LogError as error:
            damaged(error)
        yield path, []


def _may_reach(log: Path, start: int) -> bool:
    """Return whether a log may have messages after a time, judged by its name."""
    try:
        return read_time(log_name(log).time[:_NAME_TIME]) + _LONGEST >= start
    except ValueError:  # not a recorder's name
        return True


class _News:
    """Schedule of polling: after file system events, and once a second.

    If changes arrive without events, as on network file systems, five times a second.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._changes = FolderChanges()
        self._was_notified = True
        self._missed = 0
        self._due = 0.0  # by CLOCK_MONOTONIC

    def expect(self, growing: "Iterable[_Growing]", *, has_news: bool) -> None:
        """Update the active logs, and whether there was new data."""
        if has_news and not self._was_notified and not self._changes.wait(0, Event()):
            self._missed += 1
        places = {self._folder}
        for log in growing:
            places.update(log.file.path.parents)
        self._changes.watch(p for p in places if p.is_relative_to(self._folder))
        self._due = time.monotonic() + _LOOK_SECONDS

    def may_be_there(self, stop: Event) -> bool:
        """Wait for at most a fifth of a second; return whether to poll."""
        self._was_notified = self._changes.wait(_POLL_SECONDS, stop)
        has_events = self._changes.has_events and self._missed < _MOST_MISSED
        return (
            self._was_notified or not has_events or time.monotonic() >= self._due or stop.is_set()
        )

    def close(self) -> None:
        """Stop watching."""
        self._changes.close()


class _Growing:
    """Log that is being written."""

    def __init__(self, file: LogFile) -> None:
        self.file = file
        self._is_damaged = False
        self._replaced = False

    def read(
        self, topics: TopicChoice | None, start: int | None, damaged: Damaged
    ) -> Iterator[list[RawMessages]]:
        """Read the messages written since the last call."""
        # Replaced by a restarted recorder: checked first, so that no data are missed.
        self._replaced = self._is_replaced()
        try:
            for batch in read_in_batches(self.file, self.file.scan_new(), topics):
                messages = [m for m in (raw.between(start, None) for raw in batch) if len(m)]
                if messages:
                    yield messages
        except LogError as error:
            self._is_damaged = True
            damaged(error)

    def infos_before(self, start: int | None, damaged: Damaged) -> list[RawMessages]:
        """Read the stream descriptions written before a time, or before now."""
        messages: list[RawMessages] = []
        try:
            with _open(self.file.path) as file:
                chunks = file.scan_new()
                read_definitions(file)
                topics = {number: channel.topic for number, channel in file.channels.items()}
                infos = {n: name for n, name in topics.items() if name.endswith("/info")}
                chunks = file.with_channels(chunks, infos.keys())
                messages = read_chunks(file, chunks, infos.values())
        except LogError as error:
            if not _has_vanished(error):
                damaged(error)
        return [m for m in (raw.between(None, start) for raw in messages) if len(m)]

    def is_open(self) -> bool:
        """Return whether more data may come; if not, close the log."""
        if self.file.ended or self._replaced or self._is_damaged:
            self.file.close()
            return False
        return True

    def _is_replaced(self) -> bool:
        """Return whether the name is missing or another file, while its folder exists."""
        try:
            is_there = any(self.file.is_at(name) for name in _names(self.file.path))
            return not is_there and self.file.path.parent.is_dir()
        except OSError:  # unreadable at the moment
            return False


def _names(path: Path) -> tuple[Path, Path]:
    """Return the active and the finished name of a log."""
    return path.with_name(stem(path) + ACTIVE_SUFFIX), path.with_name(stem(path) + SUFFIX)


def _name(path: Path) -> str:
    """Return the part of a log's name that does not change when it is finished."""
    return os.fspath(path).removesuffix(ACTIVE_SUFFIX).removesuffix(SUFFIX)


def _open(path: Path) -> LogFile:
    """Open a log that may be renamed to its final name at any moment."""
    active, _ = _names(path)
    return LogFile(active, indexed=False)


def _has_vanished(error: LogError) -> bool:
    return isinstance(error.__cause__, FileNotFoundError)


class _Folder:
    """Folder of logs, scanned repeatedly.

    Only changed folders are listed: a recorder writes ten thousand files a year.
    """

    def __init__(self, root: Path, damaged: Damaged) -> None:
        self._root = root
        self._damaged = damaged
        self._listed: dict[Path, int] = {root: -1}
        self._listed_logs: set[str] = set()
        self._unreadable: set[Path] = set()  # folders and logs already reported

    def new_logs(self) -> list[Path]:
        """Return the logs that are new since the last call, sorted by name."""
        new: dict[str, Path] = {}
        todo = deque(self._listed)
        while todo:
            folder = todo.popleft()
            if self._unreadable and not self._unreadable.isdisjoint(folder.parents):
                continue  # unreadable like its folder, which is reported once
            for path, is_folder in self._list_changed(folder):
                if is_folder:
                    if path not in self._listed and path.name not in _NO_LOGS:
                        self._listed[path] = -1
                        todo.append(path)
                elif is_log(path):
                    name = _name(path)
                    if name not in self._listed_logs:
                        new[name] = path
        self._listed_logs |= new.keys()
        return [new[name] for name in sorted(new)]

    def open(self, logs: Iterable[Path]) -> Iterator[_Growing]:
        """Open logs; a log that cannot be opened remains new for the next call."""
        for path in logs:
            try:
                log = _Growing(_open(path))
            except LogError as error:
                if not _has_vanished(error):
                    self._listed_logs.discard(_name(path))
                    self._listed[path.parent] = -1
                    self._report(path, error)
            else:
                self._unreadable.discard(path)
                yield log

    def _list_changed(self, folder: Path) -> list[tuple[Path, bool]]:
        """Return the entries of a folder that may have changed, and whether each is a folder."""
        try:
            changed = folder.stat().st_mtime_ns
            if changed == self._listed[folder]:
                return []
            settled = time.time_ns() - changed > _SETTLED
            self._listed[folder] = changed if settled else -1
            with os.scandir(folder) as entries:
                inside = [(Path(e.path), e.is_dir(follow_symlinks=False)) for e in entries]
        except OSError as error:
            self._pass_over(folder, error)
            return []
        self._unreadable.discard(folder)
        return inside

    def _pass_over(self, folder: Path, error: OSError) -> None:
        is_gone = isinstance(error, FileNotFoundError | NotADirectoryError)
        if is_gone and folder != self._root:
            del self._listed[folder]
            self._unreadable.discard(folder)
            return
        self._listed[folder] = -1
        problem = f"may not be read ({error.strerror}); let the user of this process read it"
        if is_gone:
            problem = "the folder is gone; waiting for it"
        elif not isinstance(error, PermissionError):
            problem = f"cannot be read ({error.strerror}); it is tried again"
        self._report(folder, LogError(f"{folder}: {problem}"))

    def _report(self, path: Path, error: LogError) -> None:
        """Report an error once, until the folder or the log is readable again."""
        if path not in self._unreadable:
            self._unreadable.add(path)
            self._damaged(error)
