"""Write a log: MCAP of profile `ros2`, under another name until it is complete."""

import fcntl
import json
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from schemas import rosbag2
from schemas.chunkwriter import Block, ChunkWriter
from schemas.errors import LogError
from schemas.files import active_path, sync_folder
from schemas.messages import definition, type_hash
from schemas.rows import Column, Int64, encode_groups
from schemas.topics import Topic

PROFILE = "ros2"
ENCODING = "cdr"
SCHEMA_ENCODING = "ros2msg"
METADATA = "hearthlog"


@dataclass(frozen=True)
class Attachment:
    """A file carried inside a log."""

    name: str
    media_type: str
    data: bytes


class Rows(NamedTuple):
    """Messages of one topic as columns.

    Attributes
    ----------
    topic : str
    log_times : np.ndarray [shape=(n,)], int64
        Nanoseconds; the publish times are the same.
    fields : mapping of str to column
        As `schemas.rows.encode_groups` takes them.
    """

    topic: str
    log_times: Int64
    fields: Mapping[str, Column]


class LogWriter:
    """One log being written.

    What was written is on its way to the disk after `flush`, and survives a power cut after
    `sync`; only `finish` gives the file its name.

    Parameters
    ----------
    path : Path
        Name of the finished log. Neither it nor its active name may exist.
    topics : sequence of Topic
    metadata : mapping of str to str
        The `hearthlog` record: what made this log.
    attachments : sequence of Attachment
    created : int
        Time of the attachments, in nanoseconds of UTC.

    Raises
    ------
    LogError
        If there is such a log already.
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
        self._channels: dict[str, int] = {}
        self._counts: dict[str, rosbag2.TopicCount] = {}
        self._span: tuple[int, int] | None = None
        self._stream = _create(path, self.active_path)
        self._writer = ChunkWriter(self._stream)
        self._writer.start(profile=PROFILE, library="hearthlog")
        self._writer.add_metadata(METADATA, dict(metadata))
        for item in attachments:
            self._writer.add_attachment(created, created, item.name, item.media_type, item.data)
        schemas: dict[str, int] = {}
        for topic in topics:
            if topic.type not in schemas:
                schemas[topic.type] = self._writer.register_schema(
                    topic.type, SCHEMA_ENCODING, definition(topic.type).encode()
                )
            about = _channel_metadata(topic)
            self._counts[topic.name] = rosbag2.TopicCount(topic.type, about)
            self._channels[topic.name] = self._writer.register_channel(
                topic.name, ENCODING, schemas[topic.type], about
            )

    def write(self, topic: str, log_time: int, data: bytes) -> None:
        """Append one encoded message; its publish time is its log time."""
        self._writer.add_message(self._channels[topic], log_time, data, log_time)
        self._count(topic, 1, log_time, log_time)

    def write_columns(self, batch: Sequence[Rows]) -> None:
        """Append messages of several topics, in the order of their log times.

        Messages of one time are written in the order of the batch. The file is the same as if
        they had been encoded and written one by one.
        """
        blocks = []
        first = 0
        for part in batch:
            count = len(part.log_times)
            for rows, payloads in encode_groups(self._counts[part.topic].type, part.fields, count):
                times = part.log_times[rows]
                sequences = np.zeros(len(rows), np.uint32)
                channel = self._channels[part.topic]
                blocks.append(Block(channel, times, times, sequences, payloads, first + rows))
            first += count
            if count:
                span = int(part.log_times.min()), int(part.log_times.max())
                self._count(part.topic, count, *span)
        self._writer.write(blocks)

    def flush(self) -> None:
        """End the chunk and hand it to the operating system."""
        self._writer.flush()
        self._stream.flush()

    def sync(self) -> None:
        """Wait until what was flushed is on the disk."""
        os.fsync(self._stream.fileno())

    def finish(self) -> Path:
        """Complete the log, give it its name and return it."""
        about = rosbag2.file_metadata(self.path.name, self._counts, self._span or (0, 0))
        self._writer.add_metadata(rosbag2.METADATA, about)
        self._writer.finish()
        self._stream.flush()
        self.sync()
        self._stream.close()
        self.active_path.rename(self.path)
        sync_folder(self.path.parent)
        return self.path

    def abandon(self) -> None:
        """Stop writing and leave the active file as it is, after the disk refused it."""
        with suppress(OSError):  # it is the reason for being here
            self._stream.close()

    def _count(self, topic: str, messages: int, first: int, last: int) -> None:
        self._counts[topic].messages += messages
        start, end = self._span or (first, last)
        self._span = min(start, first), max(end, last)


def _create(path: Path, active: Path) -> BinaryIO:
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.exists():
        raise LogError(f"{path}: exists already; move it away or record into another folder")
    try:
        stream = active.open("xb")
    except FileExistsError as error:
        raise LogError(
            f"{active}: is being written, or was left by a recorder that was killed"
        ) from error
    # By this lock a recorder knows another one's file from one that was left behind.
    fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    sync_folder(path.parent)
    return stream


def _channel_metadata(topic: Topic) -> dict[str, str]:
    names = {f"{key}_names": json.dumps(list(value)) for key, value in topic.array_names.items()}
    ros = rosbag2.channel_metadata(type_hash(topic.type), topic.quality)
    return ros | names
