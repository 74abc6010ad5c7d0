"""Logs merged, or a part of them cut out: messages are copied as they are."""

import hashlib
import json
import sys
from collections import Counter
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from mcap.records import Attachment, Channel, McapRecord, Metadata, Schema
from rosbags.rosbag2.errors import ReaderError
from rosbags.rosbag2.metadata import dump_qos_v9, parse_qos

from hearthlog.analyzer.export.file_names import unused_name
from hearthlog.analyzer.export.repeats import without_repeats
from hearthlog.analyzer.logs.selection import Described, Selection, identity
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs import rosbag2
from hearthlog.schemas.logs.counted_writer import CountedWriter
from hearthlog.schemas.logs.log_stream import ENCODING
from hearthlog.schemas.logs.merged_reading import iterate_messages
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.mcap.message_blocks import Block, message_blocks
from hearthlog.schemas.mcap.raw_messages import RawMessages
from hearthlog.schemas.progress import Progress, ignore_progress
from hearthlog.schemas.storage.new_files import new_file

_CHANNELS_LIMIT = (1 << 16) - 1
_PROFILES_LIMIT = 64 << 10  # characters
_FOREVER = (1 << 31) - 1  # seconds; ROS 2 has several ways to say it, and 0


def merge_logs(
    selection: Selection,
    output: Path,
    progress: Progress = ignore_progress,
    *,
    latched: bool = False,
) -> int:
    """Write the messages of a selection to one log, in the order of their log times.

    Messages of one time keep the order of their log. What is there twice, with the same topic,
    times, sequence and bytes, is written once. Channels of equal topic, definition and
    metadata become one. Metadata records and attachments of the logs are copied, equal ones
    once; the `rosbag2` record is made anew.

    Parameters
    ----------
    selection : Selection
    output : Path
        Must not exist.
    progress : callable
        Is told the share that is done, 0 to 1.
    latched : bool
        Begin with what a late subscriber would still receive: the last message before the span
        of each channel that is transient local without end, with the log time of the first message
        in the span, and its own publish time.

    Returns
    -------
    int
        How many messages were left out because they are there already.

    Raises
    ------
    LogError
        If a log is damaged, if there is no message, if there are more channels than a log can
        have, or if the output exists or cannot be written.
    """
    with new_file(output) as temporary, temporary.open("xb") as stream:
        return write_log(selection, stream, output.name, progress, latched=latched).repeated


class WrittenLog(NamedTuple):
    """What came of a log that was written.

    Attributes
    ----------
    record : mapping of str to str, or None
        Its `rosbag2` record; None, and no record, if a topic has channels that rosbag2 cannot tell
        apart, or no ROS 2 messages.
    repeated : int
        How many messages were left out because they are there already.
    """

    record: Mapping[str, str] | None
    repeated: int


def write_log(
    selection: Selection,
    stream: BinaryIO,
    name: str,
    progress: Progress = ignore_progress,
    *,
    latched: bool = False,
) -> WrittenLog:
    """Write the messages of a selection to a stream, as `merge_logs` does to a file.

    Parameters
    ----------
    selection : Selection
    stream : binary file
        Is written to, from where it is.
    name : str
        Name of the file, for the `rosbag2` record.
    progress : callable
        Is told the share that is done, 0 to 1.
    latched : bool
        As of `merge_logs`.

    Raises
    ------
    LogError
        If a log is damaged, if there is no message, or if there are more channels than a log can
        have.
    """
    selection.verify()  # the copies get checksums of their own
    batches = selection.messages(progress)
    first = next(batches, None)
    if first is None:
        raise selection.nothing()
    log = _Log(stream, selection)
    if latched:
        start = min(int(messages.log_times[0]) for messages in first)
        spoken = {m.channel.topic for m in first if m.log_times[0] == start}
        for topic, message in _latched(selection).items():
            if topic not in spoken:
                log.write([_at(start, message)])
    repeated = 0
    for batch in chain([first], batches):
        once = without_repeats(batch)
        repeated += sum(map(len, batch)) - sum(map(len, once))
        log.write(once)
    return WrittenLog(log.finish(name), repeated)


