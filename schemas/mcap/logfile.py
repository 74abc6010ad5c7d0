"""Records of one log, located through its index or by a scan."""

import struct
import threading
import warnings
import zlib
from array import array
from collections import Counter
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np
from mcap import records
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import McapRecord
from numpy.typing import NDArray

from hearthlog.schemas.errors import HearthlogWarning, LogError
from hearthlog.schemas.files import LocalFile, StoredFile, open_file
from hearthlog.schemas.mcap.compressed_chunk import ContentStream
from hearthlog.schemas.mcap.raw_messages import CHUNK_HEAD_LIMIT, find_chunk_heads
from hearthlog.schemas.mcap.records import (
    CHUNKS,
    FOOTER,
    FOOTER_SIZE,
    HEAD,
    INDEX_ENTRIES,
    LAST_TIME,
    LATE,
    LIMIT,
    MAGIC,
    MESSAGE_INDEX_HEAD,
    TOO_LARGE,
    UINT16,
    ChunkRow,
    RecordLocation,
    begun_chunk_head,
    by_start,
    not_empty,
    not_mcap,
    parse_escaped,
    read_chunk_index,
    read_chunk_row,
    read_footer,
    read_records,
    walk_records,
)

_NO_INDEX = "its index is damaged, and messages may be missing; `hearthlog recover` says which"
_NO_UTF8 = "bytes that are not UTF-8 stand as \\xNN in names of topics, types or records"
ACTIVE_SUFFIX = ".mcap.active"  # suffix of a file that is still being written
RECOVER = "; `hearthlog recover` saves the rest"
_CHANNEL_END = HEAD.size + UINT16.size
_PLACES = 1000  # maximum number of damaged places with a chunk behind them
_LENGTH = "a record has another length than it claims"
_SEARCHED = 1 << 20  # bytes per search step
_ENDS = frozenset({int(Opcode.DATA_END), int(Opcode.FOOTER)})


@dataclass
class _Lost:
    """Skipped damaged parts of a file."""

    first: int = 0  # offset in the file
    why: str = ""
    places: int = 0
    size: int = 0  # bytes
    _end: int = -1  # end of the last part

    def add(self, start: int, end: int, why: str) -> None:
        """Add a byte range; merge it with the last one if they are adjacent."""
        if not self.places:
            self.first, self.why = start, why
        self.places += start != self._end
        self.size += end - start
        self._end = end


