"""Logs that are being written, followed from file to file."""

import os
import sys
import time
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from threading import Event
from typing import Any, Self

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

_SETTLES = 10  # milliseconds in which a change goes on


class FolderChanges:
    """Tells of files that are made, written, renamed or removed in folders.

    Where the file system does not tell, as one of the network, or on a system without inotify,
    `wait` lasts as long as it is asked to.
    """

    def __init__(self) -> None:
        self._inotify: Any = None
        self._mask = 0
        self._watches: dict[Path, int] = {}
        if sys.platform == "linux":
            from inotify_simple import INotify, flags  # noqa: PLC0415  elsewhere there is none

            with suppress(OSError):  # a machine has so many and no more
                self._inotify = INotify()
            changes = flags.CREATE | flags.MODIFY | flags.MOVED_TO
            self._mask = changes | flags.DELETE_SELF | flags.MOVE_SELF | flags.ONLYDIR

    @property
    def tells(self) -> bool:
        """Whether the system can tell of changes."""
        return self._inotify is not None

    def watch(self, folders: Iterable[Path]) -> None:
        """Be told of these folders too, and of those that have the names of watched ones since."""
        if self._inotify is None:
            return
        for folder in set(folders):
            with suppress(OSError):  # it was removed, or there are too many
                # Asked each time: no event tells that a disk was mounted over a watched folder.
                watch = self._inotify.add_watch(folder, self._mask)
                before = self._watches.get(folder, watch)
                self._watches[folder] = watch
                if before != watch:
                    self._inotify.rm_watch(before)  # if it has moved away

    def wait(self, seconds: float, stop: Event) -> bool:
        """Wait until something changes, or for some time; tell whether something did.

        Parameters
        ----------
        stop : threading.Event
            Ends the waiting when it is set, at the latest after `seconds`.
        """
        if self._inotify is None:
            stop.wait(seconds)
            return False
        return not stop.is_set() and bool(self._inotify.read(round(1000 * seconds), _SETTLES))

    def close(self) -> None:
        """Be told no more."""
        if self._inotify is not None:
            self._inotify.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


_POLL_SECONDS = 0.2
_LOOK_SECONDS = 1.0  # where the file system tells of news
_MOST_MISSED = 3  # news of which it did not
_SETTLED = 2_000_000_000  # ns after which a folder's time of change tells a further change
_LONGEST = 2 * 86_400 * NANOSECONDS  # a log lasts a day at most, and its clock may be set
_NAME_TIME = len("20260301T120000Z")
_NO_LOGS = {ENROLLED, "lost+found"}  # the latter, on many disks, only root may read


def follow(
    folder: Path,
    topics: TopicChoice | None = None,
    start: int | None = None,
    fields: Collection[str] | None = None,
    stop: Event | None = None,
) -> Iterator[list[Columns]]:
    """Read the logs of a folder as they are written, across files and restarts of the recorder.

    What a recorder hands to the operating system is read within a fraction of a second.

    Parameters
    ----------
    folder : Path
        Logs may lie at any depth. Files that are there but not being written are read first, if
        `start` asks for them.
    start : int, optional
        Log time, in nanoseconds of UTC, from which on messages are read; by default those that are
        written from now on.
    stop : threading.Event, optional
        Ends the reading when it is set; by default it never ends.

    Raises
    ------
    LogError
        If there is no such folder, or no more, if a folder or a log in it cannot be read, if a log
        is damaged, or if its messages are not of the type that it says.
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
    """Read the messages of logs, still encoded, as they are written; as `follow` does.

    Parameters
    ----------
    start : int, optional
        Log time, in nanoseconds of UTC, from which on messages are read; by default those that are
        written from now on.
    stop : threading.Event, optional
        Ends the reading when it is set; by default it never ends.
    damaged : callable
        Told the error of a log that is damaged, of which no more is read then; and once, until it
        is over, of a log or a folder that cannot be read now or is gone, which is tried again and
        again. By default it is raised.
    infos : bool
        Whether the `AudioStreamInfo` messages of the logs that are being written come first, also
        those that were written before.
    ticks : bool
        Whether the folder with an empty list comes five times a second while nothing is written,
        when all that was written has been read: for who judges how long ago that was.

    Yields
    ------
    messages : list of RawMessages
        What was written to it since the last time, perhaps nothing: so after each log that is not
        being written, for the caller to have a turn.

    Raises
    ------
    LogError
        If there is no such folder, or what `damaged` raises.
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
            known = len(growing)
            growing.extend(watch.open(watch.new_logs()))
            late = [log for log in growing[known:] if _name(log.file.path) in before]
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
    """Pass over what is not asked for of logs that were there before."""
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
    """Tell by its name whether a log may have messages from a time on."""
    try:
        return read_time(log_name(log).time[:_NAME_TIME]) + _LONGEST >= start
    except ValueError:  # no recorder gave the name
        return True


