"""MCAP records (https://mcap.dev/spec): layouts, parsing within limits, and rows of chunks."""

import io
import struct
import threading
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from typing import Any, NamedTuple

import numpy as np
import zstandard
from mcap import records
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, McapRecord, Schema
from numpy.typing import NDArray

from hearthlog.schemas.files import LocalFile, Section, StoredFile

# All numbers are little-endian; times are nanoseconds. A record is its opcode, the length of its
# content, and its content. A `Struct` is the fixed start of a content, without opcode and length
# unless its comment includes them; the rows of a dtype are complete records or entries.
MAGIC = b"\x89MCAP0\r\n"
UINT16, UINT32, UINT64 = struct.Struct("<H"), struct.Struct("<I"), struct.Struct("<Q")
HEAD = struct.Struct("<BQ")  # opcode, length of the content
MESSAGE = struct.Struct("<BQHIQQ")  # with HEAD: channel, sequence, log time, publish time; payload
MESSAGE_FIXED = MESSAGE.size - HEAD.size  # bytes of a message's content before its payload
MESSAGE_HEAD = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<i8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<i8"),
        ("publish_time", "<i8"),
    ]
)
# First and last log time, uncompressed size and CRC, length of the compression name; the name,
# length of the data (UINT64), data.
CHUNK = struct.Struct("<QQQII")
ZSTD_CHUNK_HEAD = np.dtype(  # head of a chunk whose compression name has four letters
    [
        ("opcode", "u1"),
        ("length", "<i8"),
        ("start", "<i8"),
        ("end", "<i8"),
        ("size", "<i8"),
        ("crc", "<u4"),
        ("name_length", "<u4"),
        ("name", "S4"),
        ("stored", "<i8"),
    ]
)
MESSAGE_INDEX = struct.Struct("<HI")  # channel, bytes of the entries; entries
MESSAGE_INDEX_HEAD = np.dtype(
    [("opcode", "u1"), ("length", "<i8"), ("channel", "<u2"), ("size", "<u4")]
)
INDEX_ENTRY = struct.Struct("<QQ")  # log time of a message, offset in the uncompressed chunk
INDEX_ENTRIES = np.dtype([("time", "<i8"), ("offset", "<i8")])
# First and last log time, offset and length of the chunk, bytes of the index offsets; these, the
# tail, the compression name, compressed and uncompressed size (UINT64 each).
CHUNK_INDEX = struct.Struct("<QQQQI")
INDEX_OFFSET = struct.Struct("<HQ")  # channel, offset of its message index
CHUNK_INDEX_TAIL = struct.Struct("<QI")  # bytes of the message indexes, length of a name
ATTACHMENT = struct.Struct("<QQI")  # log time, time of creation, length of the name
SUMMARY_OFFSET = struct.Struct("<9xBQQ")  # with HEAD: opcode, start and length of a group
FOOTER = struct.Struct("<QQ")  # start of the summary, start of the summary offsets; CRC (UINT32)
FOOTER_SIZE = HEAD.size + FOOTER.size + UINT32.size + len(MAGIC)
_OTHERS = {  # formats mistaken for MCAP by their first bytes, and the tool that converts each
    b"\x28\xb5\x2f\xfd": "is compressed as a whole: `zstd -d -o NEW.mcap` makes a log of it",
    b"\x04\x22\x4d\x18": "is compressed as a whole: `lz4 -d` makes a log of it",
    b"\x1f\x8b": "is compressed as a whole: `gzip -d` makes a log of it",
    b"BZh": "is compressed as a whole: `bzip2 -d` makes a log of it",
    b"\xfd7zXZ\0": "is compressed as a whole: `xz -d` makes a log of it",
    b"PK\3\4": "is an archive: `unzip` takes out what is in it",
    b"SQLite format 3\0": "is a bag in SQLite, no MCAP: `ros2 bag convert` makes MCAP of it",
    b"#ROSBAG": "is a bag of ROS 1, no MCAP: `rosbags-convert` makes a bag of ROS 2 of it",
}
_COMPRESSED = (".zst", ".zstd", ".lz4", ".gz", ".bz2", ".xz")
COMPRESSED_SUFFIXES = tuple(f".mcap{suffix}" for suffix in _COMPRESSED)
OTHER_SUFFIXES = (*_COMPRESSED, ".db3", ".bag")


def not_mcap(start: bytes) -> str:
    """Describe a file that does not start as MCAP, from its first 16 bytes or all of them."""
    for magic, what in _OTHERS.items():
        if start.startswith(magic):
            return what
    return "is not an MCAP file"


