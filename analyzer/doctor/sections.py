"""Checks of a file's data and summary sections against the MCAP specification."""

import zlib
from collections import Counter
from collections.abc import Callable, Collection, Iterable
from typing import Any, Protocol

import numpy as np
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from hearthlog.analyzer.doctor import RECOVER, REINDEX, Findings
from hearthlog.analyzer.doctor.records import (
    BATCH_SIZE,
    CheckedDefinitions,
    Chunk,
    MessageBatch,
    Record,
    RecordBudget,
    batches,
    check_channels,
    name_of,
    parse_strictly,
)
from hearthlog.schemas.mcap.raw_messages import gather_heads, iterate_records
from hearthlog.schemas.mcap.records import (
    ATTACHMENT,
    HEAD,
    LAST_TIME,
    MESSAGE_HEAD,
    UINT32,
    UINT64,
    encode,
    parse,
)

_KEPT_SIZE = 1 << 20  # bytes
_INDEX_SIZE = 4105  # bytes; records with a longer index are not compared with it
_RESERVED = 0x80
# What each kind of index record lists, and the byte of the offset in its content.
_INDEXES: dict[int, tuple[str, int]] = {
    Opcode.CHUNK_INDEX: ("chunk", 16),
    Opcode.ATTACHMENT_INDEX: ("attachment", 0),
    Opcode.METADATA_INDEX: ("metadata record", 0),
}
_SUMMARY = {*_INDEXES, Opcode.STATISTICS, Opcode.SUMMARY_OFFSET}


class BatchChecks(Protocol):
    """Checks of the messages of a file, in file order."""

    def add(self, batch: MessageBatch) -> None:
        """Check the next messages."""

    def interrupt(self) -> None:
        """Record that messages are missing here, because the file is damaged."""


