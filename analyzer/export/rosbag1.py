"""Logs as a bag of ROS 1."""

import re
from collections.abc import Hashable
from typing import NamedTuple

from mcap.records import Schema
from rosbags.interfaces import Connection
from rosbags.rosbag1 import Writer
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from hearthlog.analyzer.export.exporter import Exporter, OutputFiles
from hearthlog.analyzer.export.merge import held_count
from hearthlog.analyzer.logs.selection import Selection
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.log_stream import ENCODING, SCHEMA_ENCODING
from hearthlog.schemas.mcap.raw_messages import RawMessages
from hearthlog.schemas.messages.message_types import definition, typestore
from hearthlog.schemas.progress import Progress
from hearthlog.schemas.times import NANOSECONDS

_HEADER = "std_msgs/msg/Header"
_NAME = re.compile(r"[A-Za-z]\w*/msg/[A-Za-z]\w*", re.ASCII)
_TIME_LIMIT = NANOSECONDS << 32  # the year 2106
_LITTLE_ENDIAN = b"\x00\x01"


def _save(selection: Selection, files: OutputFiles, progress: Progress) -> None:
    """Write a bag; the sequence numbers of headers, which ROS 2 does not have, are 0."""
    selection.verify()
    with Writer(files.path) as writer:
        bag = _Bag(writer)
        for batch in selection.messages(progress):
            bag.write(batch)
        if not writer.connections:
            raise selection.nothing()


class _Topic(NamedTuple):
    """A connection of the bag, and how messages come to it."""

    connection: Connection
    types: Typestore

    def convert(self, payload: bytes) -> memoryview:
        name = self.connection.msgtype
        try:
            if not payload.startswith(_LITTLE_ENDIAN):
                message = self.types.deserialize_cdr(payload, name)
                payload = bytes(self.types.serialize_cdr(message, name, little_endian=True))
            return self.types.cdr_to_ros1(payload, name)
        except SerdeError as error:
            raise LogError(f"{self.connection.topic}: no message of type {name}") from error


class _Bag:
    """The bag being written."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._topics: dict[Hashable, _Topic] = {}
        self._trimmed = 0

    def write(self, batch: list[RawMessages]) -> None:
        """Append messages, in the order of their log times."""
        rows = []
        for messages in batch:
            topic = self._topic(messages)
            if messages.log_times[-1] >= _TIME_LIMIT:
                raise LogError(f"{messages.channel.topic}: ROS 1 has no times after 2106")
            ends = messages.offsets + messages.sizes
            places = zip(messages.offsets.tolist(), ends.tolist(), strict=True)
            payloads = (messages.buffer[first:end].tobytes() for first, end in places)
            times = messages.log_times.tolist()
            rows += [(t, topic, p) for t, p in zip(times, payloads, strict=True)]
        for time, topic, payload in sorted(rows, key=lambda row: row[0]):
            self._writer.write(topic.connection, time, topic.convert(payload))
        self._trim()

    def _trim(self) -> None:
        """Replace the places of messages in written chunks by their number, which is enough."""
        for chunk in self._writer.chunks[self._trimmed : -1]:
            counts = {key: range(len(each)) for key, each in chunk.connections.items()}
            chunk.connections = counts  # type: ignore[assignment]
        self._trimmed = len(self._writer.chunks) - 1

    def _topic(self, messages: RawMessages) -> _Topic:
        channel, schema = messages.channel, messages.schema
        if schema is None or channel.message_encoding != ENCODING:
            raise LogError(f"{channel.topic}: holds no ROS 2 messages")
        key = channel.topic, schema.name, schema.data
        if key not in self._topics:
            types = _types_of(schema)
            of_ros1 = get_typestore(Stores.EMPTY)
            header = get_typestore(Stores.ROS1_NOETIC).fielddefs[_HEADER]
            of_ros1.fielddefs.update({**types.fielddefs, _HEADER: header})
            text, digest = of_ros1.generate_msgdef(schema.name)
            connection = self._writer.add_connection(
                channel.topic,
                schema.name,
                msgdef=text,
                md5sum=digest,
                latching=int(held_count(channel) > 0),
            )
            self._topics[key] = _Topic(connection, types)
        return self._topics[key]


def _types_of(schema: Schema) -> Typestore:
    """Return the types by which messages of a channel are encoded."""
    ours = typestore()
    if schema.name in ours.fielddefs and schema.data == definition(schema.name).encode():
        return ours
    try:
        if schema.encoding != SCHEMA_ENCODING:
            raise LogError(f"{schema.name!r} is defined as {schema.encoding!r}")
        own = get_types_from_msg(schema.data.decode(), schema.name)
        for name in (schema.name, *own):
            if not _NAME.fullmatch(name):  # code is made of these types
                raise LogError(f"{name!r} is no name of a type")
        types = get_typestore(Stores.EMPTY)
        types.register({**ours.fielddefs, **own})
        types.get_msgdef(schema.name)
    except (TypesysError, UnicodeDecodeError, RecursionError, ValueError, KeyError) as error:
        raise LogError(f"the definition of {schema.name!r} cannot be read") from error
    return types


EXPORTER = Exporter(_save)
