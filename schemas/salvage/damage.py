"""Losses in a damaged file, found by its index and neighbouring records."""

import zlib
from array import array
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from operator import itemgetter
from typing import NamedTuple

import numpy as np
from mcap import records
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from numpy.typing import NDArray

from hearthlog.schemas.frames import millisecond_text
from hearthlog.schemas.logs.metadata import ROSBAG2_METADATA
from hearthlog.schemas.mcap.chunk_index import LAST_TIME
from hearthlog.schemas.mcap.compressed_chunk import StoredChunk
from hearthlog.schemas.mcap.records import (
    CHUNK,
    FOOTER,
    FOOTER_SIZE,
    HEAD,
    INDEX_ENTRY,
    LIMIT,
    MAGIC,
    MESSAGE,
    MESSAGE_INDEX_HEAD,
    UINT32,
    Definition,
    Definitions,
    read_footer,
)
from hearthlog.schemas.salvage.intact_records import (
    SHORTEST,
    IntactAttachment,
    IntactChunk,
    IntactRecord,
    LargeAttachment,
    LargeChunk,
    UnknownRecord,
)
from hearthlog.schemas.salvage.record_verifier import Claim, RecordVerifier

_BLOCK = 1 << 20
_DATA_END = HEAD.pack(Opcode.DATA_END, UINT32.size)
_DATA_ENDS = 4  # maximum number of Data End candidates
_UNMET = -1


class Index(NamedTuple):
    """Index of a file, with a valid checksum if it has one.

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
    """

    reader: RecordVerifier
    start: int
    moved: bool
    definitions: list[Definition]
    messages: dict[int, int] | None
    chunks: NDArray[np.int64]
    names: dict[int, str]

    def messages_of(self, first: int, last: int) -> Counter[int]:
        """Count the messages of consecutive chunks, by channel."""
        messages: Counter[int] = Counter()
        for place in self.chunks[first:last, 5].tolist():
            record = self.reader.whole(place).record
            assert isinstance(record, records.ChunkIndex)
            messages.update(_messages_of(record))
        return messages


