"""Undamaged records of a damaged file: possible sizes, and contents."""

import struct
import zlib
from array import array
from collections.abc import Iterable, Iterator, Mapping
from itertools import repeat
from typing import NamedTuple

import numpy as np
from mcap import records
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import McapRecord

from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.mcap.compressed_chunk import StoredChunk, compress_chunk
from hearthlog.schemas.mcap.raw_messages import gather_heads, index_messages, iterate_records
from hearthlog.schemas.mcap.records import (
    ATTACHMENT,
    HEAD,
    INDEX_ENTRIES,
    LAST_TIME,
    LIMIT,
    MESSAGE,
    MESSAGE_FIXED,
    UINT32,
    UINT64,
    Definition,
    encode,
    parse_escaped,
)

UNKNOWN = 1 << 62  # larger than any file, in bytes
# Content of each kind of record: a number of bytes, or a length of this format and that many bytes.
FIELDS: dict[int, tuple[int | struct.Struct, ...]] = {
    Opcode.HEADER: (UINT32, UINT32),
    Opcode.FOOTER: (20,),
    Opcode.SCHEMA: (2, UINT32, UINT32, UINT32),
    Opcode.CHANNEL: (4, UINT32, UINT32, UINT32),
    Opcode.CHUNK: (28, UINT32, UINT64),
    Opcode.MESSAGE_INDEX: (2, UINT32),
    Opcode.CHUNK_INDEX: (32, UINT32, 8, UINT32, 16),
    Opcode.ATTACHMENT: (16, UINT32, UINT32, UINT64, 4),
    Opcode.ATTACHMENT_INDEX: (40, UINT32, UINT32),
    Opcode.STATISTICS: (42, UINT32),
    Opcode.METADATA: (UINT32, UINT32),
    Opcode.METADATA_INDEX: (16, UINT32),
    Opcode.SUMMARY_OFFSET: (17,),
    Opcode.DATA_END: (4,),
}
SHORTEST = np.full(256, UNKNOWN)  # minimum content size in bytes, by opcode
for _opcode, _fields in FIELDS.items():
    SHORTEST[_opcode] = sum(f if isinstance(f, int) else f.size for f in _fields)
SHORTEST[Opcode.MESSAGE] = MESSAGE_FIXED
LARGEST = np.full(256, 16 << 20)  # maximum record size in bytes that is read, by opcode
LARGEST[[Opcode.ATTACHMENT, Opcode.MESSAGE_INDEX]] = LIMIT


def find_record_heads(window: bytes) -> list[int]:
    """Return ascending offsets with a plausible opcode and length, of records damaged or not."""
    count = len(window) - HEAD.size + 1
    if count <= 0:
        return []
    shortest = SHORTEST[np.frombuffer(window, np.uint8)[:count]]
    places = np.flatnonzero(shortest <= LIMIT)
    lengths = np.ndarray((count,), "<u8", window, 1, (1,))[places]
    heads: list[int] = places[(lengths <= LIMIT) & (lengths >= shortest[places])].tolist()
    return heads


_DEFINITIONS_LIMIT = 1 << 19


class IntactChunk(NamedTuple):
    """Chunk with verified content, and its definitions."""

    stored: StoredChunk
    definitions: list[Definition]
    leading: int  # number of definitions before the first message
    late: Mapping[int, int] = {}  # by channel: messages omitted for their log time


class LargeChunk(NamedTuple):
    """Chunk that is too large to read at once, or a large message that becomes a chunk."""

    stored: StoredChunk  # without its data
    data: tuple[int, int]  # start and end offset of the data in the file
    definitions: list[Definition]
    leading: int  # number of definitions before the first message
    unread: Mapping[int, int]  # by channel: messages that are too large themselves
    unopened: str = ""  # reason why the content was not read


class IntactAttachment(NamedTuple):
    """Attachment of any size, with its index entry."""

    index_record: records.AttachmentIndex
    data: tuple[int, int]  # start and end offset of the record in the file
    inner: tuple[int, int]  # start and end offset of the attached data in the file
    escaped: bool  # whether a text before the data is not UTF-8


class UnknownRecord(NamedTuple):
    """Record of a later version of MCAP, or of an application, of any size."""

    head: bytes  # its first bytes
    data: tuple[int, int]  # start and end offset of the record in the file


class IntactRecord(NamedTuple):
    """Complete record."""

    offset: int
    end: int
    record: "McapRecord | IntactPiece | None"  # None for a message index
    corrected: str = ""  # description of the error in its head
    escaped: tuple[str, ...] = ()  # names of records with texts that are not UTF-8
    proved: bool = True  # False: there is no checksum, so its content may be wrong


IntactPiece = IntactChunk | LargeChunk | IntactAttachment | UnknownRecord


def split_content(content: bytes) -> tuple[Int64, Int64]:
    """Return the offsets of messages [shape=(m,)] and definitions [shape=(d,)] in a chunk.

    They are those of opcodes, ascending. Raise `McapError` if a record is damaged, or not allowed
    in a chunk.
    """
    messages, definitions = array("q"), array("q")
    kind, shortest = int(Opcode.MESSAGE), MESSAGE.size
    for opcode, start, end in iterate_records(content):
        if opcode == kind and end - start >= shortest:
            messages.append(start)
        elif opcode > Opcode.DATA_END:
            continue  # from a later version of MCAP, or an application
        elif opcode not in {Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL}:
            raise McapError("the records of a chunk are damaged")
        elif end - start < HEAD.size + SHORTEST[opcode]:
            raise McapError("a record in a chunk is too short")
        else:
            definitions.append(start)
    return np.frombuffer(messages, np.int64), np.frombuffer(definitions, np.int64)