class LogFile:
    """Log, open for reading.

    Raise `LogError` if the file cannot be read, is not an MCAP file, or is damaged.

    Parameters
    ----------
    indexed : bool
        Whether to locate the chunks immediately; otherwise `scan_new` does.
    partial : bool
        Whether to skip damaged records, with a warning that counts their bytes; by default they
        are an error.

    Attributes
    ----------
    header : mcap.records.Header or None
        None until it is read.
    schemas, channels : dict of int to mcap.records.Schema, mcap.records.Channel
        Without definitions inside chunks if the file has no index.
    chunks : np.ndarray [shape=(n,)], of dtype `CHUNKS`
        All chunks found so far, by start time.
    channel_sets : list of frozenset of int
        Channels with messages in a chunk; empty if the file does not list them.
    late : bool
        Whether there may be messages with log times after `LAST_TIME`, which are skipped.
    statistics : mcap.records.Statistics or None
        None without a valid index or statistics.
    """

    def __init__(self, path: Path, *, indexed: bool = True, partial: bool = False) -> None:
        self.path, self._file = open_log(path)
        self.partial = partial
        self.complete = False
        self.ended = False
        self.late = False
        self.header: records.Header | None = None
        self.schemas: dict[int, records.Schema] = {}
        self.channels: dict[int, records.Channel] = {}
        self.statistics: records.Statistics | None = None
        self.record_locations: list[RecordLocation] = []
        self.channel_sets: list[frozenset[int]] = []
        self.chunks = np.empty(0, CHUNKS)
        self._end = len(MAGIC)  # end of the scanned records
        self._sets: dict[frozenset[int], int] = {}
        self._lost = _Lost()
        self.undefined: set[int] = set()  # channels without definition in any chunk
        self.doubtful: set[int] = set()  # channels with two different definitions
        self._doubtful_schemas: set[int] = set()
        self.streams: list[ContentStream] = []  # large chunks that are being read
        self.again: Counter[int] = Counter()  # bytes of repeated decompression, by large chunk
        self.lock = threading.Lock()  # guards `streams` and `again`
        try:
            self._check_magic()
            if indexed:
                self._find_chunks()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    @property
    def size(self) -> int:
        """Size of the file in bytes: a local file may grow, a file in a store does not."""
        return self._file.size

    @property
    def span(self) -> tuple[int, int] | None:
        """First and last log time of the chunks found so far; None without chunks."""
        chunks = self.chunks
        if self.late:
            chunks = chunks[chunks["start"] < LAST_TIME]
            if len(chunks) < len(self.chunks):
                warnings.warn(HearthlogWarning(LATE, self.path, each=True), stacklevel=2)
        if not len(chunks):
            return None
        return int(chunks["start"].min()), int(chunks["end"].max())

    def is_at(self, path: Path) -> bool:
        """Return whether a path refers to this open file."""
        return self._file.is_at(path)

    def read(self, offset: int, length: int) -> bytes:
        """Read bytes at an offset; raise `LogError` if the file cannot be read."""
        return self._file.read(offset, length)

    def read_into(self, out: memoryview, offset: int) -> None:
        """Read bytes at an offset into a buffer, filled partly at the end of the file.

        Raise `LogError` if the file cannot be read.
        """
        self._file.read_into(out, offset)

    def record(self, location: RecordLocation) -> McapRecord | None:
        """Read a metadata record, an attachment, or another record without messages.

        None for a chunk, a message, a message index, or a kind that MCAP does not define. Raise
        `LogError` if the record is larger than `LIMIT`, damaged, or cannot be read.
        """
        if location.length > LIMIT:
            what = "an attachment" if location.opcode == Opcode.ATTACHMENT else "a record"
            raise LogError(f"{self.path}: {what} at byte {location.offset}: {TOO_LARGE}")
        if location.offset > self.size:
            raise self.damaged(location.offset, "a record claims to be longer than the file")
        content = self.read(location.offset, location.length)[HEAD.size :]
        try:
            return self.parse(location.opcode, content)
        except McapError as error:
            raise self.damaged(location.offset, error) from error

    def parse(self, opcode: int, content: bytes) -> McapRecord | None:
        """Parse a record of this file; warn of texts that are not UTF-8.

        Raise `McapError` if the record is shorter than its fields.
        """
        record, escaped = parse_escaped(opcode, content)
        if escaped:
            warnings.warn(HearthlogWarning(_NO_UTF8, self.path, each=True), stacklevel=2)
        return record

    def with_channels(
        self, chunks: NDArray[np.void], channels: AbstractSet[int]
    ) -> NDArray[np.void]:
        """Select rows of `chunks` with any of some channels, or without a list of channels."""
        may_have = [not ids or not ids.isdisjoint(channels) for ids in self.channel_sets]
        return chunks[np.array(may_have, bool)[chunks["channels"]]]

    def damaged(self, offset: int, what: object) -> LogError:
        """Return the error for a damaged record at an offset of this file."""
        return LogError(f"{self.path}: damaged at byte {offset} ({what}){RECOVER}")

    def _check_magic(self) -> None:
        start = self.read(0, 2 * len(MAGIC))
        magic = start[: len(MAGIC)]
        if magic == MAGIC or (self.path.name.endswith(ACTIVE_SUFFIX) and MAGIC.startswith(magic)):
            return  # a new file may be shorter than the magic bytes
        raise LogError(f"{self.path}: {not_mcap(start)}")

    def _find_chunks(self) -> None:
        end = self.size - FOOTER_SIZE
        footer = read_footer(self.read(max(end, 0), FOOTER_SIZE))
        self.complete = footer is not None
        if footer is None or footer.summary_start in {0, end} or not self._has_index(footer, end):
            if self.partial:
                self._scan(self.size)
            else:
                self.scan_new()
        self._warn_of_lost()

    def _scan(self, size: int) -> NDArray[np.void]:
        """Scan the remaining records; continue at the next chunk behind a damaged record."""
        rows = array("q")
        row = self._walk(rows, self._end, size)
        for _ in range(_PLACES):
            place = None if self.ended else self._next_chunk(self._end + 1, size)
            if place is None:
                break
            self._lost.add(self._end, place, _LENGTH)
            self._end = place
            self._add_last_row(rows, row)
            row = self._walk(rows, self._end, size)
        if self.complete and not self.ended:
            self._lost.add(self._end, size, _LENGTH)
        self._add_last_row(rows, row)
        return self._add_chunks(rows)

    def _next_chunk(self, start: int, size: int) -> int | None:
        """Search for a compressed chunk that fits into the file and precedes a record."""
        while start < size:
            window = self.read(start, min(_SEARCHED + CHUNK_HEAD_LIMIT, size - start))
            for place in find_chunk_heads(window):
                if place < _SEARCHED and self._is_chunk(
                    start + place, window[place : place + CHUNK_HEAD_LIMIT], size
                ):
                    return start + place
            start += _SEARCHED
        return None

    def _is_chunk(self, offset: int, head: bytes, size: int) -> bool:
        """Return whether a chunk with consistent lengths begins at an offset."""
        opcode, length = HEAD.unpack_from(head)
        try:
            stop = begun_chunk_head(head[HEAD.size : CHUNK_HEAD_LIMIT]).data.stop
        except McapError:
            return False
        end = offset + HEAD.size + length
        if opcode != Opcode.CHUNK or stop != length or end > size:
            return False
        following = self.read(end, 1)
        return not following or 0 < following[0] <= Opcode.DATA_END

    def _warn_of_lost(self) -> None:
        """Warn in one line of the skipped damaged records."""
        lost = self._lost
        if lost.places and not self.partial:
            raise self.damaged(lost.first, lost.why)
        if lost.places:
            more = f" and in {lost.places - 1:,} more places" if lost.places > 1 else ""
            text = f"damaged at byte {lost.first} ({lost.why}){more}: {lost.size:,} bytes left out"
            text += RECOVER
            warnings.warn(HearthlogWarning(text, self.path, each=True), stacklevel=2)
            self._lost = _Lost()

    def _has_index(self, footer: records.Footer, end: int) -> bool:
        """Read the summary, and return whether it has an index; warn if it is damaged."""
        if not self._read_summary(footer, end):
            self._forget()
            warnings.warn(HearthlogWarning(_NO_INDEX, self.path, each=True), stacklevel=2)
            return False
        if not len(self.chunks) and (self.statistics is None or self.statistics.message_count):
            self._forget()
            return False
        if not self.lists_all_messages():
            self._walk_between(footer.summary_start)
        return True

    def lists_all_messages(self) -> bool:
        """Return whether the message indexes have as many entries as the statistics count."""
        if self.statistics is None:
            return False
        counts = np.array([len(channels) for channels in self.channel_sets] or [0])
        heads = counts[self.chunks["channels"]] * MESSAGE_INDEX_HEAD.itemsize
        size = int((self.chunks["index_length"] - heads).sum())
        return size == self.statistics.message_count * INDEX_ENTRIES.itemsize

    def _walk_between(self, end: int) -> None:
        """Find records that the index does not list, such as messages outside of chunks."""
        every = [(each.offset, each.length) for each in self.record_locations]
        places = [place for place in every if sum(place) <= self.size]
        chunks = self.chunks
        starts = np.array([place for place, _ in places] + [end], np.int64)
        ends = np.array([sum(place) for place in places] + [end], np.int64)
        starts = np.concatenate([chunks["offset"], starts])
        ends = np.concatenate([chunks["offset"] + chunks["length"] + chunks["index_length"], ends])
        order = np.argsort(starts, kind="stable")
        behind = np.concatenate([[len(MAGIC)], np.maximum.accumulate(ends[order])[:-1]])
        rows = array("q")
        for gap in np.flatnonzero(behind < starts[order]).tolist():
            first, last = int(behind[gap]), int(starts[order[gap]])
            self._add_row(rows, self._walk(rows, first, last))
        self._add_chunks(rows)

    def _read_summary(self, footer: records.Footer, end: int) -> bool:
        """Read the summary, and return whether it is valid."""
        start = footer.summary_start
        if not len(MAGIC) <= start < end:
            return False
        rows = array("q")
        crc = 0
        try:
            for location, raw in read_records(self._file, start, end):
                crc = zlib.crc32(raw, crc)
                content = raw[HEAD.size :]
                if location.opcode == Opcode.CHUNK_INDEX:
                    self._add_row(rows, read_chunk_index(content))
                else:
                    self._add(self.parse(location.opcode, content))
            crc = zlib.crc32(self.read(end, HEAD.size + FOOTER.size), crc)
        except (McapError, struct.error):
            return False
        if footer.summary_crc not in {0, crc}:
            return False
        opcode, length = HEAD.unpack(self.read(len(MAGIC), HEAD.size))
        if opcode == Opcode.HEADER:
            self._note(RecordLocation(opcode, len(MAGIC), HEAD.size + length))
        self.chunks = by_start(np.frombuffer(rows, CHUNKS))
        return self._is_consistent()

    def _is_consistent(self) -> bool:
        """Return whether no chunk is listed twice or outside of the time span of the statistics."""
        places = self.chunks[["offset", "length"]][np.argsort(self.chunks["offset"])]
        ends = places["offset"] + places["length"]
        if (ends[:-1] > places["offset"][1:]).any():
            return False
        if self.statistics is None or not len(self.chunks) or not self.statistics.message_count:
            return True
        first, last = self.statistics.message_start_time, self.statistics.message_end_time
        chunks = not_empty(self.chunks)
        return bool(
            (chunks["start"] >= min(first, LAST_TIME)).all() and (chunks["end"] <= last).all()
        )

    def scan_new(self) -> NDArray[np.void]:
        """Scan the records written since the last scan; return new chunks [shape=(n,)].

        They are rows of `CHUNKS` by start time, also for runs of messages outside of chunks, and
        are added to `chunks`. Raise `LogError` if a record is damaged, or the file cannot be read.
        """
        rows = array("q")
        if self.partial:
            found = self._scan(self.size)
            self._warn_of_lost()
            return found
        row = self._walk(rows, self._end, self.size)
        if self._lost.places:
            lost, self._lost = self._lost, _Lost()
            raise self.damaged(lost.first, lost.why)
        if self.complete and not self.ended:
            raise self.damaged(self._end, _LENGTH)
        self._add_last_row(rows, row)
        return self._add_chunks(rows)

    def _add_last_row(self, rows: "array[int]", row: ChunkRow | None) -> None:
        """Add the last row found; its message indexes may be incomplete."""
        if row is not None:
            row.index_length = min(row.index_length, 0)
            row.channels.clear()
        self._add_row(rows, row)

    def _walk(self, rows: "array[int]", start: int, end: int) -> ChunkRow | None:
        """Scan records up to an offset; return the last row, which may be incomplete.

        Add the rows before it to `rows`, set `_end` to the end of the last complete record, and
        `ended` to whether the data end there.
        """
        row: ChunkRow | None = None
        for opcode, offset, length, head in walk_records(self.read, start):
            self.ended = opcode in _ENDS
            if self.ended or opcode == 0 or offset + length > end:
                break
            self._end = offset + length
            if opcode == Opcode.MESSAGE_INDEX and row is not None:
                row.index_length += length
                row.channels.add(int.from_bytes(head[HEAD.size : _CHANNEL_END], "little"))
                continue
            location = RecordLocation(opcode, offset, length)
            chunk = self._chunk_row(location, head)
            if opcode == Opcode.MESSAGE and row is not None and row.continues(location):
                if chunk is None:
                    continue
                row.extend(chunk)
                continue
            self._add_row(rows, row)
            row = chunk
            self._note(location)
        return row

    def _add_chunks(self, rows: "array[int]") -> NDArray[np.void]:
        """Add rows to `chunks`, and return them."""
        chunks = by_start(np.frombuffer(rows, CHUNKS))
        if len(chunks):
            self.chunks = by_start(np.concatenate([self.chunks, chunks]))
        return chunks

    def _add_row(self, rows: "array[int]", row: ChunkRow | None) -> None:
        if row is None:
            return
        if row.late:
            self.late = True
            row.end = self._last_time(row)
        rows.extend([*row.numbers(), self.channel_set(frozenset(row.channels)), -1])

    def _last_time(self, row: ChunkRow) -> int:
        """Find the last log time of a chunk up to `LAST_TIME` in its message indexes."""
        last, offset, end = -1, row.offset + row.length, min(row.offset + row.length, self.size)
        if 0 < row.index_length <= LIMIT:
            end += row.index_length
        for opcode, start, length, _ in walk_records(self.read, offset):
            if opcode != Opcode.MESSAGE_INDEX or start + length > end:
                break
            first = start + MESSAGE_INDEX_HEAD.itemsize
            raw = self.read(first, max(start + length - first, 0))
            times = np.frombuffer(raw, INDEX_ENTRIES, len(raw) // INDEX_ENTRIES.itemsize)["time"]
            last = max(last, int(times[times <= LAST_TIME].max(initial=-1)))
        return row.end if last < row.start else last

    def _note(self, location: RecordLocation) -> None:
        if location.opcode in {Opcode.METADATA, Opcode.ATTACHMENT}:
            self.record_locations.append(location)
        elif location.opcode in {Opcode.HEADER, Opcode.SCHEMA, Opcode.CHANNEL}:
            end = location.offset + location.length
            if location.length > LIMIT:
                self._lost.add(location.offset, end, TOO_LARGE)
                return
            try:
                content = self.read(location.offset, location.length)[HEAD.size :]
                self._add(self.parse(location.opcode, content))
            except McapError as error:
                self._lost.add(location.offset, end, str(error))

    def _chunk_row(self, location: RecordLocation, head: bytes) -> ChunkRow | None:
        """Describe a chunk, or a message outside of one; None if the record is neither."""
        if location.opcode not in {Opcode.CHUNK, Opcode.MESSAGE}:
            return None
        try:
            return read_chunk_row(location, head)
        except McapError as error:
            self._lost.add(location.offset, location.offset + location.length, str(error))
            return None

    def channel_set(self, ids: frozenset[int]) -> int:
        """Return the index of a set of channels in `channel_sets`, adding a new set."""
        if ids not in self._sets:
            self._sets[ids] = len(self.channel_sets)
            self.channel_sets.append(ids)
        return self._sets[ids]

    def _add(self, record: McapRecord | None) -> None:
        if isinstance(record, records.Header):
            self.header = record
        elif isinstance(record, records.Schema | records.Channel):
            self.define(record)
        elif isinstance(record, records.Statistics):
            self.statistics = record
        elif isinstance(record, records.AttachmentIndex | records.MetadataIndex):
            is_metadata = isinstance(record, records.MetadataIndex)
            opcode = Opcode.METADATA if is_metadata else Opcode.ATTACHMENT
            self.record_locations.append(RecordLocation(opcode, record.offset, record.length))

    def define(self, record: records.Schema | records.Channel) -> None:
        """Add a schema or a channel; a contradictory definition marks it as doubtful."""
        if isinstance(record, records.Schema):
            if self.schemas.setdefault(record.id, record) != record:
                self._doubtful_schemas.add(record.id)
                channels = list(self.channels.items())  # another thread may add a channel
                self._doubt({number for number, c in channels if c.schema_id == record.id})
            return
        first = self.channels.setdefault(record.id, record)
        differs = first is not record and replace(first, metadata={}) != replace(
            record, metadata={}
        )
        if differs or record.schema_id in self._doubtful_schemas:
            self._doubt({record.id})

    def _doubt(self, channels: set[int]) -> None:
        if channels <= self.doubtful:
            return
        self.doubtful |= channels
        text = "messages of channels that the file defines in two ways are left out"
        warnings.warn(HearthlogWarning(text, self.path, each=True), stacklevel=2)

    def _forget(self) -> None:
        self.header = None
        self.late = False
        self._lost = _Lost()
        self.doubtful.clear()
        self.undefined.clear()
        self._doubtful_schemas.clear()
        self.chunks = np.empty(0, CHUNKS)
        self.schemas.clear()
        self.channels.clear()
        self.record_locations.clear()
        self.channel_sets.clear()
        self._sets.clear()
        self.statistics = None


def open_log(path: Path) -> tuple[Path, LocalFile | StoredFile]:
    """Open a log file by its name, or by its final name if it was renamed.

    Raise `LogError` if the file cannot be opened.
    """
    try:
        return path, open_file(path)
    except LogError:
        final = path.with_suffix("")
        if not path.name.endswith(ACTIVE_SUFFIX) or not final.exists():
            raise
        return final, open_file(final)
