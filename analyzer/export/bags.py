"""Export of logs as ROS 1 and ROS 2 bags, and a folder of logs described as one bag."""

import re
import warnings
from collections.abc import Hashable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag1,
    MessageDefinition,
    MessageDefinitionFormat,
    Nodetype,
)
from rosbags.rosbag1 import Writer
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_typestore
from rosbags.typesys.msg import normalize_msgtype
from rosbags.typesys.store import Typestore

from hearthlog.analyzer.export.exporter import Exporter, OutputFiles
from hearthlog.analyzer.export.merge import bag_metadata, held_count, is_for_rosbag2, write_log
from hearthlog.analyzer.logs.selection import LogSelection
from hearthlog.schemas.errors import HearthlogWarning, LogError, Progress, ignore_progress
from hearthlog.schemas.files import is_local
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import decode, unreadable, without_unreadable
from hearthlog.schemas.logs.files import find_logs, is_active, is_layer
from hearthlog.schemas.logs.metadata import FileCounts, TopicCount, rosbag2_yaml
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.mcap.raw_messages import RawMessages
from hearthlog.schemas.messages.cdr_codec import rows_by_layout
from hearthlog.schemas.messages.message_types import typestore
from hearthlog.schemas.messages.type_definitions import defined_types, message_type
from hearthlog.schemas.new_files import replaced_file

_HEADER = "std_msgs/msg/Header"
_TYPE_NAME = re.compile(r"[A-Za-z]\w*/msg/[A-Za-z]\w*", re.ASCII)
_TIME_LIMIT = NANOSECONDS << 32  # the year 2106
_NOT_READ = re.compile("[\udc80-\udcff]")
_LITTLE_ENDIAN = b"\x00\x01"


def _save_rosbag1(selection: LogSelection, files: OutputFiles, progress: Progress) -> None:
    """Write a ROS 1 bag; header sequence numbers, which ROS 2 lacks, are 0."""
    selection = selection.decodable()
    with Writer(files.path) as writer:
        bag = _Bag(writer)
        for batch in selection.messages(progress):
            bag.write(batch)
        if not writer.connections:
            raise bag.fault or selection.nothing()


class _Topic(NamedTuple):
    """A bag connection and the conversion of its messages."""

    connection: Connection
    types: Typestore

    def convert(self, payload: bytes) -> memoryview:
        name = self.connection.msgtype
        if not payload.startswith(_LITTLE_ENDIAN):
            message = self.types.deserialize_cdr(payload, name)
            payload = bytes(self.types.serialize_cdr(message, name, little_endian=True))
        return self.types.cdr_to_ros1(payload, name)


class _Connections(list[Connection]):
    """Bag connections with constant-time lookup by number."""

    def __contains__(self, connection: object) -> bool:
        return isinstance(connection, Connection) and connection == self[connection.id]


