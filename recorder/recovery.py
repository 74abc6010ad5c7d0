"""Complete the logs that a killed recorder left behind."""

import fcntl
import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    Channel,
    Chunk,
    Header,
    McapRecord,
    Message,
    Metadata,
    Schema,
)
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import MCAP0_MAGIC, Writer

from recorder.stream import FRAME_NANOSECONDS
from schemas import messages, rosbag2
from schemas.errors import LogError
from schemas.files import ACTIVE_SUFFIX, SUFFIX, sync_folder

_RECORD_LIMIT = 256 << 20  # bytes; ours are below 2 MiB
_HEAD = struct.Struct("<BQ")  # opcode and length
_READ = {  # the others index these
    Opcode.HEADER,
    Opcode.SCHEMA,
    Opcode.CHANNEL,
    Opcode.MESSAGE,
    Opcode.CHUNK,
    Opcode.ATTACHMENT,
    Opcode.METADATA,
    Opcode.FOOTER,
}
_TAIL_LIMIT = 64 << 10  # a longer one was not left by a writer that was killed between two flushes


def read_records(path: Path) -> Iterator[McapRecord]:
    """Read the records of a log, those inside chunks too, up to the point where it is cut.

    The last record is a `Footer` if the log is complete.

    Raises
    ------
    LogError
        If this is no MCAP file, or if it is damaged before its end.
    """
    with path.open("rb") as stream:
        magic = stream.read(len(MCAP0_MAGIC))
        if path.name.endswith(ACTIVE_SUFFIX) and MCAP0_MAGIC.startswith(magic):
            pass  # at first a writer has written less than that
        elif magic != MCAP0_MAGIC:
            raise LogError(f"{path}: is no MCAP file")
        while True:
            offset = stream.tell()
            try:
                content = _next_record(stream, path.stat().st_size - offset)
                records = [] if content is None else _parsed(content)
            except Exception as error:  # the decompressors raise what they like
                what = str(error) or type(error).__name__
                raise LogError(f"{path}: damaged at byte {offset} ({what})") from error
            yield from records
            if content is None or content[0] == Opcode.FOOTER:
                return


def _next_record(stream: BinaryIO, rest: int) -> bytes | None:
    """Read one record as it is; None at the end of what was written."""
    head = stream.read(_HEAD.size)
    length = _HEAD.unpack(head)[1] if len(head) == _HEAD.size else _RECORD_LIMIT
    if len(head) + length > rest:
        if rest > _TAIL_LIMIT:
            raise McapError("a record claims to be longer than the file")
        return None
    if length > _RECORD_LIMIT:
        raise McapError("a record claims to be too large")
    return head + stream.read(length)


def _parsed(content: bytes) -> list[McapRecord]:
    if content[0] not in _READ:
        return []
    record = next(StreamReader(BytesIO(content), skip_magic=True, emit_chunks=True).records)
    if not isinstance(record, Chunk):
        return [record]
    if record.uncompressed_size > _RECORD_LIMIT:
        raise McapError("a chunk claims to be too large")
    return breakup_chunk(record, validate_crc=True)


@dataclass(frozen=True)
class Recovered:
    """A log that was completed.

    Attributes
    ----------
    path : Path
    end : int
        End of its last frame, in nanoseconds of UTC; 0 if it has none.
    damage : str
        Why less than the whole file could be read; empty if it only ended early.
    """

    path: Path
    end: int
    damage: str


def recover_active(root: Path, node: str) -> list[Recovered]:
    """Complete all logs of a node that nobody writes any more.

    Each is copied to its final name up to where it was cut, read again and counted, and only
    then removed. One that is damaged, or holds no message, is kept beside it as `*.damaged`.
    """
    found = []
    for active in sorted(root.rglob(f"{node}_*{ACTIVE_SUFFIX}")):
        with _abandoned(active) as is_abandoned:
            if is_abandoned:
                found += _recover(active)
    return found


