"""Compressed chunks: building, batch decompression, and streaming of large chunks."""

import io
import threading
import zlib
from array import array
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import zstandard
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from numpy.typing import NDArray

from hearthlog.schemas.arrays import Bytes, Int64, gather
from hearthlog.schemas.mcap.raw_messages import gather_heads
from hearthlog.schemas.mcap.records import (
    HEAD,
    INDEX_ENTRIES,
    INDEX_ENTRY,
    LIMIT,
    MESSAGE,
    ZSTD_CHUNK_HEAD,
    ChunkHead,
    begun_chunk_head,
    decompress,
    zstd_decompressor,
)

LATEST = 1 << 63  # log time, in nanoseconds, after all log times of a file


class StoredChunk(NamedTuple):
    """Chunk in its stored form."""

    compression: bytes
    data: bytes | memoryview  # compressed records
    size: int  # uncompressed bytes of the records
    crc: int  # CRC-32 of the uncompressed records
    start: int  # log time of the first message, in nanoseconds
    end: int  # log time of the last message, in nanoseconds
    entries: Mapping[
        int, bytes | bytearray | memoryview
    ]  # the message index, `INDEX_ENTRIES` by channel
    raw: bytes | bytearray | memoryview | None = None  # uncompressed records, if they are kept

    def times(self, channel: int) -> Int64:
        """Return the log times of a channel's messages from the message index."""
        return np.frombuffer(self.entries[channel], INDEX_ENTRIES)["time"]

    def content(self) -> bytes:
        """Decompress the records; raise `McapError` if they are damaged."""
        head = ChunkHead(0, 0, self.size, 0, self.compression, slice(None))
        return decompress(head, self.data)


_LEVEL = 1  # zstd level: the default of 3 takes 1.5 times the time and saves 0.5 % of a log


class _Local(threading.local):
    """Per-thread compressors: costly to create, and not thread-safe."""

    def __init__(self) -> None:
        self.zstd = zstandard.ZstdCompressor(_LEVEL)


_LOCAL = _Local()


class ChunkBuilder:
    """Builder of a chunk; `entries` has the message index by channel, rows of `INDEX_ENTRIES`.

    `start` and `end` are its first and last log time, in nanoseconds; `LATEST` and 0 without
    messages.
    """

    def __init__(self) -> None:
        self.content = bytearray()
        self.entries: defaultdict[int, bytearray] = defaultdict(bytearray)
        self.start, self.end = LATEST, 0

    def add_messages(self, data: Bytes, channels: Int64, entries: NDArray[np.void]) -> None:
        """Append concatenated message records [shape=(b,)] of channels [shape=(n,)], n >= 1.

        `entries` [shape=(n,), dtype `INDEX_ENTRIES`] have offsets in the content of the complete
        chunk.
        """
        self.content += data.data
        numbers, firsts = np.unique(channels, return_index=True)
        for channel in numbers[np.argsort(firsts)].tolist():
            same = entries[channels == channel].tobytes()
            self.entries[channel] += same
        times = entries["time"]
        self.start, self.end = min(self.start, int(times.min())), max(self.end, int(times.max()))

    def add_chunk(self, chunk: StoredChunk, dropped: Collection[int] = ()) -> None:
        """Append a chunk's records without dropped channels; nothing if these are all of them."""
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
        """Append only the messages of the given channels of a chunk."""
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
        """Compress the records to a chunk in its stored form."""
        return compress_chunk(self.content, (self.start, self.end), self.entries)


def compress_chunk(
    content: bytearray | memoryview,
    span: tuple[int, int],
    entries: Mapping[int, bytes | bytearray | memoryview],
) -> StoredChunk:
    """Compress the records of a chunk to its stored form.

    `span` has the first and last log time in nanoseconds, `entries` the message index by channel:
    rows of dtype `INDEX_ENTRIES`.
    """
    data, crc = _LOCAL.zstd.compress(content), zlib.crc32(content)
    return StoredChunk(b"zstd", data, len(content), crc, *span, entries, content)


_LARGE = 16 << 10  # uncompressed bytes of a chunk that make the cost of a Python call negligible
_IS_POSSIBLE = "multi_decompress_to_buffer" in zstandard.backend_features