class _Bag:
    """Writer of a ROS 1 bag."""

    def __init__(self, writer: Writer) -> None:
        self.fault: LogError | None = None
        self._writer = writer
        self._writer.connections = _Connections()
        self._types = get_typestore(Stores.EMPTY)  # ROS 1 types: a bag has one definition per name
        self._topics: dict[Hashable, _Topic | None] = {}
        self._connections: dict[Hashable, Connection] = {}
        self._trimmed = 0

    def write(self, batch: list[RawMessages]) -> None:
        """Append messages in log-time order."""
        rows = []
        for each in batch:
            topic = self._topic(each)
            if topic is None:
                continue
            messages = self._in_time(_readable(each))
            ends = messages.offsets + messages.sizes
            places = zip(messages.offsets.tolist(), ends.tolist(), strict=True)
            payloads = (messages.buffer[first:end].tobytes() for first, end in places)
            times = messages.log_times.tolist()
            rows += [(t, topic, p) for t, p in zip(times, payloads, strict=True)]
        for time, topic, payload in sorted(rows, key=lambda row: row[0]):
            try:
                converted = topic.convert(payload)
            except (SerdeError, ValueError):
                text = "some messages have no form in ROS 1: left out"
                self._warn(topic.connection.topic, text)
            else:
                self._writer.write(topic.connection, time, converted)
        self._trim()

    def _in_time(self, messages: RawMessages) -> RawMessages:
        late = messages.log_times >= _TIME_LIMIT
        if late.any():
            self._warn(messages.channel.topic, "ROS 1 has no times after 2106: left out")
            messages = messages.take(~late)
        return messages

    def _warn(self, topic: str, text: str) -> None:
        self.fault = self.fault or LogError(f"{topic}: {text}")
        warnings.warn(HearthlogWarning(text, topic, each=True), stacklevel=2)

    def _trim(self) -> None:
        """Replace message positions of written chunks by their count, which is sufficient."""
        for chunk in self._writer.chunks[self._trimmed : -1]:
            counts = {key: range(len(each)) for key, each in chunk.connections.items()}
            chunk.connections = counts  # type: ignore[assignment]
        self._trimmed = len(self._writer.chunks) - 1

    def _topic(self, messages: RawMessages) -> _Topic | None:
        """Return the connection for messages; None if the bag cannot hold them."""
        channel, schema = messages.channel, messages.schema
        if schema is None or unreadable(channel, schema):
            return None  # already reported for this topic
        latching = int(held_count(channel) > 0)
        key = channel.topic, schema.name, schema.encoding, schema.data, latching
        if key not in self._topics:
            try:
                name, types = _types_of(schema.name, schema.encoding, schema.data)
                text, digest = self._define(name, types)
            except (LogError, TypesysError) as error:
                self._topics[key] = None
                self._warn(channel.topic, f"{error}: left out")
            else:
                connection = self._connect(channel.topic, name, text, digest, latching)
                self._topics[key] = _Topic(connection, types)
        return self._topics[key]

    def _define(self, name: str, types: Typestore) -> tuple[str, str]:
        """Return the bag definition of a type; LogError if another topic's definition differs.

        ROS 1 keeps neither comments nor bounds, and readers use one definition per name. The first
        set of constants is kept.
        """
        built_on: dict[str, tuple[str, str]] = {}
        types.gendefhash(name, built_on)
        own = {
            each: (constants, [(field, _unbounded(*described)) for field, described in fields])
            for each in (name, *built_on)
            for constants, fields in [types.fielddefs[each]]
        }
        if _HEADER in own:
            own[_HEADER] = get_typestore(Stores.ROS1_NOETIC).fielddefs[_HEADER]
        for each, (_, fields) in own.items():
            if each in self._types.fielddefs and self._types.fielddefs[each][1] != fields:
                raise LogError(
                    f"{each} is defined in two ways, for which a ROS 1 bag has no place; export "
                    "the logs of each to a bag of its own"
                )
        self._types.fielddefs.update(own | self._types.fielddefs)
        return self._types.generate_msgdef(name)

    def _connect(self, topic: str, name: str, text: str, digest: str, latching: int) -> Connection:
        """Add a connection unless an equal one exists; the writer would search all of them."""
        key = topic, name, latching
        if key not in self._connections:
            definition_ = MessageDefinition(MessageDefinitionFormat.MSG, text)
            about = ConnectionExtRosbag1(None, latching)
            number = len(self._writer.connections)
            connection = Connection(
                number, topic, name, definition_, digest, -1, about, self._writer
            )
            self._writer.write_connection(connection, self._writer.chunks[-1].data)
            self._writer.connections.append(connection)
            self._connections[key] = connection
        return self._connections[key]