class _News:
    """Tells when to look for news: when the file system says so, and once a second.

    Where news come without a word of it, as on a file system of the network, five times a second.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._changes = FolderChanges()
        self._was_told = True
        self._missed = 0
        self._due = 0.0  # by CLOCK_MONOTONIC

    def expect(self, growing: "Iterable[_Growing]", *, has_news: bool) -> None:
        """Note what is being written, and whether there was anything new."""
        if has_news and not self._was_told and not self._changes.wait(0, Event()):
            self._missed += 1
        places = {self._folder}
        for log in growing:
            places.update(log.file.path.parents)
        self._changes.watch(p for p in places if p.is_relative_to(self._folder))
        self._due = time.monotonic() + _LOOK_SECONDS

    def may_be_there(self, stop: Event) -> bool:
        """Wait for a fifth of a second at most; tell whether to look for news then."""
        self._was_told = self._changes.wait(_POLL_SECONDS, stop)
        tells = self._changes.tells and self._missed < _MOST_MISSED
        return self._was_told or not tells or time.monotonic() >= self._due or stop.is_set()

    def close(self) -> None:
        """Be told no more."""
        self._changes.close()


class _Growing:
    """A log that is being written."""

    def __init__(self, file: LogFile) -> None:
        self.file = file
        self._is_damaged = False
        self._replaced = False

    def read(
        self, topics: TopicChoice | None, start: int | None, damaged: Damaged
    ) -> Iterator[list[RawMessages]]:
        """Read what was written since the last time."""
        # Replaced by a recorder that was started again: asked first, so nothing comes in between.
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
        """Read the descriptions of the streams that were written before a time, or before now."""
        messages: list[RawMessages] = []
        try:
            with _open(self.file.path) as file:
                messages = _read_infos(file)
        except LogError as error:
            if not _has_vanished(error):
                damaged(error)
        return [m for m in (raw.between(None, start) for raw in messages) if len(m)]

    def is_open(self) -> bool:
        """Tell whether more may come; if not, close the log."""
        if self.file.ended or self._replaced or self._is_damaged:
            self.file.close()
            return False
        return True

    def _is_replaced(self) -> bool:
        """Tell whether another file has the name, or none, though its folder is not gone."""
        try:
            is_there = any(self.file.is_at(name) for name in _names(self.file.path))
            return not is_there and self.file.path.parent.is_dir()
        except OSError:  # nobody may look at it now
            return False


def _read_infos(file: LogFile) -> list[RawMessages]:
    chunks = file.scan_new()
    read_definitions(file)
    topics = {number: channel.topic for number, channel in file.channels.items()}
    of_infos = {number: name for number, name in topics.items() if name.endswith("/info")}
    return read_chunks(file, file.with_channels(chunks, of_infos.keys()), of_infos.values())


def _names(path: Path) -> tuple[Path, Path]:
    """Return the name of a log while it is written, and when it is finished."""
    return path.with_name(stem(path) + ACTIVE_SUFFIX), path.with_name(stem(path) + SUFFIX)


def _name(path: Path) -> str:
    """Return what stays the same of a log when it gets its final name."""
    return os.fspath(path).removesuffix(ACTIVE_SUFFIX).removesuffix(SUFFIX)


def _open(path: Path) -> LogFile:
    """Open a log that may get its final name at any moment."""
    active, _ = _names(path)
    return LogFile(active, indexed=False)


def _has_vanished(error: LogError) -> bool:
    return isinstance(error.__cause__, FileNotFoundError)


class _Folder:
    """A folder of logs, looked through again and again.

    Only the folders that changed are listed: a recorder leaves ten thousand files a year.
    """

    def __init__(self, root: Path, damaged: Damaged) -> None:
        self._root = root
        self._damaged = damaged
        self._listed: dict[Path, int] = {root: -1}
        self._listed_logs: set[str] = set()
        self._unreadable: set[Path] = set()  # folders and logs, as was told

    def new_logs(self) -> list[Path]:
        """Return the logs that were not there the last time, by name."""
        new: dict[str, Path] = {}
        todo = deque(self._listed)
        while todo:
            folder = todo.popleft()
            if self._unreadable and not self._unreadable.isdisjoint(folder.parents):
                continue  # nor can this one be: one line says it
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
        """Open logs; one that cannot be opened now is new the next time too."""
        for path in logs:
            try:
                log = _Growing(_open(path))
            except LogError as error:
                if not _has_vanished(error):
                    self._listed_logs.discard(_name(path))
                    self._listed[path.parent] = -1
                    self._tell(path, error)
            else:
                self._unreadable.discard(path)
                yield log

    def _list_changed(self, folder: Path) -> list[tuple[Path, bool]]:
        """Return what is in a folder that may have changed, and which of it are folders."""
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
        self._tell(folder, LogError(f"{folder}: {problem}"))

    def _tell(self, path: Path, error: LogError) -> None:
        """Tell it once, until the folder or the log can be read."""
        if path not in self._unreadable:
            self._unreadable.add(path)
            self._damaged(error)