def decompress_together(
    raw: Bytes, starts: Int64, lengths: Int64, limit: int
) -> tuple[Bytes, Int64] | None:
    """Decompress chunks and verify their checksums, if all are undamaged and use zstd.

    `raw` [shape=(b,)] has records with `starts` and `lengths` [shape=(n,)] in bytes, including the
    record head. All chunks together have at most `limit` bytes uncompressed. Return the
    concatenated records [shape=(c,)], and the uncompressed bytes of each chunk [shape=(n,)].
    """
    fixed = ZSTD_CHUNK_HEAD.itemsize
    if not _IS_POSSIBLE or (lengths < fixed).any():
        return None
    heads = gather(raw, starts, fixed).view(ZSTD_CHUNK_HEAD)
    sizes, stored = heads["size"], heads["stored"]
    simple = (
        (heads["opcode"] == Opcode.CHUNK)
        & (heads["length"] == lengths - HEAD.size)
        & (heads["name_length"] == len(b"zstd"))
        & (heads["name"] == b"zstd")
        & (stored > 0)
        & (stored <= lengths - fixed)
        & (sizes > 0)
        & (sizes <= LIMIT)
    )
    if not simple.all() or sizes.sum() > limit:
        return None
    ends = np.cumsum(sizes).astype(np.int64)
    first, last = starts + fixed, starts + fixed + stored.astype(np.int64)
    try:
        if ends[-1] >= _LARGE * len(sizes):
            buffer = _one_by_one(raw, first.tolist(), last.tolist(), ends.tolist())
        else:
            buffer = _all_at_once(raw, first, stored, sizes)
    except zstandard.ZstdError:
        return None
    sums = [zlib.crc32(buffer[start:end].data) for start, end in pairwise([0, *ends.tolist()])]
    if ((heads["crc"] != sums) & (heads["crc"] != 0)).any():
        return None
    return buffer, sizes.astype(np.int64)


def _one_by_one(raw: Bytes, first: list[int], last: list[int], ends: list[int]) -> Bytes:
    """Decompress chunks one by one into one buffer."""
    buffer, decompressor, start = np.empty(ends[-1], np.uint8), zstd_decompressor(), 0
    content, out = raw.data, buffer.data
    for begin, end, stop in zip(first, last, ends, strict=True):
        reader = decompressor.stream_reader(content[begin:end])
        if reader.readinto(out[start:stop]) != stop - start or reader.read(1):
            raise zstandard.ZstdError("of another size")
        start = stop
    return buffer


def _all_at_once(raw: Bytes, first: Int64, stored: Int64, sizes: Int64) -> Bytes:
    """Decompress chunks in one call without Python between them, and concatenate them."""
    frames = np.stack([first, stored], axis=1).astype(np.uint64)
    chunks = zstd_decompressor().multi_decompress_to_buffer(
        zstandard.BufferWithSegments(raw.data, frames.tobytes()),
        decompressed_sizes=sizes.astype(np.uint64).tobytes(),
        threads=1,  # the readers have their own threads
    )
    return np.frombuffer(b"".join(chunks), np.uint8)  # type: ignore[arg-type]  # of buffers


_PART = 4 << 20  # bytes of records
_PIECE = 1 << 20  # bytes per decompression step
_HEAD_LIMIT = 128  # bytes that hold the head of a chunk
# Limit of the stated content size: a constant plus a multiple of the stored size. A small file
# with a larger claim is not worth the time.
_CLAIMED, _RATIO = 1 << 30, 256

Read = Callable[[int, int], bytes]  # called with offset and length, returns bytes of a file


class TooLargeError(McapError):
    """Error of a chunk with a stated size that is not worth the time."""


def most_content(length: Any) -> Any:
    """Return the maximum content, in bytes, of a chunk record that is opened, by its bytes."""
    return _CLAIMED + _RATIO * length


class ContentStream:
    """Stream of the decompressed records of a chunk; `position` counts uncompressed bytes read.

    `read` maps offset and length to bytes; fewer at the end of the file. Raise `McapError` if there
    is no chunk at the offset, or it is larger than hearthlog reads.
    """

    def __init__(self, read: Read, offset: int) -> None:
        begin = read(offset, HEAD.size + _HEAD_LIMIT)
        self.head = begun_chunk_head(begin[HEAD.size :])
        self.offset, self.position = offset, 0
        stored = self.head.data.stop - self.head.data.start
        if HEAD.unpack_from(begin)[0] != Opcode.CHUNK:
            raise McapError("here should be a chunk")
        most = most_content(HEAD.size + self.head.data.stop)
        if self.head.size > most:
            what = f"a chunk of {self.head.size >> 20:,} MiB is larger than hearthlog reads"
            raise TooLargeError(f"{what} ({most >> 20:,} MiB of so few bytes)")
        self._crc = 0
        source = _Stored(read, offset + HEAD.size + self.head.data.start, stored)
        self._stream = _decompressing(self.head.compression, io.BufferedReader(source, _PIECE))

    def read(self, length: int) -> bytes:
        """Read the next bytes, fewer at the end; raise `McapError` if they are damaged."""
        parts = []
        left = min(length, self.head.size - self.position)
        try:
            while left and (part := self._stream.read(min(left, _PIECE))):
                parts.append(part)
                left -= len(part)
                self.position += len(part)
                self._crc = zlib.crc32(part, self._crc)
        except (zstandard.ZstdError, RuntimeError, EOFError, OSError) as error:
            raise McapError(f"a chunk cannot be decompressed ({error})") from error
        return b"".join(parts)

    def skip(self, length: int) -> None:
        """Skip the next bytes."""
        end = self.position + length
        while self.position < end and self.read(min(_PIECE, end - self.position)):
            pass

    def check(self) -> int:
        """Return the checksum of the complete content, which must have been read.

        Raise `McapError` if size or checksum of the content differ from the stated values.
        """
        if self.position != self.head.size or self._stream.read(1):
            raise McapError("a chunk has another size than it claims")
        if self.head.crc not in {0, self._crc}:
            raise McapError("a chunk has another checksum than it claims")
        return self._crc


