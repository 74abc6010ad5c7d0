"""Write a log: MCAP of profile `ros2`, under another name until it is complete."""

import errno
import fcntl
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.files import active_path
from hearthlog.schemas.logs.log_stream import Attachment, LogStreamWriter, TopicBatch
from hearthlog.schemas.logs.provenance import METADATA
from hearthlog.schemas.messages.topics import Topic
from hearthlog.schemas.storage.new_files import create_file, make_folders, sync_folder


class LogWriter:
    """One log being written.

    What was written is on its way to the disk after `flush`, and survives a power cut after
    `sync`; only `finish` gives the file its name, and `complete` leaves that to others.

    Parameters
    ----------
    path : Path
        Name of the finished log. Neither it nor its active name may exist.
    created : int
        Time of the attachments, in nanoseconds of UTC.

    Raises
    ------
    LogError
        If the log exists already, or is being written.
    OSError
        If the folder or the file cannot be written.
    """

    def __init__(
        self,
        path: Path,
        topics: Sequence[Topic],
        metadata: Mapping[str, str],
        attachments: Sequence[Attachment] = (),
        created: int = 0,
    ) -> None:
        self.path = path
        self.active_path = active_path(path)
        self._synced = 0  # bytes
        self._stream = _create(path, self.active_path)
        self._status = os.fstat(self._stream.fileno())
        try:
            self._content = LogStreamWriter(self._stream, topics)
            self._content.add_metadata(METADATA, metadata)
            for attachment in attachments:
                self._content.add_attachment(attachment, created)
        except OSError:
            self.abandon()
            self.discard_unsynced()
            raise

    @property
    def size(self) -> int:
        """Bytes that were flushed."""
        return self._stream.tell()

    def write(self, topic: str, log_time: int, data: bytes) -> None:
        """Append one encoded message, as `write_messages` does."""
        self._content.write_messages([(log_time, topic, data)])

    def write_messages(self, messages: Sequence[tuple[int, str, bytes]]) -> None:
        """Append encoded messages, as `LogStreamWriter.write_messages` does.

        Raise `OSError` if the file cannot be written.
        """
        self._content.write_messages(messages)

    def write_columns(self, batch: Sequence[TopicBatch]) -> None:
        """Append messages of several topics, as `LogStreamWriter.write_columns` does.

        Raise `LogError` if a message cannot be encoded; see `encode_groups`. Raise `OSError` if
        the file cannot be written.
        """
        self._content.write_columns(batch)

    def flush(self) -> None:
        """End the chunk and hand it to the operating system.

        Raise `OSError` if the file cannot be written.
        """
        self._content.flush()
        self._stream.flush()

    def sync(self) -> None:
        """Wait until what was flushed is on the disk.

        Raise `OSError` if the file cannot be written, or has been deleted.
        """
        os.fsync(self._stream.fileno())
        if not self._has_its_name():
            raise FileNotFoundError(errno.ENOENT, "the file was deleted or moved away")
        self._synced = os.fstat(self._stream.fileno()).st_size

    def complete(self) -> None:
        """Complete the log under its active name.

        Raise `OSError` if the file cannot be written.
        """
        self._content.finish(self.path.name)
        self._stream.flush()
        self.sync()
        self._stream.close()

    def finish(self) -> Path:
        """Complete the log, give it its name, and return that.

        Raise `OSError` if the file cannot be written or renamed.
        """
        self.complete()
        self.active_path.rename(self.path)
        sync_folder(self.path.parent)
        return self.path

    def abandon(self) -> None:
        """Stop writing and leave the active file as it is, after the disk refused it."""
        with suppress(OSError):  # it is the reason for being here
            self._stream.close()

    def discard_unsynced(self) -> None:
        """Cut the abandoned file to what is known to be on the disk, or delete it if nothing is.

        Raise `OSError` if the disk refuses that too.
        """
        if not self._has_its_name():
            return
        if self._synced:
            os.truncate(self.active_path, self._synced)
        else:
            self.active_path.unlink()

    def _has_its_name(self) -> bool:
        try:
            return os.path.samestat(self._status, self.active_path.stat())
        except FileNotFoundError:
            return False


def _create(path: Path, active: Path) -> BinaryIO:
    make_folders(path.parent)
    if path.exists():
        raise LogError(f"{path}: exists already; move it away or record into another folder")
    try:
        stream = create_file(active, 0o666)
    except FileExistsError as error:
        raise LogError(
            f"{active}: is being written, or was left by a recorder that was killed"
        ) from error
    # By this lock a recorder knows another one's file from one that was left behind.
    fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    sync_folder(path.parent)
    return stream
