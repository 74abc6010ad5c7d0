"""Logs taken apart into records, and put together again with something changed."""

import struct
import zlib
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path

import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    McapRecord,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.stream_reader import StreamReader, breakup_chunk

from hearthlog.schemas.logs.contents import CONTENTS_METADATA as CONTENTS
from hearthlog.schemas.logs.metadata import ROSBAG2_METADATA, TopicCount, rosbag2_metadata
from hearthlog.schemas.mcap.records import MAGIC
from hearthlog.schemas.messages.message_types import decode, encode

HEAD = struct.Struct("<BQ")


@dataclass
class Raw:
    """A record as bytes, without opcode and length."""

    opcode: int
    content: bytes


@dataclass
class Chunked:
    """The records of one chunk."""

    records: list = field(default_factory=list)


class Log:
    """The data section of a log: records, chunks as lists of records.

    What refers to other parts of the file (chunks, indexes, statistics, the counts of rosbag2) is
    made anew when it is written. What the log says of its messages is left out, for they change,
    unless `contents` is true. A log without an end is written without one.
    """

    def __init__(self, path: Path, *, contents: bool = False) -> None:
        self.items: list = []
        self._finished = False
        with path.open("rb") as stream, suppress(EndOfFile):
            for record in StreamReader(stream, emit_chunks=True).records:
                if isinstance(record, Chunk):
                    self.items.append(Chunked(breakup_chunk(record)))
                elif isinstance(record, DataEnd):
                    self._finished = True
                    break
                elif not isinstance(record, MessageIndex) and (
                    contents or not _is_contents(record)
                ):
                    self.items.append(record)
        self._counted = self._count()

    def chunks(self) -> list[Chunked]:
        return [item for item in self.items if isinstance(item, Chunked)]

    def records(self):
        for item in self.items:
            yield from item.records if isinstance(item, Chunked) else [item]

    def named(self, topic: str) -> Channel:
        return next(r for r in self.records() if isinstance(r, Channel) and r.topic == topic)

    def schema(self, topic: str) -> Schema:
        number = self.named(topic).schema_id
        return next(r for r in self.records() if isinstance(r, Schema) and r.id == number)

    def messages(self, topic: str) -> list[Message]:
        number = self.named(topic).id
        return [r for r in self.records() if isinstance(r, Message) and r.channel_id == number]

    def metadata(self, name: str) -> Metadata:
        return next(r for r in self.records() if isinstance(r, Metadata) and r.name == name)

    def drop(self, *records) -> None:
        numbers = {id(record) for record in records}
        for chunk in self.chunks():
            chunk.records = [r for r in chunk.records if id(r) not in numbers]
        self.items = [item for item in self.items if id(item) not in numbers]

    def change(self, message: Message, **fields) -> None:
        """Set fields of a message of ours, "header__stamp" for one of its header."""
        topics = {r.id: r for r in self.records() if isinstance(r, Channel)}
        schemas = {r.id: r.name for r in self.records() if isinstance(r, Schema)}
        typename = schemas[topics[message.channel_id].schema_id]
        content = decode(message.data, typename)
        for name, value in fields.items():
            *parents, last = name.split("__")
            target = content
            for parent in parents:
                target = getattr(target, parent)
            setattr(target, last, value)
        message.data = encode(content)

    def write(self, path: Path, edit=lambda _: None) -> Path:
        """Put it together; `edit` may change the list of `Raw` that the file will consist of."""
        if self._count() != self._counted:
            self._recount(path.name)
        records = _Layout(self).records
        edit(records)
        if not self._finished:
            end = next(i for i, raw in enumerate(records) if raw.opcode == Opcode.DATA_END)
            path.write_bytes(MAGIC + joined(records[:end], ends=False))
            return path
        path.write_bytes(joined(records))
        return path

    def _count(self):
        """Count messages by channel, and note the first and the last log time."""
        messages = [r for r in self.records() if isinstance(r, Message)]
        times = [message.log_time for message in messages] or [0]
        return Counter(message.channel_id for message in messages), (min(times), max(times))

    def _recount(self, name: str) -> None:
        channels: dict[int, Channel] = {}
        for record in self.records():
            if isinstance(record, Channel):
                channels.setdefault(record.id, record)
        schemas = {r.id: r.name for r in self.records() if isinstance(r, Schema)}
        counts, span = self._count()
        topics = {
            c.topic: TopicCount(schemas.get(c.schema_id, ""), c.metadata, counts[i])
            for i, c in channels.items()
            if {"offered_qos_profiles", "topic_type_hash"} <= c.metadata.keys()
        }
        for record in self.records():
            if isinstance(record, Metadata) and record.name == ROSBAG2_METADATA:
                record.metadata = rosbag2_metadata(name, topics, span)


