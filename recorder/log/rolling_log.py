"""A recorder's log: files of limited length and size; a live log outlasts disk errors."""

import errno
import mmap
import os
import shutil
import struct
import time
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import groupby
from pathlib import Path

from hearthlog.recorder.events import OK, WARNING, Notice
from hearthlog.recorder.host import give_back
from hearthlog.recorder.log.description import LogDescription
from hearthlog.recorder.log.folder_lock import FolderLock
from hearthlog.recorder.log.recovery import LogFinisher, active_logs
from hearthlog.recorder.stream import EncodedMessage, opening_messages
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.files import free_log_path, log_path
from hearthlog.schemas.logs.writer import LogWriter
from hearthlog.schemas.messages.message_types import header

# Maximum delay from a sound to its writing: a block of frames, and the capture delay.
_DELAY_SECONDS = 0.9
_QUIET_SECONDS = 2.0  # without a flush; sound has one every half a second
_FILES = 256  # remembered: longer than clips are buffered, even with one file per second
_LATE = 10 * NANOSECONDS  # lag between microphones; more means that the clock was set back
_NEVER = (1 << 63) - 1
_HELD_BYTES = 8 << 20  # twenty minutes of one microphone
_RETRY_SECONDS = 2.0
_SPARE_BYTES = 1 << 20  # free space required in addition to the held messages


_ENTRY = struct.Struct("<qHI")  # log time, bytes of the topic, bytes of the data
_FIRST_BYTES = 1 << 18
_WRITTEN_AT_ONCE = 256  # held messages per batch

Held = EncodedMessage | LogDescription  # a description begins another log


class HeldMessages:
    """Queue of messages, and of the descriptions of logs that begin between them; `size` in bytes.

    The bytes are in one block of memory: many small objects would leave holes in the heap that the
    process never returns to the system.
    """

    def __init__(self) -> None:
        self._memory = mmap.mmap(-1, _FIRST_BYTES)
        self._begin = self._end = 0
        self._descriptions: deque[LogDescription] = deque()  # each has an entry without a topic

    def __bool__(self) -> bool:
        return self._begin < self._end

    def __iter__(self) -> Iterator[Held]:
        descriptions = iter(self._descriptions)
        begin = self._begin
        while begin < self._end:
            log_time, topic_size, size = _ENTRY.unpack_from(self._memory, begin)
            data = begin + _ENTRY.size + topic_size
            if topic_size:
                topic = self._memory[data - topic_size : data].decode()
                yield EncodedMessage(log_time, topic, self._memory[data : data + size])
            else:
                yield next(descriptions)
            begin = data + size

    @property
    def size(self) -> int:  # noqa: D102
        return self._end - self._begin

    def extend(self, items: Iterable[Held]) -> None:
        """Append messages and descriptions."""
        parts = []
        for item in items:
            if isinstance(item, LogDescription):
                self._descriptions.append(item)
                parts.append(_ENTRY.pack(0, 0, 0))
            else:
                topic = item.topic.encode()
                parts += [_ENTRY.pack(item.log_time, len(topic), len(item.data)), topic, item.data]
        self._append(b"".join(parts))

    def batches(self) -> Iterator[list[Held]]:
        """Split the items at a change of the log time: files may begin there."""
        batch: list[Held] = []
        last = -1
        for item in self:
            now = item.log_time if isinstance(item, EncodedMessage) else -1
            if len(batch) >= _WRITTEN_AT_ONCE and now != last:
                yield batch
                batch = []
            batch.append(item)
            last = now
        yield batch

    def drop(self, messages: int, *, trailing: bool) -> None:
        """Drop so many messages, the descriptions before them, and with `trailing` those behind."""
        while self._begin < self._end:
            _, topic_size, size = _ENTRY.unpack_from(self._memory, self._begin)
            if not (messages or (trailing and not topic_size)):
                return
            if topic_size:
                messages -= 1
            else:
                self._descriptions.popleft()
            self._begin += _ENTRY.size + topic_size + size
        if self._end:
            self._begin = self._end = 0
            if len(self._memory) > _FIRST_BYTES:
                self._memory.close()
                self._memory = mmap.mmap(-1, _FIRST_BYTES)

    def _append(self, entries: bytes) -> None:
        if self._end + len(entries) > len(self._memory):
            wider = mmap.mmap(-1, 2 * len(self._memory) + len(entries))
            wider[: self._end] = self._memory[: self._end]
            self._memory.close()
            self._memory = wider
        self._memory[self._end : self._end + len(entries)] = entries
        self._end += len(entries)