def _recover(active: Path) -> list[Recovered]:
    path = active.with_name(active.name.removesuffix(ACTIVE_SUFFIX) + SUFFIX)
    copy = active.with_name(path.name + ".recovering")
    try:
        with copy.open("wb") as stream:
            log = _Copy(stream)
            log.read(active)
            if log.count:
                log.finish(path.name)
            stream.flush()
            os.fsync(stream.fileno())
        _put_in_place(copy, path, log.count)
    except OSError as error:
        copy.unlink(missing_ok=True)
        what = error.strerror or str(error)
        raise LogError(f"{active}: cannot be completed ({what}); it is left as it is") from error
    if log.damage or not log.count:
        active.rename(active.with_name(path.name + ".damaged"))
    else:
        active.unlink()
    sync_folder(path.parent)
    return [Recovered(path, log.end, log.damage)] if log.count else []


def _put_in_place(copy: Path, path: Path, count: int) -> None:
    if not count:
        copy.unlink()
        return
    _check(copy, count)
    if not path.exists():
        copy.rename(path)
        return
    copy.unlink()
    _check(path, count)  # else an earlier start got as far as this, and no further


class _Copy:
    """A log being copied record by record."""

    def __init__(self, stream: BinaryIO) -> None:
        self.count = 0
        self.end = 0
        self.damage = ""
        self._writer = Writer(stream)
        self._schemas: dict[int, tuple[int, str]] = {}
        self._channels: dict[int, tuple[int, rosbag2.TopicCount]] = {}
        self._topics: dict[str, rosbag2.TopicCount] = {}
        self._span = (1 << 64, 0)

    def read(self, source: Path) -> None:
        """Copy all complete records of a log."""
        try:
            for record in read_records(source):
                self._add(record)
        except LogError as error:
            self.damage = str(error)

    def finish(self, name: str) -> None:
        """Complete the copy, which will bear this name."""
        about = rosbag2.file_metadata(name, self._topics, self._span)
        self._writer.add_metadata(rosbag2.METADATA, about)
        self._writer.finish()

    def _add(self, record: object) -> None:
        if isinstance(record, Message):
            self._add_message(record)
        elif isinstance(record, Header):
            self._writer.start(record.profile, record.library)
        elif isinstance(record, Metadata):
            self._writer.add_metadata(record.name, record.metadata)
        elif isinstance(record, Attachment):
            self._writer.add_attachment(
                record.create_time, record.log_time, record.name, record.media_type, record.data
            )
        elif isinstance(record, Schema) and record.id not in self._schemas:
            new = self._writer.register_schema(record.name, record.encoding, record.data)
            self._schemas[record.id] = new, record.name
        elif isinstance(record, Channel) and record.id not in self._channels:
            schema, name = self._schemas[record.schema_id]
            topic = rosbag2.TopicCount(name, record.metadata)
            new = self._writer.register_channel(
                record.topic, record.message_encoding, schema, record.metadata
            )
            self._channels[record.id] = new, topic
            self._topics[record.topic] = topic

    def _add_message(self, record: Message) -> None:
        channel, topic = self._channels[record.channel_id]
        self._writer.add_message(
            channel, record.log_time, record.data, record.publish_time, record.sequence
        )
        topic.messages += 1
        self.count += 1
        self._span = min(self._span[0], record.log_time), max(self._span[1], record.log_time)
        if topic.type == messages.FEATURES:
            self.end = max(self.end, record.log_time + FRAME_NANOSECONDS)


def _check(path: Path, expected: int) -> None:
    count = sum(isinstance(record, Message) for record in read_records(path))
    if count != expected:
        raise LogError(f"{path}: holds {count} messages of {expected} that were recovered")


@contextmanager
def _abandoned(path: Path) -> Iterator[bool]:
    """Hold the file's lock, unless a recorder does."""
    with path.open("rb") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
        else:
            yield True
