"""Messages and records that the indexes of a damaged file list."""

import zlib
from array import array
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import suppress
from operator import itemgetter
from typing import NamedTuple

import numpy as np
from mcap import records
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from numpy.typing import NDArray

from hearthlog.schemas.logs.metadata import ROSBAG2_METADATA
from hearthlog.schemas.mcap.compressed_chunk import LATEST, StoredChunk
from hearthlog.schemas.mcap.records import (
    FOOTER,
    FOOTER_SIZE,
    HEAD,
    INDEX_ENTRIES,
    INDEX_ENTRY,
    LAST_TIME,
    MAGIC,
    MESSAGE_INDEX_HEAD,
    UINT32,
    Definition,
    read_footer,
)
from hearthlog.schemas.salvage.intact_records import (
    IntactAttachment,
    IntactChunk,
    IntactRecord,
    LargeChunk,
    UnknownRecord,
)
from hearthlog.schemas.salvage.record_verifier import RecordVerifier

_BLOCK = 1 << 20
_DATA_END = HEAD.pack(Opcode.DATA_END, UINT32.size)
_DATA_ENDS = 4  # maximum number of Data End candidates
_UNMET = -1
_NO_TIMES = (LATEST, 0)
_KEPT = 1000  # claims
_INDEXES = 1 << 16  # per chunk: the maximum number of channels


class MissingMessages(NamedTuple):
    """Messages that an index lists, but that the file lacks between two offsets."""

    start: int
    end: int
    messages: Mapping[int, int]  # by channel
    times: tuple[int, int]  # first and last log time
    exact: bool = True  # whether the index states their number


