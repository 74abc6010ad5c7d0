"""Compressed chunks: built, decompressed many at once, and the largest in parts."""

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


_LARGE = 16 << 10  # bytes, uncompressed: for chunks of so many, a call of Python is nothing
_IS_POSSIBLE = "multi_decompress_to_buffer" in zstandard.backend_features


def decompress_together(
    raw: Bytes, starts: Int64, lengths: Int64, limit: int
) -> tuple[Bytes, Int64] | None:
    """Decompress chunks, and compare them with their checksums, if all are sound and of zstd.

    Parameters
    ----------
    raw : np.ndarray [shape=(b,)], uint8
        Holds the records of the chunks.
    starts, lengths : np.ndarray [shape=(n,)], int64
        Where each record begins, with its opcode, and its bytes, heads included.
    limit : int
        Bytes, uncompressed, that the chunks may have in all.

    Returns
    -------
    buffer : np.ndarray [shape=(c,)], uint8
        The records of all chunks, uncompressed, one behind the other.
    sizes : np.ndarray [shape=(n,)], int64
        Bytes of each chunk, uncompressed.
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
    """Decompress chunks to where they are to lie."""
    buffer, decompressor, start = np.empty(ends[-1], np.uint8), zstd_decompressor(), 0
    content, out = raw.data, buffer.data
    for begin, end, stop in zip(first, last, ends, strict=True):
        reader = decompressor.stream_reader(content[begin:end])
        if reader.readinto(out[start:stop]) != stop - start or reader.read(1):
            raise zstandard.ZstdError("of another size")
        start = stop
    return buffer


def _all_at_once(raw: Bytes, first: Int64, stored: Int64, sizes: Int64) -> Bytes:
    """Decompress chunks without Python between them, and put them together."""
    frames = np.stack([first, stored], axis=1).astype(np.uint64)
    chunks = zstd_decompressor().multi_decompress_to_buffer(
        zstandard.BufferWithSegments(raw.data, frames.tobytes()),
        decompressed_sizes=sizes.astype(np.uint64).tobytes(),
        threads=1,  # whoever reads has threads of its own
    )
    return np.frombuffer(b"".join(chunks), np.uint8)  # type: ignore[arg-type]  # of buffers


_PART = 4 << 20  # bytes of records
_PIECE = 1 << 20  # bytes that are decompressed at once
_HEAD_LIMIT = 128  # bytes in which the head of a chunk ends
# A chunk may claim so many bytes, and so many more for each byte that it has: a small file that
# claims more is not worth the time.
_CLAIMED, _RATIO = 1 << 30, 256

Read = Callable[[int, int], bytes]  # bytes of a file from an offset on


class TooLargeError(McapError):
    """A chunk claims more than is worth the time."""


def most_content(length: Any) -> Any:
    """Return how large the content of a chunk may be that is opened.

    Parameters
    ----------
    length : int or np.ndarray
        Bytes of the chunk's record.
    """
    return _CLAIMED + _RATIO * length


class ContentStream:
    """The records of a chunk, decompressed piece by piece.

    Parameters
    ----------
    read : callable
        Returns bytes of the file from an offset on, fewer than asked for at its end.
    offset : int
        Byte of the file at which the chunk begins.

    Attributes
    ----------
    position : int
        Bytes that were read, uncompressed.

    Raises
    ------
    McapError
        If no chunk begins there, or it is larger than hearthlog reads.
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
        """Read the next bytes; fewer at the end.

        Raise `McapError` if they cannot be decompressed.
        """
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
        """Pass over the next bytes."""
        end = self.position + length
        while self.position < end and self.read(min(_PIECE, end - self.position)):
            pass

    def check(self) -> int:
        """Return the checksum of all that was read, which must be the whole content.

        Raise `McapError` if the content has another size or another checksum than the chunk
        claims.
        """
        if self.position != self.head.size or self._stream.read(1):
            raise McapError("a chunk has another size than it claims")
        if self.head.crc not in {0, self._crc}:
            raise McapError("a chunk has another checksum than it claims")
        return self._crc


class _Stored(io.RawIOBase):
    """Some bytes of a file, as a stream."""

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
    """Open a stream of what was compressed."""
    if compression == b"zstd":
        return zstandard.ZstdDecompressor().stream_reader(source)
    if compression == b"lz4":
        import lz4.frame  # noqa: PLC0415  only others write such files

        return lz4.frame.LZ4FrameFile(source)
    if compression:
        raise McapError(f"a chunk has unknown compression {compression!r}")
    return source


def stated_size(compression: bytes, data: bytes) -> int | None:
    """Return how large compressed data claim to be, by their first bytes; None if they do not.

    Parameters
    ----------
    compression : bytes
        `zstd`, `lz4`, or empty.
    data : bytes
        The first 32 bytes of the data, or more.

    Raises
    ------
    McapError
        If no such data begin there.
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
    """Some records of a chunk, one behind the other.

    Attributes
    ----------
    first : int
        Byte of the content at which they begin.
    size : int
        Bytes of them.
    messages : array of int
        Bytes of `content` at which messages begin.
    others : list of (int, int)
        Bytes of `content` at which schemas and channels begin, and before which they end.
    """

    first: int
    size: int
    content: bytes
    messages: "array[int]"
    others: list[tuple[int, int]]


def read_parts(stream: ContentStream) -> Iterator[Part]:
    """Read all records of a chunk, and compare them with its checksum at the end.

    Raise `McapError` if the chunk is damaged.
    """
    held, first = bytearray(), 0  # byte of the content at which `held` begins
    messages, others = array("q"), list[tuple[int, int]]()
    whole = 0  # bytes of `held` that are whole records
    while piece := stream.read(_PIECE):
        held += piece
        whole, large = _next_records(held, whole, stream.head.size - first, messages, others)
        if large or whole >= _PART:
            if whole:
                yield Part(first, whole, bytes(held[:whole]), messages, others)
            del held[:whole]
            first += whole
            whole, messages, others = 0, array("q"), []
        if large:
            yield Part(first, large, bytes(held[: MESSAGE.size]), messages, others)
            first += large
            stream.skip(first - stream.position)
            held = bytearray()
    if whole < len(held):
        raise McapError("a record in a chunk is cut")
    if whole:
        yield Part(first, whole, bytes(held), messages, others)
    stream.check()


def _next_records(
    held: bytearray, whole: int, end: int, messages: "array[int]", others: list[tuple[int, int]]
) -> tuple[int, int]:
    """Go on from record to record; return where the last whole one ends.

    The second number is the bytes of the record that begins there if that is larger than `LIMIT`.
    """
    while len(held) - whole >= min(MESSAGE.size, end - whole):
        if end - whole < HEAD.size:
            break
        opcode, length = HEAD.unpack_from(held, whole)
        length += HEAD.size
        if opcode == 0 or whole + length > end:
            raise McapError("a record in a chunk is damaged")
        if length > LIMIT:
            return whole, length
        if whole + length > len(held):
            break
        if opcode == Opcode.MESSAGE and length >= MESSAGE.size:
            messages.append(whole)
        elif opcode in {Opcode.SCHEMA, Opcode.CHANNEL}:
            others.append((whole, whole + length))
        whole += length
    return whole, 0
