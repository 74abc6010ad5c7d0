"""Write MCAP from arrays: whole blocks of messages at once, as the writer of `mcap` would.

The file is, byte for byte, what `mcap.writer.Writer` makes of the same messages one by one.
"""

import struct
import zlib
from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import BinaryIO, NamedTuple

import numpy as np
import zstandard
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from numpy.typing import NDArray

from schemas.chunks import MESSAGE_HEAD, RawMessages
from schemas.records import HEAD, MAGIC
from schemas.rows import Int64, gather

CHUNK_SIZE = 1 << 20
_COMPRESSION = b"zstd"
_LAST = 1 << 63
_MESSAGE = struct.Struct("<BQHIQQ")
_CHUNK = struct.Struct("<BQQQQII")
_INDEX = np.dtype([("time", "<i8"), ("offset", "<i8")])
_ENTRY = struct.Struct("<QQ")
_INDEX_HEAD = struct.Struct("<BQHI")
_FOOTER_START = struct.Struct("<BQQQ")


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


def blocks_of(messages: RawMessages, channel: int, first_rank: int = 0) -> Iterator[Block]:
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
        self._compressor = zstandard.ZstdCompressor()
        self._schemas: list[records.Schema] = []
        self._channels: list[records.Channel] = []
        self._chunks: list[records.ChunkIndex] = []
        self._attachments: list[records.AttachmentIndex] = []
        self._metadata: list[records.MetadataIndex] = []
        self._counts: defaultdict[int, int] = defaultdict(int)
        self._content = bytearray()  # of the chunk in progress
        self._entries: dict[int, bytearray] = {}  # its index, by channel
        self._span = (_LAST, 0)

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
        offset, length = self._write(
            records.Attachment(
                create_time=create_time,
                log_time=log_time,
                name=name,
                media_type=media_type,
                data=data,
            )
        )
        self._attachments.append(
            records.AttachmentIndex(
                offset=offset,
                length=length,
                log_time=log_time,
                create_time=create_time,
                data_size=len(data),
                name=name,
                media_type=media_type,
            )
        )

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Add a schema and return its number."""
        schema = records.Schema(len(self._schemas) + 1, data, encoding, name)
        self._schemas.append(schema)
        self._content += _encoded(schema)
        return schema.id

    def register_channel(
        self, topic: str, message_encoding: str, schema_id: int, metadata: dict[str, str]
    ) -> int:
        """Add a channel and return its number."""
        channel = records.Channel(
            len(self._channels) + 1, topic, message_encoding, metadata, schema_id
        )
        self._channels.append(channel)
        self._content += _encoded(channel)
        return channel.id

    def add_message(
        self, channel_id: int, log_time: int, data: bytes, publish_time: int, sequence: int = 0
    ) -> None:
        """Append a message."""
        entry = _ENTRY.pack(log_time, len(self._content))
        self._entries.setdefault(channel_id, bytearray()).extend(entry)
        length = _MESSAGE.size - HEAD.size + len(data)
        self._content += _MESSAGE.pack(
            Opcode.MESSAGE, length, channel_id, sequence, log_time, publish_time
        )
        self._content += data
        self._span = min(self._span[0], log_time), max(self._span[1], log_time)
        if len(self._content) > self._chunk_size:
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
        if not self._entries:
            return
        start, end = self._span
        size = len(self._content)
        data = self._compressor.compress(self._content)
        length = _CHUNK.size - HEAD.size + len(_COMPRESSION) + 8 + len(data)
        crc = zlib.crc32(self._content)
        head = _CHUNK.pack(Opcode.CHUNK, length, start, end, size, crc, len(_COMPRESSION))
        offset = self._stream.tell()
        self._stream.write(head + _COMPRESSION + struct.pack("<Q", len(data)))
        self._stream.write(data)
        first = self._stream.tell()
        places = {}
        for channel, entries in self._entries.items():
            places[channel] = self._stream.tell()
            head = _INDEX_HEAD.pack(Opcode.MESSAGE_INDEX, 6 + len(entries), channel, len(entries))
            self._stream.write(head + entries)
            self._counts[channel] += len(entries) // _ENTRY.size
        self._chunks.append(
            records.ChunkIndex(
                chunk_length=first - offset,
                chunk_start_offset=offset,
                compression=_COMPRESSION.decode(),
                compressed_size=len(data),
                message_end_time=end,
                message_index_length=self._stream.tell() - first,
                message_index_offsets=places,
                message_start_time=start,
                uncompressed_size=size,
            )
        )
        self._content.clear()
        self._entries.clear()
        self._span = (_LAST, 0)

    def finish(self) -> None:
        """Complete the file; the stream stays open."""
        self.flush()
        self._write(records.DataEnd(0))
        summary_start = self._stream.tell()
        groups: list[Sequence[records.McapRecord]] = [
            self._schemas,
            self._channels,
            [self._statistics()],
            self._chunks,
            self._attachments,
            self._metadata,
        ]
        opcodes = [
            Opcode.SCHEMA,
            Opcode.CHANNEL,
            Opcode.STATISTICS,
            Opcode.CHUNK_INDEX,
            Opcode.ATTACHMENT_INDEX,
            Opcode.METADATA_INDEX,
        ]
        summary = bytearray()
        offsets = bytearray()
        for opcode, group in zip(opcodes, groups, strict=True):
            encoded = b"".join(_encoded(record) for record in group)
            place = records.SummaryOffset(opcode, summary_start + len(summary), len(encoded))
            offsets += _encoded(place)
            summary += encoded
        offset_start = summary_start + len(summary)
        summary += offsets
        footer = _FOOTER_START.pack(Opcode.FOOTER, 20, summary_start, offset_start)
        crc = zlib.crc32(footer, zlib.crc32(summary))
        self._stream.write(summary)
        self._stream.write(footer + struct.pack("<I", crc) + MAGIC)

    def _statistics(self) -> records.Statistics:
        starts = [chunk.message_start_time for chunk in self._chunks]
        ends = [chunk.message_end_time for chunk in self._chunks]
        return records.Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=dict(self._counts),
            chunk_count=len(self._chunks),
            message_count=sum(self._counts.values()),
            message_end_time=max(ends, default=0),
            message_start_time=min(starts, default=0),
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )

    def _append(
        self, data: NDArray[np.uint8], ends: Int64, sizes: Int64, channels: Int64, times: Int64
    ) -> None:
        """Cut encoded messages, one after the other, into chunks."""
        first = offset = 0
        while first < len(ends):
            room = self._chunk_size - len(self._content)
            full = int(np.searchsorted(ends, offset + room, side="right"))
            last = min(full + 1, len(ends))
            part = slice(first, last)
            entries = np.empty(last - first, _INDEX)
            entries["time"] = times[part]
            entries["offset"] = ends[part] - sizes[part] - offset + len(self._content)
            self._content += data[offset : ends[last - 1]].data
            self._add_entries(channels[part], entries)
            first, offset = last, int(ends[last - 1])
            if full < len(ends):
                self.flush()

    def _add_entries(self, channels: Int64, entries: NDArray[np.void]) -> None:
        found, places = np.unique(channels, return_index=True)
        for channel in found[np.argsort(places)].tolist():
            same = entries[channels == channel].tobytes()
            self._entries.setdefault(channel, bytearray()).extend(same)
        times = entries["time"]
        self._span = min(self._span[0], int(times.min())), max(self._span[1], int(times.max()))

    def _write(self, record: records.McapRecord) -> tuple[int, int]:
        """Write a record; return its offset and its length."""
        offset, encoded = self._stream.tell(), _encoded(record)
        self._stream.write(encoded)
        return offset, len(encoded)


def _encoded(record: records.McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


def _scatter(rows: NDArray[np.void], data: NDArray[np.uint8], offsets: Int64) -> None:
    """Copy each row to its place; the places do not overlap."""
    size = rows.dtype.itemsize
    view: NDArray[np.void] = np.ndarray(
        (len(data) - size + 1,), f"V{size}", data.data, strides=(1,)
    )
    view[offsets] = rows