class _Stored(io.RawIOBase):
    """Byte range of a file as a stream."""

    def __init__(self, read: Read, start: int, length: int) -> None:
        super().__init__()
        self._read, self._position, self._end = read, start, start + length

    def readable(self) -> bool:
        return True

    def readinto(self, out: Any) -> int:
        data = self._read(self._position, min(len(out), self._end - self._position))
        out[: len(data)] = data
        self._position += len(data)
        return len(data)


def _decompressing(compression: bytes, source: io.BufferedReader) -> Any:
    """Open a stream that decompresses a source."""
    if compression == b"zstd":
        return zstandard.ZstdDecompressor().stream_reader(source)
    if compression == b"lz4":
        import lz4.frame  # noqa: PLC0415  only other writers use lz4

        return lz4.frame.LZ4FrameFile(source)
    if compression:
        raise McapError(f"a chunk has unknown compression {compression!r}")
    return source


def stated_size(compression: bytes, data: bytes) -> int | None:
    """Return the decompressed size stated by the first 32 bytes or more of data; None for none.

    `compression` is `zstd`, `lz4`, or empty. Raise `McapError` if no such data begin there.
    """
    try:
        if compression == b"zstd":
            size = zstandard.frame_content_size(data)
            return None if size < 0 else size
        if compression == b"lz4":
            import lz4.frame  # noqa: PLC0415  only others write such files

            return int(lz4.frame.get_frame_info(data)["content_size"]) or None
    except (zstandard.ZstdError, RuntimeError) as error:
        raise McapError(f"a chunk cannot be decompressed ({error})") from error
    return None


class Part(NamedTuple):
    """Some records of a chunk, one behind the other."""

    first: int  # offset of the part in the content
    size: int  # size of the part in bytes
    content: bytes
    messages: "array[int]"  # offsets of messages in `content`
    others: list[tuple[int, int]]  # start and end offsets of schemas and channels in `content`


def read_parts(stream: ContentStream) -> Iterator[Part]:
    """Read all records of a chunk, and verify its checksum; raise `McapError` if it is damaged."""
    held, first = bytearray(), 0  # offset of `held` in the content
    messages, others = array("q"), list[tuple[int, int]]()
    complete = 0  # bytes of complete records in `held`
    while piece := stream.read(_PIECE):
        held += piece
        complete, large = _next_records(held, complete, stream.head.size - first, messages, others)
        if large or complete >= _PART:
            if complete:
                yield Part(first, complete, bytes(held[:complete]), messages, others)
            del held[:complete]
            first += complete
            complete, messages, others = 0, array("q"), []
        if large:
            yield Part(first, large, bytes(held[: MESSAGE.size]), messages, others)
            first += large
            stream.skip(first - stream.position)
            held = bytearray()
    if complete < len(held):
        raise McapError("a record in a chunk is cut")
    if complete:
        yield Part(first, complete, bytes(held), messages, others)
    stream.check()


def _next_records(
    held: bytearray, complete: int, end: int, messages: "array[int]", others: list[tuple[int, int]]
) -> tuple[int, int]:
    """Return the end of the last complete record, and the next one's size if over `LIMIT`."""
    while len(held) - complete >= min(MESSAGE.size, end - complete):
        if end - complete < HEAD.size:
            break
        opcode, length = HEAD.unpack_from(held, complete)
        length += HEAD.size
        if opcode == 0 or complete + length > end:
            raise McapError("a record in a chunk is damaged")
        if length > LIMIT:
            return complete, length
        if complete + length > len(held):
            break
        if opcode == Opcode.MESSAGE and length >= MESSAGE.size:
            messages.append(complete)
        elif opcode in {Opcode.SCHEMA, Opcode.CHANNEL}:
            others.append((complete, complete + length))
        complete += length
    return complete, 0
