"""Whether a whole record begins at a certain byte of a file that may be damaged anywhere.

What has a checksum is compared with it. What has none is believed if the lengths inside a record
add up to the length before it.
"""

import os
import struct
import zlib
from array import array
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from mcap import records
from mcap.opcode import Opcode
from mcap.records import McapRecord
from numpy.typing import NDArray

from hearthlog.schemas.arrays import gather
from hearthlog.schemas.mcap.chunk_writer import StoredChunk
from hearthlog.schemas.mcap.records import (
    HEAD,
    LIMIT,
    MAGIC,
    ChunkHead,
    McapError,
    decompress,
    parse,
)

MESSAGE_SIZE = 31  # bytes of a message without payload, opcode and length included
_SMALL = 16 << 20  # bytes; a record that is neither chunk, message nor attachment has fewer
_LARGEST: dict[int, int] = {Opcode.ATTACHMENT: LIMIT, Opcode.MESSAGE_INDEX: LIMIT}
_TEXT, _DATA = struct.Struct("<I"), struct.Struct("<Q")
# What follows opcode and length: so many bytes, or the length of a text or of data, and these.
_FIELDS: dict[int, tuple[int | struct.Struct, ...]] = {
    Opcode.HEADER: (_TEXT, _TEXT),
    Opcode.FOOTER: (20,),
    Opcode.SCHEMA: (2, _TEXT, _TEXT, _TEXT),
    Opcode.CHANNEL: (4, _TEXT, _TEXT, _TEXT),
    Opcode.CHUNK: (28, _TEXT, _DATA),
    Opcode.MESSAGE_INDEX: (2, _TEXT),
    Opcode.CHUNK_INDEX: (32, _TEXT, 8, _TEXT, 16),
    Opcode.ATTACHMENT: (16, _TEXT, _TEXT, _DATA, 4),
    Opcode.ATTACHMENT_INDEX: (40, _TEXT, _TEXT),
    Opcode.STATISTICS: (42, _TEXT),
    Opcode.METADATA: (_TEXT, _TEXT),
    Opcode.METADATA_INDEX: (16, _TEXT),
    Opcode.SUMMARY_OFFSET: (17,),
    Opcode.DATA_END: (4,),
}
_UNKNOWN = 1 << 62
SHORTEST = np.full(256, _UNKNOWN)  # what a record must have at least after opcode and length
for _opcode, _fields in _FIELDS.items():
    SHORTEST[_opcode] = sum(f if isinstance(f, int) else f.size for f in _fields)
SHORTEST[Opcode.MESSAGE] = MESSAGE_SIZE - HEAD.size
_CHUNK = struct.Struct("<BQQQQII")
_MESSAGE = struct.Struct("<BQHIQQ")
_INDEX_HEAD = struct.Struct("<BQHI")
_ENTRY = np.dtype([("time", "<i8"), ("offset", "<i8")])


class WholeChunk(NamedTuple):
    """A chunk whose content is proved, and what it defines."""

    stored: StoredChunk
    definitions: list[records.Schema | records.Channel]


class WholeAttachment(NamedTuple):
    """An attachment as the file holds it, and what an index says of it."""

    record: bytes
    about: records.AttachmentIndex


class WholeRecord(NamedTuple):
    """A whole record, from `offset` to `end`; `wrong` says what of its head had to be corrected."""

    offset: int
    end: int
    record: McapRecord | WholeChunk | WholeAttachment | None
    wrong: str = ""