class DataSection:
    """Data section of a file of `size` bytes, checked record by record.

    Metadata records and attachments of some names are kept: the first two of each, up to 1 MiB.
    `checks` returns the checks of the messages, which get them in batches of a few megabytes.
    """

    def __init__(
        self,
        findings: Findings,
        names: Collection[str],
        size: int,
        checks: Callable[["DataSection", Findings], BatchChecks],
        *,
        ours: bool,
    ) -> None:
        self.definitions = CheckedDefinitions(findings, ours=ours)
        self.header: Header | None = None
        self.metadata: dict[str, list[dict[str, str]]] = {}
        self.attachments: dict[str, list[bytes]] = {}
        self.counts: Counter[int] = Counter()  # messages by channel
        self.span: tuple[int, int] | None = None  # first and last log time
        # Expected index content, by opcode of the index and by offset.
        self.expected_indexes: dict[int, dict[int, bytes]] = {opcode: {} for opcode in _INDEXES}
        self.is_readable = True  # whether everything could be read
        self.loose = False  # whether there are messages outside of chunks
        self.ended = False  # whether there was a Data End
        self.findings = findings
        self._names = names
        self._budget = RecordBudget(size)
        self._chunk: Chunk | None = None
        self._run = bytearray()  # messages outside of chunks
        self._run_offset = 0
        self._parts: list[MessageBatch] = []
        self._size = 0
        self._first = True
        self.checks = checks(self, findings)

    def add(self, record: Record) -> None:
        """Check the next record."""
        self._check_first(record)
        if record.opcode == Opcode.MESSAGE:
            self._add_message(record)
        else:
            self._end_run()
        if record.opcode == Opcode.MESSAGE_INDEX:
            self._add_index(record)
        else:
            self._end_chunk()
        if record.opcode == Opcode.CHUNK:
            self._chunk = Chunk(record, self.findings, self.definitions, self._budget)
        elif record.opcode not in {Opcode.MESSAGE, Opcode.MESSAGE_INDEX}:
            self._add_other(record)
        if self._size >= BATCH_SIZE:
            self._hand_on()

    def finish(self, *, cut: bool) -> None:
        """Check an open chunk, and the remaining messages."""
        self._end_run()
        self._end_chunk(cut=cut)
        self._hand_on()

    def _check_first(self, record: Record) -> None:
        if self._first and record.opcode != Opcode.HEADER:
            what = f"the first record is no Header, but {name_of(record.opcode)}"
            self.findings.error("header", what, RECOVER, offset=record.offset)
        elif not self._first and record.opcode == Opcode.HEADER:
            self.findings.error("header", "a second Header", RECOVER, offset=record.offset)
        self._first = False

    def _add_other(self, record: Record) -> None:
        if record.opcode in {*_SUMMARY, Opcode.FOOTER}:
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
            self._expect_index(MetadataIndex(record.offset, record.length, content.name))
            self._keep(self.metadata, content.name, content.metadata, record)
        elif isinstance(content, Attachment):
            self._add_attachment(content, record)
        elif isinstance(content, DataEnd):
            self.ended = True
            if content.data_section_crc and record.crc not in {None, content.data_section_crc}:
                what = "the data section has another checksum than its Data End says"
                self.findings.error("data-crc", what, RECOVER, offset=record.offset)
        else:
            self.is_readable = False

    def _add_attachment(self, attachment: Attachment, record: Record) -> None:
        times = attachment.log_time, attachment.create_time
        names = attachment.name, attachment.media_type
        size = len(attachment.data)
        index = AttachmentIndex(record.offset, record.length, *times, size, *names)
        self._expect_index(index)
        self._keep(self.attachments, attachment.name, attachment.data, record)
        texts = sum(len(name.encode()) for name in names)
        end = ATTACHMENT.size + UINT32.size + UINT64.size + texts + size
        (crc,) = UINT32.unpack_from(record.content, end)
        if crc and zlib.crc32(record.content[:end]) != crc:
            what = f"attachment {attachment.name} has another checksum than it claims"
            self.findings.error("attachment-crc", what, RECOVER, offset=record.offset)

    def _expect_index(self, index: AttachmentIndex | MetadataIndex) -> None:
        """Store the expected index record, unless it is too long to be compared."""
        raw = encode(index)
        content = raw[HEAD.size :] if len(raw) < _INDEX_SIZE else b""
        self.expected_indexes[raw[0]][index.offset] = content

    def _keep(self, kept: dict[str, list[Any]], name: str, content: Any, record: Record) -> None:
        if name in self._names and record.length <= _KEPT_SIZE and len(kept.get(name, ())) < 2:
            kept.setdefault(name, []).append(content)

    def _add_index(self, record: Record) -> None:
        if self._chunk is None and self.definitions.incomplete:
            return  # the chunk was too large
        if self._chunk is None:
            what = "a message index that does not stand behind a chunk"
            self.findings.error("message-index-place", what, RECOVER, offset=record.offset)
        else:
            self._chunk.add_index(record)

    def _end_chunk(self, *, cut: bool = False) -> None:
        chunk, self._chunk = self._chunk, None
        if chunk is None:
            return
        chunk.check(cut=cut)
        self.is_readable &= chunk.is_complete
        index = chunk.index_content()
        if index is not None:
            self.expected_indexes[Opcode.CHUNK_INDEX][chunk.offset] = index
        if chunk.content is not None:
            self._add_messages(chunk.content)
        if not chunk.is_complete:
            self._hand_on()
            self.checks.interrupt()

    def _add_message(self, record: Record) -> None:
        self.loose = True
        if record.length < MESSAGE_HEAD.itemsize:
            what = "a message is too short"
            self.findings.error("message-short", what, RECOVER, offset=record.offset)
            self.is_readable = False
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
        content = MessageBatch(records, starts, gather_heads(records, starts))
        check_channels(self.findings, self.definitions, content, {}, self._run_offset)
        self._add_messages(content)

    def _add_messages(self, content: MessageBatch) -> None:
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

    def _hand_on(self) -> None:
        parts, self._parts, self._size = self._parts, [], 0
        for batch in batches(parts) if parts else ():
            self.checks.add(batch)


