"""What was lost where a file is damaged, as far as the file still shows it."""

import zlib
from array import array
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from operator import itemgetter
from typing import NamedTuple

import numpy as np
from mcap import records
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from numpy.typing import NDArray

from hearthlog.schemas.logs import rosbag2
from hearthlog.schemas.mcap.definitions import Definition, Definitions
from hearthlog.schemas.mcap.formats import (
    CHUNK,
    FOOTER,
    FOOTER_SIZE,
    HEAD,
    INDEX_ENTRY,
    MAGIC,
    MESSAGE,
    MESSAGE_INDEX_HEAD,
)
from hearthlog.schemas.mcap.records import LIMIT, read_footer
from hearthlog.schemas.salvage.record_sizes import SHORTEST
from hearthlog.schemas.salvage.record_verifier import RecordVerifier
from hearthlog.schemas.salvage.whole_records import WholeRecord
from hearthlog.schemas.times import millisecond_text

_BLOCK = 1 << 20
_DAMAGES = 1000  # as many are told apart
_NAME_AFTER = {Opcode.METADATA: 0, Opcode.ATTACHMENT: 16}  # bytes


@dataclass(frozen=True)
class Damage:
    """A part of a file that is not whole, and what was lost with it."""

    start: int  # bytes of the file
    end: int
    why: str
    messages: Mapping[str, int] = field(default_factory=dict)  # that are lost, by topic
    exact: bool = True  # whether these are all that are lost
    times: tuple[int, int] | None = None  # log times of the first and last of them
    others: tuple[str, ...] = ()  # names of lost metadata records and attachments
    cut: bool = False  # whether the file just ends here

    @property
    def lossless(self) -> bool:
        """Whether nothing was lost with it."""
        return self.exact and not self.messages and not self.others

    def __str__(self) -> str:
        where = f"damaged at byte {self.start} ({self.why})"
        if self.lossless:
            return f"{where}: nothing is lost"
        lost = [f"{count} of {topic}" for topic, count in sorted(self.messages.items())]
        if not self.exact:
            lost.append("perhaps more" if lost else "an unknown number of messages")
        span = "" if self.times is None else ", " + " to ".join(map(millisecond_text, self.times))
        return f"{where}: lost up to byte {self.end}: {', '.join([*lost, *self.others])}{span}"


class DamageList:
    """The damages of a file, and its whole messages of channels that are nowhere defined."""

    def __init__(self) -> None:
        # By channel: messages, first and last log time, and the bytes of the file between them.
        self.unnamed: dict[int, tuple[int, tuple[int, int], tuple[int, int]]] = {}
        self._damages: list[tuple[Damage, dict[int, int]]] = []

    def __len__(self) -> int:
        return len(self._damages)

    def add(self, damage: Damage, messages: dict[int, int] | None = None) -> None:
        """Add a damage, which must be behind all others in the file.

        All from the thousandth on count as one, with the lost messages of the first of them.

        Parameters
        ----------
        damage : Damage
            Its own `messages` are replaced.
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
        self, channel: int, messages: int, times: tuple[int, int], whole: WholeRecord
    ) -> None:
        """Add messages of a channel that is not defined so far.

        Parameters
        ----------
        channel : int
            Number of the channel.
        messages : int
            How many there are.
        times : tuple of int
            First and last log time of them, in nanoseconds.
        whole : WholeRecord
            The record they are in, which must be behind those added before for the channel.
        """
        count, span, (start, _) = self.unnamed.get(channel, (0, times, (whole.offset, 0)))
        span = min(span[0], times[0]), max(span[1], times[1])
        self.unnamed[channel] = count + messages, span, (start, whole.end)

    def resolve(self, definitions: Definitions) -> list[Damage]:
        """List the damages, then the messages without a definition, with the names of topics.

        Parameters
        ----------
        definitions : Definitions
            Tell the topics of channels.

        Returns
        -------
        list of Damage
            Damages by offset, then one for each channel that was added as unnamed.
        """
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


class Index(NamedTuple):
    """The index of a file, whose checksum is right if it has one.

    Attributes
    ----------
    reader : RecordVerifier
        Of the whole file.
    messages : dict of int to int, or None
        How many messages each channel has; None if the index does not say so.
    chunks : np.ndarray [shape=(n, 6)], int64
        Offset, length, length of the message indexes, first and last log time of each chunk, and
        the byte at which its record in the index begins; in the order of the file.
    """

    reader: RecordVerifier
    start: int  # byte at which it begins
    definitions: list[Definition]
    messages: dict[int, int] | None
    chunks: NDArray[np.int64]
    names: dict[int, str]  # of metadata records and attachments, by offset


class DamagedRange(NamedTuple):
    """Bytes of a file that hold no whole record.

    Attributes
    ----------
    start, end : int
        Bytes of the file at which the range begins, and before which it ends.
    opcode : int
        The first byte of the range.
    ends : tuple of int
        Bytes at which the record should end that may have been here.
    """

    start: int
    end: int
    opcode: int
    ends: tuple[int, ...]


class Loss(NamedTuple):
    """What was lost in a damaged range; fields as of `Damage`, but messages by channel."""

    messages: dict[int, int]
    exact: bool
    times: tuple[int, int] | None = None
    others: tuple[str, ...] = ()


_NOTHING = Loss({}, exact=True)


def read_index(reader: RecordVerifier, limit: int) -> Index | None:
    """Read the index of a finished file.

    Parameters
    ----------
    reader : RecordVerifier
        Of the file, up to its end, where it stays.
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
    start = footer.summary_start or end
    if not len(MAGIC) <= start <= end or end - start > limit:
        return None
    crc = 0
    for place in range(start, end, _BLOCK):
        crc = zlib.crc32(reader.read(place, min(_BLOCK, end - place)), crc)
    crc = zlib.crc32(tail[: HEAD.size + FOOTER.size], crc)
    if footer.summary_crc not in {0, crc}:
        return None
    with suppress(McapError, UnicodeDecodeError, OverflowError):
        return _records_of_index(reader, start, end)
    return None


