"""Writers of logs, MCAP of profile `ros2` with a contents record, to a stream or a file."""

import errno
import fcntl
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain, zip_longest
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from mcap.records import Channel, Schema

from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.contents import (
    CONTENTS_METADATA,
    LogContents,
    as_metadata,
    has_contents,
)
from hearthlog.schemas.logs.files import active_path
from hearthlog.schemas.logs.metadata import (
    HEARTHLOG_METADATA,
    ROSBAG2_METADATA,
    TopicCount,
    rosbag2_channel,
    rosbag2_metadata,
)
from hearthlog.schemas.mcap.chunk_writer import Block, ChunkWriter
from hearthlog.schemas.mcap.chunks import BATCH_SIZE
from hearthlog.schemas.mcap.compressed_chunk import LATEST, StoredChunk
from hearthlog.schemas.mcap.raw_messages import RawMessages, gather_heads
from hearthlog.schemas.mcap.records import INDEX_ENTRIES, MESSAGE_HEAD, Definitions
from hearthlog.schemas.messages.cdr_codec import Column, encode_groups
from hearthlog.schemas.messages.message_types import definition, type_hash
from hearthlog.schemas.messages.topics import Topic
from hearthlog.schemas.new_files import create_file, make_folders, sync_folder


class CountedWriter(ChunkWriter):
    """`ChunkWriter` whose last metadata record is `hearthlog_contents`.

    The record is omitted if it would be empty, if it or a chunk would be large, or if a message
    cannot be read.
    """

    def __init__(
        self,
        stream: BinaryIO,
        definitions: Definitions | None = None,
        chunk_span: int = LATEST,
    ) -> None:
        super().__init__(stream, chunk_span=chunk_span)
        self._copied = definitions
        self._contents: LogContents | None = LogContents()
        self._waiting: list[StoredChunk] = []  # one batch of a reader, for identical counts
        self._size = 0

    def add_metadata(self, name: str, data: dict[str, str]) -> None:
        """Write a metadata record; skip the contents record of another file."""
        if name != CONTENTS_METADATA:
            super().add_metadata(name, data)

    def finish(self) -> None:
        """Write the chunk in progress, the contents record, the index and the footer."""
        self.flush()
        self._count_waiting()
        channels, schemas = self._definitions()
        ours = any(has_contents(c, schemas.get(c.schema_id)) for c in channels.values())
        record = as_metadata(self._contents) if ours and self._contents is not None else None
        if record is not None:
            super().add_metadata(CONTENTS_METADATA, record)
        super().finish()

    def copy_large_chunk(self, chunk: StoredChunk, length: int, data: Iterable[bytes]) -> None:
        """Write a chunk of another file; its messages are not counted."""
        self._give_up()
        super().copy_large_chunk(chunk, length, data)

    def _put(self, chunk: StoredChunk) -> int:
        length = super()._put(chunk)
        batch = self._size // BATCH_SIZE
        self._size += chunk.size + length
        if self._size // BATCH_SIZE != batch:
            self._count_waiting()
        if chunk.size > BATCH_SIZE:
            self._give_up()  # not from a recorder, and too large to keep
        if self._contents is not None:
            self._waiting.append(chunk)
        return length

    def _count_waiting(self) -> None:
        if self._contents is None or not self._waiting:
            return
        try:
            self._contents.add(_messages(self._waiting, *self._definitions()))
        except LogError:
            self._give_up()
        else:
            self._waiting = []
            if as_metadata(self._contents) is None:
                self._give_up()

    def _give_up(self) -> None:
        self._contents = None
        self._waiting = []

    def _definitions(self) -> tuple[dict[int, Channel], dict[int, Schema]]:
        if self._copied is not None:
            return self._copied.channels, self._copied.schemas
        return {c.id: c for c in self._channels}, {s.id: s for s in self._schemas}


def _messages(
    chunks: list[StoredChunk], channels: dict[int, Channel], schemas: dict[int, Schema]
) -> list[RawMessages]:
    """Read the messages of chunks, in the order of a reader."""
    contents = [chunk.content() if chunk.raw is None else chunk.raw for chunk in chunks]
    buffer = np.frombuffer(b"".join(contents), np.uint8)
    bases = np.cumsum([0, *map(len, contents)]).tolist()
    messages = []
    numbers = chain.from_iterable(zip_longest(*(chunk.entries for chunk in chunks)))
    for number in dict.fromkeys(n for n in numbers if n is not None):
        starts = np.concatenate(
            [
                np.frombuffer(chunk.entries[number], INDEX_ENTRIES)["offset"] + base
                for chunk, base in zip(chunks, bases, strict=False)
                if number in chunk.entries
            ]
        )
        heads = gather_heads(buffer, starts)
        order = np.argsort(heads["log_time"], kind="stable")
        channel = channels[number]
        schema = schemas.get(channel.schema_id)
        offsets = starts[order] + MESSAGE_HEAD.itemsize
        messages.append(RawMessages(channel, schema, buffer, offsets, heads[order]))
    return messages


PROFILE = "ros2"
ENCODING = "cdr"
SCHEMA_ENCODING = "ros2msg"


@dataclass(frozen=True)
class Attachment:
    """File inside a log."""

    name: str
    media_type: str
    data: bytes


class TopicBatch(NamedTuple):
    """Messages of one topic as columns."""

    topic: str
    log_times: Int64  # [shape=(n,)] nanoseconds; also the publish times
    fields: Mapping[str, Column]


