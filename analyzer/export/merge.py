"""Merging and cutting of logs; messages are copied unchanged."""

import hashlib
import json
import math
import sys
from collections import Counter
from collections.abc import Collection, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, McapRecord, Metadata, Schema
from numpy.typing import NDArray
from rosbags.rosbag2.errors import ReaderError
from rosbags.rosbag2.metadata import dump_qos_v9, parse_qos

from hearthlog.analyzer.export import unused_name
from hearthlog.analyzer.logs.selection import Damages, Described, LogSelection, identity
from hearthlog.schemas.arrays import Indices
from hearthlog.schemas.errors import LogError, Progress, ignore_progress
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.merged_reading import iterate_messages
from hearthlog.schemas.logs.metadata import ROSBAG2_METADATA, TopicCount, rosbag2_metadata
from hearthlog.schemas.logs.writer import ENCODING, CountedWriter
from hearthlog.schemas.mcap.chunk_writer import Block, message_blocks
from hearthlog.schemas.mcap.chunks import read_in_batches, repeated_chunks
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.mcap.raw_messages import RawMessages
from hearthlog.schemas.mcap.records import HEAD, LIMIT, UINT32, RecordLocation
from hearthlog.schemas.messages.message_types import PACKAGE
from hearthlog.schemas.new_files import new_file
from hearthlog.schemas.salvage.intact_records import (
    AttachmentHead,
    attachment_head,
    encode_attachment,
)


def without_repeats(batch: Sequence[RawMessages]) -> list[RawMessages]:
    """Drop messages that another log already provides.

    A batch holds either all messages of a log time or none. Of equal topic, times, sequence and
    bytes, the first messages remain, as many as one log has: equal messages within one log are not
    duplicates.
    """
    topics: dict[tuple[str, str, str], list[int]] = {}
    for place, messages in enumerate(batch):
        kind = "" if messages.schema is None else messages.schema.name
        key = messages.channel.topic, messages.channel.message_encoding, kind
        topics.setdefault(key, []).append(place)
    kept = list(batch)
    for places in topics.values():
        parts = [batch[place] for place in places]
        if len({part.source for part in parts}) == 1:
            continue
        for place, rows in zip(places, _repeated(parts), strict=True):
            if len(rows):
                kept[place] = batch[place].take(np.delete(np.arange(len(batch[place])), rows))
    return [messages for messages in kept if len(messages)]


def _repeated(parts: Sequence[RawMessages]) -> list[Indices]:
    """Return the rows of each part that duplicate a row of another source in an earlier part."""
    dropped: list[list[Indices]] = [[np.arange(0)] for _ in parts]
    numbers = {source: number for number, source in enumerate({part.source for part in parts})}
    sources = [numbers[part.source] for part in parts]
    records: dict[int, list[tuple[int, Indices, NDArray[np.void]]]] = {}  # by record size
    for place, rows in enumerate(_of_shared_times(parts, sources)):
        for block in message_blocks(parts[place].take(rows), 0):
            data = block.records()
            records.setdefault(data.dtype.itemsize, []).append((place, rows[block.rank], data))
    for same in records.values():
        counts = [len(rows) for _, rows, _ in same]
        _, equal = np.unique(np.concatenate([data for _, _, data in same]), return_inverse=True)
        of_source = np.repeat([sources[place] for place, _, _ in same], counts)
        repeats = np.ones(len(equal), bool)
        number = _numbered(equal, of_source)
        firsts = np.unique(equal * len(equal) + number, return_index=True)[1]
        repeats[firsts] = False
        for (place, rows, _), again in zip(
            same, np.split(repeats, np.cumsum(counts)[:-1]), strict=True
        ):
            dropped[place].append(rows[again])
    return [np.concatenate(rows) for rows in dropped]


