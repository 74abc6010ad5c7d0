"""Chunks as files hold them, and how they are built: records, compressed, and their index."""

import threading
import zlib
from collections import defaultdict
from collections.abc import Collection, Mapping
from typing import NamedTuple

import numpy as np
import zstandard
from numpy.typing import NDArray

from hearthlog.schemas.arrays import Bytes, Int64
from hearthlog.schemas.mcap.formats import HEAD, INDEX_ENTRIES, INDEX_ENTRY
from hearthlog.schemas.mcap.raw_messages import gather_heads
from hearthlog.schemas.mcap.records import ChunkHead, decompress

LATEST = 1 << 63  # log time, in nanoseconds, after all that a file may have


class StoredChunk(NamedTuple):
    """A chunk as a file holds it."""

    compression: bytes
    data: bytes | memoryview  # compressed records
    size: int  # bytes of the records, uncompressed
    crc: int  # CRC-32 of the same
    start: int  # log time of the first message, in nanoseconds
    end: int  # and of the last
    entries: Mapping[
        int, bytes | bytearray | memoryview
    ]  # the message index, `INDEX_ENTRIES` by channel
    raw: bytes | bytearray | memoryview | None = None  # records, uncompressed, where they are kept

    def times(self, channel: int) -> Int64:
        """Return the log times of a channel's messages, as the message index has them."""
        return np.frombuffer(self.entries[channel], INDEX_ENTRIES)["time"]

    def content(self) -> bytes:
        """Decompress the records.

        Raise `McapError` if they are damaged.
        """
        head = ChunkHead(0, 0, self.size, 0, self.compression, slice(None))
        return decompress(head, self.data)


_LEVEL = 1  # of zstd: the usual 3 takes half as long again and saves 0.5 % of a log


class _Local(threading.local):
    """Compressors are dear to make and must not be shared between threads."""

    def __init__(self) -> None:
        self.zstd = zstandard.ZstdCompressor(_LEVEL)


_LOCAL = _Local()


class ChunkBuilder:
    """A chunk in progress.

    Attributes
    ----------
    entries : dict of int to bytearray
        Its message index, by channel: rows of dtype `INDEX_ENTRIES`.
    start, end : int
        First and last log time of its messages, in nanoseconds; `LATEST` and 0 without messages.
    """

    def __init__(self) -> None:
        self.content = bytearray()
        self.entries: defaultdict[int, bytearray] = defaultdict(bytearray)
        self.start, self.end = LATEST, 0

    def add_messages(self, data: Bytes, channels: Int64, entries: NDArray[np.void]) -> None:
        """Append message records.

        Parameters
        ----------
        data : np.ndarray [shape=(b,)], uint8
            The records, one behind the other.
        channels : np.ndarray [shape=(n,)], int64
            Number of the channel of each; n is 1 or more.
        entries : np.ndarray [shape=(n,)], of dtype `INDEX_ENTRIES`
            Log time of each, and its offset in the content of the whole chunk.
        """
        self.content += data.data
        numbers, firsts = np.unique(channels, return_index=True)
        for channel in numbers[np.argsort(firsts)].tolist():
            same = entries[channels == channel].tobytes()
            self.entries[channel] += same
        times = entries["time"]
        self.start, self.end = min(self.start, int(times.min())), max(self.end, int(times.max()))

    def add_chunk(self, chunk: StoredChunk, dropped: Collection[int] = ()) -> None:
        """Append the records of a chunk, without the messages of some channels.

        Parameters
        ----------
        dropped : collection of int
            Numbers of the channels; if there are no others, nothing is appended.
        """
        kept = {channel: rows for channel, rows in chunk.entries.items() if channel not in dropped}
        if not kept:
            return
        content = chunk.content()
        gone = [rows for channel, rows in chunk.entries.items() if channel in dropped]
        starts = np.sort(np.frombuffer(b"".join(gone), INDEX_ENTRIES)["offset"])
        sizes = gather_heads(content, starts)["length"] + HEAD.size
        before = np.concatenate([[0], np.cumsum(sizes)])  # bytes dropped before each message
        for channel, rows in kept.items():
            moved = np.frombuffer(rows, INDEX_ENTRIES).copy()
            moved["offset"] += len(self.content) - before[starts.searchsorted(moved["offset"])]
            self.entries[channel] += moved.tobytes()
            self.start = min(self.start, int(moved["time"].min()))
            self.end = max(self.end, int(moved["time"].max()))
        firsts, lasts = [0, *(starts + sizes).tolist()], [*starts.tolist(), len(content)]
        for first, last in zip(firsts, lasts, strict=True):
            self.content += content[first:last]

    def gather(self, chunk: StoredChunk, channels: Collection[int]) -> None:
        """Append the messages of some channels of a chunk, and nothing else that it holds."""
        content = chunk.content()
        for channel, rows in chunk.entries.items():
            if channel not in channels:
                continue
            entries = np.frombuffer(rows, INDEX_ENTRIES)
            sizes = gather_heads(content, entries["offset"].astype(np.int64))["length"] + HEAD.size
            for row, size in zip(entries.tolist(), sizes.tolist(), strict=True):
                time, offset = row
                self.entries[channel] += INDEX_ENTRY.pack(time, len(self.content))
                self.content += content[offset : offset + size]
                self.start, self.end = min(self.start, time), max(self.end, time)

    def compress(self) -> StoredChunk:
        """Compress the records; return the chunk as a file will hold it."""
        return compress_chunk(self.content, (self.start, self.end), self.entries)


def compress_chunk(
    content: bytearray | memoryview,
    span: tuple[int, int],
    entries: Mapping[int, bytes | bytearray | memoryview],
) -> StoredChunk:
    """Compress the records of a chunk; return it as a file will hold it.

    Parameters
    ----------
    span : (int, int)
        First and last log time of its messages, in nanoseconds.
    entries : mapping of int to bytes-like
        Its message index, by channel: rows of dtype `INDEX_ENTRIES`.
    """
    data, crc = _LOCAL.zstd.compress(content), zlib.crc32(content)
    return StoredChunk(b"zstd", data, len(content), crc, *span, entries, content)
