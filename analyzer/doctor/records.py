"""Records of a file and of its chunks: a reader that skips damaged parts, and checks."""

import bisect
import re
import struct
import zlib
from array import array
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, McapRecord, Schema
from numpy.typing import NDArray

from hearthlog.analyzer.doctor import RECOVER, REINDEX, Findings
from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.files import LocalFile
from hearthlog.schemas.logs.columns import definition_fault
from hearthlog.schemas.logs.writer import ENCODING, PROFILE, SCHEMA_ENCODING
from hearthlog.schemas.mcap.raw_messages import (
    CHUNK_HEAD_LIMIT,
    RawMessages,
    find_chunk_heads,
    gather_heads,
    index_messages,
    iterate_records,
)
from hearthlog.schemas.mcap.records import (
    CHUNK_INDEX,
    CHUNK_INDEX_TAIL,
    HEAD,
    INDEX_ENTRIES,
    INDEX_OFFSET,
    LIMIT,
    MAGIC,
    MESSAGE_FIXED,
    MESSAGE_HEAD,
    MESSAGE_INDEX,
    UINT64,
    ChunkHead,
    Definitions,
    begun_chunk_head,
    chunk_head,
    decompress,
    encode,
    parse,
)

_PIECE = 1 << 20  # bytes
_READ_ANYWAY = 1 << 30  # bytes; a longer skip may be a sparse hole of any length
_SIZE_LIMIT = 16 << 20  # bytes of a record other than a chunk or an attachment
_CUT = 2 << 20  # bytes; a killed writer leaves no longer remainder


class Record(NamedTuple):
    """A record in a file."""

    opcode: int
    offset: int
    length: int  # bytes, including opcode and length
    content: bytes
    crc: int | None  # CRC-32 of the file before the record; None if some bytes were not read


def parse_strictly(
    findings: Findings, opcode: int, offset: int, content: bytes
) -> McapRecord | None:
    """Parse the record at byte `offset` (or that of its chunk); report a damaged or too large one.

    A record is damaged if it is too short, has invalid UTF-8, or repeats a key of a map. None if
    the record cannot be parsed, is too large for hearthlog, or is of an unknown kind.
    """
    if len(content) > _SIZE_LIMIT and opcode != Opcode.ATTACHMENT:
        what = f"{name_of(opcode)} of {len(content)} bytes is larger than hearthlog reads"
        findings.error("too-large", what, RECOVER, offset=offset)
        return None
    try:
        record = parse(opcode, content)
    except (McapError, UnicodeDecodeError) as error:
        findings.error("fields", f"{name_of(opcode)}: {error}", RECOVER, offset=offset)
        return None
    if record is None or opcode == Opcode.ATTACHMENT:
        return record
    if not content.startswith(encode(record)[HEAD.size :]):  # later versions may append fields
        what = f"{name_of(opcode)}: a map in it has a key twice, or another length than it says"
        findings.error("fields", what, RECOVER, offset=offset)
    return record


def name_of(opcode: int) -> str:
    """Return the name of a kind of record, such as `Chunk index`."""
    try:
        return Opcode(opcode).name.capitalize().replace("_", " ")
    except ValueError:
        return f"record of opcode {opcode}"