def without_late(chunk: IntactChunk, content: bytes, messages: Int64) -> IntactChunk:
    """Remove the messages with log times after `LAST_TIME` from a chunk.

    `messages` [shape=(m,)] are the offsets from `split_content`.
    """
    times = gather_heads(content, messages)["log_time"].astype(np.uint64)
    starts = messages[times > LAST_TIME]
    late = index_messages(content, starts)
    stored, _ = _with_records(content, starts, repeat(b""))
    counts = {channel: len(rows) // INDEX_ENTRIES.itemsize for channel, rows in late.items()}
    return chunk._replace(stored=stored, late=counts)


def with_definitions(
    chunk: IntactChunk, content: bytes, starts: Int64
) -> tuple[IntactChunk, bytes]:
    """Rewrite the definitions of a chunk, at their opcodes [shape=(d,)]; return both."""
    stored, content = _with_records(content, starts, map(encode, chunk.definitions))
    return chunk._replace(stored=stored), content


def _with_records(
    content: bytes, starts: Int64, replaced: Iterable[bytes]
) -> tuple[StoredChunk, bytes]:
    """Replace the records at offsets of a chunk, and compress the content."""
    parts, place = [], 0
    for start, record in zip(starts.tolist(), replaced, strict=False):
        parts += [content[place:start], record]
        place = start + HEAD.size + HEAD.unpack_from(content, start)[1]
    content = b"".join([*parts, content[place:]])
    entries = index_messages(content, split_content(content)[0])
    chunk = compress_chunk(memoryview(content), span_of(entries), entries)
    return chunk._replace(raw=None), content


def read_definitions(content: bytes, starts: Int64) -> tuple[list[Definition], list[str]]:
    """Read the schemas and channels of a chunk, at offsets of opcodes [shape=(d,)].

    Raise `McapError` if one is damaged, or there are more than 524288.
    """
    if len(starts) > _DEFINITIONS_LIMIT:
        raise McapError("a chunk holds more definitions than can be kept")
    definitions: list[Definition] = []
    names: list[str] = []
    for start in starts.tolist():
        opcode, length = HEAD.unpack_from(content, start)
        raw = content[start + HEAD.size : start + HEAD.size + length]
        record, escaped = parse_escaped(opcode, raw)
        assert isinstance(record, Definition)
        definitions.append(record)
        names += [name_of(record)] * escaped
    return definitions, names


def name_of(record: McapRecord | None) -> str:
    """Return the topic, type or name of a record."""
    if isinstance(record, records.Channel):
        return record.topic
    if isinstance(record, records.Header):
        return record.profile
    return str(getattr(record, "name", ""))


def span_of(entries: Mapping[int, bytes | bytearray]) -> tuple[int, int]:
    """Return the first and last log time, in nanoseconds, of a message index; 0 and 0 if empty.

    It has rows of dtype `INDEX_ENTRIES`, by channel.
    """
    if not entries:
        return 0, 0
    times = [np.frombuffer(e, INDEX_ENTRIES)["time"].view(np.uint64) for e in entries.values()]
    return min(int(each.min()) for each in times), max(int(each.max()) for each in times)


def chunk_messages(chunk: StoredChunk) -> Iterator[records.Message]:
    """Read the messages of a chunk one by one."""
    content = chunk.content()
    for opcode, start, end in iterate_records(content):
        if opcode == Opcode.MESSAGE:
            yield read_message(content[start:end])


def read_message(raw: bytes) -> records.Message:
    """Parse a message record."""
    _, _, channel, sequence, log_time, publish_time = MESSAGE.unpack_from(raw)
    return records.Message(channel, log_time, raw[MESSAGE.size :], publish_time, sequence)


class AttachmentHead(NamedTuple):
    """Fields of an attachment before its data."""

    index_record: records.AttachmentIndex  # its offset and length are 0
    first: int  # offset of the data in the record
    escaped: bool  # whether a text in it is not UTF-8

    @property
    def end(self) -> int:
        """End of the data in the record."""
        return self.first + self.index_record.data_size


def attachment_head(raw: bytes | memoryview) -> AttachmentHead:
    """Read an attachment's fields before its data; raise `McapError` if it ends within them."""
    record = memoryview(raw)
    try:
        log_time, create_time, length = ATTACHMENT.unpack_from(record, HEAD.size)
        first = HEAD.size + ATTACHMENT.size + length
        name = bytes(record[first - length : first])
        (length,) = UINT32.unpack_from(record, first)
        media = bytes(record[first + UINT32.size :][:length])
        first += UINT32.size + length
        (size,) = UINT64.unpack_from(record, first)
    except struct.error as error:
        raise McapError("an attachment is damaged") from error
    texts = [text.decode(errors="backslashreplace") for text in (name, media)]
    index = records.AttachmentIndex(0, 0, log_time, create_time, size, *texts)
    escaped = [text.encode() for text in texts] != [name, media]
    return AttachmentHead(index, first + UINT64.size, escaped)


def encode_attachment(
    index: records.AttachmentIndex, data: Iterable[bytes | memoryview]
) -> Iterator[bytes | memoryview]:
    """Encode an attachment of any size, in pieces."""
    name, media = index.name.encode(), index.media_type.encode()
    start = ATTACHMENT.pack(index.log_time, index.create_time, len(name)) + name
    start += UINT32.pack(len(media)) + media + UINT64.pack(index.data_size)
    yield HEAD.pack(Opcode.ATTACHMENT, len(start) + index.data_size + UINT32.size) + start
    crc = zlib.crc32(start)
    for piece in data:
        crc = zlib.crc32(piece, crc)
        yield piece
    yield UINT32.pack(crc)
