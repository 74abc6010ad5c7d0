"""The index of a finished file, and what is in it and was not met in the file."""

import zlib
from array import array
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from operator import itemgetter
from typing import NamedTuple

import numpy as np
from mcap import records
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from numpy.typing import NDArray

from hearthlog.schemas.logs import rosbag2
from hearthlog.schemas.mcap.chunk_table import LAST_TIME
from hearthlog.schemas.mcap.definitions import Definition
from hearthlog.schemas.mcap.formats import (
    FOOTER,
    FOOTER_SIZE,
    HEAD,
    INDEX_ENTRY,
    MAGIC,
    MESSAGE_INDEX_HEAD,
    UINT32,
)
from hearthlog.schemas.mcap.records import read_footer
from hearthlog.schemas.mcap.stored_chunk import StoredChunk
from hearthlog.schemas.salvage.record_verifier import RecordVerifier
from hearthlog.schemas.salvage.whole_records import (
    LargeAttachment,
    LargeChunk,
    UnknownRecord,
    WholeAttachment,
    WholeChunk,
    WholeRecord,
)

_BLOCK = 1 << 20
_DATA_END = HEAD.pack(Opcode.DATA_END, UINT32.size)
_DATA_ENDS = 4  # so many of what looks like one are tried
_UNMET = -1


class Index(NamedTuple):
    """The index of a file, whose checksum is right if it has one.

    Attributes
    ----------
    start : int
        Byte at which it begins.
    moved : bool
        Whether that is another byte than the footer says: bytes of the file are missing, or were
        added.
    messages : dict of int to int, or None
        How many messages each channel has; None if the index does not say so.
    chunks : np.ndarray [shape=(n, 6)], int64
        Offset, length, length of the message indexes, first and last log time of each chunk, and
        the byte at which its record in the index begins; in the order of the file.
    """

    reader: RecordVerifier
    start: int
    moved: bool
    definitions: list[Definition]
    messages: dict[int, int] | None
    chunks: NDArray[np.int64]
    names: dict[int, str]

    def messages_of(self, first: int, last: int) -> Counter[int]:
        """Count the messages of successive chunks, by channel."""
        messages: Counter[int] = Counter()
        for place in self.chunks[first:last, 5].tolist():
            record = self.reader.whole(place).record
            assert isinstance(record, records.ChunkIndex)
            messages.update(_messages_of(record))
        return messages


