"""Encoded messages of one channel, and the records of a chunk."""

import re
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from mcap.exceptions import McapError
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from hearthlog.schemas.arrays import Bool, Bytes, Indices, Int64, gather
from hearthlog.schemas.mcap.records import CHUNK, HEAD, INDEX_ENTRIES, MESSAGE_FIXED, MESSAGE_HEAD


@dataclass(frozen=True)
class RawMessages:
    """Messages of one channel, in the order of their log times."""

    channel: Channel
    schema: Schema | None
    buffer: Bytes  # [shape=(b,)], uint8: messages of this and other channels
    offsets: Int64  # [shape=(n,)], int64: offsets of the payloads in the buffer
    heads: NDArray[np.void]  # [shape=(n,)], of dtype `MESSAGE_HEAD`
    source: Path | None = None  # log of the messages

    def __len__(self) -> int:
        return len(self.offsets)

    @property
    def sizes(self) -> Int64:
        """Sizes of the payloads in bytes."""
        return self.heads["length"] - MESSAGE_FIXED

    @property
    def log_times(self) -> Int64:
        """Log times in nanoseconds."""
        return self.heads["log_time"]

    def payload(self, row: int) -> bytes:
        """Return the payload of one message: CDR, with its header."""
        start = int(self.offsets[row])
        return self.buffer[start : start + int(self.sizes[row])].tobytes()

    def take(self, rows: slice | Indices | Bool) -> "RawMessages":
        """Return the messages at indices, or of a mask, with the same buffer."""
        return replace(self, offsets=self.offsets[rows], heads=self.heads[rows])

    def between(self, start: int | None, end: int | None) -> "RawMessages":
        """Select the messages with start <= log time < end, in nanoseconds of UTC."""
        rows = slice(*bounds(self.log_times, start, end))
        if rows == slice(0, len(self)):
            return self
        return self.take(rows)


def in_order_of_time(parts: Sequence[RawMessages]) -> Iterator[tuple[RawMessages, int]]:
    """Iterate over the messages of several channels in order of log time."""
    times = [part.log_times for part in parts]
    part_of = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    rows = np.concatenate([np.arange(0), *(np.arange(len(part)) for part in parts)])
    order = np.argsort(np.concatenate([np.arange(0), *times]), kind="stable")
    for part, row in zip(part_of[order].tolist(), rows[order].tolist(), strict=True):
        yield parts[part], row


def bounds(times: Int64, start: int | None, end: int | None) -> tuple[int, int]:
    """Return the range of ascending times [shape=(n,)], in any unit, with start <= time < end.

    It is the first index, and the one behind the last; equal if there are none.
    """
    first = 0 if start is None else int(np.searchsorted(times, start))
    last = len(times) if end is None else int(np.searchsorted(times, end))
    return first, max(first, last)


def gather_heads(buffer: Bytes | bytes | memoryview, starts: Int64) -> NDArray[np.void]:
    """Copy the heads [shape=(n,), dtype `MESSAGE_HEAD`] of messages out of a buffer [shape=(b,)].

    `starts` [shape=(n,)] are the offsets of their opcodes.
    """
    if not len(starts):
        return np.empty(0, MESSAGE_HEAD)
    array = np.frombuffer(buffer, np.uint8)
    return gather(array, starts, MESSAGE_HEAD.itemsize).view(MESSAGE_HEAD)


_COMPRESSED = re.compile(  # from the length of the compression name to the magic bytes of the data
    rb"\x04\0\0\0zstd.{8}\x28\xb5\x2f\xfd|\x03\0\0\0lz4.{8}\x04\x22\x4d\x18", re.DOTALL
)
_BEFORE_COMPRESSED = HEAD.size + CHUNK.size - 4
CHUNK_HEAD_LIMIT = 64  # bytes that hold the head of a compressed chunk and the data's magic bytes


def iterate_records(
    content: bytes | memoryview, start: int = 0, end: int | None = None
) -> Iterator[tuple[int, int, int]]:
    """Yield the range, including the opcode, of each record in a chunk's content.

    `start` is the offset of the first record, `end` of the end of the last one; by default all.
    Raise `McapError` if the last record is incomplete, or longer than the content.
    """
    last = len(content) if end is None else end
    unpack = HEAD.unpack_from
    try:
        while start < last:
            opcode, length = unpack(content, start)
            following = start + 9 + length
            if following > last:
                raise McapError("a record in a chunk claims to be longer than the chunk")
            yield opcode, start, following
            start = following
    except struct.error as error:
        raise McapError("a record in a chunk is cut") from error


def index_messages(content: bytes | memoryview, starts: Int64) -> dict[int, bytes]:
    """Build the message index of a chunk: rows of `INDEX_ENTRIES` by channel.

    `starts` [shape=(n,)] are ascending offsets of complete message records, at their opcodes.
    Channels are in the order of their first messages.
    """
    if not len(starts):
        return {}
    heads = gather_heads(content, starts)
    channels = heads["channel"]
    entries = np.empty(len(starts), INDEX_ENTRIES)
    entries["time"], entries["offset"] = heads["log_time"], starts
    channels = channels.copy()
    del heads  # frees millions of rows
    if (channels == channels[0]).all():  # no sorting needed
        return {int(channels[0]): entries.tobytes()}
    order = np.argsort(channels, kind="stable")
    numbers, firsts, counts = np.unique(channels, return_index=True, return_counts=True)
    ends = np.cumsum(counts)
    return {
        int(numbers[i]): entries[order[ends[i] - counts[i] : ends[i]]].tobytes()
        for i in np.argsort(firsts)
    }


def find_chunk_heads(window: bytes) -> Iterator[int]:
    """Yield ascending offsets of possible opcodes of compressed chunks, damaged or not.

    `window` is any part of a file. A head is found only with `CHUNK_HEAD_LIMIT` bytes from its
    start.
    """
    for match in _COMPRESSED.finditer(window):
        if match.start() >= _BEFORE_COMPRESSED:
            yield match.start() - _BEFORE_COMPRESSED