class LogStreamWriter:
    """Writer of a log to a stream."""

    def __init__(self, stream: BinaryIO, topics: Sequence[Topic], chunk_span: int = LATEST) -> None:
        self._channels: dict[str, int] = {}
        self._topics: dict[str, TopicCount] = {}
        self._writer = CountedWriter(stream, chunk_span=chunk_span)
        self._writer.start(profile=PROFILE, library="hearthlog")
        schemas: dict[str, int] = {}
        for topic in topics:
            if topic.type not in schemas:
                schemas[topic.type] = self._writer.register_schema(
                    topic.type, SCHEMA_ENCODING, definition(topic.type).encode()
                )
            names = {f"{key}_names": json.dumps([*n]) for key, n in topic.array_names.items()}
            ros = rosbag2_channel(type_hash(topic.type), topic.quality)
            channel_metadata = ros | names | dict(topic.metadata)
            self._topics[topic.name] = TopicCount(topic.type, channel_metadata)
            self._channels[topic.name] = self._writer.register_channel(
                topic.name, ENCODING, schemas[topic.type], channel_metadata
            )

    def add_metadata(self, name: str, metadata: Mapping[str, str]) -> None:
        """Append a metadata record."""
        self._writer.add_metadata(name, dict(metadata))

    def add_attachment(self, attachment: Attachment, created: int) -> None:
        """Append a file, created at a time in nanoseconds of UTC."""
        item = attachment
        self._writer.add_attachment(created, created, item.name, item.media_type, item.data)

    def write_messages(self, messages: Sequence[tuple[int, str, bytes]]) -> None:
        """Append messages in the order of log times: nanoseconds of UTC, topic, CDR.

        A log time is also the publish time; the topic is one of the writer.
        """
        if messages:
            times, topics, payloads = zip(*messages, strict=True)
            channels = [self._channels[topic] for topic in topics]
            self._writer.add_messages(channels, times, payloads)

    def write_columns(self, batch: Sequence[TopicBatch]) -> None:
        """Append messages of several topics, in the order of their log times.

        The result equals that of messages encoded and written one by one. Raise `LogError` if a
        message cannot be encoded; see `encode_groups`.
        """
        blocks: list[Block] = []
        first = 0
        for part in batch:
            count = len(part.log_times)
            for rows, payloads in encode_groups(self._topics[part.topic].type, part.fields, count):
                times = part.log_times[rows]
                sequences = np.zeros(len(rows), np.uint32)
                channel = self._channels[part.topic]
                blocks.append(Block(channel, times, times, sequences, payloads, first + rows))
            first += count
        self._writer.write(blocks)

    def flush(self) -> None:
        """End the chunk in progress."""
        self._writer.flush()

    def end(self, name: str) -> None:
        """Write the index and the other records at the end of the log."""
        self._writer.flush()
        for topic, channel in self._channels.items():
            self._topics[topic].messages = self._writer.message_counts.get(channel, 0)
        metadata = rosbag2_metadata(name, self._topics, self._writer.span)
        self._writer.add_metadata(ROSBAG2_METADATA, metadata)
        self._writer.finish()


class LogWriter(LogStreamWriter):
    """Log that is being written to `path`, under its active name; neither may exist.

    `flush` hands data to the operating system, and after `sync` they survive a power cut; only
    `finish` renames the file to its final name, and `complete` leaves that to the caller. `created`
    is the time of the attachments, in nanoseconds of UTC. Raise `LogError` if the log exists, or is
    being written, `OSError` if the folder or the file cannot be written.
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
        self._synced = 0  # bytes on disk
        self._stream = _create(path, self.active_path)
        self._status = os.fstat(self._stream.fileno())
        try:
            super().__init__(self._stream, topics)
            self.add_metadata(HEARTHLOG_METADATA, metadata)
            for attachment in attachments:
                self.add_attachment(attachment, created)
        except OSError:
            self.abandon()
            self.discard_unsynced()
            raise

    @property
    def size(self) -> int:
        """Number of flushed bytes."""
        return self._stream.tell()

    def write(self, topic: str, log_time: int, data: bytes) -> None:
        """Append one encoded message, as `write_messages` does."""
        self.write_messages([(log_time, topic, data)])

    def flush(self) -> None:
        """End the chunk and pass it to the operating system; raise `OSError` if that fails."""
        super().flush()
        self._stream.flush()

    def sync(self) -> None:
        """Wait until the flushed data are on disk.

        Raise `OSError` if the file cannot be written, or has been deleted.
        """
        os.fsync(self._stream.fileno())
        if not self._has_its_name():
            raise FileNotFoundError(errno.ENOENT, "the file was deleted or moved away")
        self._synced = os.fstat(self._stream.fileno()).st_size

    def complete(self) -> None:
        """Finish the log under its active name; raise `OSError` if it cannot be written."""
        self.end(self.path.name)
        self._stream.flush()
        self.sync()
        self._stream.close()

    def finish(self) -> Path:
        """Finish the log, rename it to its final name, and return the path.

        Raise `OSError` if the file cannot be written or renamed.
        """
        self.complete()
        self.active_path.rename(self.path)
        sync_folder(self.path.parent)
        return self.path

    def abandon(self) -> None:
        """Stop writing after a disk error, and leave the active file unchanged."""
        with suppress(OSError):  # the error that led here
            self._stream.close()

    def discard_unsynced(self) -> None:
        """Truncate the abandoned file to its synced bytes, or delete it if there are none.

        Raise `OSError` if the disk refuses.
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
    # The lock distinguishes the file of a running recorder from an abandoned one.
    fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    sync_folder(path.parent)
    return stream