LIMIT = 100 << 20  # maximum bytes in memory at once; records of hearthlog are below 2 MiB
TOO_LARGE = f"it is larger than hearthlog reads at once ({LIMIT >> 20} MiB)"
_CLASSES: dict[int, Any] = {
    Opcode.HEADER: records.Header,
    Opcode.FOOTER: records.Footer,
    Opcode.SCHEMA: records.Schema,
    Opcode.CHANNEL: records.Channel,
    Opcode.CHUNK_INDEX: records.ChunkIndex,
    Opcode.ATTACHMENT: records.Attachment,
    Opcode.ATTACHMENT_INDEX: records.AttachmentIndex,
    Opcode.STATISTICS: records.Statistics,
    Opcode.METADATA: records.Metadata,
    Opcode.METADATA_INDEX: records.MetadataIndex,
    Opcode.SUMMARY_OFFSET: records.SummaryOffset,
    Opcode.DATA_END: records.DataEnd,
}


class _Content(ReadDataStream):
    """Content of one record; an end within a field is an error."""

    def read(self, length: int) -> bytes:
        data = super().read(min(length, LIMIT))
        if len(data) != length:
            raise McapError("a record ends within a field")
        return data


class _EscapedContent(_Content):
    """Content of one record whose texts may not be UTF-8."""

    def read_prefixed_string(self) -> str:
        return self.read(self.read4()).decode(errors="backslashreplace")


def parse(opcode: int, content: bytes, *, escaped: bool = False) -> McapRecord | None:
    r"""Parse a record; None for a chunk, message, message index, or a kind unknown to MCAP.

    With `escaped`, bytes that are not UTF-8 become `\xNN`, so different names remain different;
    else raise `UnicodeDecodeError`. Raise `McapError` if the record is shorter than its fields.
    """
    kind = _CLASSES.get(opcode)
    stream = _EscapedContent if escaped else _Content
    return None if kind is None else kind.read(stream(BytesIO(content)))


def parse_escaped(opcode: int, content: bytes) -> tuple[McapRecord | None, bool]:
    """Parse a record as `parse` does; also return whether a text had to be escaped.

    Raise `McapError` if the record is shorter than its fields.
    """
    try:
        return parse(opcode, content), False
    except UnicodeDecodeError:
        return parse(opcode, content, escaped=True), True


def read_footer(tail: bytes) -> records.Footer | None:
    """Read the footer from the last `FOOTER_SIZE` bytes of a file, or all of a shorter one.

    None if the file does not end with a footer and the magic bytes.
    """
    if len(tail) < FOOTER_SIZE or tail[0] != Opcode.FOOTER or not tail.endswith(MAGIC):
        return None
    footer = parse(Opcode.FOOTER, tail[HEAD.size :])
    assert isinstance(footer, records.Footer)
    return footer


def encode(record: McapRecord) -> bytes:
    """Encode a record, including opcode and length."""
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


class ChunkHead(NamedTuple):
    """The head of a chunk."""

    start: int  # log time of the first message, in nanoseconds
    end: int  # log time of the last message, in nanoseconds
    size: int  # uncompressed bytes of the records
    crc: int  # CRC-32 of the uncompressed records; 0 for none
    compression: bytes  # `zstd`, `lz4`, or empty for uncompressed records
    data: slice  # range of the compressed records in the chunk's content


def chunk_head(content: bytes | memoryview) -> ChunkHead:
    """Read the head of a chunk from its content.

    Raise `McapError` if the head is incomplete, or states records larger than `LIMIT`.
    """
    head = begun_chunk_head(content)
    if head.data.stop > len(content):
        raise McapError("a chunk is shorter than it claims")
    if head.size > LIMIT:
        raise McapError(TOO_LARGE)
    return head


def begun_chunk_head(content: bytes | memoryview) -> ChunkHead:
    """Read a chunk's head from its content up to the compressed records, without checks.

    Raise `McapError` if the content is too short.
    """
    try:
        start, end, size, crc, length = CHUNK.unpack_from(content)
        first = CHUNK.size + length
        compression = bytes(content[CHUNK.size : first])
        (stored,) = UINT64.unpack_from(content, first)
    except struct.error as error:
        raise McapError("a chunk is too short") from error
    first += UINT64.size
    return ChunkHead(start, end, size, crc, compression, slice(first, first + stored))


def decompress(head: ChunkHead, content: bytes | memoryview) -> bytes:
    """Decompress the records of a chunk, of `head.size` bytes, and verify their checksum.

    Raise `McapError` if the compression is unknown, or the data are damaged.
    """
    out = bytearray(head.size)
    decompress_into(memoryview(out), head, content)
    return bytes(out)


