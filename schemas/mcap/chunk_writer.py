"""MCAP writer for arrays, with blocks of messages as input.

The output is byte for byte that of `mcap.writer.Writer` for the same single messages.
"""

import zlib
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import BinaryIO, NamedTuple

import numpy as np
from mcap import records
from mcap.opcode import Opcode
from numpy.typing import NDArray

from hearthlog.schemas.arrays import Bytes, Int64, gather, scatter
from hearthlog.schemas.files import prefetch
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.mcap.compressed_chunk import LATEST, ChunkBuilder, StoredChunk
from hearthlog.schemas.mcap.raw_messages import RawMessages
from hearthlog.schemas.mcap.records import (
    CHUNK,
    FOOTER,
    HEAD,
    INDEX_ENTRIES,
    INDEX_ENTRY,
    MAGIC,
    MESSAGE,
    MESSAGE_FIXED,
    MESSAGE_HEAD,
    MESSAGE_INDEX,
    UINT32,
    UINT64,
    encode,
)


class Block(NamedTuple):
    """Messages of one channel with payloads of one size."""

    channel: int
    log_times: Int64  # [shape=(n,)] nanoseconds of UTC
    publish_times: Int64  # [shape=(n,)] nanoseconds of UTC
    sequences: NDArray[np.uint32]  # [shape=(n,)]
    payloads: NDArray[np.void]  # [shape=(n,), dtype V`size`]
    rank: Int64  # [shape=(n,)] order of messages with equal log times

    def records(self) -> NDArray[np.void]:
        """Encode the messages as complete MCAP records [shape=(n,), dtype V`size`]."""
        size = self.payloads.dtype.itemsize
        records = np.empty(len(self.payloads), [("head", MESSAGE_HEAD), ("payload", f"V{size}")])
        head = records["head"]
        head["opcode"] = Opcode.MESSAGE
        head["length"] = MESSAGE_FIXED + size
        head["channel"] = self.channel
        head["sequence"] = self.sequences
        head["log_time"] = self.log_times
        head["publish_time"] = self.publish_times
        records["payload"] = self.payloads.view(f"V{size}")
        return records.view(f"V{records.dtype.itemsize}")


def message_blocks(messages: RawMessages, channel: int, first_rank: int = 0) -> Iterator[Block]:
    """Group messages by payload size, to write them unchanged to a channel."""
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


class MessageRecords(NamedTuple):
    """Message records of one or more channels, in the order of their log times."""

    data: Bytes  # [shape=(b,)] concatenated records
    ends: Int64  # [shape=(n,)] end offset of each record in the data
    sizes: Int64  # [shape=(n,)] bytes of each record
    channels: Int64  # [shape=(n,)] channel ID of each record
    times: Int64  # [shape=(n,)] log time of each in nanoseconds, ascending


def join_messages(
    channels: Sequence[int], times: Sequence[int], payloads: Sequence[bytes]
) -> MessageRecords:
    """Encode at least one message as records, in order.

    `channels` are IDs; `times`, ascending in nanoseconds, are log time and publish time.
    """
    heads = np.empty(len(payloads), MESSAGE_HEAD)
    heads["opcode"] = Opcode.MESSAGE
    heads["length"] = np.fromiter(map(len, payloads), np.int64, len(payloads)) + MESSAGE_FIXED
    heads["channel"] = channels
    heads["sequence"] = 0
    heads["log_time"] = heads["publish_time"] = times
    pieces = [b""] * (2 * len(payloads))
    pieces[::2] = heads.view(f"V{MESSAGE_HEAD.itemsize}").tolist()  # S would strip trailing zeros
    pieces[1::2] = payloads
    sizes = heads["length"].astype(np.int64) + HEAD.size
    return MessageRecords(
        np.frombuffer(b"".join(pieces), np.uint8),
        np.cumsum(sizes),
        sizes,
        heads["channel"].astype(np.int64),
        heads["log_time"].astype(np.int64),
    )