def _numbered(equal: Indices, sources: Indices) -> Indices:
    """Count equal messages of one source: 0, 1, 2 and so on."""
    order = np.lexsort((equal, sources))
    new = np.ones(len(order), bool)
    new[1:] = (np.diff(equal[order]) != 0) | (np.diff(sources[order]) != 0)
    places = np.arange(len(order))
    numbers = np.empty(len(order), np.intp)
    numbers[order] = places - np.maximum.accumulate(np.where(new, places, 0))
    return numbers


def _of_shared_times(parts: Sequence[RawMessages], sources: Sequence[int]) -> list[Indices]:
    """Return the rows of each part whose log time also occurs in another source."""
    counts = [len(part) for part in parts]
    times = np.concatenate([part.log_times for part in parts])
    of_source = np.repeat(sources, counts)
    order = np.argsort(times, kind="stable")
    firsts = np.flatnonzero(np.diff(times[order], prepend=times[order[0]] - 1))
    lowest, highest = (each.reduceat(of_source[order], firsts) for each in (np.minimum, np.maximum))
    shared = np.empty(len(times), bool)
    shared[order] = np.repeat(lowest != highest, np.diff(firsts, append=len(times)))
    return [np.flatnonzero(rows) for rows in np.split(shared, np.cumsum(counts)[:-1])]


_PIECE = 1 << 20  # bytes
_CHANNELS_LIMIT = (1 << 16) - 1
_PROFILES_LIMIT = 64 << 10  # characters
_BRACKETS = 2000  # in all profiles; each has four in JSON
_FOREVER = (1 << 31) - 1  # seconds; ROS 2 has several encodings of infinity, including 0
_DEPTH = 10  # ROS 2 default profile
_CHUNK_SPAN = 10 * NANOSECONDS  # same as the recorder


def merge_logs(
    selection: LogSelection,
    output: Path,
    progress: Progress = ignore_progress,
    *,
    latched: bool = False,
) -> int:
    """Write the messages of a selection to one log, in log-time order.

    Messages of equal time keep the order of their log. Messages that several logs hold (equal
    topic, times, sequence and bytes) are written once, and so are chunks that a log holds twice.
    Channels of equal topic, definition and metadata become one. Metadata records and attachments
    are copied, equal ones once; the `rosbag2` record is rebuilt.

    Raise `LogError` if a log is damaged, there is no message, there are more channels than a log
    can have, or the output exists or cannot be written.

    Parameters
    ----------
    progress : callable
        Receives the completed share, 0 to 1.
    latched : bool
        Begin with the messages that a late subscriber would still receive: for each transient
        local channel without expiry, the last messages before the span up to its depth, with the
        log time of the first message in the span and their own publish times.
    """
    with new_file(output) as temporary, temporary.open("xb") as stream:
        _, repeated = write_log(selection, stream, output.name, progress, latched=latched)
    return repeated


def write_log(
    selection: LogSelection,
    stream: BinaryIO,
    name: str,
    progress: Progress = ignore_progress,
    *,
    latched: bool = False,
) -> tuple[Mapping[str, str] | None, int]:
    """Write the messages of a selection to a stream, as `merge_logs` does to a file.

    Return the `rosbag2` record, and the number of messages that several logs hold. The record is
    None, and not in the log, if a topic has channels that rosbag2 cannot distinguish, or no ROS 2
    messages.

    `progress` receives the completed share, 0 to 1. Raise `LogError` if a log is damaged, there is
    no message, or there are more channels than a log can have.
    """
    batches = selection.messages(progress, once=True)
    first = next(batches, None)
    log = _Log(stream, selection)
    if first is None and (log.is_empty or selection.is_part):
        raise selection.nothing()
    if latched and first is not None:
        for held in _held_messages(selection, first):
            log.write(held)
    repeated = _count_repeated(selection)
    for batch in batches if first is None else chain([first], batches):
        once = without_repeats(batch)
        repeated += sum(map(len, batch)) - sum(map(len, once))
        log.write(once)
    return log.finish(name), repeated