class Index:
    """Index of a file, with a valid checksum if it has one, and its records found so far.

    Records are found even at shifted offsets.

    Attributes
    ----------
    start : int
        Offset of the index.
    moved : bool
        Whether the offset differs from the footer: bytes of the file are missing or were added.
    messages : dict of int to int, or None
        Number of messages of each channel; None if the index does not state it.
    chunks : np.ndarray [shape=(n, 6)], int64
        Offset, length, length of the message indexes, first and last log time of each chunk, and
        the offset of its record in the index; in file order.
    names : dict of int to str
        Metadata records and attachments, by offset.
    """

    def __init__(self, reader: RecordVerifier, start: int, end: int, *, moved: bool) -> None:
        self.start = start
        self.moved = moved
        self.definitions: list[Definition] = []
        self.messages: dict[int, int] | None = None
        self.names: dict[int, str] = {}
        self._reader = reader
        self.chunks = self._read(start, end)
        self._places = np.full(len(self.chunks), _UNMET)  # offsets in the file
        self._ends = self._places.copy()  # end offsets in the file
        self._row, self._shift = -1, 0  # row and shift of the last chunk found
        self._unmet_names = Counter(self.names.values())
        keys = self.chunks[:, [1, 4, 3]]  # length, last and first log time
        self._order = np.lexsort(keys.T)
        self._keys = np.ascontiguousarray(keys[self._order, ::-1])

    def _read(self, start: int, end: int) -> NDArray[np.int64]:
        """Read the records of the index; return the table of chunks."""
        chunks = array("q")
        offset = start
        while offset < end:
            intact = self._reader.intact(offset)
            record = intact.record
            if isinstance(record, Definition):
                self.definitions.append(record)
            elif isinstance(record, records.Statistics):
                self.messages = record.channel_message_counts
            elif isinstance(record, records.ChunkIndex):
                chunks.extend([record.chunk_start_offset, record.chunk_length])
                chunks.append(record.message_index_length)
                times = record.message_start_time, record.message_end_time
                chunks.extend([*(min(time, LAST_TIME) for time in times), offset])
            elif isinstance(record, records.MetadataIndex):
                if record.name != ROSBAG2_METADATA:  # the writer builds a new one
                    self.names[record.offset] = _name_of(record)
            elif isinstance(record, records.AttachmentIndex):
                self.names[record.offset] = _name_of(record)
            elif not isinstance(record, records.SummaryOffset | UnknownRecord):
                raise McapError("here should be the index")
            offset = intact.end
        table = np.array(chunks, np.int64).reshape(-1, 6)
        table = table[np.argsort(table[:, 0])]
        ends = table[:, :3].sum(axis=1)
        if (table < 0).any() or (ends[:-1] > table[1:, 0]).any():
            raise McapError("chunks overlap")
        return table

    def messages_of(self, first: int, last: int) -> Counter[int]:
        """Count the messages of consecutive chunks, by channel."""
        messages: Counter[int] = Counter()
        for place in self.chunks[first:last, 5].tolist():
            record = self._reader.intact(place).record
            assert isinstance(record, records.ChunkIndex)
            messages.update(_messages_of(record))
        return messages

    def meet(self, intact: IntactRecord) -> None:
        """Mark a record as found."""
        record = intact.record
        if isinstance(record, records.Metadata | IntactAttachment):
            self._unmet_names[_name_of(record)] -= 1
        elif isinstance(record, IntactChunk | LargeChunk):
            self._meet_chunk(intact, record.stored)

    def _meet_chunk(self, intact: IntactRecord, chunk: StoredChunk) -> None:
        chunks = self.chunks
        span, length = (chunk.start, chunk.end), intact.end - intact.offset
        row = int(np.searchsorted(chunks[:, 0], intact.offset - self._shift))
        is_there = row < len(chunks) and chunks[row, 0] == intact.offset - self._shift
        if not is_there or (chunks[row, 3:5] != span).any():
            other = self._like(*span, length)
            row = row if is_there and other < 0 else other
        if row < 0:
            return
        self._row, self._shift = row, intact.offset - int(chunks[row, 0])
        self._places[row] = intact.offset
        self._ends[row] = intact.end

    def unmet_names(self) -> list[str]:
        """List the missing metadata records and attachments, as in `names`."""
        return list((+self._unmet_names).elements())

    def unmet(self) -> Iterator[MissingMessages]:
        """Iterate over the runs of missing chunks."""
        missing = np.concatenate([[False], self._places == _UNMET, [False]])
        borders = np.flatnonzero(missing[1:] != missing[:-1]).reshape(-1, 2)
        for first, last in borders.tolist():
            start = int(self._ends[first - 1]) if first else 0
            end = int(self._places[last]) if last < len(self._places) else self.start
            chunks = self.chunks[first:last]
            times = int(chunks[:, 3].min()), int(chunks[:, 4].max())
            messages = self.messages_of(first, last)
            exact = bool((chunks[:, 2] > 0).all())
            yield MissingMessages(min(start, end), end, messages, times, exact)

    def _like(self, start: int, end: int, length: int) -> int:
        """Find a missing chunk by its times and its length; -1 if there is none."""
        first, last = 0, len(self._keys)
        for column, value in enumerate((start, end, length)):
            same = self._keys[first:last, column]
            last = first + int(np.searchsorted(same, value, side="right"))
            first += int(np.searchsorted(same, value))
        rows = self._order[first:last]
        following = rows[np.searchsorted(rows, self._row, side="right") :][:1]
        near = [*following.tolist(), *rows[:1].tolist()]
        return next((row for row in near if self._places[row] == _UNMET), -1)


def read_index(reader: RecordVerifier, limit: int) -> Index | None:
    """Read the index of a finished file, even if bytes before it are missing or were added.

    None if the file is unfinished, or its index is damaged or larger than `limit`, in bytes. The
    index of a finished file may be empty.
    """
    end = reader.end - FOOTER_SIZE
    tail = reader.read(max(end, 0), FOOTER_SIZE)
    footer = read_footer(tail)
    if footer is None:
        return None
    claimed = footer.summary_start or end
    for start in _starts(reader, claimed, end, limit):
        if not len(MAGIC) <= start <= end or end - start > limit:
            continue
        crc = 0
        for place in range(start, end, _BLOCK):
            crc = zlib.crc32(reader.read(place, min(_BLOCK, end - place)), crc)
        crc = zlib.crc32(tail[: HEAD.size + FOOTER.size], crc)
        if footer.summary_crc not in {0, crc}:
            continue
        with suppress(McapError, OverflowError):
            return Index(reader, start, end, moved=start != claimed)
    return None


def _starts(reader: RecordVerifier, claimed: int, end: int, limit: int) -> Iterator[int]:
    """Yield the index offset of the footer, and then those behind possible Data End records."""
    yield claimed
    if claimed == end:
        return
    last = end
    for _ in range(_DATA_ENDS):
        last = _find_back(reader, _DATA_END, max(end - limit, 0), last)
        start = last + len(_DATA_END) + UINT32.size
        if last < 0:
            return
        if start not in {claimed, end}:
            yield start