class RecordWalk:
    """All records of a file, up to its size when opened, except those inside chunks.

    `offsets` are bytes at which records begin, ascending, from the index of the file: the walk
    resumes there after damage.
    """

    def __init__(
        self, file: LocalFile, findings: Findings, offsets: Sequence[int], *, finished: bool
    ) -> None:
        self.size = file.size
        self.offset = 0  # of the next byte
        self.losses = 0  # number of skipped places
        self.skipped = False  # whether a record was too large to be checked
        self._crc: int | None = 0  # of all bytes before `offset`; None after a long skip
        self._file = file
        self._findings = findings
        self._finished = finished
        self._offsets = offsets

    @property
    def damaged(self) -> bool:
        """Whether any part was skipped."""
        return self.losses > 0

    def __iter__(self) -> Iterator[Record]:
        self.take(len(MAGIC))
        while (rest := self.size - self.offset) > 0:
            offset, crc = self.offset, self._crc
            head = self.take(HEAD.size)
            if self._finished and head == MAGIC:
                return
            opcode, length = HEAD.unpack(head) if len(head) == HEAD.size else (0, 0)
            if opcode == 0 or length > rest - HEAD.size:
                if not self._lost(offset, rest):
                    return
            elif length > LIMIT:
                self.losses += 1
                self.skipped = True
                what = f"a record of {length} bytes is larger than hearthlog reads: not checked"
                self._findings.warning("too-large", what, offset=offset)
                self._skip(offset + HEAD.size + length)
            else:
                yield Record(opcode, offset, HEAD.size + length, self.take(length), crc)
                if opcode == Opcode.FOOTER:
                    return

    def take(self, length: int) -> bytes:
        """Read the next bytes; fewer at the end of the file."""
        data = self._file.read(self.offset, min(length, self.size - self.offset))
        self.offset += len(data)
        if self._crc is not None:
            self._crc = zlib.crc32(data, self._crc)
        return data

    def _skip(self, offset: int) -> None:
        """Move to a later byte; skipped bytes are read for the checksum, up to 1 GiB."""
        if offset - self.offset > _READ_ANYWAY:
            self._crc = None
            self.offset = offset
        while self.offset < offset and self.take(min(_PIECE, offset - self.offset)):
            pass

    def _lost(self, offset: int, rest: int) -> bool:
        """Report a missing record; return whether the walk can resume."""
        following = next(iter(self._offsets[bisect.bisect_right(self._offsets, offset) :]), None)
        if following is None:
            following = self._search(offset + 1)
        if following is None and not self._finished and rest < _CUT:
            return False  # reported as an unfinished file
        self.losses += 1
        where = "nor behind it" if following is None else f"the next one at byte {following}"
        self._findings.error("framing", f"no record begins here; {where}", RECOVER, offset=offset)
        if following is None:
            return False
        self._skip(following)
        return self.offset == following

    def _search(self, offset: int) -> int | None:
        """Find the next compressed chunk that ends within the file."""
        while offset < self.size:
            window = self._file.read(offset, _PIECE + CHUNK_HEAD_LIMIT)
            for place in find_chunk_heads(window):
                opcode, length = HEAD.unpack_from(window, place)
                end = offset + place + HEAD.size + length
                if opcode == Opcode.CHUNK and end <= self.size:
                    return offset + place
            offset += _PIECE
        return None


ROS_ENCODINGS = (SCHEMA_ENCODING, "ros2idl")
_TOTAL_LIMIT = 64 << 20  # bytes of all schemas and channels of a file
_TYPE_NAME = re.compile(r"[A-Za-z]\w*(/[A-Za-z]\w*){1,2}")


class CheckedDefinitions(Definitions):
    """Schemas and channels defined so far, each checked when added.

    In a file of hearthlog, `ours`, violations of its profile are errors, not warnings.
    """

    def __init__(self, findings: Findings, *, ours: bool) -> None:
        super().__init__()
        self.ours = ours  # whether hearthlog wrote the file
        self.profile = ""  # of the header
        self.incomplete = False  # whether unchecked, too large parts may hold more definitions
        self._size = 0
        self._findings = findings

    def read(self, opcode: int, offset: int, content: bytes) -> int | None:
        """Read and check a schema or a channel; return the number of a new channel.

        Only the first definition of each number is kept. The record, or its chunk, begins at byte
        `offset`.
        """
        record = parse_strictly(self._findings, opcode, offset, content)
        if isinstance(record, Schema):
            is_defined, name = record.id in self.schemas, record.name
        elif isinstance(record, Channel):
            is_defined, name = record.id in self.channels, record.topic
        else:
            return None
        if isinstance(record, Schema) and record.id == 0:
            self._error("schema-id", f"schema {name} has the number 0", offset)
        elif is_defined:
            if not self.add(record):
                what = f"{name_of(opcode).lower()} {record.id} ({name})"
                self._error("redefined", f"{what} differs from the first of its number", offset)
        elif self._keeps(len(content), offset):
            self.add(record)
            if isinstance(record, Channel):
                self._check_channel(record, offset)
                return record.id
            self._check_schema(record, offset)
        return None

    def _error(self, rule: str, what: str, offset: int) -> None:
        self._findings.error(rule, what, RECOVER, offset=offset)

    def _keeps(self, size: int, offset: int) -> bool:
        """Whether another definition fits into the limit."""
        self._size += size
        if self._size > _TOTAL_LIMIT:
            self._error("too-large", "more schemas and channels than hearthlog reads", offset)
        return self._size <= _TOTAL_LIMIT

    def _check_schema(self, schema: Schema, offset: int) -> None:
        if not schema.encoding and schema.data:
            what = f"schema {schema.name} has data, but no encoding"
            self._error("schema-encoding", what, offset)
        if schema.encoding not in ROS_ENCODINGS:
            what = f"schema {schema.name} is {schema.encoding!r}, neither ros2msg nor ros2idl"
            self._profile("profile-schema", what, offset)
            return
        if not _TYPE_NAME.fullmatch(schema.name):
            what = f"schema {schema.name!r} is not named as a ROS message type"
            self._error("schema-name", what, offset)
        if fault := definition_fault(schema.name, schema.encoding, schema.data):
            advice = "its messages can be copied only"
            self._findings.error("schema-definition", fault, advice, offset=offset)

    def _check_channel(self, channel: Channel, offset: int) -> None:
        topic = f"channel {channel.id} ({channel.topic})"
        if channel.schema_id not in {0, *self.schemas} and not self.incomplete:
            what = f"{topic} has schema {channel.schema_id}, which is not defined before it"
            self._error("schema-missing", what, offset)
        if not channel.message_encoding:
            self._error("channel-encoding", f"{topic} has no message encoding", offset)
        elif channel.message_encoding != ENCODING:
            what = f"{topic} is encoded as {channel.message_encoding!r}, not as {ENCODING}"
            self._profile("profile-channel", what, offset)
        elif not channel.schema_id:
            self._profile("profile-channel", f"{topic} has no schema", offset)
        if "offered_qos_profiles" not in channel.metadata:
            self._profile("profile-qos", f"{topic} has no offered_qos_profiles", offset)

    def _profile(self, rule: str, what: str, offset: int) -> None:
        """Report a violation of the profile `ros2`: an error in files of hearthlog."""
        if self.profile == PROFILE:
            report = self._findings.error if self.ours else self._findings.warning
            report(rule, what, "its profile, ros2, asks for that", offset=offset)


