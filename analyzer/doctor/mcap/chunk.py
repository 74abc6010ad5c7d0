"""One chunk and the message indexes behind it."""

import struct
import zlib
from array import array
from contextlib import suppress

import numpy as np
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from numpy.typing import NDArray

from hearthlog.analyzer.doctor.findings import RECOVER, REINDEX, Findings
from hearthlog.analyzer.doctor.mcap.checked_definitions import CheckedDefinitions, name_of
from hearthlog.analyzer.doctor.mcap.message_batch import ChunkContent
from hearthlog.analyzer.doctor.mcap.record_walk import Record
from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.mcap.raw_messages import gather_heads, iterate_records
from hearthlog.schemas.mcap.records import (
    CHUNK_INDEX,
    CHUNK_INDEX_TAIL,
    HEAD,
    INDEX_ENTRIES,
    INDEX_OFFSET,
    LIMIT,
    MESSAGE_FIXED,
    MESSAGE_HEAD,
    MESSAGE_INDEX,
    UINT64,
    ChunkHead,
    begun_chunk_head,
    chunk_head,
    decompress,
)


class Chunk:
    """A chunk, checked when the message indexes behind it are known."""

    def __init__(
        self,
        record: Record,
        findings: Findings,
        definitions: CheckedDefinitions,
        budget: "RecordBudget",
    ) -> None:
        self.content: ChunkContent | None = None  # None if the chunk is too damaged to be read
        self.whole = False  # whether all of its messages are in `content`
        self.offset = record.offset
        self._length = record.length
        self._findings = findings
        self._definitions = definitions
        self._budget = budget
        self._head: ChunkHead | None = None
        self._records = b""
        self._indexes: dict[int, bytes] = {}
        self._index_offsets: list[tuple[int, int]] = []  # channel, and offset of its message index
        self._index_length = 0
        try:
            self._head = begun_chunk_head(record.content)
            if self._head.size > LIMIT:
                what = f"a chunk of {self._head.size} bytes, uncompressed: not checked"
                findings.warning("too-large", what, offset=self.offset)
                definitions.incomplete = True
                return
            self._head = chunk_head(record.content)
            unchecked = self._head._replace(crc=0)  # a wrong checksum has a rule of its own
            self._records = decompress(unchecked, record.content)
        except McapError as error:
            self._error("chunk-data", str(error))
            return
        if self._head.crc and zlib.crc32(self._records) != self._head.crc:
            self._error("chunk-crc", "a chunk has another checksum than it claims")
            return
        self.whole = True

    def add_index(self, record: Record) -> None:
        """Add a message index that stands behind the chunk."""
        self._index_length += record.length
        try:
            channel, size = MESSAGE_INDEX.unpack_from(record.content)
        except struct.error:
            channel, size = 0, -1
        most = len(record.content) - MESSAGE_INDEX.size
        if size % INDEX_ENTRIES.itemsize or not 0 <= size <= most:
            what = "a message index has another length than it says"
            self._findings.error("message-index", what, REINDEX, offset=record.offset)
        elif channel in self._indexes:
            what = f"a second message index of channel {channel} behind one chunk"
            self._findings.error("message-index", what, REINDEX, offset=record.offset)
        else:
            entries = record.content[MESSAGE_INDEX.size : MESSAGE_INDEX.size + size]
            self._indexes[channel] = entries
            if entries:
                self._index_offsets.append((channel, record.offset))

    def check(self, *, cut: bool) -> None:
        """Check the records of the chunk, its times and its message indexes.

        Parameters
        ----------
        cut : bool
            Whether message indexes may be missing behind it: they are not compared then.
        """
        if not self.whole:
            return
        counts = [len(e) // INDEX_ENTRIES.itemsize for e in self._indexes.values()]
        entries = np.frombuffer(b"".join(self._indexes.values()), INDEX_ENTRIES)
        channels = np.repeat([*self._indexes], counts)
        order = np.argsort(entries["offset"], kind="stable")
        entries, channels = entries[order], channels[order]
        self._find_records(entries["offset"])
        if self.content is not None and self.whole:
            self._check_times()
        if self.content is not None and self.whole and not cut:
            self._check_index(entries, channels)

    def index_content(self) -> bytes | None:
        """Return the chunk index that there should be, without opcode and length.

        Returns
        -------
        bytes or None
            None if the head of the chunk cannot be read.
        """
        if self._head is None:
            return None
        head = self._head
        places = b"".join(INDEX_OFFSET.pack(*pair) for pair in self._index_offsets)
        first = CHUNK_INDEX.pack(head.start, head.end, self.offset, self._length, len(places))
        text = CHUNK_INDEX_TAIL.pack(self._index_length, len(head.compression))
        text += head.compression
        size = head.data.stop - head.data.start
        return first + places + text + UINT64.pack(size) + UINT64.pack(head.size)

    def _find_records(self, hints: Int64) -> None:
        """Find messages, take schemas and channels."""
        records = self._records
        starts, others, end = _split(records, hints, self._budget)
        if self._budget.left < 0:
            self._error("too-large", "the file holds more records than one of its size can")
            self.whole = False
        elif end != len(records):
            self._error("chunk-records", "the last record of a chunk is damaged")
            self.whole = False
        new: dict[int, int] = {}
        for start in others.tolist():
            opcode, length = HEAD.unpack_from(records, start)
            first = start + HEAD.size
            new |= self._other(opcode, start, records[first : first + length])
        self.content = ChunkContent(records, starts, gather_heads(records, starts))
        check_channels(self._findings, self._definitions, self.content, new, self.offset)

    def _other(self, opcode: int, start: int, content: bytes) -> dict[int, int]:
        """Take a record that is no message; return the channel that it defines, and where."""
        if opcode == Opcode.MESSAGE:
            self._error("message-short", f"a message at byte {start} of a chunk is too short")
            self.whole = False
        elif opcode not in {Opcode.SCHEMA, Opcode.CHANNEL}:
            report = self._findings.error if opcode <= Opcode.DATA_END else self._findings.warning
            what = f"{name_of(opcode)} inside a chunk"
            report("chunk-opcode", what, RECOVER, offset=self.offset)
        else:
            channel = self._definitions.read(opcode, self.offset, content)
            return {} if channel is None else {channel: start}
        return {}

    def _check_times(self) -> None:
        assert self.content is not None
        assert self._head is not None
        times = self.content.heads["log_time"].astype(np.uint64)
        claimed = self._head.start, self._head.end
        span = (int(times.min()), int(times.max())) if len(times) else (0, 0)
        if claimed != span:
            what = f"a chunk says that it spans {claimed[0]} to {claimed[1]} ns"
            what += f", and spans {span[0]} to {span[1]} ns"
            self._error("chunk-times", what, REINDEX)

    def _check_index(self, entries: NDArray[np.void], channels: Int64) -> None:
        """Compare the message indexes, in the order of their offsets, with the messages."""
        assert self.content is not None
        heads, starts = self.content.heads, self.content.starts
        if not self._indexes:
            if self._definitions.ours and len(heads):
                self._error("message-index", "a chunk has no message index", REINDEX)
            return
        if (
            len(entries) == len(heads)
            and (
                (entries["offset"] == starts)
                & (entries["time"] == heads["log_time"])
                & (channels == heads["channel"])
            ).all()
        ):
            return
        right = np.intersect1d(
            _keys(channels, entries["time"], entries["offset"]),
            _keys(heads["channel"], heads["log_time"], starts),
        )
        what = (
            f"the message indexes of a chunk leave out {len(heads) - len(right)} of its "
            f"{len(heads)} messages and have {len(entries) - len(right)} entries that are wrong"
        )
        self._error("message-index", what, REINDEX)

    def _error(self, rule: str, what: str, advice: str = RECOVER) -> None:
        self._findings.error(rule, what, advice, offset=self.offset)


class RecordBudget:
    """How many records inside of chunks are gone through one by one in a file.

    Parameters
    ----------
    size : int
        Bytes of the file: a small one that claims very many is not believed.
    """

    def __init__(self, size: int) -> None:
        self.left = (1 << 20) + 4 * size


def _split(records: bytes, hints: Int64, budget: RecordBudget) -> tuple[Int64, Int64, int]:
    """Find the records of a chunk.

    Parameters
    ----------
    hints : np.ndarray [shape=(n,)], int64
        Where messages begin, ascending, if the index can be believed.

    Returns
    -------
    starts, others : np.ndarray [shape=(m,)], int64
        Where messages begin, and other records, and messages that are too short.
    end : int
        Of the last record; not the length of the chunk if that is damaged.
    """
    if len(hints) and hints[0] >= 0 and hints[-1] <= len(records) - MESSAGE_HEAD.itemsize:
        heads = gather_heads(records, hints)
        lengths = np.minimum(heads["length"], len(records))  # or their sums may overflow
        firsts = np.concatenate([[0], hints + HEAD.size + lengths])
        lasts = np.concatenate([hints, [len(records)]])
        if ((firsts <= lasts) & (lasts <= len(records))).all() and (
            (heads["opcode"] == Opcode.MESSAGE) & (lengths >= MESSAGE_FIXED)
        ).all():
            others = [np.empty(0, np.int64)]
            for place in np.flatnonzero(firsts < lasts).tolist():
                starts, between, end = _walk(records, int(firsts[place]), int(lasts[place]), budget)
                if len(starts) or end != lasts[place]:
                    break  # a message that the index does not know, or no whole records
                others.append(between)
            else:
                return hints, np.concatenate(others), len(records)
    return _walk(records, 0, len(records), budget)


def _walk(content: bytes, start: int, end: int, budget: RecordBudget) -> tuple[Int64, Int64, int]:
    """Go from record to record; return what `_split` does."""
    messages, others = array("q"), array("q")
    with suppress(McapError):
        for opcode, first, last in iterate_records(content, start, end):
            budget.left -= 1
            if opcode == 0 or budget.left < 0:
                break
            if opcode == Opcode.MESSAGE and last - first >= MESSAGE_HEAD.itemsize:
                messages.append(first)
            else:
                others.append(first)
            start = last
    return np.frombuffer(messages, np.int64), np.frombuffer(others, np.int64), start


def check_channels(
    findings: Findings,
    definitions: CheckedDefinitions,
    content: ChunkContent,
    new: dict[int, int],
    offset: int,
) -> None:
    """Report messages whose channel is not defined, or only behind them.

    Parameters
    ----------
    new : dict of int to int
        By number of a channel that these records define: where in their bytes they do.
    offset : int
        Byte of the file at which the chunk, or the first of the messages, begins.
    """
    numbers = content.heads["channel"]
    for channel in np.flatnonzero(np.bincount(numbers)).tolist():
        if channel not in definitions.channels:
            if definitions.incomplete:
                continue
            what = f"messages of channel {channel}, which is not defined"
            findings.error("channel-missing", what, RECOVER, offset=offset)
        elif channel in new and (content.starts[numbers == channel] < new[channel]).any():
            what = f"messages of channel {channel} stand before it is defined"
            findings.error("channel-missing", what, RECOVER, offset=offset)


def _keys(channels: Int64, times: Int64, offsets: Int64) -> NDArray[np.void]:
    """Return an array of one comparable thing for each message."""
    keys = np.empty(len(channels), [("channel", "<u2"), ("time", "<i8"), ("offset", "<i8")])
    keys["channel"], keys["time"], keys["offset"] = channels, times, offsets
    return keys
