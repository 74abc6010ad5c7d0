"""Chunks that are too large for the memory: decompressed from their beginning on, in parts."""

import io
import zlib
from array import array
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import zstandard
from mcap.exceptions import McapError
from mcap.opcode import Opcode

from hearthlog.schemas.mcap.formats import HEAD, MESSAGE
from hearthlog.schemas.mcap.records import LIMIT, begun_chunk_head

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
