"""The summary section of a file and its footer, compared with what is in the file."""

import zlib
from collections import Counter
from collections.abc import Iterable
from typing import Any

from mcap.opcode import Opcode
from mcap.records import Channel, Footer, McapRecord, Schema, Statistics, SummaryOffset

from hearthlog.analyzer.doctor.findings import RECOVER, REINDEX, Findings
from hearthlog.analyzer.doctor.mcap.checked_definitions import name_of, parse_strictly
from hearthlog.analyzer.doctor.mcap.data_section import DataSection
from hearthlog.analyzer.doctor.mcap.record_walk import Record
from hearthlog.schemas.mcap.records import CHUNK_INDEX, HEAD, INDEX_OFFSET, UINT64, parse

_ALLOWED = {
    Opcode.SCHEMA,
    Opcode.CHANNEL,
    Opcode.CHUNK_INDEX,
    Opcode.ATTACHMENT_INDEX,
    Opcode.STATISTICS,
    Opcode.METADATA_INDEX,
    Opcode.SUMMARY_OFFSET,
}
_OFFSETS = {  # where in an index record the offset of what it speaks of stands
    Opcode.CHUNK_INDEX: 16,
    Opcode.ATTACHMENT_INDEX: 0,
    Opcode.METADATA_INDEX: 0,
}
_THINGS = {
    Opcode.CHUNK_INDEX: "chunk",
    Opcode.ATTACHMENT_INDEX: "attachment",
    Opcode.METADATA_INDEX: "metadata record",
}
_RESERVED = 0x80


class SummarySection:
    """The summary section, the summary offsets, and the footer.

    Parameters
    ----------
    whole : bool
        Whether all of that could be read: if not, what the index says is not compared with it.
    """

    def __init__(self, data: DataSection, findings: Findings, *, whole: bool) -> None:
        self._data = data
        self._findings = findings
        self._whole = whole
        self._starts: dict[int, int] = {}  # of the groups, by opcode
        self._lengths: Counter[int] = Counter()
        self._last = 0
        self._offsets: list[tuple[int, SummaryOffset]] = []
        self._copies: dict[type, dict[int, McapRecord]] = {Schema: {}, Channel: {}}
        self._unseen = {opcode: dict(places) for opcode, places in data.expected_indexes.items()}
        self._indexed: set[int] = set()  # channels of which the chunk indexes speak
        self._statistics: list[tuple[int, Statistics]] = []
        self._crc = 0

    def add(self, record: Record) -> None:
        """Check the next record behind the Data End."""
        opcode = record.opcode
        if opcode not in _ALLOWED:
            if opcode < _RESERVED:
                what = f"{name_of(opcode)} in the summary section"
                self._findings.error("summary-opcode", what, REINDEX, offset=record.offset)
        else:
            self._group(record)
            if opcode in _OFFSETS:
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
        if footer.summary_start not in {first, first or offsets}:
            what = f"the Footer says the summary begins at byte {footer.summary_start}, and it "
            where = f"begins at {first}" if first else "is empty"
            self._error("footer", what + where, record.offset)
        if footer.summary_offset_start != offsets:
            what = f"the Footer says the summary offsets begin at {footer.summary_offset_start}"
            where = f"they begin at {offsets}" if offsets else "there are none"
            self._error("footer", f"{what}, and {where}", record.offset)
        if footer.summary_crc:
            head = HEAD.pack(Opcode.FOOTER, len(record.content)) + record.content[:16]
            if zlib.crc32(head, self._crc) != footer.summary_crc:
                what = "the summary has another checksum than the Footer says"
                self._error("summary-crc", what, record.offset)
        self._check_offsets()
        self._check_complete(record.offset)
        if self._whole:
            for offset, statistics in self._statistics:
                self._check_statistics(offset, statistics)

    def _error(self, rule: str, what: str, offset: int) -> None:
        self._findings.error(rule, what, REINDEX, offset=offset)

    def _group(self, record: Record) -> None:
        """Note the group of a record: those of one opcode must stand together."""
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
        if not self._whole or originals.get(definition.id) == definition:
            return
        name = f"{name_of(record.opcode)} {definition.id}"
        if definition.id in originals:
            self._error("summary-copy", f"{name} is not that of the data section", record.offset)
        else:
            what = f"{name} is in the summary alone"
            self._findings.warning("summary-only", what, offset=record.offset)

    def _add_index(self, record: Record) -> None:
        """Compare an index record with what is at the place of which it speaks."""
        at = _OFFSETS[Opcode(record.opcode)]
        if len(record.content) < at + 8:
            parse_strictly(self._findings, record.opcode, record.offset, record.content)
            return
        (offset,) = UINT64.unpack_from(record.content, at)
        expected = self._unseen[record.opcode].pop(offset, None)
        if expected is None:
            thing = _THINGS[Opcode(record.opcode)]
            if offset in self._data.expected_indexes[record.opcode]:
                what = f"a second {name_of(record.opcode)} for the {thing} at byte {offset}"
                self._error("index-twice", what, record.offset)
            elif self._whole:
                what = f"{name_of(record.opcode)} for byte {offset}, where no {thing} is"
                self._error("index-place", what, record.offset)
            return
        if not record.content.startswith(expected):
            self._compare(record, expected)
        if record.opcode == Opcode.CHUNK_INDEX:
            first = CHUNK_INDEX.size
            *_, size = CHUNK_INDEX.unpack_from(expected)
            offsets = INDEX_OFFSET.iter_unpack(expected[first : first + size])
            self._indexed |= {channel for channel, _ in offsets}

    def _compare(self, record: Record, expected: bytes) -> None:
        index = parse_strictly(self._findings, record.opcode, record.offset, record.content)
        try:
            expected_index = parse(record.opcode, expected)
        except UnicodeDecodeError:  # the compression of a damaged chunk, is reported there
            return
        if index is None or expected_index is None:
            return
        differing = [
            f"{name} {getattr(index, name)} and should say {value}"
            for name, value in vars(expected_index).items()
            if getattr(index, name) != value
            # A chunk index may leave out message indexes of no messages.
            and (getattr(index, name) or name != "message_index_offsets")
        ]
        if differing:
            what = f"{name_of(record.opcode)} says {'; '.join(differing)}"
            self._error("index-differs", what, record.offset)

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
        differing = [
            f"{name} {getattr(statistics, name)} and should say {value}"
            for name, value in expected.items()
            if getattr(statistics, name) != value
        ]
        if differing:
            self._error("statistics", f"the statistics say {'; '.join(differing)}", offset)

    def _count(self, kind: type, defined: Iterable[int], said: int) -> int:
        """Count definitions; whether those in the summary alone are counted, writers choose."""
        none = {0} if kind is Schema else set()  # what the number 0 means of a channel's schema
        in_data = set(defined) - none
        if said == len(in_data):  # libmcap leaves them out, and so does `ros2 bag record`
            return said
        return len((in_data | self._copies[kind].keys()) - none)

    def _check_offsets(self) -> None:
        for offset, group in self._offsets:
            opcode = group.group_opcode
            start, length = self._starts.get(opcode, 0), self._lengths[opcode]
            if not length and not group.group_length:
                continue  # writers say it of groups that are empty, too
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
            what = f"{len(unseen)} of kind {_THINGS[Opcode(opcode)]} are not indexed, the first at "
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
