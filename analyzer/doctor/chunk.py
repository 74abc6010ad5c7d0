"""Checks of chunks: schemas, channels, messages and message indexes."""

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

from hearthlog.analyzer.doctor.findings import RECOVER, REINDEX, Findings
from hearthlog.analyzer.doctor.record_walk import Record
from hearthlog.schemas.arrays import Bytes, Int64
from hearthlog.schemas.logs.columns import definition_fault
from hearthlog.schemas.logs.writer import ENCODING, PROFILE, SCHEMA_ENCODING
from hearthlog.schemas.mcap.raw_messages import RawMessages, gather_heads, iterate_records
from hearthlog.schemas.mcap.records import (
    CHUNK_INDEX,
    CHUNK_INDEX_TAIL,
    HEAD,
    INDEX_ENTRIES,
    INDEX_OFFSET,
    LIMIT,
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

ROS_ENCODINGS = (SCHEMA_ENCODING, "ros2idl")
_SIZE_LIMIT = 16 << 20  # bytes of a record other than a chunk or an attachment
_TOTAL_LIMIT = 64 << 20  # bytes of all schemas and channels of a file
_TYPE_NAME = re.compile(r"[A-Za-z]\w*(/[A-Za-z]\w*){1,2}")


def parse_strictly(
    findings: Findings, opcode: int, offset: int, content: bytes
) -> McapRecord | None:
    """Parse a record, and report a damaged or too large one.

    A record is damaged if it is too short, has invalid UTF-8, or repeats a key of a map.

    Parameters
    ----------
    offset : int
        Byte of the file at which the record, or its chunk, begins.

    Returns
    -------
    McapRecord or None
        None if the record cannot be parsed, is too large for hearthlog, or is of an unknown kind.
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


class CheckedDefinitions(Definitions):
    """Schemas and channels defined so far, each checked when added.

    Parameters
    ----------
    ours : bool
        Whether hearthlog wrote the file: violations of its profile are then errors, not warnings.
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

        Parameters
        ----------
        offset : int
            Byte of the file at which the record, or its chunk, begins.
        """
        record = parse_strictly(self._findings, opcode, offset, content)
        if isinstance(record, Schema):
            self._add_schema(record, offset, len(content))
        elif isinstance(record, Channel) and self._add_channel(record, offset, len(content)):
            return record.id
        return None

    def _keeps(self, size: int, offset: int) -> bool:
        """Whether another definition fits into the limit."""
        self._size += size
        if self._size > _TOTAL_LIMIT:
            what = "more schemas and channels than hearthlog reads"
            self._findings.error("too-large", what, RECOVER, offset=offset)
        return self._size <= _TOTAL_LIMIT

    def _add_schema(self, schema: Schema, offset: int, size: int) -> None:
        """Check a schema; keep only the first with its number."""
        error = self._findings.error
        if schema.id == 0:
            error("schema-id", f"schema {schema.name} has the number 0", RECOVER, offset=offset)
            return
        if schema.id in self.schemas:
            if not self.add(schema):
                what = f"schema {schema.id} ({schema.name}) differs from the first of its number"
                error("redefined", what, RECOVER, offset=offset)
            return
        if not self._keeps(size, offset):
            return
        self.add(schema)
        if not schema.encoding and schema.data:
            what = f"schema {schema.name} has data, but no encoding"
            error("schema-encoding", what, RECOVER, offset=offset)
        if schema.encoding in ROS_ENCODINGS:
            self._check_definition(schema, offset)
        elif self.profile == PROFILE:
            what = f"schema {schema.name} is {schema.encoding!r}, neither ros2msg nor ros2idl"
            self._profile("profile-schema", what, offset)

    def _add_channel(self, channel: Channel, offset: int, size: int) -> bool:
        """Check a channel; keep only the first with its number, and return whether it is new."""
        error = self._findings.error
        topic = f"channel {channel.id} ({channel.topic})"
        if channel.id in self.channels:
            if not self.add(channel):
                what = f"{topic} differs from the first of its number"
                error("redefined", what, RECOVER, offset=offset)
            return False
        if not self._keeps(size, offset):
            return False
        self.add(channel)
        is_defined = channel.schema_id in {0, *self.schemas}
        if not is_defined and not self.incomplete:
            what = f"{topic} has schema {channel.schema_id}, which is not defined before it"
            error("schema-missing", what, RECOVER, offset=offset)
        if not channel.message_encoding:
            error("channel-encoding", f"{topic} has no message encoding", RECOVER, offset=offset)
        elif self.profile == PROFILE:
            if channel.message_encoding != ENCODING:
                what = f"{topic} is encoded as {channel.message_encoding!r}, not as {ENCODING}"
                self._profile("profile-channel", what, offset)
            elif not channel.schema_id:
                self._profile("profile-channel", f"{topic} has no schema", offset)
        if self.profile == PROFILE and "offered_qos_profiles" not in channel.metadata:
            self._profile("profile-qos", f"{topic} has no offered_qos_profiles", offset)
        return True

    def _profile(self, rule: str, what: str, offset: int) -> None:
        """Report a violation of the profile: an error in files of hearthlog, else a warning."""
        report = self._findings.error if self.ours else self._findings.warning
        report(rule, what, "its profile, ros2, asks for that", offset=offset)

    def _check_definition(self, schema: Schema, offset: int) -> None:
        error = self._findings.error
        if not _TYPE_NAME.fullmatch(schema.name):
            what = f"schema {schema.name!r} is not named as a ROS message type"
            error("schema-name", what, RECOVER, offset=offset)
        if fault := definition_fault(schema.name, schema.encoding, schema.data):
            error("schema-definition", fault, "its messages can be copied only", offset=offset)


BATCH_SIZE = 4 << 20  # bytes


class ChunkContent(NamedTuple):
    """The records of a chunk.

    Attributes
    ----------
    starts : np.ndarray [shape=(n,)], int64
        Bytes in `records` at which messages begin, ascending.
    heads : np.ndarray [shape=(n,)], of dtype `MESSAGE_HEAD`
        Heads of these messages.
    """

    records: bytes
    starts: Int64
    heads: NDArray[np.void]


class MessageBatch(NamedTuple):
    """Some messages, still encoded."""

    buffer: Bytes  # [shape=(b,)], uint8: contains their records
    starts: Int64  # [shape=(n,)], int64: starts of their records in the buffer
    heads: NDArray[np.void]  # [shape=(n,)], of dtype `MESSAGE_HEAD`

    def by_channel(
        self, channels: Mapping[int, Channel], schemas: Mapping[int, Schema]
    ) -> Iterator[RawMessages]:
        """Group the messages by channel, without messages of undefined channels."""
        for identity in np.flatnonzero(np.bincount(self.heads["channel"])).tolist():
            if identity in channels:
                channel = channels[identity]
                rows = self.heads["channel"] == identity
                offsets = self.starts[rows] + MESSAGE_HEAD.itemsize
                schema = schemas.get(channel.schema_id)
                yield RawMessages(channel, schema, self.buffer, offsets, self.heads[rows])


def batches(chunks: Sequence[ChunkContent]) -> Iterator[MessageBatch]:
    """Yield the messages of some chunks in batches of a few megabytes, whatever the chunk size.

    Parameters
    ----------
    chunks : sequence of ChunkContent
        At least one.
    """
    firsts = np.cumsum([0, *(len(chunk.records) for chunk in chunks[:-1])]).tolist()
    buffer = np.frombuffer(b"".join(chunk.records for chunk in chunks), np.uint8)
    starts = np.concatenate([c.starts + first for c, first in zip(chunks, firsts, strict=True)])
    heads = np.concatenate([chunk.heads for chunk in chunks])
    number = np.cumsum(heads["length"]) // BATCH_SIZE
    for rows in np.split(np.arange(len(starts)), np.flatnonzero(np.diff(number)) + 1):
        if len(rows):
            some = slice(rows[0], rows[-1] + 1)
            yield MessageBatch(buffer, starts[some], heads[some])


class Chunk:
    """A chunk, to be checked after its message indexes were added."""

    def __init__(
        self,
        record: Record,
        findings: Findings,
        definitions: CheckedDefinitions,
        budget: "RecordBudget",
    ) -> None:
        self.content: ChunkContent | None = None  # None if the chunk is too damaged to be read
        self.whole = False  # whether `content` has all of its messages
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
        self.whole = True

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
        """Check the records of the chunk, its times and its message indexes.

        Parameters
        ----------
        cut : bool
            Whether message indexes may be missing after the chunk: they are then not compared.
        """
        if not self.whole:
            return
        counts = [len(e) // INDEX_ENTRIES.itemsize for e in self._indexes.values()]
        entries = np.frombuffer(b"".join(self._indexes.values()), INDEX_ENTRIES)
        channels = np.repeat([*self._indexes], counts)
        order = np.argsort(entries["offset"], kind="stable")
        entries, channels = entries[order], channels[order]
        self._find_records(entries["offset"])
        if self.content is not None and self.whole:
            self._check_times()
        if self.content is not None and self.whole and not cut:
            self._check_index(entries, channels)

    def index_content(self) -> bytes | None:
        """Return the expected chunk index, without opcode and length.

        Returns
        -------
        bytes or None
            None if the head of the chunk cannot be read.
        """
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
            self.whole = False
        elif end != len(records):
            self._error("chunk-records", "the last record of a chunk is damaged")
            self.whole = False
        new: dict[int, int] = {}
        for start in others.tolist():
            opcode, length = HEAD.unpack_from(records, start)
            first = start + HEAD.size
            new |= self._other(opcode, start, records[first : first + length])
        self.content = ChunkContent(records, starts, gather_heads(records, starts))
        check_channels(self._findings, self._definitions, self.content, new, self.offset)

    def _other(self, opcode: int, start: int, content: bytes) -> dict[int, int]:
        """Read a record other than a message; return a newly defined channel and its position."""
        if opcode == Opcode.MESSAGE:
            self._error("message-short", f"a message at byte {start} of a chunk is too short")
            self.whole = False
        elif opcode not in {Opcode.SCHEMA, Opcode.CHANNEL}:
            report = self._findings.error if opcode <= Opcode.DATA_END else self._findings.warning
            what = f"{name_of(opcode)} inside a chunk"
            report("chunk-opcode", what, RECOVER, offset=self.offset)
        else:
            channel = self._definitions.read(opcode, self.offset, content)
            return {} if channel is None else {channel: start}
        return {}

    def _check_times(self) -> None:
        assert self.content is not None
        assert self._head is not None
        times = self.content.heads["log_time"].astype(np.uint64)
        claimed = self._head.start, self._head.end
        span = (int(times.min()), int(times.max())) if len(times) else (0, 0)
        if claimed != span:
            what = f"a chunk says that it spans {claimed[0]} to {claimed[1]} ns"
            what += f", and spans {span[0]} to {span[1]} ns"
            self._error("chunk-times", what, REINDEX)

    def _check_index(self, entries: NDArray[np.void], channels: Int64) -> None:
        """Compare the message indexes, in the order of their offsets, with the messages."""
        assert self.content is not None
        heads, starts = self.content.heads, self.content.starts
        if not self._indexes:
            if self._definitions.ours and len(heads):
                self._error("message-index", "a chunk has no message index", REINDEX)
            return
        if (
            len(entries) == len(heads)
            and (
                (entries["offset"] == starts)
                & (entries["time"] == heads["log_time"])
                & (channels == heads["channel"])
            ).all()
        ):
            return
        right = np.intersect1d(
            _keys(channels, entries["time"], entries["offset"]),
            _keys(heads["channel"], heads["log_time"], starts),
        )
        what = (
            f"the message indexes of a chunk leave out {len(heads) - len(right)} of its "
            f"{len(heads)} messages and have {len(entries) - len(right)} entries that are wrong"
        )
        self._error("message-index", what, REINDEX)

    def _error(self, rule: str, what: str, advice: str = RECOVER) -> None:
        self._findings.error(rule, what, advice, offset=self.offset)


class RecordBudget:
    """Limit of the records inside chunks that are walked one by one in a file.

    Parameters
    ----------
    size : int
        Bytes of the file; limits the records that a small file can claim.
    """

    def __init__(self, size: int) -> None:
        self.left = (1 << 20) + 4 * size


def _split(records: bytes, hints: Int64, budget: RecordBudget) -> tuple[Int64, Int64, int]:
    """Find the records of a chunk.

    Parameters
    ----------
    hints : np.ndarray [shape=(n,)], int64
        Starts of messages according to the index, ascending; not trusted.

    Returns
    -------
    starts, others : np.ndarray [shape=(m,)], int64
        Starts of messages; starts of other records and of messages that are too short.
    end : int
        End of the last record; less than the length of the chunk if a record is damaged.
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
    content: ChunkContent,
    new: dict[int, int],
    offset: int,
) -> None:
    """Report messages with an undefined channel, or a channel defined after them.

    Parameters
    ----------
    new : dict of int to int
        Byte of the definition, by channel defined in these records.
    offset : int
        Byte of the file at which the chunk, or the first of the messages, begins.
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


def _keys(channels: Int64, times: Int64, offsets: Int64) -> NDArray[np.void]:
    """Return one comparable key for each message."""
    keys = np.empty(len(channels), [("channel", "<u2"), ("time", "<i8"), ("offset", "<i8")])
    keys["channel"], keys["time"], keys["offset"] = channels, times, offsets
    return keys