def _records_of_index(reader: RecordVerifier, start: int, end: int) -> Index:
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
            chunks.extend([record.message_index_length, record.message_start_time])
            chunks.extend([record.message_end_time, offset])
        elif isinstance(record, records.MetadataIndex):
            if record.name != rosbag2.METADATA:  # it is made anew
                names[record.offset] = f"the metadata {record.name!r}"
        elif isinstance(record, records.AttachmentIndex):
            names[record.offset] = f"the attachment {record.name!r}"
        elif not isinstance(record, records.SummaryOffset):
            raise McapError("here should be the index")
        offset = whole.end
    table = np.array(chunks, np.int64).reshape(-1, 6)
    table = table[np.argsort(table[:, 0])]
    ends = table[:, :3].sum(axis=1)
    if (table < 0).any() or (ends[:-1] > table[1:, 0]).any():
        raise McapError("chunks overlap")
    return Index(reader, start, definitions, messages, table, names)


def loss_in(reader: RecordVerifier, damaged: DamagedRange, index: Index | None) -> Loss:
    """Find out what was lost in a damaged range.

    Parameters
    ----------
    reader : RecordVerifier
        Of the file.
    damaged : DamagedRange
    index : Index or None
        Index of the file. None if the file has none that is whole: the bytes of the range and the
        message indexes behind it then tell what was lost.
    """
    if index is None:
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
    messages: Counter[int] = Counter()
    for place in chunks[:, 5].tolist():
        record = index.reader.whole(place).record
        assert isinstance(record, records.ChunkIndex)
        messages.update(_messages_of(record))
    times = int(chunks[:, 3].min()), int(chunks[:, 4].max())
    return Loss(messages, exact=True, times=times, others=others)


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


def _loss_by_neighbours(reader: RecordVerifier, damaged: DamagedRange) -> Loss:
    start, end, opcode, ends = damaged
    if end - start < MESSAGE.size and (end < reader.end or opcode != Opcode.CHUNK):
        return _NOTHING
    is_record = end in ends or end == reader.end
    if end in ends and reader.like_message_index(start):
        return _NOTHING  # whatever its first byte says
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
        return Loss({}, True, None, () if name == rosbag2.METADATA else (f"{kind} {name!r}",))
    is_message = opcode == Opcode.MESSAGE or SHORTEST[opcode] > LIMIT
    return _NOTHING if is_record and not is_message else Loss({}, exact=False)


def _count(
    reader: RecordVerifier, offset: int, messages: dict[int, int]
) -> tuple[int, tuple[int, int] | None]:
    """Count messages by the indexes from here on; return where these end, and their times."""
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