class _Layout:
    """Lays out the records of a file, with all that says where others are."""

    def __init__(self, log: Log) -> None:
        self.records: list[Raw] = []
        self._offset = len(MAGIC)
        self._index: dict[int, list[McapRecord]] = {
            opcode: []
            for opcode in (
                Opcode.SCHEMA,
                Opcode.CHANNEL,
                Opcode.STATISTICS,
                Opcode.CHUNK_INDEX,
                Opcode.ATTACHMENT_INDEX,
                Opcode.METADATA_INDEX,
            )
        }
        self._counts: Counter[int] = Counter()
        self._times: list[int] = []
        for item in log.items:
            self._add(item)
        self._put(DataEnd(0))
        self._summary()

    def _put(self, record) -> tuple[int, int]:
        raw = record if isinstance(record, Raw) else as_raw(record)
        offset, length = self._offset, HEAD.size + len(raw.content)
        self.records.append(raw)
        self._offset += length
        return offset, length

    def _add(self, item) -> None:
        if isinstance(item, Chunked):
            self._chunk(item)
            return
        self._note(item)
        offset, length = self._put(item)
        if isinstance(item, Metadata):
            self._index[Opcode.METADATA_INDEX].append(MetadataIndex(offset, length, item.name))
        elif isinstance(item, Attachment):
            self._index[Opcode.ATTACHMENT_INDEX].append(
                AttachmentIndex(
                    create_time=item.create_time,
                    data_size=len(item.data),
                    length=length,
                    log_time=item.log_time,
                    media_type=item.media_type,
                    name=item.name,
                    offset=offset,
                )
            )

    def _note(self, record) -> None:
        for opcode, kind in ((Opcode.SCHEMA, Schema), (Opcode.CHANNEL, Channel)):
            known = self._index[opcode]
            if isinstance(record, kind) and record.id not in {r.id for r in known}:
                known.append(record)
        if isinstance(record, Message):
            self._counts[record.channel_id] += 1
            self._times.append(record.log_time)

    def _chunk(self, item: Chunked) -> None:
        content = bytearray()
        entries: dict[int, list[tuple[int, int]]] = {}
        for record in item.records:
            self._note(record)
            if isinstance(record, Message):
                entry = record.log_time, len(content)
                entries.setdefault(record.channel_id, []).append(entry)
            content += joined([record if isinstance(record, Raw) else as_raw(record)], ends=False)
        times = [time for found in entries.values() for time, _ in found] or [0]
        data = zstandard.compress(bytes(content), level=1)
        chunk = Chunk("zstd", data, max(times), min(times), zlib.crc32(content), len(content))
        offset, length = self._put(chunk)
        first = self._offset
        places = {i: self._put(MessageIndex(i, found))[0] for i, found in entries.items()}
        self._index[Opcode.CHUNK_INDEX].append(
            ChunkIndex(
                length,
                offset,
                "zstd",
                len(data),
                max(times),
                self._offset - first,
                places,
                min(times),
                len(content),
            )
        )

    def _summary(self) -> None:
        index = self._index
        times = self._times or [0]
        statistics = Statistics(
            attachment_count=len(index[Opcode.ATTACHMENT_INDEX]),
            channel_count=len(index[Opcode.CHANNEL]),
            channel_message_counts=dict(self._counts),
            chunk_count=len(index[Opcode.CHUNK_INDEX]),
            message_count=sum(self._counts.values()),
            message_end_time=max(times),
            message_start_time=min(times),
            metadata_count=len(index[Opcode.METADATA_INDEX]),
            schema_count=len(index[Opcode.SCHEMA]),
        )
        index[Opcode.STATISTICS].append(statistics)
        start = self._offset
        groups = []
        for opcode, group in index.items():
            places = [self._put(record) for record in group]
            if places:
                groups.append(SummaryOffset(opcode, places[0][0], sum(n for _, n in places)))
        offsets = self._offset
        for group in groups:
            self._put(group)
        self._put(Footer(start, offsets, 0))


def as_raw(record: McapRecord) -> Raw:
    builder = RecordBuilder()
    record.write(builder)
    data = builder.end()
    return Raw(data[0], data[HEAD.size :])


def joined(records: list[Raw], *, ends=True) -> bytes:
    """Write records one after the other, and the checksum into a footer that has none."""
    data = bytearray(MAGIC if ends else b"")
    summary = 0
    if ends and not any(raw.opcode == Opcode.DATA_END for raw in records):
        (summary,) = struct.unpack_from("<Q", records[-1].content)
    for raw in records:
        content = raw.content
        if raw.opcode == Opcode.FOOTER and content[16:20] == bytes(4) and summary:
            body = data[summary:] + HEAD.pack(raw.opcode, len(content)) + content[:16]
            content = content[:16] + struct.pack("<I", zlib.crc32(body)) + content[20:]
        data += HEAD.pack(raw.opcode, len(content)) + content
        if raw.opcode == Opcode.DATA_END:
            summary = len(data)
    return bytes(data + (MAGIC if ends else b""))


def split(data: bytes) -> list[Raw]:
    """Cut a whole file into its records, those inside chunks excepted."""
    records, place = [], len(MAGIC)
    while place < len(data) - len(MAGIC):
        opcode, length = HEAD.unpack_from(data, place)
        records.append(Raw(opcode, data[place + HEAD.size : place + HEAD.size + length]))
        place += HEAD.size + length
    return records


def parsed(raw: Raw, kind):
    """Parse a record."""
    return kind.read(ReadDataStream(BytesIO(raw.content)))


def _is_contents(record) -> bool:
    return isinstance(record, Metadata) and record.name == CONTENTS