def read_index(reader: RecordVerifier, limit: int) -> Index | None:
    """Read the index of a finished file, also where bytes before it are missing or were added.

    Parameters
    ----------
    limit : int
        Bytes; a larger index is not read.

    Returns
    -------
    Index or None
        None if the file is not finished, or if its index is damaged or larger than the limit. That
        of a finished file may be empty.
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
            return _records_of_index(reader, start, end, moved=start != claimed)
    return None


def _starts(reader: RecordVerifier, claimed: int, end: int, limit: int) -> Iterator[int]:
    """Yield where the index begins by the footer, and then behind what looks like a Data End."""
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
    """Return the last byte before `last` at which something begins; -1 if there is none."""
    while first < last:
        start = max(last - _BLOCK, first)
        place = reader.read(start, last - start + len(what) - 1).rfind(what)
        if place >= 0:
            return start + place
        last = start
    return -1


def _records_of_index(reader: RecordVerifier, start: int, end: int, *, moved: bool) -> Index:
    definitions: list[Definition] = []
    names: dict[int, str] = {}
    messages: dict[int, int] | None = None
    chunks = array("q")
    offset = start
    while offset < end:
        whole = reader.whole(offset)
        record = whole.record
        if isinstance(record, Definition):
            definitions.append(record)
        elif isinstance(record, records.Statistics):
            messages = record.channel_message_counts
        elif isinstance(record, records.ChunkIndex):
            chunks.extend([record.chunk_start_offset, record.chunk_length])
            chunks.append(record.message_index_length)
            times = record.message_start_time, record.message_end_time
            chunks.extend([*(min(time, LAST_TIME) for time in times), offset])
        elif isinstance(record, records.MetadataIndex):
            if record.name != rosbag2.METADATA:  # it is made anew
                names[record.offset] = _name_of(record)
        elif isinstance(record, records.AttachmentIndex):
            names[record.offset] = _name_of(record)
        elif not isinstance(record, records.SummaryOffset | UnknownRecord):
            raise McapError("here should be the index")
        offset = whole.end
    table = np.array(chunks, np.int64).reshape(-1, 6)
    table = table[np.argsort(table[:, 0])]
    ends = table[:, :3].sum(axis=1)
    if (table < 0).any() or (ends[:-1] > table[1:, 0]).any():
        raise McapError("chunks overlap")
    return Index(reader, start, moved, definitions, messages, table, names)


def _name_of(
    record: records.MetadataIndex
    | records.AttachmentIndex
    | records.Metadata
    | WholeAttachment
    | LargeAttachment,
) -> str:
    if isinstance(record, records.MetadataIndex | records.Metadata):
        return f"the metadata {record.name!r}"
    if isinstance(record, WholeAttachment | LargeAttachment):
        record = record.index_record
    name = record.name
    return f"the attachment {name!r}"


def _messages_of(chunk: records.ChunkIndex) -> dict[int, int]:
    """Count the messages of a chunk, by channel, from the lengths of its message indexes."""
    places = sorted(chunk.message_index_offsets.items(), key=itemgetter(1))
    ends = [place for _, place in places[1:]]
    ends.append(chunk.chunk_start_offset + chunk.chunk_length + chunk.message_index_length)
    head = MESSAGE_INDEX_HEAD.itemsize
    return {
        channel: max(end - place - head, 0) // INDEX_ENTRY.size
        for (channel, place), end in zip(places, ends, strict=False)
    }


class UnmetChunks(NamedTuple):
    """Successive chunks of the index that were not met, and the bytes between their neighbours."""

    start: int
    end: int
    messages: dict[int, int]  # by channel
    exact: bool  # whether the index tells how many there are
    times: tuple[int, int]  # first and last log time


class MetRecords:
    """Which records of an index were met in the file, wherever bytes before them are missing."""

    def __init__(self, index: Index) -> None:
        self._index = index
        self._places = np.full(len(index.chunks), _UNMET)  # bytes of the file
        self._ends = self._places.copy()  # bytes of the file
        self._row, self._shift = -1, 0  # of the last one
        self._names = Counter(index.names.values())
        keys = index.chunks[:, [1, 4, 3]]  # length, last and first log time
        self._order = np.lexsort(keys.T)
        self._keys = np.ascontiguousarray(keys[self._order, ::-1])

    def meet(self, whole: WholeRecord) -> None:
        """Note that a record was met."""
        record = whole.record
        if isinstance(record, records.Metadata | WholeAttachment | LargeAttachment):
            self._names[_name_of(record)] -= 1
        elif isinstance(record, WholeChunk | LargeChunk):
            self._meet_chunk(whole, record.stored)

    def _meet_chunk(self, whole: WholeRecord, chunk: StoredChunk) -> None:
        chunks = self._index.chunks
        span, length = (chunk.start, chunk.end), whole.end - whole.offset
        row = int(np.searchsorted(chunks[:, 0], whole.offset - self._shift))
        is_there = row < len(chunks) and chunks[row, 0] == whole.offset - self._shift
        if not is_there or (chunks[row, 3:5] != span).any():
            other = self._like(*span, length)
            row = row if is_there and other < 0 else other
        if row < 0:
            return
        self._row, self._shift = row, whole.offset - int(chunks[row, 0])
        self._places[row] = whole.offset
        self._ends[row] = whole.end

    def unmet_names(self) -> list[str]:
        """List the metadata records and attachments that were not met, as in `Index.names`."""
        return list((+self._names).elements())

    def unmet(self) -> Iterator[UnmetChunks]:
        """Go through the chunks that were not met."""
        missing = np.concatenate([[False], self._places == _UNMET, [False]])
        borders = np.flatnonzero(missing[1:] != missing[:-1]).reshape(-1, 2)
        for first, last in borders.tolist():
            start = int(self._ends[first - 1]) if first else 0
            end = int(self._places[last]) if last < len(self._places) else self._index.start
            chunks = self._index.chunks[first:last]
            times = int(chunks[:, 3].min()), int(chunks[:, 4].max())
            messages = self._index.messages_of(first, last)
            exact = bool((chunks[:, 2] > 0).all())
            yield UnmetChunks(min(start, end), end, messages, exact, times)

    def _like(self, start: int, end: int, length: int) -> int:
        """Find a chunk that was not met yet by its times and its length; -1 if there is none."""
        first, last = 0, len(self._keys)
        for column, value in enumerate((start, end, length)):
            same = self._keys[first:last, column]
            last = first + int(np.searchsorted(same, value, side="right"))
            first += int(np.searchsorted(same, value))
        rows = self._order[first:last]
        following = rows[np.searchsorted(rows, self._row, side="right") :][:1]
        unmet = (row for row in [*following.tolist(), *rows[:1].tolist()] if self._is_unmet(row))
        return next(unmet, -1)

    def _is_unmet(self, row: int) -> bool:
        return bool(self._places[row] == _UNMET)