def _find_back(reader: RecordVerifier, what: bytes, first: int, last: int) -> int:
    """Return the last offset of a byte string before `last`; -1 if there is none."""
    while first < last:
        start = max(last - _BLOCK, first)
        place = reader.read(start, last - start + len(what) - 1).rfind(what)
        if place >= 0:
            return start + place
        last = start
    return -1


def _name_of(
    record: records.MetadataIndex | records.AttachmentIndex | records.Metadata | IntactAttachment,
) -> str:
    if isinstance(record, records.MetadataIndex | records.Metadata):
        return f"the metadata {record.name!r}"
    index = record.index_record if isinstance(record, IntactAttachment) else record
    return f"the attachment {index.name!r}"


def _messages_of(chunk: records.ChunkIndex) -> dict[int, int]:
    """Count the messages of a chunk by channel, from the lengths of its message indexes."""
    places = sorted(chunk.message_index_offsets.items(), key=itemgetter(1))
    ends = [place for _, place in places[1:]]
    ends.append(chunk.chunk_start_offset + chunk.chunk_length + chunk.message_index_length)
    head = MESSAGE_INDEX_HEAD.itemsize
    return {
        channel: max(end - place - head, 0) // INDEX_ENTRY.size
        for (channel, place), end in zip(places, ends, strict=False)
    }


class MessageIndexes:
    """Message indexes of a file without another index, compared with the chunks before them."""

    def __init__(self, reader: RecordVerifier) -> None:
        self._reader = reader
        self._claims: list[MissingMessages] = []
        self._spans = array("q")  # first and last log times of all chunks
        self._own: dict[int, NDArray[np.void]] | None = {}  # expected entries of the chunk
        self._listed: Counter[int] = Counter()  # entries by channel
        self._others: set[tuple[int, int]] = set()  # indexes that do not belong to the chunk
        self._times = _NO_TIMES
        self._start = 0

    def meet(self, intact: IntactRecord) -> None:
        """Compare the next record, if it is a message index, with the chunk before it."""
        if intact.record is None:
            with suppress(McapError):
                channel, entries, _ = self._reader.message_index(intact.offset)
                self._add(channel, entries)
            return
        self._close(intact.offset)
        if isinstance(intact.record, IntactChunk | LargeChunk):
            chunk = intact.record.stored
            self._spans.extend([chunk.start, chunk.end])
            self._begin(intact.end)
            rows = chunk.entries.items()
            self._own = {channel: np.frombuffer(same, INDEX_ENTRIES) for channel, same in rows}

    def _add(self, channel: int, entries: NDArray[np.void]) -> None:
        if self._own is None or not len(entries):
            return
        own = self._own.get(channel)
        if own is not None and len(own) == len(entries) and (own == entries).all():
            self._listed[channel] = max(self._listed[channel], len(entries))
            return
        key = channel, zlib.crc32(entries.tobytes())
        if key not in self._others and len(self._others) < _INDEXES:
            self._others.add(key)
            self._listed[channel] += len(entries)
            first, last = int(entries["time"].min()), int(entries["time"].max())
            self._times = min(self._times[0], first), max(self._times[1], last)

    def _close(self, end: int) -> None:
        """Finish the indexes of a chunk at the offset of the next record."""
        if self._own is not None and self._others and len(self._claims) < _KEPT:
            own = Counter({channel: len(same) for channel, same in self._own.items()})
            if self._listed.total() > own.total():
                lost = self._listed - own
                self._claims.append(MissingMessages(self._start, self._start, lost, self._times))
        self._begin(end)

    def give_up(self, end: int) -> None:
        """Ignore the indexes behind an offset, where a damage is reported already."""
        self._close(end)
        self._own = None

    def _begin(self, start: int) -> None:
        self._start, self._own, self._listed = start, {}, Counter()
        self._others, self._times = set(), _NO_TIMES

    def unmet(self, end: int) -> Iterator[MissingMessages]:
        """List the claims with times that no chunk covers, at the end of the file's records."""
        self._close(end)
        spans = np.frombuffer(self._spans, np.int64).reshape(-1, 2)
        spans = spans[np.argsort(spans[:, 0], kind="stable")]
        ends = np.maximum.accumulate(spans[:, 1])
        for claim in self._claims:
            middle = sum(claim.times) // 2
            before = int(np.searchsorted(spans[:, 0], middle, side="right"))
            if not before or ends[before - 1] < middle:
                yield claim