class RecordVerifier:
    """Reads whole records of a file from any byte on.

    Parameters
    ----------
    descriptor : int
        Of the open file.
    end : int
        Of what is read.

    Attributes
    ----------
    work : int
        Bytes that were read and decompressed.
    inner : int
        Records inside of chunks that were gone through.
    """

    def __init__(self, descriptor: int, end: int) -> None:
        self.end = end
        self.work = 0
        self.inner = 0
        self._descriptor = descriptor

    def read(self, offset: int, length: int) -> bytes:
        """Read some bytes; fewer at the end of the file."""
        data = os.pread(self._descriptor, max(min(length, self.end - offset), 0), offset)
        self.work += len(data)
        return data

    def head(self, offset: int) -> tuple[int, int]:
        """Read opcode and length, whatever they claim.

        Raises
        ------
        McapError
            If the file ends before.
        """
        data = self.read(offset, HEAD.size)
        if len(data) < HEAD.size:
            raise McapError("the file ends within a record")
        opcode, length = HEAD.unpack(data)
        return opcode, length

    def ends(self, offset: int) -> tuple[int, int]:
        """Say where a record ends by the length before it, and by the lengths inside of it.

        For a message, and for what is no record, both are the same; where the file ends before
        that is said, the second is beyond all files.
        """
        opcode, length = self.head(offset)
        outer = offset + HEAD.size + length
        inner = offset + HEAD.size
        for field in _FIELDS.get(opcode, (length,)):
            if isinstance(field, int):
                inner += field
                continue
            data = self.read(inner, field.size)
            if len(data) < field.size:
                return outer, _UNKNOWN
            inner += field.size + field.unpack(data)[0]
        return outer, inner

    def like_message_index(self, offset: int) -> bool:
        """Whether the record that begins here could be a message index, but for its opcode."""
        data = self.read(offset, HEAD.size + 6)
        if len(data) < HEAD.size + 6:
            return False
        _, length, _, size = _INDEX_HEAD.unpack(data)
        return bool(length == size + 6 and size % _ENTRY.itemsize == 0)

    def plausible(self, offset: int) -> bool:
        """Whether a record may begin here, or the file may be cut here."""
        if offset >= self.end:
            return offset == self.end
        data = self.read(offset, HEAD.size)
        if len(data) < HEAD.size:
            return bool(SHORTEST[data[0]] < _UNKNOWN) or MAGIC.startswith(data)
        opcode, length = HEAD.unpack(data)
        return bool(SHORTEST[opcode] <= length <= LIMIT) or data.startswith(MAGIC)

    def whole(self, offset: int, chained: int = 1) -> WholeRecord:
        """Read the record that begins here, if it is whole.

        Parameters
        ----------
        offset : int
        chained : int
            How many plausible records must follow a message outside of chunks, which has nothing
            else to be known by.

        Raises
        ------
        McapError
            If it is not, or if this is no record.
        UnicodeDecodeError
            If a text in it is none.
        """
        opcode, length = self.head(offset)
        if opcode == Opcode.CHUNK:
            return self.chunk(offset)
        if length < SHORTEST[opcode]:
            raise McapError("a record of unknown kind, or too short")
        if opcode == Opcode.MESSAGE:
            return self._message(offset, chained)
        outer, inner = self.ends(offset)
        wrong = "" if inner == outer else "the length of a record"
        if inner - offset > _LARGEST.get(opcode, _SMALL):
            raise McapError("a record claims to be too large")
        if inner > self.end:
            raise McapError("a record claims to be longer than the file")
        if wrong and not self.plausible(inner):
            raise McapError("a record has another length than it claims")
        if opcode == Opcode.MESSAGE_INDEX:  # it is made anew
            return WholeRecord(offset, inner, None, wrong)
        raw = self.read(offset, inner - offset)
        if wrong:
            raw = HEAD.pack(opcode, inner - offset - HEAD.size) + raw[HEAD.size :]
        if opcode == Opcode.ATTACHMENT:
            return WholeRecord(offset, inner, _attachment(raw), wrong)
        return WholeRecord(offset, inner, parse(opcode, raw[HEAD.size :]), wrong)

    def chunk(self, offset: int) -> WholeRecord:
        """Read a chunk that should begin here, if its content is proved.

        Whatever its head says beside that is not needed.

        Raises
        ------
        McapError
            If it is not.
        UnicodeDecodeError
            If a text in it is none.
        """
        head = self.read(offset, _CHUNK.size + 4 + _DATA.size)
        try:
            opcode, length, start, end, size, crc, text = _CHUNK.unpack_from(head)
            first = _CHUNK.size + text
            (stored,) = _DATA.unpack_from(head, first)
        except struct.error as error:
            raise McapError("the head of a chunk is damaged") from error
        first += _DATA.size
        exact = (opcode, length) == (Opcode.CHUNK, first + stored - HEAD.size)
        if not crc and not exact:
            raise McapError("the head of a chunk is damaged")
        if size > LIMIT:
            raise McapError("a chunk claims to be too large")
        compression = head[_CHUNK.size : first - _DATA.size]
        about = ChunkHead(start, end, size, crc, compression, slice(None))
        # One of two lengths may be wrong. Decompressors overlook what follows their data, so the
        # shorter one comes first: if it is enough it is right.
        lengths = sorted({stored, length + HEAD.size - first})
        for number in lengths:
            try:
                data = self._data(offset + first, number)
                content, checksum = self._proved(about, data)
            except McapError:
                if number == lengths[-1]:
                    raise
                continue
            break
        definitions, entries, span = self._content(content)
        wrong = "" if exact and (not entries or span == (start, end)) else "the head of a chunk"
        chunk = StoredChunk(compression, data, size, checksum, *span, entries)
        return WholeRecord(offset, offset + first + number, WholeChunk(chunk, definitions), wrong)

    def _data(self, offset: int, length: int) -> memoryview:
        """Read the data of a chunk, of which there may be any length."""
        if not 0 <= length <= LIMIT:
            raise McapError("a chunk claims to be too large")
        if offset + length > self.end:
            raise McapError("a chunk claims to be longer than the file")
        return memoryview(self.read(offset, length))

    def _proved(self, head: ChunkHead, data: memoryview) -> tuple[bytes, int]:
        """Decompress a chunk; return its content and its checksum."""
        self.work += head.size
        content = decompress(head, data)
        checksum = zlib.crc32(content)
        if head.crc not in {0, checksum}:
            raise McapError("a chunk has another checksum than it claims")
        return content, checksum

    def _content(
        self, content: bytes
    ) -> tuple[list[records.Schema | records.Channel], dict[int, bytes], tuple[int, int]]:
        """Go through the records of a chunk; return its definitions, its index and its times."""
        found = array("q", _starts(content))
        self.inner += len(found)
        starts = np.frombuffer(found, np.int64)
        buffer = np.frombuffer(content, np.uint8)
        is_message = buffer[starts] == Opcode.MESSAGE if len(starts) else np.empty(0, np.bool_)
        definitions = []
        for start in starts[~is_message].tolist():
            record = parse(content[start], content[start + HEAD.size : _end(content, start)])
            assert isinstance(record, records.Schema | records.Channel)
            definitions.append(record)
        starts = starts[is_message]
        if not len(starts):
            return definitions, {}, (0, 0)
        channels = gather(buffer, starts + 9, 2).view("<u2")
        times = gather(buffer, starts + 15, 8).view("<i8")
        span = int(times.min()), int(times.max())
        if span[0] < 0:
            raise McapError("a log time is out of range")
        entries = np.empty(len(starts), _ENTRY)
        entries["time"] = times
        entries["offset"] = starts
        order = np.argsort(channels, kind="stable")
        numbers, places, counts = np.unique(channels, return_index=True, return_counts=True)
        lasts = np.cumsum(counts)
        index = {
            int(numbers[i]): entries[order[lasts[i] - counts[i] : lasts[i]]].tobytes()
            for i in np.argsort(places)
        }
        return definitions, index, span

    def _message(self, offset: int, chained: int) -> WholeRecord:
        opcode, length = self.head(offset)
        end = offset + HEAD.size + length
        if length > LIMIT:
            raise McapError("a record claims to be too large")
        if end > self.end:
            raise McapError("a record claims to be longer than the file")
        follower = end
        for _ in range(chained):
            if not self.plausible(follower):
                raise McapError("no record begins where a message ends")
            if follower >= self.end - HEAD.size:
                break
            opcode, length = self.head(follower)
            if opcode != Opcode.MESSAGE:
                break
            follower += HEAD.size + length
        raw = self.read(offset, end - offset)
        return WholeRecord(offset, end, _as_message(raw))

    def message_index(self, offset: int) -> tuple[int, NDArray[np.void], int]:
        """Read a message index: its channel, its entries, and where it ends.

        Raises
        ------
        McapError
            If there is none.
        """
        if self.head(offset)[0] != Opcode.MESSAGE_INDEX:
            raise McapError("here should be a message index")
        outer, inner = self.ends(offset)
        if outer != inner or inner > self.end or inner - offset > LIMIT:
            raise McapError("a message index is damaged")
        raw = self.read(offset, inner - offset)
        (channel,) = struct.unpack_from("<H", raw, HEAD.size)
        entries = raw[HEAD.size + 6 :]
        if len(entries) % _ENTRY.itemsize:
            raise McapError("a message index is damaged")
        return channel, np.frombuffer(entries, _ENTRY), inner