class RollingLog:
    """Writes messages into successive files, which begin at multiples of `file_seconds` in UTC.

    A killed process loses at most `flush_seconds` of sound, a power cut `sync_seconds`. The next
    file also begins after `file_bytes`, unless 0. With `live`, disk errors do not raise: messages
    are held in memory until they can be written. The lock is renewed after a disk error.
    """

    def __init__(  # noqa: PLR0913
        self,
        description: LogDescription,
        file_seconds: int,
        flush_seconds: float,
        sync_seconds: float,
        *,
        live: bool = False,
        file_bytes: int = 0,
        finisher: LogFinisher | None = None,
        lock: FolderLock | None = None,
    ) -> None:
        self.finished: list[Path] = []
        self._safe = 0  # appended messages that are on the disk
        self._given = 0  # appended messages, without the opening messages of files
        self._description = description
        self._file_nanoseconds = file_seconds * NANOSECONDS
        self._file_bytes = file_bytes
        self._flush_nanoseconds = int((flush_seconds - _DELAY_SECONDS) * NANOSECONDS)
        self._sync_seconds = sync_seconds - _DELAY_SECONDS
        self._live = live
        self._name = free_log_path if live else log_path
        self._finisher = finisher
        self._writer: LogWriter | None = None
        self._abandoned: LogWriter | None = None  # of the file with the disk error
        self._late = _LATE if len(description.infos) > 1 else 0
        self._last = self._until = 0  # empty range: the first message opens a file
        self._flush_at: int | None = None
        self._flushed = time.monotonic()
        self._synced = time.monotonic()
        self._begun: deque[tuple[int, Path]] = deque(maxlen=_FILES)
        self._lock = lock
        self._mount = _mount_of(description.root)
        self._held = HeldMessages()  # of a live log: not yet synced to the disk
        self._dropped = 0  # messages dropped from `_held`
        self._failing = False
        self._reason = ""
        self._retry_at = 0.0
        self._notices: list[Notice] = []

    def write(self, messages: Sequence[EncodedMessage]) -> None:
        """Append messages; begin a new file if time runs backwards, because the clock was set.

        Raise `LogError`, unless live, on a disk error, or if the name of a new file is taken: the
        written part remains and is completed at the next start.
        """
        if self._live:
            self._hold(messages)
        else:
            self._write(messages)

    def _write(self, messages: Sequence[EncodedMessage]) -> None:
        with self._preserving_written():
            for part in self._parts(messages):
                if not self._last - self._late <= part[0].log_time < self._until:
                    self._roll(part[0].log_time)
                self._append(part)
                self._given += len(part)
            if self._is_flush_due():
                self.flush()
            if time.monotonic() - self._synced >= self._sync_seconds:
                self.sync()

    def _is_flush_due(self) -> bool:
        if self._flush_at is None:
            return False
        # Without sound there is one message in ten seconds; it must not wait for the next.
        waits = self._live and time.monotonic() - self._flushed >= _QUIET_SECONDS
        return waits or self._last >= self._flush_at

    def flush(self) -> None:
        """Pass written data to the operating system; raise `OSError` on a disk error."""
        if self._writer is not None and self._flush_at is not None:
            self._writer.flush()
            self._flush_at = None
            self._flushed = time.monotonic()
            if self._file_bytes and self._writer.size >= self._file_bytes:
                self._until = 0

    def sync(self) -> None:
        """Wait until written data is on the disk; raise `OSError` on a disk error."""
        self.flush()
        if self._writer is not None:
            self._writer.sync()
        self._safe = self._given
        self._synced = time.monotonic()

    def finish(self, messages: Sequence[EncodedMessage] = ()) -> None:
        """Append the last messages, in the order of log time, to the open file, and complete it.

        Without an open file the messages are dropped, unless live. Raise `LogError` on a disk
        error; the written part remains and is completed at the next start.
        """
        if self._live:
            self._retry_at = 0.0
            self._hold(messages)
            if self._failing:
                times = [item.log_time for item in self._held if isinstance(item, EncodedMessage)]
                seconds = (max(times) - min(times)) / NANOSECONDS if times else 0.0
                what = f"{self._description.root}: cannot be written ({self._reason})"
                raise LogError(f"{what}; the last {seconds:.0f} s are lost")
            messages = ()
        self._finish(messages)

    def _finish(self, messages: Sequence[EncodedMessage] = ()) -> None:
        with self._preserving_written():
            if self._writer is not None:
                self._append(messages)
                self._given += len(messages)
            self._finish_file()

    def may_begin(self, stamp: int) -> bool:
        """Return whether a file may begin at a time: each second has one name."""
        if self._failing:
            return False
        description = self._description
        path = log_path(description.root, description.node, stamp)
        return free_log_path(description.root, description.node, stamp) == path

    @property
    def is_full(self) -> bool:
        """Whether so much is held after a disk error that sound must be dropped."""
        return self._failing and self._held.size >= _HELD_BYTES

    def notices(self) -> list[Notice]:
        """Return the notices about the disk of a live log since the last call."""
        notices, self._notices = self._notices, []
        return notices

    def file_at(self, stamp: int) -> tuple[Path, int]:
        """Return the file that contains a written time, and its end, in nanoseconds of UTC.

        If the clock was set back, it is the later file.
        """
        until = _NEVER
        if not self._begun:
            return log_path(self._description.root, self._description.node, stamp), until
        for start, path in reversed(self._begun):
            if start <= stamp:
                return path, until
            until = start
        return self._begun[0][1], until

    def begin_anew(self, description: LogDescription, messages: Sequence[EncodedMessage]) -> None:
        """Complete the open file; the next message begins a file with another description.

        Raise `LogError` as `write` does.
        """
        if self._live:
            self._hold([*messages, description])
        else:
            self._finish(messages)
            self._describe(description)

    def _describe(self, description: LogDescription) -> None:
        """Let the next message begin a file with another description."""
        self._description = description
        self._until = 0

    def _hold(self, items: Sequence[Held]) -> None:
        """Hold new items until they are on the disk; write them, or all of them after an error."""
        self._held.extend(items)
        was_failing = self._failing
        if was_failing and time.monotonic() < self._retry_at:
            return
        try:
            if was_failing:
                self._write_anew()
            else:
                self._pour(items)
                if self._held.size >= _HELD_BYTES:
                    self.sync()
        except (LogError, OSError) as error:
            self._fail(error)
        self._held.drop(self._safe - self._dropped, trailing=not self._failing)
        self._dropped = self._safe
        if was_failing and not self._failing:
            give_back()

    def _write_anew(self) -> None:
        """Write all held items after a disk error; raise `LogError` or `OSError` if it persists."""
        self._check_disk()
        if self._lock is not None:
            self._lock.renew()
        if self._abandoned is not None:
            self._abandoned.discard_unsynced()
            self._abandoned = None
        self._given = self._safe
        self._until = 0
        self._flush_at = None
        for batch in self._held.batches():
            self._pour(batch)
        self.sync()
        self._failing = False
        root = self._description.root
        self._notices.append(Notice(OK, f"{root} can be written again"))
        if self._finisher is not None:  # completes the files with disk errors, including clips
            # The open file is excluded: the disk may refuse it before that process has started.
            is_open = None if self._writer is None else self._writer.active_path
            logs = active_logs(root, self._description.node)
            self._finisher.add([path for path in logs if path != is_open])

    def _pour(self, items: Sequence[Held]) -> None:
        for is_message, run in groupby(items, lambda item: isinstance(item, EncodedMessage)):
            if is_message:
                self._write([item for item in run if isinstance(item, EncodedMessage)])
                continue
            for description in run:
                assert isinstance(description, LogDescription)
                self._finish()
                self._describe(description)

    def _check_disk(self) -> None:
        if not self._mount.is_mount():  # the folder under the mount point is on another disk
            raise OSError(errno.ENODEV, f"{self._mount} is not mounted")
        if shutil.disk_usage(self._mount).free < 2 * self._held.size + _SPARE_BYTES:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def _fail(self, error: LogError | OSError) -> None:
        cause = error.__cause__ if isinstance(error.__cause__, OSError) else error
        self._reason = getattr(cause, "strerror", None) or str(error)
        self._retry_at = time.monotonic() + _RETRY_SECONDS
        if not self._failing:
            self._failing = True
            what = f"{self._description.root} cannot be written ({self._reason})"
            self._notices.append(
                Notice(WARNING, f"{what}: messages are held in memory until it can")
            )

    @contextmanager
    def _preserving_written(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            kept = ""
            if self._writer is not None:
                self._writer.abandon()
                self._abandoned, self._writer = self._writer, None
                kept = "; what was recorded is kept, and completed at the next start"
            what = error.strerror or str(error)
            root = self._description.root
            raise LogError(f"{root}: cannot be written ({what}){kept}") from error

    def _finish_file(self) -> None:
        if self._writer is not None:
            if self._finisher is None:
                self._writer.finish()
            else:
                self._writer.complete()
                self._finisher.add([self._writer.active_path])
            self.finished.append(self._writer.path)
            self._writer = None
        self._safe = self._given

    def _parts(self, messages: Sequence[EncodedMessage]) -> Iterator[Sequence[EncodedMessage]]:
        """Split messages where a file may begin; ordered messages within the file stay together."""
        times = [message.log_time for message in messages]
        if times and times[-1] < self._until and times == sorted(times):
            yield messages
        else:
            for place in range(len(messages)):
                yield messages[place : place + 1]

    def _append(self, messages: Sequence[EncodedMessage]) -> None:
        if not messages:
            return
        assert self._writer is not None
        self._writer.write_messages(messages)
        self._last = max(self._last, messages[-1].log_time)
        if self._flush_at is None:
            self._flush_at = messages[0].log_time + self._flush_nanoseconds

    def _roll(self, stamp: int) -> None:
        self._finish_file()
        description = self._description
        path = self._name(description.root, description.node, stamp)
        self._writer = LogWriter(
            path, description.topics, description.metadata, description.attachments, stamp
        )
        self._begun.append((stamp, path))
        self._last = stamp
        self._until = (stamp // self._file_nanoseconds + 1) * self._file_nanoseconds
        for info in description.infos:
            info.header = header(stamp, info.header.frame_id)
            lines = description.lines.get(info.header.frame_id, ())
            self._append(opening_messages(info, lines))
        self._writer.flush()  # the file is identifiable whatever happens next
        self._flush_at = None


def _mount_of(folder: Path) -> Path:
    """Return the mount point of a folder that may not exist yet."""
    folder = folder.resolve()
    return next(path for path in (folder, *folder.parents) if path.is_mount())