def decompress_into(out: memoryview, head: ChunkHead, content: bytes | memoryview) -> None:
    """Decompress records as `decompress` does, into a buffer of exactly `head.size` bytes.

    Raise `McapError` if the compression is unknown, or the data are damaged.
    """
    try:
        size = _DECOMPRESS[head.compression](content[head.data], out)
    except KeyError as error:
        raise McapError(f"a chunk has unknown compression {head.compression!r}") from error
    except (zstandard.ZstdError, RuntimeError, EOFError) as error:  # the last two are from lz4
        raise McapError(f"a chunk cannot be decompressed ({error})") from error
    if size != head.size:
        raise McapError("a chunk has another size than it claims")
    if head.crc and zlib.crc32(out) != head.crc:
        raise McapError("a chunk has another checksum than it claims")


def _zstd(data: bytes | memoryview, out: memoryview) -> int:
    reader = _LOCAL.zstd.stream_reader(data)
    size = reader.readinto(out) if out else 0
    return size + len(reader.read(1))


def _lz4(data: bytes | memoryview, out: memoryview) -> int:
    import lz4.frame  # noqa: PLC0415  only other writers use lz4

    raw = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=len(out) + 1)
    return _stored(raw, out)


def _stored(data: bytes | memoryview, out: memoryview) -> int:
    if len(data) == len(out):
        out[:] = data
    return len(data)


class _Local(threading.local):
    """Per-thread decompressors: costly to create, and not thread-safe."""

    def __init__(self) -> None:
        self.zstd = zstandard.ZstdDecompressor()


_LOCAL = _Local()


def zstd_decompressor() -> zstandard.ZstdDecompressor:
    """Return the decompressor of this thread."""
    return _LOCAL.zstd


_DECOMPRESS = {b"zstd": _zstd, b"lz4": _lz4, b"": _stored}


Definition = Schema | Channel


class Definitions:
    """Schemas and channels of a file by ID, and IDs with contradictory definitions."""

    def __init__(self) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self._doubtful: set[tuple[type, int]] = set()

    def add(self, record: Definition) -> bool:
        """Add a definition, unless its ID is taken."""
        if isinstance(record, Schema):
            return self.schemas.setdefault(record.id, record) == record
        return self.channels.setdefault(record.id, record) == record

    def doubt(self, record: Definition) -> None:
        """Mark a definition as contradictory to another one with its ID."""
        self._doubtful.add((type(record), record.id))

    def defines(self, number: int) -> bool:
        """Return whether a channel and its schema, if any, are defined without contradiction."""
        channel = self.channels.get(number)
        if channel is None or (Channel, number) in self._doubtful:
            return False
        schema = channel.schema_id
        is_defined = schema == 0 or schema in self.schemas
        return is_defined and (Schema, schema) not in self._doubtful

    def topic(self, number: int) -> str:
        """Return the topic of a channel."""
        return self.channels[number].topic if self.defines(number) else f"channel {number}"


CHUNKS = np.dtype(
    [
        ("offset", "<i8"),  # offset of the chunk, or of a run of messages outside of chunks
        ("length", "<i8"),  # bytes, heads included
        ("index_length", "<i8"),  # bytes of the message indexes behind it; -1 for a run of messages
        ("size", "<i8"),  # uncompressed bytes
        ("start", "<i8"),  # log time of the first message, in nanoseconds
        ("end", "<i8"),  # log time of the last message, in nanoseconds
        ("channels", "<i8"),  # index into `LogFile.channel_sets`
        # Start offset in the content for a part of a large chunk, and -1 for a complete chunk. The
        # other fields of a part describe the part; its length and index_length are 0.
        ("part", "<i8"),
    ]
)
LAST_TIME = (1 << 63) - 2  # ns; later log times, as of clocks that ran below zero, are skipped
LATE = "messages are left out whose log times are after the year 2262, as of a clock below zero"
_EMPTY = 80  # maximum bytes of a chunk without records
_RUN_LIMIT = 1 << 20  # bytes of messages outside of chunks read at once


class RecordLocation(NamedTuple):
    """Location of a record in a file; the length includes opcode and length."""

    opcode: int
    offset: int
    length: int


@dataclass
class ChunkRow:
    """Row of `CHUNKS` under construction, and the channels of the following message indexes.

    Log times after `LAST_TIME` are clipped to it, and set `late`.
    """

    offset: int
    length: int
    index_length: int
    size: int
    start: int
    end: int
    channels: set[int] = field(default_factory=set)
    late: bool = False

    def numbers(self) -> tuple[int, ...]:
        """Return the values of the row, except its channels."""
        return self.offset, self.length, self.index_length, self.size, self.start, self.end

    def continues(self, location: RecordLocation) -> bool:
        """Return whether a message starts at the end of this run, which is below its size limit."""
        is_next = self.offset + self.length == location.offset and not self.late
        is_next &= location.length < _RUN_LIMIT
        return self.index_length < 0 and is_next and self.length < _RUN_LIMIT

    def extend(self, message: "ChunkRow") -> None:
        """Append a message to this run."""
        self.length += message.length
        self.size += message.size
        self.start = min(self.start, message.start)
        if not message.late:
            self.end = max(self.end, message.end)
        self.late |= message.late


