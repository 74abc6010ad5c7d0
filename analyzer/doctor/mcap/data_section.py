"""The data section of a file, checked against the specification of MCAP."""

import zlib
from collections import Counter
from collections.abc import Collection, Iterator
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Attachment, AttachmentIndex, DataEnd, Header, Metadata, MetadataIndex

from hearthlog.analyzer.doctor.findings import RECOVER, Findings
from hearthlog.analyzer.doctor.mcap.checked_definitions import (
    CheckedDefinitions,
    name_of,
    parse_strictly,
)
from hearthlog.analyzer.doctor.mcap.chunk import Chunk, RecordBudget, check_channels
from hearthlog.analyzer.doctor.mcap.message_batch import (
    BATCH_SIZE,
    ChunkContent,
    MessageBatch,
    batches,
)
from hearthlog.analyzer.doctor.mcap.record_walk import Record
from hearthlog.schemas.mcap.chunk_index import LAST_TIME
from hearthlog.schemas.mcap.raw_messages import gather_heads, iterate_records
from hearthlog.schemas.mcap.records import ATTACHMENT, HEAD, MESSAGE_HEAD, UINT32, UINT64, encode

_KEPT_SIZE = 1 << 20  # bytes
_INDEX_SIZE = 4096  # bytes; what has a longer name is not compared with its index
_RESERVED = 0x80
_INDEXES = {
    Opcode.CHUNK_INDEX,
    Opcode.ATTACHMENT_INDEX,
    Opcode.METADATA_INDEX,
    Opcode.STATISTICS,
    Opcode.SUMMARY_OFFSET,
    Opcode.FOOTER,
}