def _readable(raw: RawMessages) -> RawMessages:
    """Drop messages that do not match their type, and repair texts that bag readers would refuse.

    Invalid UTF-8 is replaced by one-byte question marks.
    """
    try:
        decode([raw])
    except LogError:
        raw = without_unreadable(raw)
    else:
        return raw
    try:
        decode([raw])
    except LogError as error:
        text = f"? stands for what cannot be read in texts of {raw.channel.topic}"
        warnings.warn(HearthlogWarning(text, str(error)), stacklevel=2)
    else:
        return raw
    assert raw.schema is not None
    kind = message_type(raw.schema.name, raw.schema.encoding, raw.schema.data)
    payloads = [b""] * len(raw)
    for _, rows, block in rows_by_layout(kind, raw.buffer, raw.offsets, raw.sizes):
        for name in block.dtype.names or ():
            if block.dtype[name].kind == "V" and block.dtype[name].names is None:
                for row, value in enumerate(block[name]):
                    text = value.tobytes().decode(errors="surrogateescape")
                    block[name][row] = _NOT_READ.sub("?", text).encode()
        for row, payload in zip(rows.tolist(), block, strict=True):
            payloads[row] = payload.tobytes()
    ends = np.cumsum([len(payload) for payload in payloads])
    return replace(
        raw,
        buffer=np.frombuffer(b"".join(payloads), np.uint8),
        offsets=ends - raw.sizes,
    )


def _unbounded(node: Nodetype, details: Any) -> Any:
    """Remove bounds of texts and sequences, which ROS 1 lacks."""
    if node == Nodetype.BASE and details[0] == "wstring":
        raise LogError("ROS 1 has no wstring")
    if node == Nodetype.BASE:
        return node, (details[0], 0)
    if node == Nodetype.NAME:
        return node, details
    return node, (_unbounded(*details[0]), details[1] if node == Nodetype.ARRAY else 0)


@lru_cache(256)
def _types_of(name: str, encoding: str, text: bytes) -> tuple[str, Typestore]:
    """Return the ROS 2 name of a type, and the types that decode its messages."""
    ours = typestore()
    own = defined_types(name, encoding, text)
    name = name if name in ours.fielddefs else normalize_msgtype(name)
    if not own:
        return name, ours
    for each in (name, *own):
        if not _TYPE_NAME.fullmatch(each):  # code is generated from these types
            raise LogError(f"{each!r} is no name of a type")
    types = get_typestore(Stores.EMPTY)
    try:
        types.register({**ours.fielddefs, **own})
        types.get_msgdef(name)
    except (TypesysError, RecursionError, ValueError, KeyError) as error:
        raise LogError(f"the definition of {name!r} cannot be read") from error
    return name, types


BAG = Exporter(_save_rosbag1)


_NO_PLACE = (
    "channels of different types or qualities of service, or without ROS 2 messages, for which "
    "rosbag2 has no place"
)


def _save_rosbag2(selection: LogSelection, files: OutputFiles, progress: Progress) -> int:
    """Write a log and `metadata.yaml`, without topics whose channels rosbag2 cannot distinguish."""
    topics = [topic for topic, channels in selection.channels.items() if is_for_rosbag2(channels)]
    if selection.channels and not topics:
        raise LogError(_NO_PLACE)
    for topic in sorted(selection.channels.keys() - topics):
        warnings.warn(HearthlogWarning(f"{_NO_PLACE}: left out", topic, each=True), stacklevel=2)
    if len(topics) < len(selection.channels):
        selection = selection.only(topics)
    _warn_of_definitions(selection)
    log = files.path / f"{files.output.name}.mcap"
    with log.open("xb") as stream:
        record, repeated = write_log(selection, stream, log.name, progress)
    assert record is not None  # each topic has one description
    information = record["serialized_metadata"]  # JSON, which is valid YAML
    text = f"rosbag2_bagfile_information: {information}\n"
    (files.path / METADATA).write_text(text, "utf-8")
    return repeated


