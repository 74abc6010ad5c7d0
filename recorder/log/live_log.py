"""Live log: buffers messages in memory during disk errors."""

import errno
import mmap
import os
import shutil
import struct
import time
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from itertools import groupby
from pathlib import Path

from hearthlog.recorder.events import OK, WARNING, Notice
from hearthlog.recorder.host import give_back
from hearthlog.recorder.log.folder_lock import FolderLock
from hearthlog.recorder.log.rolling_log import LogDescription, RollingLog
from hearthlog.recorder.stream.messages import EncodedMessage
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS

_ENTRY = struct.Struct("<qHI")  # log time, bytes of the topic, bytes of the data
_FIRST_BYTES = 1 << 18

Held = EncodedMessage | LogDescription  # a description begins another log


class HeldMessages:
    """Queue of messages, and of the descriptions of logs that begin between them.

    The bytes are in one block of memory: many small objects would leave holes in the heap that the
    process never returns to the system.

    Attributes
    ----------
    size : int
        Bytes held.
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

    @property
    def begins_log(self) -> bool:
        """Whether the first item is a description."""
        return not _ENTRY.unpack_from(self._memory, self._begin)[1]

    def extend(self, items: Iterable[Held]) -> None:
        """Append messages and descriptions."""
        for item in items:
            if isinstance(item, LogDescription):
                self._descriptions.append(item)
                self._append(0, b"", b"")
            else:
                self._append(item.log_time, item.topic.encode(), item.data)

    def drop_first(self) -> None:
        """Drop the first item."""
        _, topic_size, size = _ENTRY.unpack_from(self._memory, self._begin)
        if not topic_size:
            self._descriptions.popleft()
        self._begin += _ENTRY.size + topic_size + size
        if self._begin == self._end:
            self._begin = self._end = 0
            if len(self._memory) > _FIRST_BYTES:
                self._memory.close()
                self._memory = mmap.mmap(-1, _FIRST_BYTES)

    def _append(self, log_time: int, topic: bytes, data: bytes) -> None:
        entry = _ENTRY.pack(log_time, len(topic), len(data)) + topic + data
        if self._end + len(entry) > len(self._memory):
            wider = mmap.mmap(-1, 2 * len(self._memory) + len(entry))
            wider[: self._end] = self._memory[: self._end]
            self._memory.close()
            self._memory = wider
        self._memory[self._end : self._end + len(entry)] = entry
        self._end += len(entry)


_HELD_BYTES = 8 << 20  # twenty minutes of one microphone
_RETRY_SECONDS = 2.0
_SPARE_BYTES = 1 << 20  # free space required in addition to the held messages

_WRITTEN_AT_ONCE = 256  # held messages per batch


class LiveLog:
    """Writes messages to a rolling log, and buffers them in memory during disk errors."""

    def __init__(self, log: RollingLog, root: Path, lock: FolderLock | None = None) -> None:
        self._log = log
        self._root = root
        self._lock = lock
        self._mount = _mount_of(root)
        self._held = HeldMessages()  # not yet synced to the disk
        self._safe = 0  # messages dropped from `_held`
        self._failing = False
        self._reason = ""
        self._retry_at = 0.0
        self._notices: list[Notice] = []

    @property
    def is_full(self) -> bool:
        """Whether the buffer is full, so that sound must be dropped."""
        return self._failing and self._held.size >= _HELD_BYTES

    @property
    def finished(self) -> list[Path]:
        """Completed files."""
        return self._log.finished

    def write(self, messages: Sequence[EncodedMessage]) -> None:
        """Append messages, or buffer them."""
        self._held.extend(messages)
        self._write(messages)

    def notices(self) -> list[Notice]:
        """Return the notices about the disk since the last call."""
        notices, self._notices = self._notices, []
        return notices

    def may_begin(self, stamp: int) -> bool:
        """Return whether a file may begin at a time, as `RollingLog.may_begin` does."""
        return not self._failing and self._log.may_begin(stamp)

    def file_at(self, stamp: int) -> tuple[Path, int]:
        """Return the file that contains a time, as `RollingLog.file_at` does."""
        return self._log.file_at(stamp)

    def begin_anew(self, description: LogDescription, messages: Sequence[EncodedMessage]) -> None:
        """Complete the open file; the next message begins a file with another description."""
        self._held.extend([*messages, description])
        self._write([*messages, description])

    def finish(self, messages: Sequence[EncodedMessage] = ()) -> None:
        """Append the last messages, and complete the open file.

        Raise `LogError` on a disk error.
        """
        self._held.extend(messages)
        self._retry_at = 0.0
        self._write(messages)
        if self._failing:
            times = [item.log_time for item in self._held if isinstance(item, EncodedMessage)]
            seconds = (max(times) - min(times)) / NANOSECONDS if times else 0.0
            what = f"{self._root}: cannot be written ({self._reason})"
            raise LogError(f"{what}; the last {seconds:.0f} s are lost")
        self._log.finish()

    def _write(self, items: Sequence[Held]) -> None:
        """Write the new items, or all held items after a disk error."""
        if self._failing and time.monotonic() < self._retry_at:
            return
        was_failing = self._failing
        try:
            if self._failing:
                self._check_disk()
                if self._lock is not None:
                    self._lock.renew()
                self._log.begin_after_failure()
                for batch in _batches(self._held):
                    self._pour(batch)
                self._log.sync()
            else:
                self._pour(items)
                if self._held.size >= _HELD_BYTES:
                    self._log.sync()
        except (LogError, OSError) as error:
            self._fail(error)
        else:
            if self._failing:
                self._failing = False
                self._notices.append(Notice(OK, f"{self._root} can be written again"))
                self._log.complete_truncated()
        self._let_go()
        if was_failing and not self._failing:
            give_back()

    def _pour(self, items: Sequence[Held]) -> None:
        for is_message, run in groupby(items, lambda item: isinstance(item, EncodedMessage)):
            if is_message:
                self._log.write([item for item in run if isinstance(item, EncodedMessage)])
                continue
            for description in run:
                assert isinstance(description, LogDescription)
                self._log.begin_anew(description, [])

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
            what = f"{self._root} cannot be written ({self._reason})"
            self._notices.append(Notice(WARNING, f"{what}: it is held in memory until it can"))

    def _let_go(self) -> None:
        """Drop the messages that are on the disk."""
        while self._held:
            begins_log = self._held.begins_log
            if self._safe == self._log.safe and (self._failing or not begins_log):
                return
            self._held.drop_first()
            self._safe += not begins_log


def _batches(held: Iterable[Held]) -> Iterator[list[Held]]:
    """Split held items at a change of the log time: files may begin there."""
    batch: list[Held] = []
    last = -1
    for item in held:
        now = item.log_time if isinstance(item, EncodedMessage) else -1
        if len(batch) >= _WRITTEN_AT_ONCE and now != last:
            yield batch
            batch = []
        batch.append(item)
        last = now
    yield batch


def _mount_of(folder: Path) -> Path:
    """Return the mount point of a folder that may not exist yet."""
    folder = folder.resolve()
    return next(path for path in (folder, *folder.parents) if path.is_mount())
