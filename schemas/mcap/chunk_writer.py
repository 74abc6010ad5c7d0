"""Write MCAP from arrays: whole blocks of messages at once, as the writer of `mcap` would.

The file is, byte for byte, what `mcap.writer.Writer` makes of the same messages one by one.
"""

import struct
import threading
import zlib
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import BinaryIO, NamedTuple

import numpy as np
import zstandard
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from numpy.typing import NDArray

from hearthlog.schemas.arrays import Int64, gather
from hearthlog.schemas.mcap.chunks import MESSAGE_HEAD, RawMessages
from hearthlog.schemas.mcap.records import HEAD, MAGIC
from hearthlog.schemas.storage.prefetch import prefetch

CHUNK_SIZE = 1 << 20
_COMPRESSION = b"zstd"
_COMPRESSORS = 2  # threads
_LAST = 1 << 63
_MESSAGE = struct.Struct("<BQHIQQ")
_CHUNK = struct.Struct("<BQQQQII")
_INDEX = np.dtype([("time", "<i8"), ("offset", "<i8")])
_ENTRY = struct.Struct("<QQ")
_INDEX_HEAD = struct.Struct("<BQHI")
_FOOTER_START = struct.Struct("<BQQQ")


class _Chunk:
    """A chunk in progress: its records, its index by channel, and the span of its log times."""

    def __init__(self) -> None:
        self.content = bytearray()
        self.entries: dict[int, bytearray] = {}
        self.start, self.end = _LAST, 0

    def add(self, data: NDArray[np.uint8], channels: Int64, entries: NDArray[np.void]) -> None:
        """Append encoded messages."""
        self.content += data.data
        found, places = np.unique(channels, return_index=True)
        for channel in found[np.argsort(places)].tolist():
            same = entries[channels == channel].tobytes()
            self.entries.setdefault(channel, bytearray()).extend(same)
        times = entries["time"]
        self.start, self.end = min(self.start, int(times.min())), max(self.end, int(times.max()))

    def stored(self) -> "StoredChunk":
        """Compress it."""
        data = _LOCAL.zstd.compress(self.content)
        crc = zlib.crc32(self.content)
        size = len(self.content)
        return StoredChunk(_COMPRESSION, data, size, crc, self.start, self.end, self.entries)


class _Local(threading.local):
    """Compressors are dear to make and must not be shared between threads."""

    def __init__(self) -> None:
        self.zstd = zstandard.ZstdCompressor()


_LOCAL = _Local()


class Block(NamedTuple):
    """Messages of one channel whose payloads have one size.

    Attributes
    ----------
    channel : int
    log_times, publish_times : np.ndarray [shape=(n,)], int64
    sequences : np.ndarray [shape=(n,)], uint32
    payloads : np.ndarray [shape=(n,)], of a dtype of the payloads' size
    rank : np.ndarray [shape=(n,)], int64
        Where log times are equal, the message of lower rank comes first.
    """

    channel: int
    log_times: Int64
    publish_times: Int64
    sequences: NDArray[np.uint32]
    payloads: NDArray[np.void]
    rank: Int64

    def records(self) -> NDArray[np.void]:
        """Return the message records, of dtype V`size`."""
        size = self.payloads.dtype.itemsize
        whole = np.empty(len(self.payloads), [("head", MESSAGE_HEAD), ("payload", f"V{size}")])
        head = whole["head"]
        head["opcode"] = Opcode.MESSAGE
        head["length"] = MESSAGE_HEAD.itemsize - HEAD.size + size
        head["channel"] = self.channel
        head["sequence"] = self.sequences
        head["log_time"] = self.log_times
        head["publish_time"] = self.publish_times
        whole["payload"] = self.payloads.view(f"V{size}")
        return whole.view(f"V{whole.dtype.itemsize}")


class StoredChunk(NamedTuple):
    """A chunk as a file holds it.

    Attributes
    ----------
    compression : bytes
    data : bytes-like
        Its records, compressed.
    size, crc : int
        Of its records.
    start, end : int
        Log times of its first and last message.
    entries : mapping of int to bytes-like
        Its message index: by channel, times and offsets of the messages.
    """

    compression: bytes
    data: bytes | memoryview
    size: int
    crc: int
    start: int
    end: int
    entries: Mapping[int, bytes | bytearray]


def message_blocks(messages: RawMessages, channel: int, first_rank: int = 0) -> Iterator[Block]:
    """Group messages that were read by the sizes of their payloads, to write them as they are.

    Parameters
    ----------
    messages : RawMessages
    channel : int
        Number of the channel that they are written to.
    first_rank : int
        Rank of the first of them; the others follow.
    """
    for size in np.unique(messages.sizes).tolist():
        rows = np.flatnonzero(messages.sizes == size)
        heads = messages.heads[rows]
        yield Block(
            channel,
            heads["log_time"],
            heads["publish_time"],
            heads["sequence"],
            gather(messages.buffer, messages.offsets[rows], size),
            first_rank + rows,
        )