class SummarySection:
    """The summary section, the summary offsets, and the footer.

    If the data section was not completely readable, the index is not compared with it.
    """

    def __init__(self, data: DataSection, findings: Findings, *, is_readable: bool) -> None:
        self._data = data
        self._findings = findings
        self._is_readable = is_readable
        self._starts: dict[int, int] = {}  # of the record groups, by opcode
        self._lengths: Counter[int] = Counter()
        self._last = 0
        self._offsets: list[tuple[int, SummaryOffset]] = []
        self._copies: dict[type, dict[int, McapRecord]] = {Schema: {}, Channel: {}}
        self._unseen = {opcode: dict(places) for opcode, places in data.expected_indexes.items()}
        self._indexed: set[int] = set()  # channels in the chunk indexes
        self._statistics: list[tuple[int, Statistics]] = []
        self._crc = 0

    def add(self, record: Record) -> None:
        """Check the next record after the Data End."""
        opcode = record.opcode
        if opcode not in {*_SUMMARY, Opcode.SCHEMA, Opcode.CHANNEL}:
            if opcode < _RESERVED:
                what = f"{name_of(opcode)} in the summary section"
                self._findings.error("summary-opcode", what, REINDEX, offset=record.offset)
        else:
            self._group(record)
            if opcode in _INDEXES:
                self._add_index(record)
            else:
                self._add_other(record)
        self._crc = zlib.crc32(HEAD.pack(opcode, len(record.content)), self._crc)
        self._crc = zlib.crc32(record.content, self._crc)

    def finish(self, record: Record) -> None:
        """Check the footer, and whether the summary is complete."""
        footer = parse_strictly(self._findings, record.opcode, record.offset, record.content)
        if not isinstance(footer, Footer):
            return
        if len(record.content) != 20:
            self._error("footer", "the Footer is too long", record.offset)
        first = min((s for o, s in self._starts.items() if o != Opcode.SUMMARY_OFFSET), default=0)
        offsets = self._starts.get(Opcode.SUMMARY_OFFSET, 0)
        if first == 0 and footer.summary_start == offsets:
            first = offsets  # some writers count the offsets alone
        for name, place in {"summary_start": first, "summary_offset_start": offsets}.items():
            self._compare("footer", "the Footer says", footer, {name: place}, record.offset)
        if footer.summary_crc:
            head = HEAD.pack(Opcode.FOOTER, len(record.content)) + record.content[:16]
            if zlib.crc32(head, self._crc) != footer.summary_crc:
                what = "the summary has another checksum than the Footer says"
                self._error("summary-crc", what, record.offset)
        self._check_offsets()
        self._check_complete(record.offset)
        if self._is_readable:
            for offset, statistics in self._statistics:
                self._check_statistics(offset, statistics)

    def _error(self, rule: str, what: str, offset: int) -> None:
        self._findings.error(rule, what, REINDEX, offset=offset)

    def _group(self, record: Record) -> None:
        """Record the group of a record: records of one opcode must be contiguous."""
        opcode = record.opcode
        if opcode not in self._starts:
            self._starts[opcode] = record.offset
            if self._last == Opcode.SUMMARY_OFFSET:
                what = f"{name_of(opcode)} behind the summary offsets"
                self._error("summary-groups", what, record.offset)
        elif opcode != self._last:
            what = f"{name_of(opcode)} apart from the others of its kind"
            self._error("summary-groups", what, record.offset)
        self._last = opcode
        self._lengths[opcode] += record.length

    def _add_other(self, record: Record) -> None:
        content = parse_strictly(self._findings, record.opcode, record.offset, record.content)
        if isinstance(content, Schema):
            self._copy(content, self._data.definitions.schemas, record)
        elif isinstance(content, Channel):
            self._copy(content, self._data.definitions.channels, record)
        elif isinstance(content, SummaryOffset):
            self._offsets.append((record.offset, content))
        elif isinstance(content, Statistics):
            self._add_statistics(content, record.offset)

    def _copy(self, definition: Any, originals: Any, record: Record) -> None:
        self._copies[type(definition)][definition.id] = definition
        if not self._is_readable or originals.get(definition.id) == definition:
            return
        name = f"{name_of(record.opcode)} {definition.id}"
        if definition.id in originals:
            self._error("summary-copy", f"{name} is not that of the data section", record.offset)
        else:
            what = f"{name} is in the summary alone"
            self._findings.warning("summary-only", what, offset=record.offset)

    def _add_index(self, record: Record) -> None:
        """Compare an index record with the record at its offset."""
        thing, at = _INDEXES[record.opcode]
        if len(record.content) < at + 8:
            parse_strictly(self._findings, record.opcode, record.offset, record.content)
            return
        (offset,) = UINT64.unpack_from(record.content, at)
        expected = self._unseen[record.opcode].pop(offset, None)
        if expected is None:
            if offset in self._data.expected_indexes[record.opcode]:
                what = f"a second {name_of(record.opcode)} for the {thing} at byte {offset}"
                self._error("index-twice", what, record.offset)
            elif self._is_readable:
                what = f"{name_of(record.opcode)} for byte {offset}, where no {thing} is"
                self._error("index-place", what, record.offset)
            return
        try:
            index = parse(record.opcode, expected) if expected else None
        except UnicodeDecodeError:  # invalid compression name of a damaged chunk, reported there
            index = None
        if isinstance(index, ChunkIndex):
            self._indexed |= index.message_index_offsets.keys()
        if record.content.startswith(expected):
            return
        stated = parse_strictly(self._findings, record.opcode, record.offset, record.content)
        if stated is not None and index is not None:
            values = vars(index)
            if isinstance(stated, ChunkIndex) and not stated.message_index_offsets:
                values.pop("message_index_offsets")  # a chunk index may omit them
            text = f"{name_of(record.opcode)} says"
            self._compare("index-differs", text, stated, values, record.offset)

    def _compare(
        self, rule: str, text: str, stated: McapRecord, expected: dict[str, Any], offset: int
    ) -> None:
        """Compare a record with the values that a writer would write."""
        differing = [
            f"{field} {getattr(stated, field)} and should say {value}"
            for field, value in expected.items()
            if getattr(stated, field) != value
        ]
        if differing:
            self._error(rule, f"{text} {'; '.join(differing)}", offset)

    def _add_statistics(self, statistics: Statistics, offset: int) -> None:
        self._statistics.append((offset, statistics))
        if len(self._statistics) > 1:
            self._error("statistics", "more than one record of statistics", offset)
            self._statistics.pop()
        channels = self._data.definitions.channels.keys()
        if statistics.channel_message_counts and not channels <= self._copies[Channel].keys():
            what = "statistics with counts stand before copies of all channels"
            self._error("statistics-channels", what, offset)

    def _check_statistics(self, offset: int, statistics: Statistics) -> None:
        data = self._data
        start, end = data.span or (0, 0)
        expected: dict[str, Any] = {
            "message_count": sum(data.counts.values()),
            "schema_count": self._count(Schema, data.definitions.schemas, statistics.schema_count),
            "channel_count": self._count(
                Channel, data.definitions.channels, statistics.channel_count
            ),
            "attachment_count": len(data.expected_indexes[Opcode.ATTACHMENT_INDEX]),
            "metadata_count": len(data.expected_indexes[Opcode.METADATA_INDEX]),
            "chunk_count": len(data.expected_indexes[Opcode.CHUNK_INDEX]),
            "message_start_time": start,
            "message_end_time": end,
        }
        if counts := statistics.channel_message_counts:
            statistics.channel_message_counts = {k: n for k, n in counts.items() if n}
            expected["channel_message_counts"] = {k: n for k, n in data.counts.items() if n}
        self._compare("statistics", "the statistics say", statistics, expected, offset)

    def _count(self, kind: type, defined: Iterable[int], stated: int) -> int:
        """Count definitions; writers may omit definitions that are only in the summary."""
        none = {0} if kind is Schema else set()  # schema 0 means that a channel has none
        in_data = set(defined) - none
        if stated == len(in_data):  # libmcap omits them, and so does `ros2 bag record`
            return stated
        return len((in_data | self._copies[kind].keys()) - none)

    def _check_offsets(self) -> None:
        for offset, group in self._offsets:
            opcode = group.group_opcode
            start, length = self._starts.get(opcode, 0), self._lengths[opcode]
            if not length and not group.group_length:
                continue  # some writers list empty groups, too
            if (group.group_start, group.group_length) != (start, length):
                what = (
                    f"Summary offset says {name_of(opcode)} is at {group.group_start}, "
                    f"{group.group_length} bytes, and should say {start}, {length} bytes"
                )
                self._error("summary-offset", what, offset)

    def _check_complete(self, offset: int) -> None:
        for opcode, unseen in self._unseen.items():
            if not unseen or not (opcode in self._starts or self._data.definitions.ours):
                continue
            first = min(unseen)
            what = f"{len(unseen)} of kind {_INDEXES[opcode][0]} are not indexed, the first at "
            self._error("index-missing", f"{what}byte {first}", offset)
        if Opcode.CHUNK_INDEX in self._starts and self._data.loose:
            what = "messages outside of chunks, which the index cannot find"
            self._findings.warning("loose-messages", what, RECOVER)
        channels = self._data.definitions.channels
        needed = {channels[i].schema_id for i in self._indexed if i in channels} - {0}
        if not self._indexed <= self._copies[Channel].keys() or not (
            needed <= self._copies[Schema].keys()
        ):
            what = "the summary lacks copies of channels or schemas of which the index speaks"
            self._error("summary-copies", what, offset)
        if not self._statistics and self._data.definitions.ours:
            self._error("statistics", "there are no statistics", offset)