class DataSection:
    """The data section of a file, checked record by record.

    Parameters
    ----------
    names : collection of str
        Of metadata records and attachments, the first two of each are kept if they are not large.
    size : int
        Bytes of the file.
    """

    def __init__(
        self, findings: Findings, names: Collection[str], size: int, *, ours: bool
    ) -> None:
        self.definitions = CheckedDefinitions(findings, ours=ours)
        self.header: Header | None = None
        self.metadata: dict[str, list[dict[str, str]]] = {}
        self.attachments: dict[str, list[bytes]] = {}
        self.counts: Counter[int] = Counter()  # messages by channel
        self.span: tuple[int, int] | None = None  # first and last log time
        # By the opcode of the index and by offset: what the index should say.
        self.expected_indexes: dict[int, dict[int, bytes]] = {
            Opcode.CHUNK_INDEX: {},
            Opcode.ATTACHMENT_INDEX: {},
            Opcode.METADATA_INDEX: {},
        }
        self.whole = True  # everything could be read
        self.loose = False  # there are messages outside of chunks
        self.ended = False  # there was a Data End
        self.findings = findings
        self._names = names
        self._budget = RecordBudget(size)
        self._chunk: Chunk | None = None
        self._run = bytearray()  # of messages outside of chunks
        self._run_offset = 0
        self._parts: list[ChunkContent] = []
        self._size = 0
        self._first = True

    def add(self, record: Record) -> Iterator[MessageBatch | None]:
        """Check the next record.

        Yields
        ------
        MessageBatch or None
            Messages, whenever a few megabytes of them have come together; None where some are
            missing, because a chunk is damaged.
        """
        self._check_first(record)
        if record.opcode == Opcode.MESSAGE:
            self._add_message(record)
        else:
            self._end_run()
        if record.opcode == Opcode.MESSAGE_INDEX:
            self._add_index(record)
        else:
            yield from self._end_chunk()
        if record.opcode == Opcode.CHUNK:
            self._chunk = Chunk(record, self.findings, self.definitions, self._budget)
        elif record.opcode not in {Opcode.MESSAGE, Opcode.MESSAGE_INDEX}:
            self._add_other(record)
        if self._size >= BATCH_SIZE:
            yield from self._batches()

    def finish(self, *, cut: bool) -> Iterator[MessageBatch | None]:
        """Check what is still open, and hand out the last messages."""
        self._end_run()
        yield from self._end_chunk(cut=cut)
        yield from self._batches()

    def _check_first(self, record: Record) -> None:
        if self._first and record.opcode != Opcode.HEADER:
            what = f"the first record is no Header, but {name_of(record.opcode)}"
            self.findings.error("header", what, RECOVER, offset=record.offset)
        elif not self._first and record.opcode == Opcode.HEADER:
            self.findings.error("header", "a second Header", RECOVER, offset=record.offset)
        self._first = False

    def _add_other(self, record: Record) -> None:
        if record.opcode in _INDEXES:
            what = f"{name_of(record.opcode)} before the Data End"
            self.findings.error("data-opcode", what, RECOVER, offset=record.offset)
            return
        if record.opcode > Opcode.DATA_END:
            if record.opcode < _RESERVED:
                what = f"{name_of(record.opcode)}, which MCAP keeps for later versions"
                self.findings.warning("reserved-opcode", what, offset=record.offset)
            return
        if record.opcode in {Opcode.SCHEMA, Opcode.CHANNEL}:
            self.definitions.read(record.opcode, record.offset, record.content)
            return
        content = parse_strictly(self.findings, record.opcode, record.offset, record.content)
        if isinstance(content, Header):
            self.header = self.header or content
            self.definitions.profile = self.header.profile
        elif isinstance(content, Metadata):
            index = encode(MetadataIndex(record.offset, record.length, content.name))
            self._expect_index(Opcode.METADATA_INDEX, record.offset, index)
            self._keep(self.metadata, content.name, content.metadata, record)
        elif isinstance(content, Attachment):
            self._add_attachment(content, record)
        elif isinstance(content, DataEnd):
            self.ended = True
            if content.data_section_crc and record.crc not in {None, content.data_section_crc}:
                what = "the data section has another checksum than its Data End says"
                self.findings.error("data-crc", what, RECOVER, offset=record.offset)
        else:
            self.whole = False

    def _add_attachment(self, attachment: Attachment, record: Record) -> None:
        times = attachment.log_time, attachment.create_time
        names = attachment.name, attachment.media_type
        size = len(attachment.data)
        index = AttachmentIndex(record.offset, record.length, *times, size, *names)
        self._expect_index(Opcode.ATTACHMENT_INDEX, record.offset, encode(index))
        self._keep(self.attachments, attachment.name, attachment.data, record)
        texts = sum(len(name.encode()) for name in names)
        end = ATTACHMENT.size + UINT32.size + UINT64.size + texts + size
        (crc,) = UINT32.unpack_from(record.content, end)
        if crc and zlib.crc32(record.content[:end]) != crc:
            what = f"attachment {attachment.name} has another checksum than it claims"
            self.findings.error("attachment-crc", what, RECOVER, offset=record.offset)

    def _expect_index(self, opcode: int, offset: int, index: bytes) -> None:
        """Keep the index record that there should be, unless it is too long to be compared."""
        content = index[HEAD.size :]
        self.expected_indexes[opcode][offset] = content if len(content) < _INDEX_SIZE else b""

    def _keep(self, kept: dict[str, list[Any]], name: str, content: Any, record: Record) -> None:
        if name in self._names and record.length <= _KEPT_SIZE and len(kept.get(name, ())) < 2:
            kept.setdefault(name, []).append(content)

    def _add_index(self, record: Record) -> None:
        if self._chunk is None and self.definitions.incomplete:
            return  # its chunk was too large
        if self._chunk is None:
            what = "a message index that does not stand behind a chunk"
            self.findings.error("message-index-place", what, RECOVER, offset=record.offset)
        else:
            self._chunk.add_index(record)

    def _end_chunk(self, *, cut: bool = False) -> Iterator[MessageBatch | None]:
        chunk, self._chunk = self._chunk, None
        if chunk is None:
            return
        chunk.check(cut=cut)
        self.whole &= chunk.whole
        index = chunk.index_content()
        if index is not None:
            self.expected_indexes[Opcode.CHUNK_INDEX][chunk.offset] = index
        if chunk.content is not None:
            self._add_messages(chunk.content)
        if not chunk.whole:
            yield from self._batches()
            yield None

    def _add_message(self, record: Record) -> None:
        self.loose = True
        if record.length < MESSAGE_HEAD.itemsize:
            what = "a message is too short"
            self.findings.error("message-short", what, RECOVER, offset=record.offset)
            self.whole = False
            return
        if not self._run:
            self._run_offset = record.offset
        self._run += HEAD.pack(record.opcode, len(record.content)) + record.content
        if len(self._run) >= BATCH_SIZE:
            self._end_run()

    def _end_run(self) -> None:
        if not self._run:
            return
        records, self._run = bytes(self._run), bytearray()
        starts = np.array([start for _, start, _ in iterate_records(records)], np.int64)
        content = ChunkContent(records, starts, gather_heads(records, starts))
        check_channels(self.findings, self.definitions, content, {}, self._run_offset)
        self._add_messages(content)

    def _add_messages(self, content: ChunkContent) -> None:
        heads = content.heads
        if not len(heads):
            return
        counts = np.bincount(heads["channel"])
        for channel in np.flatnonzero(counts).tolist():
            self.counts[channel] += int(counts[channel])
        times = heads["log_time"].astype(np.uint64)
        first, last = int(times.min()), int(times.max())
        if self.span is not None:
            first, last = min(first, self.span[0]), max(last, self.span[1])
        self.span = first, last
        if late := int((times > LAST_TIME).sum()):
            what = f"log times after the year 2262: readers leave {late} messages here out"
            self.findings.warning("late", what, RECOVER)
        self._parts.append(content)
        self._size += len(content.records)

    def _batches(self) -> Iterator[MessageBatch]:
        parts, self._parts, self._size = self._parts, [], 0
        if parts:
            yield from batches(parts)