class ChunkWriter:
    """Writes an MCAP file, chunks compressed with Zstandard and indexed.

    The methods that it shares with `mcap.writer.Writer` do the same.
    """

    def __init__(self, stream: BinaryIO, chunk_size: int = CHUNK_SIZE) -> None:
        self._stream = stream
        self._chunk_size = chunk_size
        self._schemas: list[records.Schema] = []
        self._channels: list[records.Channel] = []
        self._chunk_indexes = bytearray()  # as it will be written: there may be very many
        self._chunk_count = 0
        self._file_span = (_LAST, 0)
        self._attachments: list[records.AttachmentIndex] = []
        self._metadata: list[records.MetadataIndex] = []
        self._counts: defaultdict[int, int] = defaultdict(int)
        self._chunk = _Chunk()  # in progress

    def __getstate__(self) -> dict[str, object]:
        return self.__dict__ | {"_stream": None}

    def continue_on(self, stream: BinaryIO) -> None:
        """Go on with a stream that has, and is behind, all that was flushed."""
        self._stream = stream

    def start(self, profile: str, library: str) -> None:
        """Begin the file."""
        self._stream.write(MAGIC)
        self._write(records.Header(profile, library))

    def add_metadata(self, name: str, data: dict[str, str]) -> None:
        """Write a metadata record."""
        offset, length = self._write(records.Metadata(name, data))
        self._metadata.append(records.MetadataIndex(offset, length, name))

    def add_attachment(
        self, create_time: int, log_time: int, name: str, media_type: str, data: bytes
    ) -> None:
        """Write an attachment."""
        record = records.Attachment(create_time, log_time, name, media_type, data)
        self.copy_attachment(
            encoded(record),
            records.AttachmentIndex(0, 0, log_time, create_time, len(data), name, media_type),
        )

    def copy_attachment(self, record: bytes | memoryview, index: records.AttachmentIndex) -> None:
        """Write an attachment as another file holds it; its place in the index is set here."""
        offset = self._stream.tell()
        self._stream.write(record)
        self._attachments.append(replace(index, offset=offset, length=len(record)))

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Add a schema and return its number."""
        schema = records.Schema(len(self._schemas) + 1, data, encoding, name)
        self._schemas.append(schema)
        self._chunk.content += encoded(schema)
        return schema.id

    def register_channel(
        self, topic: str, message_encoding: str, schema_id: int, metadata: dict[str, str]
    ) -> int:
        """Add a channel and return its number."""
        channel = records.Channel(
            len(self._channels) + 1, topic, message_encoding, metadata, schema_id
        )
        self._channels.append(channel)
        self._chunk.content += encoded(channel)
        return channel.id

    def define(
        self, schemas: Sequence[records.Schema], channels: Sequence[records.Channel]
    ) -> None:
        """Set the schemas and channels of the index, whose numbers they have already.

        They are not written anywhere else: chunks that were copied contain them, or
        `write_definition` has put them before their first message.
        """
        self._schemas = list(schemas)
        self._channels = list(channels)

    def write_definition(self, record: records.Schema | records.Channel) -> None:
        """Write a schema or a channel outside of chunks."""
        self._write(record)

    def add_message(
        self, channel_id: int, log_time: int, data: bytes, publish_time: int, sequence: int = 0
    ) -> None:
        """Append a message."""
        chunk = self._chunk
        entry = _ENTRY.pack(log_time, len(chunk.content))
        chunk.entries.setdefault(channel_id, bytearray()).extend(entry)
        length = _MESSAGE.size - HEAD.size + len(data)
        chunk.content += _MESSAGE.pack(
            Opcode.MESSAGE, length, channel_id, sequence, log_time, publish_time
        )
        chunk.content += data
        chunk.start, chunk.end = min(chunk.start, log_time), max(chunk.end, log_time)
        if len(chunk.content) > self._chunk_size:
            self.flush()

    def write(self, blocks: Sequence[Block]) -> None:
        """Append blocks of messages, in the order of their log times."""
        blocks = [block for block in blocks if len(block.log_times)]
        if not blocks:
            return
        times = np.concatenate([block.log_times for block in blocks])
        order = np.lexsort((np.concatenate([block.rank for block in blocks]), times))
        counts = [len(block.log_times) for block in blocks]
        whole = [block.records() for block in blocks]
        sizes = np.repeat([rows.dtype.itemsize for rows in whole], counts)[order]
        ends = np.cumsum(sizes)
        starts = np.empty_like(ends)
        starts[order] = ends - sizes
        data = np.empty(int(ends[-1]), np.uint8)
        first = 0
        for rows in whole:
            _scatter(rows, data, starts[first : first + len(rows)])
            first += len(rows)
        channels = np.repeat([block.channel for block in blocks], counts)[order]
        self._append(data, ends, sizes, channels, times[order])

    def flush(self) -> None:
        """End the chunk in progress."""
        if self._chunk.entries:
            self._put(self._chunk.stored())
            self._chunk = _Chunk()

    def copy_chunk(self, chunk: StoredChunk) -> None:
        """Write a chunk of another file as it is, and its message index behind it."""
        self.flush()
        self._put(chunk)

    def finish(self) -> None:
        """Complete the file; the stream stays open."""
        self.flush()
        self._write(records.DataEnd(0))
        summary_start = self._stream.tell()
        groups: dict[int, bytes | bytearray] = {
            Opcode.SCHEMA: _encoded_all(self._schemas),
            Opcode.CHANNEL: _encoded_all(self._channels),
            Opcode.STATISTICS: encoded(self._statistics()),
            Opcode.CHUNK_INDEX: self._chunk_indexes,
            Opcode.ATTACHMENT_INDEX: _encoded_all(self._attachments),
            Opcode.METADATA_INDEX: _encoded_all(self._metadata),
        }
        summary = bytearray()
        offsets = bytearray()
        for opcode, group in groups.items():
            place = records.SummaryOffset(opcode, summary_start + len(summary), len(group))
            offsets += encoded(place)
            summary += group
        offset_start = summary_start + len(summary)
        summary += offsets
        footer = _FOOTER_START.pack(Opcode.FOOTER, 20, summary_start, offset_start)
        crc = zlib.crc32(footer, zlib.crc32(summary))
        self._stream.write(summary)
        self._stream.write(footer + struct.pack("<I", crc) + MAGIC)

    def _statistics(self) -> records.Statistics:
        start, end = self._file_span
        return records.Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=dict(self._counts),
            chunk_count=self._chunk_count,
            message_count=sum(self._counts.values()),
            message_end_time=end,
            message_start_time=start if self._chunk_count else 0,
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )

    def _put(self, chunk: StoredChunk) -> None:
        """Write a chunk and its message index."""
        text = len(chunk.compression)
        length = _CHUNK.size - HEAD.size + text + 8 + len(chunk.data)
        head = _CHUNK.pack(
            Opcode.CHUNK, length, chunk.start, chunk.end, chunk.size, chunk.crc, text
        )
        offset = self._stream.tell()
        self._stream.write(head + chunk.compression + struct.pack("<Q", len(chunk.data)))
        self._stream.write(chunk.data)
        first = self._stream.tell()
        places = {}
        for channel, entries in chunk.entries.items():
            places[channel] = self._stream.tell()
            head = _INDEX_HEAD.pack(Opcode.MESSAGE_INDEX, 6 + len(entries), channel, len(entries))
            self._stream.write(head)
            self._stream.write(entries)
            self._counts[channel] += len(entries) // _ENTRY.size
        self._chunk_indexes += encoded(
            records.ChunkIndex(
                chunk_length=first - offset,
                chunk_start_offset=offset,
                compression=chunk.compression.decode(),
                compressed_size=len(chunk.data),
                message_end_time=chunk.end,
                message_index_length=self._stream.tell() - first,
                message_index_offsets=places,
                message_start_time=chunk.start,
                uncompressed_size=chunk.size,
            )
        )
        self._chunk_count += 1
        start, end = self._file_span
        self._file_span = min(start, chunk.start), max(end, chunk.end)

    def _append(
        self, data: NDArray[np.uint8], ends: Int64, sizes: Int64, channels: Int64, times: Int64
    ) -> None:
        """Cut encoded messages, one after the other, into chunks."""
        full: list[_Chunk] = []
        first = offset = 0
        while first < len(ends):
            chunk = self._chunk
            room = self._chunk_size - len(chunk.content)
            beyond = int(np.searchsorted(ends, offset + room, side="right"))
            last = min(beyond + 1, len(ends))
            part = slice(first, last)
            entries = np.empty(last - first, _INDEX)
            entries["time"] = times[part]
            entries["offset"] = ends[part] - sizes[part] - offset + len(chunk.content)
            chunk.add(data[offset : ends[last - 1]], channels[part], entries)
            first, offset = last, int(ends[last - 1])
            if beyond < len(ends):
                full.append(chunk)
                self._chunk = _Chunk()
        for stored in prefetch(_Chunk.stored, full, _COMPRESSORS):
            self._put(stored)

    def _write(self, record: records.McapRecord) -> tuple[int, int]:
        """Write a record; return its offset and its length."""
        offset, data = self._stream.tell(), encoded(record)
        self._stream.write(data)
        return offset, len(data)


def encoded(record: records.McapRecord) -> bytes:
    """Encode a record, opcode and length included."""
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


def _encoded_all(group: Sequence[records.McapRecord]) -> bytes:
    return b"".join(encoded(record) for record in group)


def _scatter(rows: NDArray[np.void], data: NDArray[np.uint8], offsets: Int64) -> None:
    """Copy each row to its place; the places do not overlap."""
    size = rows.dtype.itemsize
    view: NDArray[np.void] = np.ndarray(
        (len(data) - size + 1,), f"V{size}", data.data, strides=(1,)
    )
    view[offsets] = rows
