"""MCAP at the level of its records: framing, parsing and decompression, within limits.

A file may come from anywhere: no length that it claims is believed before it is checked, and no
record may be larger than `LIMIT`. A larger chunk is read in parts.
"""

import struct
import threading
import zlib
from io import BytesIO
from typing import Any, NamedTuple

import zstandard
from mcap import records
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import McapRecord

from hearthlog.schemas.mcap.formats import CHUNK, FOOTER_SIZE, HEAD, MAGIC, UINT64

LIMIT = 100 << 20  # bytes that are held at once; ours are below 2 MiB
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
    """The content of one record, which must not end within a field."""

    def read(self, length: int) -> bytes:
        data = super().read(min(length, LIMIT))
        if len(data) != length:
            raise McapError("a record ends within a field")
        return data


class _EscapedContent(_Content):
    """The content of one record whose texts may not be UTF-8."""

    def read_prefixed_string(self) -> str:
        return self.read(self.read4()).decode(errors="backslashreplace")


def parse(opcode: int, content: bytes, *, escaped: bool = False) -> McapRecord | None:
    r"""Parse a record of a kind that holds no messages.

    Parameters
    ----------
    escaped : bool
        Put `\xNN` in the place of bytes of a text that are not UTF-8, so that two names stay two,
        and raise no error.

    Returns
    -------
    McapRecord or None
        None for a chunk, a message, a message index, and a kind that MCAP does not define.

    Raises
    ------
    McapError
        If it is too short for what it claims to hold.
    UnicodeDecodeError
        If a text in it is not UTF-8.
    """
    kind = _CLASSES.get(opcode)
    stream = _EscapedContent if escaped else _Content
    return None if kind is None else kind.read(stream(BytesIO(content)))


def parse_escaped(opcode: int, content: bytes) -> tuple[McapRecord | None, bool]:
    """Parse a record as `parse` does; return whether a text in it had to be escaped, too.

    Raise `McapError` if it is too short for what it claims to hold.
    """
    try:
        return parse(opcode, content), False
    except UnicodeDecodeError:
        return parse(opcode, content, escaped=True), True


def read_footer(tail: bytes) -> records.Footer | None:
    """Read the footer of a finished file.

    Parameters
    ----------
    tail : bytes
        The last `FOOTER_SIZE` bytes of the file, or all of a shorter one.

    Returns
    -------
    mcap.records.Footer or None
        None if the file does not end with a footer and the magic.
    """
    if len(tail) < FOOTER_SIZE or tail[0] != Opcode.FOOTER or not tail.endswith(MAGIC):
        return None
    footer = parse(Opcode.FOOTER, tail[HEAD.size :])
    assert isinstance(footer, records.Footer)
    return footer


def encode(record: McapRecord) -> bytes:
    """Encode a record, opcode and length included."""
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


class ChunkHead(NamedTuple):
    """The head of a chunk.

    Attributes
    ----------
    start, end : int
        Log times of the first and the last message, in nanoseconds.
    size : int
        Bytes of the records, uncompressed.
    crc : int
        CRC-32 of the same; 0 if there is none.
    compression : bytes
        `zstd`, `lz4`, or empty if the records are stored as they are.
    data : slice
        Which bytes of the chunk's content are its compressed records.
    """

    start: int
    end: int
    size: int
    crc: int
    compression: bytes
    data: slice


def chunk_head(content: bytes | memoryview) -> ChunkHead:
    """Read the head of a chunk from its content.

    Raise `McapError` if it is shorter than it claims, or claims records larger than `LIMIT`.
    """
    head = begun_chunk_head(content)
    if head.data.stop > len(content):
        raise McapError("a chunk is shorter than it claims")
    if head.size > LIMIT:
        raise McapError(TOO_LARGE)
    return head


def begun_chunk_head(content: bytes | memoryview) -> ChunkHead:
    """Read the head of a chunk from the beginning of its content, whatever it claims.

    Parameters
    ----------
    content : bytes-like
        The chunk's record, without opcode and length, at least up to its compressed records.

    Raises
    ------
    McapError
        If it is too short.
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
    """Decompress the records of a chunk, and compare them with its checksum.

    Returns
    -------
    bytes
        The records, one behind the other: `head.size` bytes.

    Raises
    ------
    McapError
        If the compression is unknown, or the data are damaged.
    """
    out = bytearray(head.size)
    decompress_into(memoryview(out), head, content)
    return bytes(out)


def decompress_into(out: memoryview, head: ChunkHead, content: bytes | memoryview) -> None:
    """Decompress the records of a chunk into a buffer, and compare them with its checksum.

    Parameters
    ----------
    out : memoryview
        Exactly `head.size` bytes, which are overwritten.

    Raises
    ------
    McapError
        If the compression is unknown, or the data are damaged.
    """
    try:
        size = _DECOMPRESS[head.compression](content[head.data], out)
    except KeyError as error:
        raise McapError(f"a chunk has unknown compression {head.compression!r}") from error
    except (zstandard.ZstdError, RuntimeError, EOFError) as error:  # the last two are lz4's
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
    import lz4.frame  # noqa: PLC0415  only others write such files

    raw = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=len(out) + 1)
    return _stored(raw, out)


def _stored(data: bytes | memoryview, out: memoryview) -> int:
    if len(data) == len(out):
        out[:] = data
    return len(data)


class _Local(threading.local):
    """Decompressors are dear to make and must not be shared between threads."""

    def __init__(self) -> None:
        self.zstd = zstandard.ZstdDecompressor()


_LOCAL = _Local()


def zstd_decompressor() -> zstandard.ZstdDecompressor:
    """Return the decompressor of this thread."""
    return _LOCAL.zstd


_DECOMPRESS = {b"zstd": _zstd, b"lz4": _lz4, b"": _stored}
