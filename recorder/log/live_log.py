"""The log of a recorder that never ends: what its disk refuses is held until it takes it again."""

import errno
import os
import shutil
import time
from collections import deque
from collections.abc import Iterable, Sequence
from itertools import groupby
from pathlib import Path

from hearthlog.recorder.events import OK, WARNING, Notice
from hearthlog.recorder.log.description import LogDescription
from hearthlog.recorder.log.folder_lock import FolderLock
from hearthlog.recorder.log.recovery import recover_active
from hearthlog.recorder.log.rolling_log import RollingLog
from hearthlog.recorder.stream.messages import EncodedMessage
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.times import NANOSECONDS

_HELD_BYTES = 8 << 20  # twenty minutes of one microphone
_RETRY_SECONDS = 2.0
_SPARE_BYTES = 1 << 20  # what must be free beside what is held

_Held = EncodedMessage | LogDescription  # a description: here another log begins


class LiveLog:
    """Writes messages to a rolling log, and holds them in memory while the disk refuses them.

    Parameters
    ----------
    log : RollingLog
        Live.
    root : Path
        Its folder.
    node : str
        Name of the recorder.
    lock : FolderLock or None
        Of the folder.
    """

    def __init__(
        self, log: RollingLog, root: Path, node: str, lock: FolderLock | None = None
    ) -> None:
        self._log = log
        self._root = root
        self._node = node
        self._lock = lock
        self._mount = _mount_of(root)
        self._held: deque[_Held] = deque()  # not yet known to be on the disk
        self._held_bytes = 0
        self._safe = 0  # messages that were held and no longer are
        self._failing = False
        self._reason = ""
        self._retry_at = 0.0
        self._notices: list[Notice] = []

    @property
    def is_full(self) -> bool:
        """Whether nothing more can be held, so that sound must be dropped."""
        return self._failing and self._held_bytes >= _HELD_BYTES

    @property
    def finished(self) -> list[Path]:
        """Files that are complete."""
        return self._log.finished

    def write(self, messages: Sequence[EncodedMessage]) -> None:
        """Append messages, or hold them.

        Parameters
        ----------
        messages : sequence of EncodedMessage
            In the order of their log times.
        """
        self._hold(messages)
        self._write(messages)

    def notices(self) -> list[Notice]:
        """Return what people should know of the disk, since the last call."""
        notices, self._notices = self._notices, []
        return notices

    def may_begin(self, stamp: int) -> bool:
        """Tell whether a file may begin at a time, as `RollingLog.may_begin` does.

        Parameters
        ----------
        stamp : int
            In nanoseconds of UTC.
        """
        return not self._failing and self._log.may_begin(stamp)

    def file_at(self, stamp: int) -> tuple[Path, int]:
        """Find the file that contains a time, as `RollingLog.file_at` does.

        Parameters
        ----------
        stamp : int
            In nanoseconds of UTC.
        """
        return self._log.file_at(stamp)

    def begin_anew(self, description: LogDescription, messages: Sequence[EncodedMessage]) -> None:
        """Complete the open file, and let the next message begin one of another description.

        Parameters
        ----------
        description : LogDescription
            Of the files to come.
        messages : sequence of EncodedMessage
            The last ones of the open file, in the order of their log times.
        """
        self._hold([*messages, description])
        self._write([*messages, description])

    def finish(self, messages: Sequence[EncodedMessage] = ()) -> None:
        """Append the last messages, and complete the open file.

        Parameters
        ----------
        messages : sequence of EncodedMessage
            In the order of their log times.

        Raises
        ------
        LogError
            If the disk refuses them.
        """
        self._hold(messages)
        self._retry_at = 0.0
        self._write(messages)
        if self._failing:
            times = [item.log_time for item in self._held if isinstance(item, EncodedMessage)]
            seconds = (max(times) - min(times)) / NANOSECONDS if times else 0.0
            what = f"{self._root}: cannot be written ({self._reason})"
            raise LogError(f"{what}; the last {seconds:.0f} s are lost")
        self._log.finish()

    def _hold(self, items: Sequence[_Held]) -> None:
        self._held.extend(items)
        self._held_bytes += sum(map(_size, items))

    def _write(self, items: Sequence[_Held]) -> None:
        """Write what was just held, or all that is held if the disk refused it before."""
        if self._failing and time.monotonic() < self._retry_at:
            return
        try:
            if self._failing:
                self._check_disk()
                if self._lock is not None:
                    self._lock.renew()
                self._log.begin_after_failure()
                self._pour(self._held)
                self._log.sync()
            else:
                self._pour(items)
                if self._held_bytes >= _HELD_BYTES:
                    self._log.sync()
        except (LogError, OSError) as error:
            self._fail(error)
        else:
            if self._failing:
                self._failing = False
                self._notices.append(Notice(OK, f"{self._root} can be written again"))
                self._complete_what_was_cut()
        self._let_go()

    def _pour(self, items: Iterable[_Held]) -> None:
        for is_message, run in groupby(items, lambda item: isinstance(item, EncodedMessage)):
            if is_message:
                self._log.write([item for item in run if isinstance(item, EncodedMessage)])
                continue
            for description in run:
                assert isinstance(description, LogDescription)
                self._log.begin_anew(description, [])

    def _check_disk(self) -> None:
        if not self._mount.is_mount():  # the folder below it is on another disk
            raise OSError(errno.ENODEV, f"{self._mount} is not mounted")
        if shutil.disk_usage(self._mount).free < 2 * self._held_bytes + _SPARE_BYTES:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def _fail(self, error: LogError | OSError) -> None:
        cause = error.__cause__ if isinstance(error.__cause__, OSError) else error
        self._reason = getattr(cause, "strerror", None) or str(error)
        self._retry_at = time.monotonic() + _RETRY_SECONDS
        if not self._failing:
            self._failing = True
            what = f"{self._root} cannot be written ({self._reason})"
            self._notices.append(Notice(WARNING, f"{what}: it is held in memory until it can"))

    def _complete_what_was_cut(self) -> None:
        for recovered in recover_active(self._root, self._node):
            if recovered.damage:
                self._notices.append(Notice(WARNING, recovered.damage))

    def _let_go(self) -> None:
        """Forget the messages that are on the disk."""
        while self._held and (self._safe < self._log.safe or self._has_begun(self._held[0])):
            item = self._held.popleft()
            self._held_bytes -= _size(item)
            self._safe += isinstance(item, EncodedMessage)

    def _has_begun(self, item: _Held) -> bool:
        return isinstance(item, LogDescription) and not self._failing


def _size(item: _Held) -> int:
    return len(item.data) if isinstance(item, EncodedMessage) else 0


def _mount_of(folder: Path) -> Path:
    """Return the mount point of the disk of a folder that may not exist yet."""
    folder = folder.resolve()
    return next(path for path in (folder, *folder.parents) if path.is_mount())