def merge_blocks(blocks: Sequence[Block]) -> MessageRecords:
    """Encode the messages of blocks, none empty, by log time; equal ones are sorted by rank."""
    times = np.concatenate([block.log_times for block in blocks])
    order = np.lexsort((np.concatenate([block.rank for block in blocks]), times))
    counts = [len(block.log_times) for block in blocks]
    records = [block.records() for block in blocks]
    sizes = np.repeat([rows.dtype.itemsize for rows in records], counts)[order]
    ends = np.cumsum(sizes)
    starts = np.empty_like(ends)
    starts[order] = ends - sizes
    data = np.empty(int(ends[-1]), np.uint8)
    first = 0
    for rows in records:
        scatter(rows, data, starts[first : first + len(rows)])
        first += len(rows)
    channels = np.repeat([block.channel for block in blocks], counts)[order]
    return MessageRecords(data, ends, sizes, channels, times[order])


CHUNK_SIZE = 1 << 20
_LEAST = 4 << 10  # minimum bytes of a chunk before its time span can end it
_COMPRESSORS = 2  # threads
_FEW = 48  # below this number of messages, arrays are slower than single messages
GATHERED_SPAN = 60 * NANOSECONDS  # ns, time span of separate chunks


class ChunkWriter:
    """Writer of an MCAP file with indexed chunks in Zstandard compression.

    Methods named as in `mcap.writer.Writer` have the same effect. The message that exceeds
    `chunk_size`, uncompressed bytes of records, is the last of its chunk. A chunk made by `write`
    spans at most `chunk_span` nanoseconds, by default any, unless it is smaller than 4 KiB.
    """

    def __init__(
        self, stream: BinaryIO, chunk_size: int = CHUNK_SIZE, chunk_span: int = LATEST
    ) -> None:
        self._stream = stream
        self._chunk_size = chunk_size
        self._chunk_span = chunk_span
        self._schemas: list[records.Schema] = []
        self._channels: list[records.Channel] = []
        self._chunk_indexes = bytearray()  # encoded, as there may be very many
        self._chunk_count = 0
        self._file_span = (LATEST, 0)
        self._attachments: list[records.AttachmentIndex] = []
        self._metadata: list[records.MetadataIndex] = []
        self._counts: defaultdict[int, int] = defaultdict(int)
        self._chunk = ChunkBuilder()  # in progress
        self._gathered = ChunkBuilder()  # chunk in progress of channels with separate chunks

    def start(self, profile: str, library: str) -> None:
        """Write magic bytes and header, with the profile `ros2`, or empty for none."""
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
            [encode(record)],
            records.AttachmentIndex(0, 0, log_time, create_time, len(data), name, media_type),
        )

    def copy_attachment(
        self, record: Iterable[bytes | memoryview], index: records.AttachmentIndex
    ) -> None:
        """Write an attachment of another file; offset and length of its index are replaced."""
        offset = self._stream.tell()
        length = 0
        for piece in record:
            self._stream.write(piece)
            length += len(piece)
        self._attachments.append(replace(index, offset=offset, length=length))

    def copy_record(self, record: Iterable[bytes]) -> None:
        """Write the chunk in progress, then another file's record without index, in pieces."""
        self.flush()
        for piece in record:
            self._stream.write(piece)

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Add a schema; return its ID, from 1 on."""
        schema = records.Schema(len(self._schemas) + 1, data, encoding, name)
        self._schemas.append(schema)
        self._chunk.content += encode(schema)
        return schema.id

    def register_channel(
        self, topic: str, message_encoding: str, schema_id: int, metadata: dict[str, str]
    ) -> int:
        """Add a channel with a schema ID, 0 for none; return its ID, from 1 on."""
        channel = records.Channel(
            len(self._channels) + 1, topic, message_encoding, metadata, schema_id
        )
        self._channels.append(channel)
        self._chunk.content += encode(channel)
        return channel.id

    def define(
        self, schemas: Sequence[records.Schema], channels: Sequence[records.Channel]
    ) -> None:
        """Set the schemas and channels of the index.

        They are written only to the index: copied chunks contain them, or `write_definition` has
        written them before their first message.
        """
        self._schemas = list(schemas)
        self._channels = list(channels)

    def write_definition(self, record: records.Schema | records.Channel) -> None:
        """Write a schema or a channel outside of chunks."""
        self._write(record)

    def add_message(
        self, channel_id: int, log_time: int, data: bytes, publish_time: int, sequence: int = 0
    ) -> None:
        """Append a message, with times in nanoseconds of UTC, 0 to 2**63 - 1.

        `sequence` is 0 to 2**32 - 1.
        """
        chunk = self._chunk
        chunk.entries[channel_id] += INDEX_ENTRY.pack(log_time, len(chunk.content))
        chunk.content += MESSAGE.pack(
            Opcode.MESSAGE,
            MESSAGE_FIXED + len(data),
            channel_id,
            sequence,
            log_time,
            publish_time,
        )
        chunk.content += data
        chunk.start, chunk.end = min(chunk.start, log_time), max(chunk.end, log_time)
        if len(chunk.content) > self._chunk_size:
            self.flush()

    def add_messages(
        self, channels: Sequence[int], times: Sequence[int], payloads: Sequence[bytes]
    ) -> None:
        """Append messages from channel IDs, ascending log times and payloads.

        The publish time of a message is its log time.
        """
        if len(payloads) > _FEW:
            self._append(join_messages(channels, times, payloads))
        else:
            for message in zip(channels, times, payloads, times, strict=True):
                self.add_message(*message)

    def write(self, blocks: Sequence[Block]) -> None:
        """Append blocks of messages, merged by log time; empty blocks are skipped."""
        blocks = [block for block in blocks if len(block.log_times)]
        if blocks:
            self._append(merge_blocks(blocks))

    def flush(self) -> None:
        """Write the chunks in progress, if they have messages."""
        self._flush_chunk()
        # Written last: the other chunk may define its channels.
        if self._gathered.entries:
            self._put(self._gathered.compress())
            self._gathered = ChunkBuilder()

    def _flush_chunk(self) -> None:
        if self._chunk.entries:
            self._put(self._chunk.compress())
            self._chunk = ChunkBuilder()

    def copy_chunk(self, chunk: StoredChunk) -> None:
        """Write the chunk in progress, then another file's chunk and message index unchanged."""
        self.flush()
        self._put(chunk)

    def copy_large_chunk(self, chunk: StoredChunk, length: int, data: Iterable[bytes]) -> None:
        """Write a chunk as `copy_chunk` does, with data of `length` bytes in pieces."""
        self.flush()
        self._put_pieces(chunk, length, data)

    def join_chunk(
        self,
        chunk: StoredChunk,
        span: int,
        dropped: Collection[int] = (),
        gathered: Collection[int] = (),
    ) -> None:
        """Append the records of another file's chunk to the chunk in progress.

        A joined chunk spans at most `span` nanoseconds of log time; a longer one is not joined.
        """
        own = {number for number in chunk.entries if number in gathered} - set(dropped)
        rest = chunk.entries.keys() - own - set(dropped)
        if rest:
            begun = self._chunk
            start, end = min(begun.start, chunk.start), max(begun.end, chunk.end)
            if end - start > span or len(begun.content) + chunk.size > self._chunk_size:
                self._flush_chunk()
                begins = self._gathered.start
                if self._gathered.entries and begun.end + span - begins > GATHERED_SPAN:
                    self.flush()
            self._chunk.add_chunk(chunk, {*dropped, *own})
        if own:
            self._gather(chunk, own, every_message=not rest, dropped=dropped)

    def _gather(
        self,
        chunk: StoredChunk,
        own: Collection[int],
        *,
        every_message: bool,
        dropped: Collection[int],
    ) -> None:
        begun = self._gathered
        start, end = min(begun.start, chunk.start), max(begun.end, chunk.end)
        if end - start > GATHERED_SPAN or len(begun.content) + chunk.size > self._chunk_size:
            self.flush()
        if every_message:
            self._gathered.add_chunk(chunk, dropped)
        else:
            self._gathered.gather(chunk, own)

    def finish(self) -> None:
        """Write the chunk in progress, the index and the footer; keep the stream open."""
        self.flush()
        self._write(records.DataEnd(0))
        summary_start = self._stream.tell()
        groups: dict[int, bytes | bytearray] = {
            Opcode.SCHEMA: _encode_all(self._schemas),
            Opcode.CHANNEL: _encode_all(self._channels),
            Opcode.STATISTICS: encode(self._statistics()),
            Opcode.CHUNK_INDEX: self._chunk_indexes,
            Opcode.ATTACHMENT_INDEX: _encode_all(self._attachments),
            Opcode.METADATA_INDEX: _encode_all(self._metadata),
        }
        summary = bytearray()
        offsets = bytearray()
        for opcode, group in groups.items():
            start = summary_start + len(summary)
            offsets += encode(records.SummaryOffset(opcode, start, len(group)))
            summary += group
        offset_start = summary_start + len(summary)
        summary += offsets
        footer = HEAD.pack(Opcode.FOOTER, FOOTER.size + UINT32.size)
        footer += FOOTER.pack(summary_start, offset_start)
        crc = zlib.crc32(footer, zlib.crc32(summary))
        self._stream.write(summary)
        self._stream.write(footer + UINT32.pack(crc) + MAGIC)

    @property
    def message_counts(self) -> Mapping[int, int]:
        """Number of messages in the written chunks, by channel ID."""
        return self._counts

    @property
    def span(self) -> tuple[int, int]:
        """First and last log time of the written chunks, in nanoseconds; (0, 0) without chunks."""
        return self._file_span if self._chunk_count else (0, 0)

    def _statistics(self) -> records.Statistics:
        start, end = self.span
        return records.Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=dict(self._counts),
            chunk_count=self._chunk_count,
            message_count=sum(self._counts.values()),
            message_end_time=end,
            message_start_time=start,
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )

    def _put(self, chunk: StoredChunk) -> int:
        """Write a chunk and its message index; return the size of the chunk record in bytes."""
        return self._put_pieces(chunk, len(chunk.data), [chunk.data])

    def _put_pieces(
        self, chunk: StoredChunk, length: int, data: Iterable[bytes | memoryview]
    ) -> int:
        text = len(chunk.compression)
        head = CHUNK.pack(chunk.start, chunk.end, chunk.size, chunk.crc, text)
        head += chunk.compression + UINT64.pack(length)
        offset = self._stream.tell()
        self._stream.write(HEAD.pack(Opcode.CHUNK, len(head) + length) + head)
        for piece in data:
            self._stream.write(piece)
        first = self._stream.tell()
        index_offsets = {}
        for channel, entries in chunk.entries.items():
            index_offsets[channel] = self._stream.tell()
            head = HEAD.pack(Opcode.MESSAGE_INDEX, MESSAGE_INDEX.size + len(entries))
            self._stream.write(head + MESSAGE_INDEX.pack(channel, len(entries)))
            self._stream.write(entries)
            self._counts[channel] += len(entries) // INDEX_ENTRY.size
        self._chunk_indexes += encode(
            records.ChunkIndex(
                chunk_length=first - offset,
                chunk_start_offset=offset,
                compression=chunk.compression.decode(),
                compressed_size=length,
                message_end_time=chunk.end,
                message_index_length=self._stream.tell() - first,
                message_index_offsets=index_offsets,
                message_start_time=chunk.start,
                uncompressed_size=chunk.size,
            )
        )
        self._chunk_count += 1
        start, end = self._file_span
        self._file_span = min(start, chunk.start), max(end, chunk.end)
        return first - offset

    def _append(self, messages: MessageRecords) -> None:
        """Split message records into chunks."""
        data, ends, sizes, channels, times = messages
        full: list[ChunkBuilder] = []
        first = offset = 0
        while first < len(ends):
            chunk = self._chunk
            room = self._chunk_size - len(chunk.content)
            beyond = int(np.searchsorted(ends, offset + room, side="right"))
            start = chunk.start if chunk.entries else int(times[first])
            late = int(np.searchsorted(times, min(start + self._chunk_span, LATEST - 1)))
            lacking = _LEAST - len(chunk.content)
            if lacking > 0:
                late = max(late, int(np.searchsorted(ends, offset + lacking)) + 1)
            last = min(beyond + 1, late, len(ends))
            if last <= first:
                full.append(chunk)
                self._chunk = ChunkBuilder()
                continue
            part = slice(first, last)
            entries = np.empty(last - first, INDEX_ENTRIES)
            entries["time"] = times[part]
            entries["offset"] = ends[part] - sizes[part] - offset + len(chunk.content)
            chunk.add_messages(data[offset : ends[last - 1]], channels[part], entries)
            first, offset = last, int(ends[last - 1])
            if last == beyond + 1 or last == late < len(ends):
                full.append(chunk)
                self._chunk = ChunkBuilder()
        for stored in prefetch(ChunkBuilder.compress, full, _COMPRESSORS):
            self._put(stored)

    def _write(self, record: records.McapRecord) -> tuple[int, int]:
        """Write a record; return its offset and its length."""
        offset, data = self._stream.tell(), encode(record)
        self._stream.write(data)
        return offset, len(data)


def _encode_all(group: Sequence[records.McapRecord]) -> bytes:
    return b"".join(encode(record) for record in group)
