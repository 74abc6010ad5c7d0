"""What is in a log, written to a stream: MCAP of profile `ros2`."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import BinaryIO, NamedTuple

import numpy as np

from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.logs import rosbag2
from hearthlog.schemas.logs.counted_writer import CountedWriter
from hearthlog.schemas.mcap.message_blocks import Block
from hearthlog.schemas.mcap.stored_chunk import LATEST
from hearthlog.schemas.messages.cdr_codec import Column, encode_groups
from hearthlog.schemas.messages.message_types import definition, type_hash
from hearthlog.schemas.messages.topics import Topic

PROFILE = "ros2"
ENCODING = "cdr"
SCHEMA_ENCODING = "ros2msg"


@dataclass(frozen=True)
class Attachment:
    """A file carried inside a log."""

    name: str
    media_type: str
    data: bytes


class TopicBatch(NamedTuple):
    """Messages of one topic as columns.

    Attributes
    ----------
    log_times : np.ndarray [shape=(n,)], int64
        Nanoseconds; the publish times are the same.
    """

    topic: str
    log_times: Int64
    fields: Mapping[str, Column]


class LogStreamWriter:
    """Writes a log to a stream."""

    def __init__(self, stream: BinaryIO, topics: Sequence[Topic], chunk_span: int = LATEST) -> None:
        self._channels: dict[str, int] = {}
        self._topics: dict[str, rosbag2.TopicCount] = {}
        self._writer = CountedWriter(stream, chunk_span=chunk_span)
        self._writer.start(profile=PROFILE, library="hearthlog")
        schemas: dict[str, int] = {}
        for topic in topics:
            if topic.type not in schemas:
                schemas[topic.type] = self._writer.register_schema(
                    topic.type, SCHEMA_ENCODING, definition(topic.type).encode()
                )
            names = {f"{key}_names": json.dumps([*n]) for key, n in topic.array_names.items()}
            ros = rosbag2.channel_metadata(type_hash(topic.type), topic.quality)
            channel_metadata = ros | names | dict(topic.metadata)
            self._topics[topic.name] = rosbag2.TopicCount(topic.type, channel_metadata)
            self._channels[topic.name] = self._writer.register_channel(
                topic.name, ENCODING, schemas[topic.type], channel_metadata
            )

    def add_metadata(self, name: str, metadata: Mapping[str, str]) -> None:
        """Append a metadata record."""
        self._writer.add_metadata(name, dict(metadata))

    def add_attachment(self, attachment: Attachment, created: int) -> None:
        """Append a file.

        Parameters
        ----------
        created : int
            Time of the file, in nanoseconds of UTC.
        """
        item = attachment
        self._writer.add_attachment(created, created, item.name, item.media_type, item.data)

    def write_messages(self, messages: Sequence[tuple[int, str, bytes]]) -> None:
        """Append encoded messages, in the order of their log times.

        Parameters
        ----------
        messages : sequence of (int, str, bytes)
            Log time in nanoseconds of UTC, which is also the publish time; name of one of the
            writer's topics; CDR.
        """
        if messages:
            times, topics, payloads = zip(*messages, strict=True)
            channels = [self._channels[topic] for topic in topics]
            self._writer.add_messages(channels, times, payloads)

    def write_columns(self, batch: Sequence[TopicBatch]) -> None:
        """Append messages of several topics, in the order of their log times.

        The file is the same as if they had been encoded and written one by one.

        Raise `LogError` if a message cannot be encoded; see `encode_groups`.
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

    def finish(self, name: str) -> None:
        """Complete the log."""
        self._writer.flush()
        for topic, channel in self._channels.items():
            self._topics[topic].messages = self._writer.message_counts.get(channel, 0)
        metadata = rosbag2.file_metadata(name, self._topics, self._writer.span)
        self._writer.add_metadata(rosbag2.METADATA, metadata)
        self._writer.finish()