def read_chunk_row(location: RecordLocation, head: bytes) -> ChunkRow:
    """Return the row of a chunk, or of a message outside of chunks, from the start of its record.

    It has no channels; `index_length` is 0 for a chunk and -1 for a message. Raise `McapError` if
    the head is too short, or a size is 2**63 or more.
    """
    opcode, offset, length = location
    try:
        if opcode == Opcode.CHUNK:
            start, end, size, _, _ = CHUNK.unpack_from(head, HEAD.size)
            index_length = 0
        else:
            start = end = MESSAGE.unpack_from(head)[4]
            size, index_length = length, -1
    except struct.error as error:
        raise McapError("a record is too short") from error
    return _row((offset, length, index_length, size), start, end)


def read_chunk_index(content: bytes) -> ChunkRow:
    """Return the row of a chunk from its chunk index.

    Raise `McapError` if an offset or a size is 2**63 or more, `struct.error` if the content is
    shorter than stated, or ends within an index offset.
    """
    start, end, offset, length, entries = CHUNK_INDEX.unpack_from(content)
    first = CHUNK_INDEX.size
    offsets = INDEX_OFFSET.iter_unpack(content[first : first + entries])
    channels = {channel for channel, _ in offsets}
    first += entries
    index_length, text = CHUNK_INDEX_TAIL.unpack_from(content, first)
    first += CHUNK_INDEX_TAIL.size + text + UINT64.size
    (size,) = UINT64.unpack_from(content, first)
    row = _row((offset, length, index_length, size), start, end)
    row.channels = channels
    return row


def _row(sizes: tuple[int, int, int, int], start: int, end: int) -> ChunkRow:
    """Return a row from offset, length, length of the indexes and size, and two log times."""
    if max(sum(sizes[:3]), sizes[3]) > LAST_TIME:
        raise McapError("a number is out of range")
    late = max(start, end) > LAST_TIME
    return ChunkRow(*sizes, min(start, LAST_TIME), min(end, LAST_TIME), late=late)


def not_empty(chunks: NDArray[np.void]) -> NDArray[np.void]:
    """Remove empty chunks, which a hostile file may have in great numbers.

    Rows [shape=(n,)] and result [shape=(m,)] are of dtype `CHUNKS`.
    """
    return chunks[(chunks["size"] > 0) | (chunks["length"] > _EMPTY)]


def by_start(chunks: NDArray[np.void]) -> NDArray[np.void]:
    """Sort chunks [shape=(n,), dtype `CHUNKS`] by first log time; equal times keep their order."""
    return chunks[np.argsort(chunks["start"], kind="stable")]


_RECORD_HEAD = HEAD.size + CHUNK.size  # bytes with the length and the time span of a record
_WINDOW = 1 << 14  # bytes per read: an hour has half a million records


def walk_records(
    read: Callable[[int, int], bytes], start: int
) -> Iterator[tuple[int, int, int, bytes]]:
    """Yield opcode, offset and length of records, and a head, while there are complete heads.

    Length and head include opcode and length; the record may exceed the file. The head has the
    first bytes of the record, or all of them. `read` maps offset and length to bytes; fewer at the
    end of the file.
    """
    window, first = b"", start
    while True:
        place = start - first
        if not 0 <= place <= len(window) - _RECORD_HEAD:
            window, first, place = read(start, _WINDOW), start, 0
        head = window[place : place + _RECORD_HEAD]
        if len(head) < HEAD.size:
            return
        opcode, length = HEAD.unpack_from(head)
        length += HEAD.size
        yield opcode, start, length, head[:length]
        start += length


def read_records(
    file: LocalFile | StoredFile, start: int, end: int
) -> Iterator[tuple[RecordLocation, bytes]]:
    """Read the records of a byte range, the section, one by one.

    Raise `McapError` if a record is longer than the section, or than `LIMIT`.
    """
    with io.BufferedReader(Section(file, start), 1 << 20) as stream:
        while start < end:
            head = stream.read(HEAD.size)
            opcode, length = HEAD.unpack(head)
            if length > min(LIMIT, end - start - HEAD.size):
                raise McapError("a record claims to be too large")
            yield RecordLocation(opcode, start, HEAD.size + length), head + stream.read(length)
            start += HEAD.size + length