def _count_repeated(selection: LogSelection) -> int:
    """Count the messages in chunks that a log holds twice."""
    count = 0
    for path in selection.logs:
        with LogFile(path, partial=True) as file:
            chunks = file.chunks[repeated_chunks(file, file.chunks)]
            for batch in read_in_batches(file, chunks, selection.topics, _pass_over):
                count += sum(len(m.between(selection.start, selection.end)) for m in batch)
    return count


def _pass_over(_: Path, __: LogError) -> None:
    """Ignore a damaged chunk, which another warning already reports."""


class _Log:
    """Writer of a merged log."""

    def __init__(self, stream: BinaryIO, selection: LogSelection) -> None:
        self._writer = CountedWriter(stream, chunk_span=_CHUNK_SPAN)
        self._schemas: dict[Hashable, int] = {}
        self._channels: dict[Hashable, int] = {}
        self._described: dict[int, Described] = {}
        self._counts: Counter[int] = Counter()
        self._span = (sys.maxsize, 0)
        logs = [*selection.logs, *selection.empty]
        self._writer.start(_profile(logs), "hearthlog")
        self.is_empty = not self._copy_records(logs)
        for same in selection.channels.values():
            for described in same:
                self._channel(described)

    def write(self, batch: Sequence[RawMessages]) -> None:
        """Append messages; messages of equal time keep their read order."""
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
        """Complete the log; return its `rosbag2` record, or None."""
        topics = self._topics()
        span = self._span if self._counts else (0, 0)
        record = None if topics is None else rosbag2_metadata(name, topics, span)
        if record is not None:
            self._writer.add_metadata(ROSBAG2_METADATA, record)
        self._writer.finish()
        return record

    def _copy_records(self, logs: Sequence[Path]) -> bool:
        """Copy metadata records and attachments; return whether there are any."""
        seen: set[Hashable] = set()
        names: dict[str, int] = {}
        for path in logs:
            with LogFile(path, partial=True) as file:
                for place in sorted(set(file.record_locations), key=lambda place: place[1:]):
                    if place.opcode == Opcode.ATTACHMENT and place.length > LIMIT:
                        self._copy_large_attachment(file, place, seen, names)
                        continue
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
        return bool(seen)

    def _copy_large_attachment(
        self, file: LogFile, place: RecordLocation, seen: set[Hashable], names: dict[str, int]
    ) -> None:
        """Copy an attachment above the single-read limit."""
        head = _head_of_large(file, place)
        index = head.index_record
        data = RecordLocation(place.opcode, place.offset + head.first, index.data_size)
        digest = hashlib.sha256()
        for piece in _pieces(file, data):
            digest.update(piece)
        key = index.name, index.media_type, digest.digest()
        if key in seen:
            return
        seen.add(key)
        name = unused_name(index.name, names)
        if name == index.name and not head.escaped:
            self._writer.copy_attachment(_pieces(file, place), index)
        else:
            index = replace(index, name=name)
            self._writer.copy_attachment(encode_attachment(index, _pieces(file, data)), index)

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

    def _topics(self) -> dict[str, TopicCount] | None:
        """Describe the topics for rosbag2; None if rosbag2 cannot represent them."""
        topics: dict[str, TopicCount] = {}
        channels: dict[str, list[Described]] = {}
        for number, (channel, schema) in self._described.items():
            name = "" if schema is None else schema.name
            topic = TopicCount(name, bag_metadata(channel))
            topics.setdefault(channel.topic, topic).messages += self._counts[number]
            channels.setdefault(channel.topic, []).append((channel, schema))
        return topics if all(map(is_for_rosbag2, channels.values())) else None


def is_for_rosbag2(channels: Sequence[Described]) -> bool:
    """Return whether rosbag2 can describe all channels of a topic as one."""
    described = [
        ("" if schema is None else schema.name, bag_metadata(channel))
        for channel, schema in channels
    ]
    encodings = {channel.message_encoding for channel, _ in channels}
    return encodings == {ENCODING} and all(each == described[0] for each in described)