def read_index(reader: RecordVerifier, limit: int) -> Index | None:
    """Read the index of a finished file, even if bytes before it are missing or were added.

    Parameters
    ----------
    limit : int
        Maximum size of the index in bytes.

    Returns
    -------
    Index or None
        None if the file is unfinished, or its index is damaged or larger than the limit. The index
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
            if record.name != ROSBAG2_METADATA:  # the writer builds a new one
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
    | IntactAttachment
    | LargeAttachment,
) -> str:
    if isinstance(record, records.MetadataIndex | records.Metadata):
        return f"the metadata {record.name!r}"
    if isinstance(record, IntactAttachment | LargeAttachment):
        record = record.index_record
    name = record.name
    return f"the attachment {name!r}"


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


class UnmetChunks(NamedTuple):
    """Consecutive missing chunks of the index, and the byte range between their neighbours."""

    start: int
    end: int
    messages: dict[int, int]  # by channel
    exact: bool  # whether the index states their number
    times: tuple[int, int]  # first and last log time


class MetRecords:
    """Records of an index that were found in the file, even at shifted offsets."""

    def __init__(self, index: Index) -> None:
        self._index = index
        self._places = np.full(len(index.chunks), _UNMET)  # offsets in the file
        self._ends = self._places.copy()  # end offsets in the file
        self._row, self._shift = -1, 0  # row and shift of the last chunk found
        self._names = Counter(index.names.values())
        keys = index.chunks[:, [1, 4, 3]]  # length, last and first log time
        self._order = np.lexsort(keys.T)
        self._keys = np.ascontiguousarray(keys[self._order, ::-1])

    def meet(self, whole: IntactRecord) -> None:
        """Mark a record as found."""
        record = whole.record
        if isinstance(record, records.Metadata | IntactAttachment | LargeAttachment):
            self._names[_name_of(record)] -= 1
        elif isinstance(record, IntactChunk | LargeChunk):
            self._meet_chunk(whole, record.stored)

    def _meet_chunk(self, whole: IntactRecord, chunk: StoredChunk) -> None:
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
        """List the missing metadata records and attachments, as in `Index.names`."""
        return list((+self._names).elements())

    def unmet(self) -> Iterator[UnmetChunks]:
        """Iterate over the missing chunks."""
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
        """Find a missing chunk by its times and its length; -1 if there is none."""
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


_DAMAGES = 1000  # maximum number of separate damages
_MORE_IN_INDEX = "the index lists more than there is"
_NAME_AFTER = {Opcode.METADATA: 0, Opcode.ATTACHMENT: 16}  # offset of the name in bytes


@dataclass(frozen=True)
class Damage:
    """Damaged part of a file, and its losses."""

    start: int  # byte range in the file
    end: int
    why: str
    messages: Mapping[str, int] = field(default_factory=dict)  # lost messages by topic
    exact: bool = True  # whether these are all lost messages
    times: tuple[int, int] | None = None  # first and last log time of the lost messages
    others: tuple[str, ...] = ()  # names of lost metadata records and attachments
    cut: bool = False  # whether the file is truncated here
    sound: bool = False  # whether the file is undamaged here, but data are skipped

    @property
    def lossless(self) -> bool:
        """Whether nothing was lost."""
        return self.exact and not self.messages and not self.others

    def __str__(self) -> str:
        where = f"{self.why} at byte {self.start}"
        if not self.sound:
            where = f"damaged at byte {self.start} ({self.why})"
        if self.lossless:
            return f"{where}: nothing is lost"
        lost = [f"{count} of {topic}" for topic, count in sorted(self.messages.items())]
        if not self.exact:
            lost.append("perhaps more" if lost else "an unknown number of messages")
        span = "" if self.times is None else ", " + " to ".join(map(millisecond_text, self.times))
        return f"{where}: lost up to byte {self.end}: {', '.join([*lost, *self.others])}{span}"


class DamageList:
    """Damages of a file, and undamaged messages of undefined channels."""

    def __init__(self) -> None:
        # By channel: number of messages, first and last log time, and their byte range in the file.
        self.unnamed: dict[int, tuple[int, tuple[int, int], tuple[int, int]]] = {}
        self._damages: list[tuple[Damage, dict[int, int]]] = []

    def __len__(self) -> int:
        return len(self._damages)

    def add(self, damage: Damage, messages: dict[int, int] | None = None) -> None:
        """Add a damage behind all others in the file.

        From the thousandth on, damages are merged, with the lost messages of the first of them.

        Parameters
        ----------
        messages : dict of int to int, optional
            Lost messages by channel; None for none.
        """
        if len(self._damages) == _DAMAGES:
            last, lost = self._damages.pop()
            lossless = damage.lossless and last.lossless and not messages and not lost
            damage = Damage(last.start, damage.end, "and more", exact=lossless, cut=damage.cut)
            messages = lost
        self._damages.append((damage, messages or {}))

    def add_unnamed(
        self, channel: int, messages: int, times: tuple[int, int], whole: IntactRecord
    ) -> None:
        """Add messages of a channel without a definition so far.

        Parameters
        ----------
        times : tuple of int
            First and last log time in nanoseconds.
        whole : IntactRecord
            Record of the messages, behind those added before for the channel.
        """
        count, span, (start, _) = self.unnamed.get(channel, (0, times, (whole.offset, 0)))
        span = min(span[0], times[0]), max(span[1], times[1])
        self.unnamed[channel] = count + messages, span, (start, whole.end)

    def add_unmet(self, unmet: Iterable[UnmetChunks], names: Sequence[str]) -> None:
        """Add records of the index that the file lacks, unless known damages cover them.

        If the index has more detail than a damage, the damage is updated.

        Parameters
        ----------
        names : sequence of str
            All missing metadata records and attachments of the index.
        """
        starts = [damage.start for damage, _ in self._damages]
        more: list[tuple[Damage, dict[int, int]]] = []
        for chunks in unmet:
            first = bisect_left(starts, chunks.start)
            last = bisect_left(starts, max(chunks.end, chunks.start + 1))
            lost = Counter(chunks.messages)
            for _, told in self._damages[first:last]:
                lost.subtract(told)
            lost = +lost
            if first < last:
                damage, told = self._damages[last - 1]
                if lost or not damage.exact:
                    times = _span(damage.times, chunks.times)
                    damage = replace(damage, exact=chunks.exact, times=times)
                    self._damages[last - 1] = damage, dict(lost + Counter(told))
            elif lost or not chunks.exact:
                damage = Damage(
                    chunks.start, chunks.end, _MORE_IN_INDEX, {}, chunks.exact, chunks.times
                )
                more.append((damage, dict(lost)))
        known = Counter(name for damage, _ in self._damages for name in damage.others)
        others = tuple((Counter(names) - known).elements())
        if others:
            more.append((Damage(0, 0, _MORE_IN_INDEX, others=others), {}))
        self._insert(more)

    def add_claims(self, claims: Iterable[Claim]) -> None:
        """Add messages that message indexes list and no chunk holds."""
        why = "message indexes list more than there is"
        self._insert(
            [(Damage(start, start, why, times=times), dict(lost)) for start, lost, times in claims]
        )

    def _insert(self, more: list[tuple[Damage, dict[int, int]]]) -> None:
        """Insert damages by offset; merge them beyond the limit."""
        room = max(_DAMAGES - len(self._damages), 1)
        if len(more) > room:
            rest = more[room - 1 :]
            exact = all(damage.exact for damage, _ in rest)
            ends = rest[0][0].start, max(damage.end for damage, _ in rest)
            lost = sum((Counter(lost) for _, lost in rest), Counter[int]())
            more[room - 1 :] = [(Damage(*ends, _MORE_IN_INDEX, exact=exact), dict(lost))]
        self._damages = sorted([*self._damages, *more], key=lambda each: each[0].start)

    def resolve(self, definitions: Definitions) -> list[Damage]:
        """List the damages, then the messages without a definition, with topic names."""
        damages = []
        for damage, lost in self._damages:
            messages: dict[str, int] = {}
            for channel, count in lost.items():
                topic = definitions.topic(channel)
                messages[topic] = messages.get(topic, 0) + count
            damages.append(replace(damage, messages=messages))
        for channel, (count, times, place) in self.unnamed.items():
            why = f"nothing that is left says what channel {channel} is"
            messages = {definitions.topic(channel): count}
            damages.append(Damage(*place, why, messages, times=times))
        return damages


class DamagedRange(NamedTuple):
    """Byte range of a file without any complete record.

    Attributes
    ----------
    start, end : int
        First offset of the range, and its end.
    opcode : int
        First byte of the range.
    ends : tuple of int
        Possible ends of the damaged record.
    """

    start: int
    end: int
    opcode: int
    ends: tuple[int, ...]


class Loss(NamedTuple):
    """Losses in a damaged range; fields as in `Damage`, but messages by channel."""

    messages: dict[int, int]
    exact: bool
    times: tuple[int, int] | None = None
    others: tuple[str, ...] = ()


_NOTHING = Loss({}, exact=True)


def _span(first: tuple[int, int] | None, second: tuple[int, int]) -> tuple[int, int]:
    return second if first is None else (min(first[0], second[0]), max(first[1], second[1]))


def loss_in(reader: RecordVerifier, damaged: DamagedRange, index: Index | None) -> Loss:
    """Determine the losses in a damaged range.

    Parameters
    ----------
    index : Index or None
        Index of the file. None without a valid index: the bytes of the range and the message
        indexes behind it are used instead, as for a moved index.
    """
    if index is None or index.moved:
        return _loss_by_neighbours(reader, damaged)
    others = tuple(
        name for offset, name in index.names.items() if damaged.start <= offset < damaged.end
    )
    if not len(index.chunks):
        lost = _loss_by_neighbours(reader, damaged)
        return lost._replace(others=others or lost.others)
    first, last = np.searchsorted(index.chunks[:, 0], [damaged.start, damaged.end])
    if first == last:
        return Loss({}, True, None, others)
    chunks = index.chunks[first:last]
    times = int(chunks[:, 3].min()), int(chunks[:, 4].max())
    messages = index.messages_of(int(first), int(last))
    return Loss(messages, exact=True, times=times, others=others)


def _loss_by_neighbours(reader: RecordVerifier, damaged: DamagedRange) -> Loss:
    start, end, opcode, ends = damaged
    is_cut_chunk = opcode == Opcode.CHUNK and (end == reader.end or max(ends, default=0) > end)
    if end - start < MESSAGE.size and not is_cut_chunk:
        return _NOTHING
    is_record = end in ends or end == reader.end
    if end in ends and reader.like_message_index(start):
        return _NOTHING  # regardless of the first byte
    if opcode == Opcode.CHUNK:
        messages: dict[int, int] = {}
        behind, span = _count(reader, end, messages)
        head = reader.read(start + HEAD.size, CHUNK.size).ljust(CHUNK.size, b"\0")
        times = CHUNK.unpack(head)[:2]
        exact = bool(messages) and end in ends and behind < reader.end and reader.plausible(behind)
        exact = exact and reader.read(behind, 1)[0] != Opcode.MESSAGE_INDEX
        is_sound = 0 < times[0] <= times[1] < 1 << 63
        return Loss(messages, exact, span or (times if is_sound else None))
    if opcode in _NAME_AFTER and is_record:
        name = _name(reader, start + HEAD.size + _NAME_AFTER[Opcode(opcode)])
        kind = "the metadata" if opcode == Opcode.METADATA else "the attachment"
        return Loss({}, True, None, () if name == ROSBAG2_METADATA else (f"{kind} {name!r}",))
    is_message = opcode == Opcode.MESSAGE or SHORTEST[opcode] > LIMIT
    return _NOTHING if is_record and not is_message else Loss({}, exact=False)


def _count(
    reader: RecordVerifier, offset: int, messages: dict[int, int]
) -> tuple[int, tuple[int, int] | None]:
    """Count messages by the message indexes at an offset; return their end and log times."""
    times = []
    with suppress(McapError):
        while True:
            channel, entries, offset = reader.message_index(offset)
            messages[channel] = messages.get(channel, 0) + len(entries)
            if len(entries):
                times += [int(entries["time"].min()), int(entries["time"].max())]
    return offset, (min(times), max(times)) if times else None


def _name(reader: RecordVerifier, offset: int) -> str:
    length = int.from_bytes(reader.read(offset, 4), "little")
    return reader.read(offset + 4, min(length, 100)).decode(errors="replace")
