"""The log that is being recorded: one file after another, aligned to the clock."""

import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hearthlog.recorder.pipeline import Record, opening
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.files import active_path, log_path
from hearthlog.schemas.logs.writer import Attachment, LogWriter
from hearthlog.schemas.messages.message_types import header
from hearthlog.schemas.messages.topics import Topic
from hearthlog.schemas.times import NANOSECONDS

# What may lie between a sound and its being written: a block of frames, and the capture's delay.
_DELAY_SECONDS = 0.9
_FILES = 256  # that are remembered: of a second each, more than what clips are held back
_NEVER = (1 << 63) - 1


@dataclass(frozen=True)
class LogDescription:
    """What every file of a recording says of itself.

    Attributes
    ----------
    infos : sequence of messages
        The `AudioStreamInfo` of each microphone, without its stamp.
    """

    root: Path
    node: str
    topics: Sequence[Topic]
    infos: Sequence[Any]
    metadata: Mapping[str, str]
    attachments: Sequence[Attachment]


class RollingLog:
    """Writes records into hourly files.

    Parameters
    ----------
    description : LogDescription
    file_seconds : int
        Files begin at multiples of this, in UTC.
    flush_seconds : float
        A killed process loses at most this much sound.
    sync_seconds : float
        A power cut loses at most this much sound.
    """

    def __init__(
        self,
        description: LogDescription,
        file_seconds: int,
        flush_seconds: float,
        sync_seconds: float,
    ) -> None:
        self.finished: list[Path] = []
        self._description = description
        self._file_nanoseconds = file_seconds * NANOSECONDS
        self._flush_nanoseconds = int((flush_seconds - _DELAY_SECONDS) * NANOSECONDS)
        self._sync_seconds = sync_seconds - _DELAY_SECONDS
        self._writer: LogWriter | None = None
        self._last = self._until = 0  # no time lies between: the first record opens a file
        self._flush_at: int | None = None
        self._synced = time.monotonic()
        self._begun: deque[tuple[int, Path]] = deque(maxlen=_FILES)

    def write(self, records: Sequence[Record]) -> None:
        """Append records, in the order of their log times.

        Where time runs backwards, because the clock was set, another file begins.

        Raises
        ------
        LogError
            If the disk refuses; what was written stays, for the next start to complete.
        """
        with self._keeping_what_was_written():
            for record in records:
                if not self._last <= record.log_time < self._until:
                    self._roll(record.log_time)
                self._append(record)
            if self._flush_at is not None and self._last >= self._flush_at:
                self.flush()
            if time.monotonic() - self._synced >= self._sync_seconds:
                self.sync()

    def flush(self) -> None:
        """Hand what was written to the operating system."""
        if self._writer is not None and self._flush_at is not None:
            self._writer.flush()
            self._flush_at = None

    def sync(self) -> None:
        """Wait until what was written is on the disk."""
        self.flush()
        if self._writer is not None:
            self._writer.sync()
        self._synced = time.monotonic()

    def finish(self, records: Sequence[Record] = ()) -> None:
        """Append the last records to the file that is open, and complete it.

        Raises
        ------
        LogError
            If the disk refuses; what was written stays, for the next start to complete.
        """
        with self._keeping_what_was_written():
            if self._writer is not None:
                for record in records:
                    self._append(record)
            self._finish_file()

    def may_begin(self, stamp: int) -> bool:
        """Tell whether there is a name left for a file that begins at a time: one a second."""
        path = log_path(self._description.root, self._description.node, stamp)
        return not (path.exists() or active_path(path).exists())

    def file_at(self, stamp: int) -> tuple[Path, int]:
        """Return which of the last files has a time that was written, and the end of that file.

        Where the clock was set back and files speak of the same time, it is the later one.
        """
        until = _NEVER
        for start, path in reversed(self._begun):
            if start <= stamp:
                return path, until
            until = start
        return self._begun[0][1], until

    def begin_anew(self, description: LogDescription, records: Sequence[Record]) -> None:
        """Complete the file as `finish` does; the next record begins one of other content."""
        self.finish(records)
        self._description = description
        self._until = 0

    @contextmanager
    def _keeping_what_was_written(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            kept = ""
            if self._writer is not None:
                self._writer.abandon()
                self._writer = None
                kept = "; what was recorded is kept and completed at the next start"
            what = error.strerror or str(error)
            root = self._description.root
            raise LogError(f"{root}: cannot be written ({what}){kept}") from error

    def _finish_file(self) -> None:
        if self._writer is not None:
            self.finished.append(self._writer.finish())
            self._writer = None

    def _append(self, record: Record) -> None:
        assert self._writer is not None
        self._writer.write(record.topic, record.log_time, record.data)
        self._last = record.log_time
        if self._flush_at is None:
            self._flush_at = record.log_time + self._flush_nanoseconds

    def _roll(self, stamp: int) -> None:
        self._finish_file()
        about = self._description
        path = log_path(about.root, about.node, stamp)
        self._writer = LogWriter(path, about.topics, about.metadata, about.attachments, stamp)
        self._begun.append((stamp, path))
        self._last = stamp
        self._until = (stamp // self._file_nanoseconds + 1) * self._file_nanoseconds
        for info in about.infos:
            info.header = header(stamp, info.header.frame_id)
            for record in opening(info):
                self._append(record)
        self._writer.flush()  # the file now says what it is, whatever happens next
        self._flush_at = None