BATCH_SIZE = 4 << 20  # bytes


class MessageBatch(NamedTuple):
    """Some messages, still encoded."""

    records: bytes  # of the messages, and others
    starts: Int64  # [shape=(n,)]; bytes in `records` at which messages begin, ascending
    heads: NDArray[np.void]  # [shape=(n,)], of dtype `MESSAGE_HEAD`

    def by_channel(
        self, channels: Mapping[int, Channel], schemas: Mapping[int, Schema]
    ) -> Iterator[RawMessages]:
        """Group the messages by channel, without messages of undefined channels."""
        buffer = np.frombuffer(self.records, np.uint8)
        for identity in np.flatnonzero(np.bincount(self.heads["channel"])).tolist():
            if identity in channels:
                channel = channels[identity]
                rows = self.heads["channel"] == identity
                offsets = self.starts[rows] + MESSAGE_HEAD.itemsize
                schema = schemas.get(channel.schema_id)
                yield RawMessages(channel, schema, buffer, offsets, self.heads[rows])


def batches(chunks: Sequence[MessageBatch]) -> Iterator[MessageBatch]:
    """Yield the messages of some chunks in batches of a few megabytes, whatever the chunk size.

    There is at least one chunk.
    """
    firsts = np.cumsum([0, *(len(chunk.records) for chunk in chunks[:-1])]).tolist()
    records = b"".join(chunk.records for chunk in chunks)
    starts = np.concatenate([c.starts + first for c, first in zip(chunks, firsts, strict=True)])
    heads = np.concatenate([chunk.heads for chunk in chunks])
    number = np.cumsum(heads["length"]) // BATCH_SIZE
    for rows in np.split(np.arange(len(starts)), np.flatnonzero(np.diff(number)) + 1):
        if len(rows):
            some = slice(rows[0], rows[-1] + 1)
            yield MessageBatch(records, starts[some], heads[some])


