"""Chunks as files hold them, and how they are built: records, compressed, and their index."""

import threading
import zlib
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import zstandard
from numpy.typing import NDArray

from hearthlog.schemas.arrays import Bytes, Int64
from hearthlog.schemas.mcap.formats import INDEX_ENTRY

LATEST = 1 << 63  # log time, in nanoseconds, after all that a file may have
_COMPRESSION = b"zstd"


class StoredChunk(NamedTuple):
    """A chunk as a file holds it.

    Attributes
    ----------
    compression : bytes
    data : bytes-like
        Compressed records.
    size, crc : int
        Bytes and CRC-32 of the records, uncompressed.
    start, end : int
        Log times of the first and the last message, in nanoseconds.
    entries : mapping of int to bytes-like
        The message index: by channel, log times and offsets of the messages (`INDEX_ENTRIES`).
    """

    compression: bytes
    data: bytes | memoryview
    size: int
    crc: int
    start: int
    end: int
    entries: Mapping[int, bytes | bytearray]


class _Local(threading.local):
    """Compressors are dear to make and must not be shared between threads."""

    def __init__(self) -> None:
        self.zstd = zstandard.ZstdCompressor()


_LOCAL = _Local()


class ChunkBuilder:
    """A chunk in progress.

    Attributes
    ----------
    content : bytearray
        Its records.
    entries : dict of int to bytearray
        Its message index, by channel.
    start, end : int
        Log times of its first and last message, in nanoseconds.
    """

    def __init__(self) -> None:
        self.content = bytearray()
        self.entries: dict[int, bytearray] = {}
        self.start, self.end = LATEST, 0

    def add_message(self, channel: int, log_time: int, head: bytes, payload: bytes) -> None:
        """Append one message: the beginning of its record, and its payload."""
        entry = INDEX_ENTRY.pack(log_time, len(self.content))
        self.entries.setdefault(channel, bytearray()).extend(entry)
        self.content += head
        self.content += payload
        self.start, self.end = min(self.start, log_time), max(self.end, log_time)

    def add_messages(self, data: Bytes, channels: Int64, entries: NDArray[np.void]) -> None:
        """Append messages.

        Parameters
        ----------
        data : np.ndarray [shape=(b,)], uint8
            Their records.
        channels : np.ndarray [shape=(n,)], int64
        entries : np.ndarray [shape=(n,)], of dtype `INDEX_ENTRIES`
        """
        self.content += data.data
        numbers, firsts = np.unique(channels, return_index=True)
        for channel in numbers[np.argsort(firsts)].tolist():
            same = entries[channels == channel].tobytes()
            self.entries.setdefault(channel, bytearray()).extend(same)
        times = entries["time"]
        self.start, self.end = min(self.start, int(times.min())), max(self.end, int(times.max()))

    def compress(self) -> StoredChunk:
        """Return the chunk as a file will hold it."""
        data = _LOCAL.zstd.compress(self.content)
        crc = zlib.crc32(self.content)
        size = len(self.content)
        return StoredChunk(_COMPRESSION, data, size, crc, self.start, self.end, self.entries)