def _warn_of_definitions(selection: LogSelection) -> None:
    """Warn of types with several definitions: rosbag2 readers decode all by one of them."""
    definitions: dict[str, Any] = {}
    for topic, channels in selection.channels.items():
        for schema in [schema for _, schema in channels if schema is not None]:
            try:
                types = defined_types(schema.name, schema.encoding, schema.data)
            except LogError:
                continue  # its messages are copied regardless
            for name, (_, fields) in types.items():
                if definitions.setdefault(name, fields) != fields:
                    text = f"{name} is defined in two ways, of which readers of rosbag2 take one"
                    warnings.warn(HearthlogWarning(text, topic), stacklevel=2)


ROSBAG2 = Exporter(_save_rosbag2)


METADATA = "metadata.yaml"
_DESCRIPTION = {"offered_qos_profiles", "topic_type_hash"}


class BagInPlace(NamedTuple):
    """Result of describing a folder of logs as a bag."""

    metadata: Path  # the metadata file
    unfinished: list[Path]  # incomplete or empty logs, not in the bag
    overlapping: list[Path]  # logs that begin before an earlier log of the bag ends


def describe_as_bag(folder: Path, progress: Progress = ignore_progress) -> BagInPlace:
    """Write or replace a `metadata.yaml` that makes one bag of all finished logs in a folder.

    Layers are omitted: rosbag2 reads files one after the other. `progress` receives the completed
    share, 0 to 1. Raise `LogError` if the folder or a finished log is missing, a log is damaged, a
    topic has different types or qualities of service, or the file cannot be written.
    """
    if not (is_local(folder) and folder.is_dir()):
        raise LogError(f"{folder}: is no folder of this machine; name that of the logs")
    logs = [log for log in find_logs(folder) if not is_layer(log)]
    counts, unfinished = [], []
    for number, log in enumerate(logs):
        progress(number / len(logs))
        counted = None if is_active(log) else _count(log, folder)
        if counted is None:
            unfinished.append(log)
        else:
            counts.append(counted)
    if not counts:
        raise LogError(f"{folder}: no finished log is in this folder")
    _check_topics(counts)
    counts.sort(key=lambda file: file.span)
    path = folder / METADATA
    with replaced_file(path) as temporary:
        temporary.write_text(rosbag2_yaml(counts), "utf-8")
    return BagInPlace(path, unfinished, [folder / name for name in _overlapping(counts)])


def _overlapping(files: Sequence[FileCounts]) -> Iterator[str]:
    """Yield names of files that begin before an earlier file ends; rosbag2 does not merge."""
    latest = 0
    for file in files:
        start, end = file.span
        if start < latest:
            yield file.name
        latest = max(latest, end)


def _count(log: Path, folder: Path) -> FileCounts | None:
    """Count the messages of a log from its index; None if the log is incomplete or empty."""
    with LogFile(log) as file:
        statistics = file.statistics
        if not file.complete or statistics is None or not statistics.message_count:
            return None
        topics: dict[str, TopicCount] = {}
        for number, channel in file.channels.items():
            schema = file.schemas.get(channel.schema_id)
            if schema is None or not channel.metadata.keys() >= _DESCRIPTION:
                raise LogError(f"{log}: topic {channel.topic} is not described as rosbag2 needs it")
            described = TopicCount(schema.name, bag_metadata(channel))
            topic = topics.setdefault(channel.topic, described)
            topic.messages += statistics.channel_message_counts.get(number, 0)
        span = statistics.message_start_time, statistics.message_end_time
        return FileCounts(log.relative_to(folder).as_posix(), topics, span)


def _check_topics(files: Sequence[FileCounts]) -> None:
    """Check that every topic is described equally in all files."""
    described: dict[str, tuple[object, str]] = {}
    for file in files:
        for name, topic in file.topics.items():
            about = topic.channel_metadata
            identity = topic.type, about["offered_qos_profiles"], about["topic_type_hash"]
            other, where = described.setdefault(name, (identity, file.name))
            if other != identity:
                raise LogError(
                    f"{name} is of different types or qualities of service in {where} and "
                    f"{file.name}, which rosbag2 has no way to say; export with --format rosbag2 "
                    "and --output a part that is of one"
                )
