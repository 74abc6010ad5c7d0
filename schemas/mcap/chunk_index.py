"""Chunks of a file and their time spans, from its index or by a scan of its records."""

import io
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from numpy.typing import NDArray

from hearthlog.schemas.files import LocalFile, Section, StoredFile
from hearthlog.schemas.mcap.records import (
    CHUNK,
    CHUNK_INDEX,
    CHUNK_INDEX_TAIL,
    HEAD,
    INDEX_OFFSET,
    LIMIT,
    MESSAGE,
    UINT64,
)

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