class _Log:
    """The log being written."""

    def __init__(self, stream: BinaryIO, selection: Selection) -> None:
        self._writer = CountedWriter(stream)
        self._schemas: dict[Hashable, int] = {}
        self._channels: dict[Hashable, int] = {}
        self._described: dict[int, Described] = {}
        self._counts: Counter[int] = Counter()
        self._span = (sys.maxsize, 0)
        self._writer.start(_profile(selection.logs), "hearthlog")
        self._copy_records(selection.logs)
        for same in selection.channels.values():
            for described in same:
                self._channel(described)

    def write(self, batch: Sequence[RawMessages]) -> None:
        """Append messages; those of one time keep the order in which they were read."""
        places: dict[int, int] = {}
        end = 0
        blocks: list[Block] = []
        for messages in batch:
            if id(messages.buffer) not in places:
                places[id(messages.buffer)] = end
                end += len(messages.buffer)
            start = places[id(messages.buffer)]
            channel = self._channel((messages.channel, messages.schema))
            blocks += (
                block._replace(rank=start + messages.offsets[block.rank])
                for block in message_blocks(messages, channel)
            )
            times = messages.log_times
            self._counts[channel] += len(messages)
            self._span = min(self._span[0], int(times[0])), max(self._span[1], int(times[-1]))
        self._writer.write(blocks)

    def finish(self, name: str) -> Mapping[str, str] | None:
        """Complete the log; return its `rosbag2` record, if it has one."""
        topics = self._topics()
        record = None if topics is None else rosbag2.file_metadata(name, topics, self._span)
        if record is not None:
            self._writer.add_metadata(rosbag2.METADATA, record)
        self._writer.finish()
        return record

    def _copy_records(self, logs: Sequence[Path]) -> None:
        seen: set[Hashable] = set()
        names: set[str] = set()
        for path in logs:
            with LogFile(path) as file:
                for place in sorted(file.record_locations, key=lambda place: place.offset):
                    record = file.record(place)
                    key = _key(record)
                    if key is None or key in seen:
                        continue
                    seen.add(key)
                    if isinstance(record, Metadata):
                        self._writer.add_metadata(record.name, record.metadata)
                    elif isinstance(record, Attachment):
                        own = unused_name(record.name, names)
                        times = record.create_time, record.log_time
                        self._writer.add_attachment(*times, own, record.media_type, record.data)

    def _channel(self, described: Described) -> int:
        key = identity(*described)
        if key not in self._channels:
            channel, schema = described
            if len(self._channels) == _CHANNELS_LIMIT:
                raise LogError("more channels than a log can have; choose some with --topics")
            number = self._writer.register_channel(
                channel.topic, channel.message_encoding, self._schema(schema), channel.metadata
            )
            self._channels[key] = number
            self._described[number] = described
        return self._channels[key]

    def _schema(self, schema: Schema | None) -> int:
        if schema is None:
            return 0
        key = schema.name, schema.encoding, schema.data
        if key not in self._schemas:
            self._schemas[key] = self._writer.register_schema(*key)
        return self._schemas[key]

    def _topics(self) -> dict[str, rosbag2.TopicCount] | None:
        """Describe the topics for rosbag2; None if it cannot describe them."""
        topics: dict[str, rosbag2.TopicCount] = {}
        for number, (channel, schema) in self._described.items():
            metadata = bag_metadata(channel)
            name = "" if schema is None else schema.name
            topic = topics.setdefault(channel.topic, rosbag2.TopicCount(name, metadata))
            same = (topic.type, topic.channel_metadata) == (name, metadata)
            if not same or channel.message_encoding != ENCODING:
                return None
            topic.messages += self._counts[number]
        return topics


def _profile(logs: Sequence[Path]) -> str:
    profiles = set()
    for path in logs:
        with LogFile(path) as file:
            profiles.add("" if file.header is None else file.header.profile)
    return profiles.pop() if len(profiles) == 1 else ""


def _key(record: McapRecord | None) -> Hashable:
    """Return a key that equal records share; None for those that are not copied."""
    if isinstance(record, Metadata) and record.name != rosbag2.METADATA:
        return record.name, frozenset(record.metadata.items())
    if isinstance(record, Attachment):
        return record.name, record.media_type, hashlib.sha256(record.data).digest()
    return None


def _latched(selection: Selection) -> dict[str, RawMessages]:
    """Return the last message before the span of each latched topic."""
    lasting = {
        topic
        for topic, same in selection.channels.items()
        if any(is_latched(channel) for channel, _ in same)
    }
    latest: dict[str, RawMessages] = {}
    for path in selection.earlier:
        missing = lasting - latest.keys()
        if not missing:
            break
        last: dict[str, RawMessages] = {}
        for batch in iterate_messages([path], missing, end=selection.start):
            for messages in batch:
                topic = messages.channel.topic
                if topic not in last or messages.log_times[-1] >= last[topic].log_times[-1]:
                    last[topic] = messages
        latest |= last
    return latest


def _at(time: int, messages: RawMessages) -> RawMessages:
    """Return the last of some messages, logged at another time."""
    heads = messages.heads[-1:].copy()
    heads["log_time"] = time
    return replace(messages, offsets=messages.offsets[-1:], heads=heads)


def is_latched(channel: Channel) -> bool:
    """Tell whether a late subscriber still receives the last message, however old it is.

    Parameters
    ----------
    channel : Channel
        Its metadata `offered_qos_profiles` decides; a channel with invalid ones is not latched.
    """
    return any(
        profile["durability"] == "transient_local" and not 0 < profile["lifespan"]["sec"] < _FOREVER
        for profile in _profiles(channel)
    )


def bag_metadata(channel: Channel) -> dict[str, str]:
    """Return what rosbag2 wants to know of a channel, as a recorder writes it.

    Parameters
    ----------
    channel : Channel
        Of a recorder, or of `ros2 bag record`, which writes YAML in blocks.

    Returns
    -------
    dict of str to str
        `offered_qos_profiles`, as JSON, and `topic_type_hash`; empty ones if it has none.
    """
    return {
        "offered_qos_profiles": json.dumps(_profiles(channel)),
        "topic_type_hash": channel.metadata.get("topic_type_hash", ""),
    }


def _profiles(channel: Channel) -> list[Any]:
    """Read the offered quality of service of a channel; empty if it is invalid."""
    text = channel.metadata.get("offered_qos_profiles", "")
    try:
        return list(dump_qos_v9(parse_qos(text if len(text) < _PROFILES_LIMIT else "")))
    except (ReaderError, KeyError, TypeError, AttributeError, RecursionError):
        return []