def _profile(logs: Sequence[Path]) -> str:
    profiles = set()
    for path in logs:
        with LogFile(path, partial=True) as file:
            profiles.add("" if file.header is None else file.header.profile)
    return profiles.pop() if len(profiles) == 1 else ""


def _head_of_large(file: LogFile, place: RecordLocation) -> AttachmentHead:
    """Read the header of an attachment, which must be where the index says."""
    _, offset, length = place
    begin = HEAD.pack(Opcode.ATTACHMENT, length - HEAD.size)
    if offset + length > file.size or file.read(offset, HEAD.size) != begin:
        raise file.damaged(offset, "here should be an attachment")
    try:
        head = attachment_head(file.read(offset, _PIECE))
    except McapError as error:
        raise file.damaged(offset, error) from error
    if head.end + UINT32.size > length:
        raise file.damaged(offset, "an attachment is longer than its record")
    return head


def _pieces(file: LogFile, place: RecordLocation) -> Iterator[bytes]:
    """Yield bytes of a file in pieces of one megabyte."""
    end = place.offset + place.length
    for start in range(place.offset, end, _PIECE):
        yield file.read(start, min(_PIECE, end - start))


def _key(record: McapRecord | None) -> Hashable:
    """Return a key shared by equal records; None for records that are not copied."""
    if isinstance(record, Metadata) and record.name != ROSBAG2_METADATA:
        return record.name, frozenset(record.metadata.items())
    if isinstance(record, Attachment):
        return record.name, record.media_type, hashlib.sha256(record.data).digest()
    return None


def _held_messages(
    selection: LogSelection, first: Sequence[RawMessages]
) -> Iterator[list[RawMessages]]:
    """Yield the messages before the span that a subscriber at its first message still receives."""
    topics = {
        topic
        for topic, same in selection.channels.items()
        if any(held_count(channel) for channel, _ in same)
    }
    logs = _logs_of_held(selection, topics)
    left = _counts(_earlier(logs, topics, selection))  # up to the first message of the span
    start = min(int(messages.log_times[0]) for messages in first)
    at_start: Counter[Hashable] = Counter()
    for messages in without_repeats(first):
        at_start[_publisher(messages)] += int((messages.log_times == start).sum())
    for batch in _earlier(logs, topics, selection):
        parts: dict[Hashable, list[RawMessages]] = {}
        for messages in batch:
            parts.setdefault(_publisher(messages), []).append(messages)
        held = []
        for publisher, same in parts.items():
            kept = max(held_count(same[0].channel) - at_start[publisher], 0)
            dropped = int(max(left[publisher] - kept, 0))
            left[publisher] -= sum(map(len, same))
            held += [_at(start, messages) for messages in _without_first(same, dropped)]
        yield held


def _without_first(parts: Sequence[RawMessages], count: int) -> list[RawMessages]:
    """Drop the first messages of several logs."""
    order = np.argsort(np.concatenate([part.log_times for part in parts]), kind="stable")
    is_kept = np.zeros(len(order), bool)
    is_kept[order[count:]] = True
    ends = np.cumsum([len(part) for part in parts])
    rows = map(np.flatnonzero, np.split(is_kept, ends[:-1]))
    return [part.take(kept) for part, kept in zip(parts, rows, strict=True) if len(kept)]


def _earlier(
    logs: Sequence[Path], topics: Collection[str], selection: LogSelection
) -> Iterator[list[RawMessages]]:
    damages = Damages()
    earlier = iterate_messages(logs, topics, end=selection.start, on_damage=damages.add, once=True)
    return map(without_repeats, earlier)