class Chunk:
    """A chunk, to be checked after its message indexes were added."""

    def __init__(
        self,
        record: Record,
        findings: Findings,
        definitions: CheckedDefinitions,
        budget: "RecordBudget",
    ) -> None:
        self.content: MessageBatch | None = None  # None if the chunk is too damaged to be read
        self.is_complete = False  # whether `content` has all of its messages
        self.offset = record.offset
        self._length = record.length
        self._findings = findings
        self._definitions = definitions
        self._budget = budget
        self._head: ChunkHead | None = None
        self._records = b""
        self._indexes: dict[int, bytes] = {}
        self._index_offsets: list[tuple[int, int]] = []  # channel, and offset of its message index
        self._index_length = 0
        try:
            self._head = begun_chunk_head(record.content)
            if self._head.size > LIMIT:
                what = f"a chunk of {self._head.size} bytes, uncompressed: not checked"
                findings.warning("too-large", what, offset=self.offset)
                definitions.incomplete = True
                return
            self._head = chunk_head(record.content)
            unchecked = self._head._replace(crc=0)  # a wrong checksum has its own rule
            self._records = decompress(unchecked, record.content)
        except McapError as error:
            self._error("chunk-data", str(error))
            return
        if self._head.crc and zlib.crc32(self._records) != self._head.crc:
            self._error("chunk-crc", "a chunk has another checksum than it claims")
            return
        self.is_complete = True

    def add_index(self, record: Record) -> None:
        """Add a message index that follows the chunk."""
        self._index_length += record.length
        try:
            channel, size = MESSAGE_INDEX.unpack_from(record.content)
        except struct.error:
            channel, size = 0, -1
        most = len(record.content) - MESSAGE_INDEX.size
        if size % INDEX_ENTRIES.itemsize or not 0 <= size <= most:
            what = "a message index has another length than it says"
            self._findings.error("message-index", what, REINDEX, offset=record.offset)
        elif channel in self._indexes:
            what = f"a second message index of channel {channel} behind one chunk"
            self._findings.error("message-index", what, REINDEX, offset=record.offset)
        else:
            entries = record.content[MESSAGE_INDEX.size : MESSAGE_INDEX.size + size]
            self._indexes[channel] = entries
            if entries:
                self._index_offsets.append((channel, record.offset))

    def check(self, *, cut: bool) -> None:
        """Check the records of the chunk, its times and its message indexes, unless cut off."""
        if not self.is_complete:
            return
        entries = np.frombuffer(b"".join(self._indexes.values()), INDEX_ENTRIES)
        self._find_records(np.sort(entries["offset"]))
        if self.content is not None and self.is_complete:
            self._check_times(self.content.heads["log_time"].astype(np.uint64))
            if not cut:
                self._check_index(self.content)

    def index_content(self) -> bytes | None:
        """Return the expected chunk index, without opcode and length, if the head can be read."""
        if self._head is None:
            return None
        head = self._head
        places = b"".join(INDEX_OFFSET.pack(*pair) for pair in self._index_offsets)
        first = CHUNK_INDEX.pack(head.start, head.end, self.offset, self._length, len(places))
        text = CHUNK_INDEX_TAIL.pack(self._index_length, len(head.compression))
        text += head.compression
        size = head.data.stop - head.data.start
        return first + places + text + UINT64.pack(size) + UINT64.pack(head.size)

    def _find_records(self, hints: Int64) -> None:
        """Find the messages, and read schemas and channels."""
        records = self._records
        starts, others, end = _split(records, hints, self._budget)
        if self._budget.left < 0:
            self._error("too-large", "the file holds more records than one of its size can")
            self.is_complete = False
        elif end != len(records):
            self._error("chunk-records", "the last record of a chunk is damaged")
            self.is_complete = False
        new: dict[int, int] = {}
        for start in others.tolist():
            opcode, length = HEAD.unpack_from(records, start)
            first = start + HEAD.size
            new |= self._other(opcode, start, records[first : first + length])
        self.content = MessageBatch(records, starts, gather_heads(records, starts))
        check_channels(self._findings, self._definitions, self.content, new, self.offset)

    def _other(self, opcode: int, start: int, content: bytes) -> dict[int, int]:
        """Read a record other than a message; return a newly defined channel and its position."""
        if opcode == Opcode.MESSAGE:
            self._error("message-short", f"a message at byte {start} of a chunk is too short")
            self.is_complete = False
        elif opcode not in {Opcode.SCHEMA, Opcode.CHANNEL}:
            report = self._findings.error if opcode <= Opcode.DATA_END else self._findings.warning
            what = f"{name_of(opcode)} inside a chunk"
            report("chunk-opcode", what, RECOVER, offset=self.offset)
        else:
            channel = self._definitions.read(opcode, self.offset, content)
            return {} if channel is None else {channel: start}
        return {}

    def _check_times(self, times: NDArray[np.uint64]) -> None:
        assert self._head is not None
        claimed = self._head.start, self._head.end
        span = (int(times.min()), int(times.max())) if len(times) else (0, 0)
        if claimed != span:
            what = f"a chunk says that it spans {claimed[0]} to {claimed[1]} ns"
            what += f", and spans {span[0]} to {span[1]} ns"
            self._error("chunk-times", what, REINDEX)

    def _check_index(self, content: MessageBatch) -> None:
        """Compare the message indexes with the ones that a writer would write."""
        made = index_messages(content.records, content.starts)
        if self._indexes == made:
            return
        if not self._indexes:
            if self._definitions.ours and made:
                self._error("message-index", "a chunk has no message index", REINDEX)
            return
        entries, expected = _entries(self._indexes), _entries(made)
        if not np.array_equal(entries, expected):
            right = len(np.intersect1d(entries, expected))
            what = (
                f"the message indexes of a chunk leave out {len(expected) - right} of its "
                f"{len(expected)} messages and have {len(entries) - right} entries that are wrong"
            )
            self._error("message-index", what, REINDEX)

    def _error(self, rule: str, what: str, advice: str = RECOVER) -> None:
        self._findings.error(rule, what, advice, offset=self.offset)


