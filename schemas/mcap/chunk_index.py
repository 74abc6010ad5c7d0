"""The chunks of a file and their time spans, from its index or by a walk over its records."""

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
        ("offset", "<i8"),  # of the chunk, or of a run of messages outside of chunks
        ("length", "<i8"),  # in bytes, heads included
        ("index_length", "<i8"),  # of the message indexes behind it; -1 behind a run of messages
        ("size", "<i8"),  # bytes, uncompressed
        ("start", "<i8"),  # log time of its first message, in nanoseconds
        ("end", "<i8"),  # and of its last
        ("channels", "<i8"),  # a place in `LogFile.channel_sets`
        # Byte of the content at which a part of a large chunk begins, whose other numbers are those
        # of the part; -1: all of the chunk. Length and that of the indexes are 0 of a part.
        ("part", "<i8"),
    ]
)
LAST_TIME = (1 << 63) - 2  # ns; later log times, as of clocks that ran below zero, are not read
LATE = "messages are left out whose log times are after the year 2262, as of a clock below zero"
_EMPTY = 80  # bytes that a chunk without records has at most
_RUN_LIMIT = 1 << 20  # bytes of messages outside of chunks that are read at once


class RecordLocation(NamedTuple):
    """A record in a file; its length includes opcode and length."""

    opcode: int
    offset: int
    length: int


@dataclass
class ChunkRow:
    """A row of `CHUNKS` in the making, and the channels whose message indexes follow the chunk.

    Log times after `LAST_TIME` are that time in it, and it is `late` then.
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
        """Return the numbers of the row, without its channels."""
        return self.offset, self.length, self.index_length, self.size, self.start, self.end

    def continues(self, location: RecordLocation) -> bool:
        """Tell whether a message record belongs to this run of messages.

        It does if it begins where the run ends, and the run is not too long yet.
        """
        is_next = self.offset + self.length == location.offset and not self.late
        is_next &= location.length < _RUN_LIMIT
        return self.index_length < 0 and is_next and self.length < _RUN_LIMIT

    def extend(self, message: "ChunkRow") -> None:
        """Add a message to this run."""
        self.length += message.length
        self.size += message.size
        self.start = min(self.start, message.start)
        if not message.late:
            self.end = max(self.end, message.end)
        self.late |= message.late


def read_chunk_row(location: RecordLocation, head: bytes) -> ChunkRow:
    """Describe a chunk, or a message outside of chunks, from the beginning of its record.

    Returns
    -------
    ChunkRow
        Without channels; `index_length` is 0 for a chunk and -1 for a message.

    Raises
    ------
    McapError
        If it is too short, or a size is 2**63 or more.
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
    """Describe a chunk from its chunk index.

    Raise `McapError` if a place or a size is 2**63 or more. Raise `struct.error` if the content
    is shorter than it claims, or holds a part of an index offset.
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
    """Make a row of offset, length, length of the indexes and size, and of two log times."""
    if max(sum(sizes[:3]), sizes[3]) > LAST_TIME:
        raise McapError("a number is out of range")
    late = max(start, end) > LAST_TIME
    return ChunkRow(*sizes, min(start, LAST_TIME), min(end, LAST_TIME), late=late)


def not_empty(chunks: NDArray[np.void]) -> NDArray[np.void]:
    """Leave out chunks that hold nothing, of which a hostile file may have very many.

    Parameters
    ----------
    chunks : np.ndarray [shape=(n,)], of dtype `CHUNKS`

    Returns
    -------
    np.ndarray [shape=(m,)], of dtype `CHUNKS`
    """
    return chunks[(chunks["size"] > 0) | (chunks["length"] > _EMPTY)]


def by_start(chunks: NDArray[np.void]) -> NDArray[np.void]:
    """Sort chunks by the log times of their first messages.

    Parameters
    ----------
    chunks : np.ndarray [shape=(n,)], of dtype `CHUNKS`

    Returns
    -------
    np.ndarray [shape=(n,)], of dtype `CHUNKS`
        A sorted copy; chunks of the same time keep their order.
    """
    return chunks[np.argsort(chunks["start"], kind="stable")]


_RECORD_HEAD = HEAD.size + CHUNK.size  # bytes that tell where a record ends and what it spans
_WINDOW = 1 << 14  # bytes that are read at once: an hour has half a million records


def walk_records(
    read: Callable[[int, int], bytes], start: int
) -> Iterator[tuple[int, int, int, bytes]]:
    """Go from record to record, as long as there is the head of one.

    Parameters
    ----------
    read : callable
        Returns bytes of the file from an offset on, fewer than asked for at its end.

    Yields
    ------
    opcode, offset, length : int
        Of the record, which may claim to be longer than the file; with opcode and length.
    head : bytes
        Its first bytes, opcode and length included, or all of them.
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
    """Read the records of a section one by one.

    Parameters
    ----------
    start, end : int
        Of the section, in bytes.

    Raises
    ------
    McapError
        If a record is longer than the section, or than `LIMIT`.
    """
    with io.BufferedReader(Section(file, start), 1 << 20) as stream:
        while start < end:
            head = stream.read(HEAD.size)
            opcode, length = HEAD.unpack(head)
            if length > min(LIMIT, end - start - HEAD.size):
                raise McapError("a record claims to be too large")
            yield RecordLocation(opcode, start, HEAD.size + length), head + stream.read(length)
            start += HEAD.size + length