def _logs_of_held(selection: LogSelection, topics: Collection[str]) -> list[Path]:
    """Return the logs with the retained messages of some topics, from the last log backwards."""
    logs: list[Path] = []
    missing = set(topics)
    counts: Counter[Hashable] = Counter()
    sources: Counter[str] = Counter()  # logs per topic
    for path in selection.earlier:
        if not missing:
            break
        logs.append(path)
        wanted: dict[str, dict[Hashable, float]] = {}
        for batch in iterate_messages(
            [path], missing, end=selection.start, on_damage=_pass_over, once=True
        ):
            for messages in batch:
                publisher, topic = _publisher(messages), messages.channel.topic
                counts[publisher] += len(messages)
                wanted.setdefault(topic, {})[publisher] = held_count(messages.channel)
        for topic, depths in wanted.items():
            sources[topic] += 1
            if not any(depths.values()) or not _has_all(counts, depths):
                continue
            if sources[topic] == 1 or _has_all(
                _counts(_earlier(logs, {topic}, selection)), depths
            ):  # otherwise they are copies of each other
                missing.remove(topic)
    return logs


def _has_all(counts: Counter[Hashable], depths: Mapping[Hashable, float]) -> bool:
    """Return whether all publishers reached their depth; copies have different publishers."""
    counted = counts.keys() & depths.keys()
    return bool(counted) and all(counts[each] >= depths[each] for each in counted)


def _counts(batches: Iterable[Sequence[RawMessages]]) -> Counter[Hashable]:
    """Count the messages of each publisher."""
    counts: Counter[Hashable] = Counter()
    for batch in batches:
        for messages in batch:
            counts[_publisher(messages)] += len(messages)
    return counts


def _publisher(messages: RawMessages) -> Hashable:
    """Return a key of the publisher of messages; hearthlog topics have one publisher."""
    channel, schema = messages.channel, messages.schema
    if schema is not None and schema.name.startswith(f"{PACKAGE}/"):
        return channel.topic
    return channel.id, identity(channel, schema)


def _at(time: int, messages: RawMessages) -> RawMessages:
    """Return messages with another log time."""
    heads = messages.heads.copy()
    heads["log_time"] = time
    return replace(messages, heads=heads)


def held_count(channel: Channel) -> float:
    """Return how many past messages a late subscriber still receives, of any age.

    The channel's metadata `offered_qos_profiles` has one profile per publisher; without valid ones
    the count is 0. Volatile publishers and publishers with expiring messages keep none; publishers
    of unknown depth keep ten. It is infinite if a publisher keeps all.
    """
    return sum(
        _held_by(profile)
        for profile in _profiles(channel)
        if profile["durability"] == "transient_local" and not _expires(profile)
    )


def _expires(profile: Mapping[str, Any]) -> bool:
    seconds = profile["lifespan"]["sec"]
    return isinstance(seconds, int) and 0 < seconds < _FOREVER


def _held_by(profile: Mapping[str, Any]) -> float:
    if profile["history"] == "keep_all":
        return math.inf
    depth = profile["depth"]
    if profile["history"] != "keep_last" or not isinstance(depth, int):
        return _DEPTH
    return min(max(depth, 1), _FOREVER)  # larger values may not fit a float


def bag_metadata(channel: Channel) -> dict[str, str]:
    """Return the channel metadata of rosbag2, in the recorder's form.

    They are `offered_qos_profiles`, as JSON, and `topic_type_hash`; empty strings if unset.
    """
    return {
        "offered_qos_profiles": json.dumps(_profiles(channel), default=str),
        "topic_type_hash": channel.metadata.get("topic_type_hash", ""),
    }


def _profiles(channel: Channel) -> list[Any]:
    """Read the quality-of-service profiles of a channel; empty if invalid."""
    return list(_parsed_profiles(channel.metadata.get("offered_qos_profiles", "")))


@lru_cache(256)
def _parsed_profiles(text: str) -> list[Any]:
    brackets = sum(map(text.count, "[{"))
    if len(text) >= _PROFILES_LIMIT or brackets > _BRACKETS or "&" in text:
        return []  # deep nesting or aliases would take unbounded time
    try:
        return list(dump_qos_v9(parse_qos(text)))
    except (ReaderError, KeyError, TypeError, ValueError, AttributeError, RecursionError):
        return []