class RecordBudget:
    """Limit of the records inside chunks that are walked one by one in a file of `size` bytes.

    The size limits the records that a small file can claim.
    """

    def __init__(self, size: int) -> None:
        self.left = (1 << 20) + 4 * size


def _split(records: bytes, hints: Int64, budget: RecordBudget) -> tuple[Int64, Int64, int]:
    """Return starts of messages, of other or too short records, and the end of the last record.

    The end is less than the length of the chunk if a record is damaged. `hints` are starts of
    messages according to the index, ascending; not trusted.
    """
    if len(hints) and hints[0] >= 0 and hints[-1] <= len(records) - MESSAGE_HEAD.itemsize:
        heads = gather_heads(records, hints)
        lengths = np.minimum(heads["length"], len(records))  # prevents overflow of their sums
        firsts = np.concatenate([[0], hints + HEAD.size + lengths])
        lasts = np.concatenate([hints, [len(records)]])
        if ((firsts <= lasts) & (lasts <= len(records))).all() and (
            (heads["opcode"] == Opcode.MESSAGE) & (lengths >= MESSAGE_FIXED)
        ).all():
            others = [np.empty(0, np.int64)]
            for place in np.flatnonzero(firsts < lasts).tolist():
                starts, between, end = _walk(records, int(firsts[place]), int(lasts[place]), budget)
                if len(starts) or end != lasts[place]:
                    break  # an unindexed message, or an incomplete record
                others.append(between)
            else:
                return hints, np.concatenate(others), len(records)
    return _walk(records, 0, len(records), budget)


def _walk(content: bytes, start: int, end: int, budget: RecordBudget) -> tuple[Int64, Int64, int]:
    """Walk from record to record; return values as `_split`."""
    messages, others = array("q"), array("q")
    with suppress(McapError):
        for opcode, first, last in iterate_records(content, start, end):
            budget.left -= 1
            if opcode == 0 or budget.left < 0:
                break
            if opcode == Opcode.MESSAGE and last - first >= MESSAGE_HEAD.itemsize:
                messages.append(first)
            else:
                others.append(first)
            start = last
    return np.frombuffer(messages, np.int64), np.frombuffer(others, np.int64), start


def check_channels(
    findings: Findings,
    definitions: CheckedDefinitions,
    content: MessageBatch,
    new: dict[int, int],
    offset: int,
) -> None:
    """Report messages with an undefined channel, or a channel defined after them.

    `new` has the byte of the definition, by channel defined in these records; `offset` is the byte
    of the file at which the chunk, or the first of the messages, begins.
    """
    numbers = content.heads["channel"]
    for channel in np.flatnonzero(np.bincount(numbers)).tolist():
        if channel not in definitions.channels:
            if definitions.incomplete:
                continue
            what = f"messages of channel {channel}, which is not defined"
            findings.error("channel-missing", what, RECOVER, offset=offset)
        elif channel in new and (content.starts[numbers == channel] < new[channel]).any():
            what = f"messages of channel {channel} stand before it is defined"
            findings.error("channel-missing", what, RECOVER, offset=offset)


def _entries(indexes: Mapping[int, bytes]) -> NDArray[np.void]:
    """Return one comparable row for each entry of message indexes, by offset."""
    rows = np.frombuffer(b"".join(indexes.values()), INDEX_ENTRIES)
    entries = np.empty(len(rows), [("channel", "<u2"), ("time", "<i8"), ("offset", "<i8")])
    counts = [len(same) // INDEX_ENTRIES.itemsize for same in indexes.values()]
    entries["channel"] = np.repeat(np.array([*indexes], np.int64), counts)
    entries["time"], entries["offset"] = rows["time"], rows["offset"]
    return entries[np.argsort(entries["offset"], kind="stable")]