def chunk_messages(chunk: StoredChunk) -> Iterator[records.Message]:
    """Read the messages of a chunk that was found."""
    head = ChunkHead(0, 0, chunk.size, 0, chunk.compression, slice(None))
    content = decompress(head, chunk.data)
    for start in _starts(content):
        if content[start] == Opcode.MESSAGE:
            yield _as_message(content[start : _end(content, start)])


def _starts(content: bytes) -> Iterator[int]:
    """Go from record to record inside a chunk."""
    start, size, head = 0, len(content), HEAD.unpack_from
    allowed = {
        Opcode.MESSAGE: MESSAGE_SIZE - HEAD.size,
        Opcode.SCHEMA: int(SHORTEST[Opcode.SCHEMA]),
        Opcode.CHANNEL: int(SHORTEST[Opcode.CHANNEL]),
    }
    try:
        while start < size:
            opcode, length = head(content, start)
            if length < allowed[opcode]:
                raise McapError("a record in a chunk is too short")
            yield start
            start += 9 + length
    except (struct.error, KeyError) as error:
        raise McapError("the records of a chunk are damaged") from error
    if start != size:
        raise McapError("a record in a chunk claims to be longer than the chunk")


def _end(content: bytes, start: int) -> int:
    return start + HEAD.size + int(HEAD.unpack_from(content, start)[1])


def _as_message(raw: bytes) -> records.Message:
    _, _, channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(raw)
    if log_time >= 1 << 63:
        raise McapError("a log time is out of range")
    return records.Message(
        channel_id=channel,
        log_time=log_time,
        data=raw[_MESSAGE.size :],
        publish_time=publish_time,
        sequence=sequence,
    )


def _attachment(raw: bytes) -> WholeAttachment:
    record = memoryview(raw)
    (crc,) = _TEXT.unpack(record[-4:])
    if crc not in {0, zlib.crc32(record[HEAD.size : -4])}:
        raise McapError("an attachment has another checksum than it claims")
    log_time, create_time, name = struct.unpack_from("<QQI", record, HEAD.size)
    first = HEAD.size + 20 + name
    (media,) = _TEXT.unpack_from(record, first)
    return WholeAttachment(
        raw,
        records.AttachmentIndex(
            offset=0,
            length=0,
            log_time=log_time,
            create_time=create_time,
            data_size=_DATA.unpack_from(record, first + 4 + media)[0],
            name=str(record[first - name : first], "utf-8"),
            media_type=str(record[first + 4 : first + 4 + media], "utf-8"),
        ),
    )
