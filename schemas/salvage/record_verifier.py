"""Verification of records and message indexes in a damaged file.

Data with a checksum are compared with it. Other records are accepted if their inner lengths
add up to their length or to less: the format allows trailing fields.
"""

import struct
import zlib
from collections import Counter, defaultdict
from contextlib import suppress

import numpy as np
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import McapRecord
from numpy.typing import NDArray

from hearthlog.schemas.files import LocalFile
from hearthlog.schemas.mcap.compressed_chunk import (
    ContentStream,
    StoredChunk,
    TooLargeError,
    read_parts,
    stated_size,
)
from hearthlog.schemas.mcap.raw_messages import index_messages
from hearthlog.schemas.mcap.records import (
    CHUNK,
    HEAD,
    INDEX_ENTRIES,
    INDEX_ENTRY,
    LAST_TIME,
    LIMIT,
    MAGIC,
    MESSAGE,
    MESSAGE_INDEX,
    UINT32,
    UINT64,
    ChunkHead,
    Definition,
    begun_chunk_head,
    decompress,
    parse_escaped,
)
from hearthlog.schemas.salvage import intact_records
from hearthlog.schemas.salvage.intact_records import (
    FIELDS,
    LARGEST,
    SHORTEST,
    UNKNOWN,
    IntactAttachment,
    IntactChunk,
    IntactRecord,
    LargeChunk,
)

_VARIABLE = [kind for kind, fields in FIELDS.items() if len(fields) > 1]  # with inner lengths
_LARGE = {Opcode.CHUNK, Opcode.MESSAGE, Opcode.ATTACHMENT}  # may be larger than `LIMIT`
_ATTACHMENT_HEAD = 1 << 16  # bytes that hold the names and times of a large attachment
_CHUNK_HEAD = 128  # bytes that hold the head of a chunk and the head of its data
_PIECE = 1 << 20  # bytes
_UNKNOWN_CHAIN = 16  # consecutive records of unknown kinds
_LONGEST_PADDING = 1 << 12  # bytes of fields that a later version of the format may add


class RecordVerifier:
    """Reader of complete records at any offset of a file, up to the offset `end`.

    `work` counts the bytes read and decompressed so far.
    """

    def __init__(self, file: LocalFile, end: int) -> None:
        self.end = end
        self.work = 0
        self.inner = 0  # records inside of chunks that were checked
        self._file = file

    def read(self, offset: int, length: int) -> bytes:
        """Read bytes at an offset; raise `LogError` if the file cannot be read."""
        data = self._file.read(offset, max(min(length, self.end - offset), 0))
        self.work += len(data)
        return data

    def head(self, offset: int) -> tuple[int, int]:
        """Read opcode and stated bytes of a record, without checks.

        Raise `McapError` if the file ends within opcode and length.
        """
        data = self.read(offset, HEAD.size)
        if len(data) < HEAD.size:
            raise McapError("the file ends within a record")
        opcode, length = HEAD.unpack(data)
        return opcode, length

    def ends(self, offset: int, kind: int | None = None) -> tuple[int, int]:
        """Find the end of a record by its length, and by its inner lengths.

        Both are equal for a message or an invalid record; the second is `UNKNOWN` if the file ends
        before an inner length. Raise `McapError` if the file ends within opcode and length.
        """
        opcode, length = self.head(offset)
        outer = offset + HEAD.size + length
        inner = offset + HEAD.size
        for field in FIELDS.get(opcode if kind is None else kind, (length,)):
            if isinstance(field, int):
                inner += field
                continue
            data = self.read(inner, field.size)
            if len(data) < field.size:
                return outer, UNKNOWN
            inner += field.size + field.unpack(data)[0]
        return outer, inner

    def like_message_index(self, offset: int) -> bool:
        """Return whether a record could be a message index, ignoring its opcode."""
        data = self.read(offset, HEAD.size + MESSAGE_INDEX.size)
        if len(data) < HEAD.size + MESSAGE_INDEX.size:
            return False
        _, length = HEAD.unpack_from(data)
        _, size = MESSAGE_INDEX.unpack_from(data, HEAD.size)
        return bool(length == size + MESSAGE_INDEX.size and size % INDEX_ENTRIES.itemsize == 0)

    def plausible(self, offset: int) -> bool:
        """Return whether a record may begin at an offset, or the file may be truncated there."""
        if offset >= self.end:
            return offset == self.end
        for _ in range(_UNKNOWN_CHAIN):
            data = self.read(offset, HEAD.size)
            if len(data) < HEAD.size:
                return bool(SHORTEST[data[0]] < UNKNOWN) or MAGIC.startswith(data)
            opcode, length = HEAD.unpack(data)
            if opcode <= Opcode.DATA_END or data == MAGIC[: HEAD.size]:
                fits = opcode in _LARGE and offset + HEAD.size + length <= self.end
                most = self.end if fits else LIMIT
                return bool(SHORTEST[opcode] <= length <= most) or data.startswith(MAGIC)
            offset += HEAD.size + length  # only the records behind it can confirm it
            if offset >= self.end:
                return offset == self.end
        return True

    def intact(self, offset: int, chained: int = 1) -> IntactRecord:
        """Read a complete record.

        A message outside of chunks has no check but `chained` plausible records required behind it,
        up to the first that is no message. Raise `McapError` if there is no record at the offset,
        or it is incomplete.
        """
        opcode, length = self.head(offset)
        if opcode == Opcode.CHUNK:
            return self.chunk(offset)
        if opcode > Opcode.DATA_END and chained == 1:
            return self._unknown(offset, opcode, length)
        if length < SHORTEST[opcode]:
            raise McapError("a record of unknown kind, or too short")
        if opcode == Opcode.MESSAGE:
            return self._message(offset, chained)
        return self._framed(offset, opcode, strict=chained > 1)

    def _framed(self, offset: int, opcode: int, *, strict: bool) -> IntactRecord:
        """Read a record that ends by its inner lengths; if `strict`, only with valid UTF-8."""
        outer, inner = self.ends(offset)
        end = outer if self._is_padded(inner, outer) else inner
        wrong = "" if end == outer else "the length of a record"
        is_large = opcode == Opcode.ATTACHMENT and inner == outer and inner - offset > LIMIT
        if is_large and (outer > self.end or not self.plausible(outer)):
            raise McapError("a record claims to be longer than the file")
        if inner - offset > LARGEST[opcode] and not is_large:
            raise McapError("a record claims to be too large")
        if inner > self.end:
            raise McapError("a record claims to be longer than the file")
        if wrong and not self.plausible(inner):
            raise McapError("a record has another length than it claims")
        if opcode == Opcode.MESSAGE_INDEX:  # the writer builds a new one
            return IntactRecord(offset, end, None, wrong)
        record: McapRecord | IntactAttachment | None
        if opcode == Opcode.ATTACHMENT:
            record = self._attachment(offset, inner)
            name, is_escaped = record.index_record.name, record.escaped
        else:
            content = self.read(offset, inner - offset)[HEAD.size :]
            record, is_escaped = parse_escaped(opcode, content)
            name = intact_records.name_of(record)
        if is_escaped and strict and not is_large:
            raise McapError("a text is not UTF-8")
        return IntactRecord(offset, end, record, wrong, escaped=(name,) * is_escaped)

    def chunk(self, offset: int) -> IntactRecord:
        """Read a chunk with a verified content, whatever its head states.

        Raise `McapError` if there is no chunk at the offset, or its content cannot be verified.
        """
        name = HEAD.size + CHUNK.size  # offset of the compression name
        head = self.read(offset, name + 4 + UINT64.size)
        try:
            opcode, length = HEAD.unpack_from(head)
            start, end, size, crc, text = CHUNK.unpack_from(head, HEAD.size)
            first = name + text
            (stored,) = UINT64.unpack_from(head, first)
        except struct.error as error:
            raise McapError("the head of a chunk is damaged") from error
        first += UINT64.size
        outer, inner = offset + HEAD.size + length, offset + first + stored
        padded = opcode == Opcode.CHUNK and self._is_padded(inner, outer)
        exact = padded or (opcode == Opcode.CHUNK and inner == outer)
        if not crc and not exact:
            raise McapError("the head of a chunk is damaged")
        if max(size, stored) > LIMIT:
            if not exact or outer > self.end:
                raise McapError("the head of a chunk is damaged")
            return IntactRecord(offset, outer, self._large_chunk(offset, outer))
        compression = head[name : first - UINT64.size]
        claim = ChunkHead(start, end, size, 0, compression, slice(None))
        # One of two lengths may be wrong. Decompressors ignore trailing bytes,
        # so the shorter length is tried first: if it suffices, it is right.
        lengths = sorted({stored, length + HEAD.size - first})
        for number in lengths:
            try:
                data = self._data(offset + first, number)
                content, checksum = self._prove(claim, data, crc)
            except McapError:
                if number == lengths[-1]:
                    raise
                continue
            break
        messages, others = intact_records.split_content(content)
        self.inner += len(messages) + len(others)
        entries = index_messages(content, messages)
        span = intact_records.span_of(entries)
        agrees = not entries or span == (start, end)
        wrong = "" if exact and agrees else "the head of a chunk"
        definitions, escaped = intact_records.read_definitions(content, others)
        leading = int((others < messages[0]).sum()) if len(messages) else len(others)
        stored_chunk = StoredChunk(compression, data, size, checksum, *span, entries)
        intact = IntactChunk(stored_chunk, definitions, leading)
        if escaped:
            intact, content = intact_records.with_definitions(intact, content, others)
            messages, _ = intact_records.split_content(content)
        if span[1] > LAST_TIME:
            intact = intact_records.without_late(intact, content, messages)
        behind = outer if padded else offset + first + number
        proved = bool(crc) or agrees
        return IntactRecord(offset, behind, intact, wrong, escaped=tuple(escaped), proved=proved)

    def _large_chunk(self, offset: int, end: int) -> LargeChunk:
        """Verify a chunk that is too large for the memory."""
        try:
            stream = ContentStream(self.read, offset)
        except TooLargeError as error:
            return self._unopened_chunk(offset, end, str(error))
        entries: defaultdict[int, bytearray] = defaultdict(bytearray)
        definitions: list[Definition] = []
        unread: Counter[int] = Counter()
        leading = 0
        for part in read_parts(stream):
            self.inner += len(part.messages) + len(part.others)
            if self.inner > (1 << 20) + 4 * self.end:
                raise McapError("the file holds more messages than one of its size can")
            if part.size > LIMIT:
                opcode, _, channel, _, time, _ = MESSAGE.unpack(part.content)
                if opcode == Opcode.MESSAGE:
                    entries[channel] += INDEX_ENTRY.pack(time, part.first)
                    unread[channel] += 1
                continue
            starts = np.frombuffer(part.messages, np.int64)
            others = np.array([start for start, _ in part.others], np.int64)
            if not entries:
                leading += int((others < starts[0]).sum()) if len(starts) else len(others)
            definitions += intact_records.read_definitions(part.content, others)[0]
            for channel, rows in index_messages(part.content, starts).items():
                moved = np.frombuffer(rows, INDEX_ENTRIES).copy()
                moved["offset"] += part.first
                entries[channel] += moved.tobytes()
        head = stream.head
        span = intact_records.span_of(entries)
        stored = StoredChunk(head.compression, b"", head.size, stream.check(), *span, entries)
        first = offset + HEAD.size
        data = first + head.data.start, first + head.data.stop
        return LargeChunk(stored, data, definitions, leading, unread)

    def _unopened_chunk(self, offset: int, end: int, why: str) -> LargeChunk:
        """Describe an unopened chunk by its head and its message indexes."""
        head = begun_chunk_head(self.read(offset + HEAD.size, _CHUNK_HEAD))
        first = offset + HEAD.size
        data = first + head.data.start, first + head.data.stop
        stated = stated_size(head.compression, self.read(data[0], _CHUNK_HEAD))
        if not head.compression:
            stated = data[1] - data[0]
        if stated not in {None, head.size} or max(head.start, head.end) > LAST_TIME:
            raise McapError("the head of a chunk is damaged")
        entries: dict[int, bytes] = {}
        with suppress(McapError):
            while True:
                channel, rows, end = self.message_index(end)
                entries[channel] = entries.get(channel, b"") + rows.tobytes()
        span = head.start, head.end
        stored = StoredChunk(head.compression, b"", head.size, head.crc, *span, entries)
        counts = {channel: len(rows) // INDEX_ENTRIES.itemsize for channel, rows in entries.items()}
        return LargeChunk(stored, data, [], 0, counts, why)

    def _large_message(self, offset: int, end: int) -> LargeChunk:
        """Wrap a message outside of chunks that is too large to read in a chunk."""
        _, _, channel, _, time, _ = MESSAGE.unpack(self.read(offset, MESSAGE.size))
        if time > LAST_TIME:
            raise McapError("a log time is out of range")
        entries = {channel: INDEX_ENTRY.pack(time, 0)}
        stored = StoredChunk(b"", b"", end - offset, self._crc(offset, end), time, time, entries)
        return LargeChunk(stored, (offset, end), [], 0, Counter({channel: 1}))

    def _attachment(self, offset: int, end: int) -> IntactAttachment:
        """Check an attachment, of any size."""
        is_large = end - offset > LIMIT
        raw = memoryview(self.read(offset, _ATTACHMENT_HEAD if is_large else end - offset))
        first, last = offset + HEAD.size, end - UINT32.size
        (crc,) = UINT32.unpack(self.read(last, UINT32.size))
        checksum = (
            self._crc(first, last) if is_large else zlib.crc32(raw[HEAD.size : last - offset])
        )
        if crc not in {0, checksum}:
            raise McapError("an attachment has another checksum than it claims")
        head = intact_records.attachment_head(raw)
        inner = offset + head.first, offset + head.end
        return IntactAttachment(head.index_record, (offset, end), inner, head.escaped)

    def _crc(self, start: int, end: int) -> int:
        crc = 0
        for place in range(start, end, _PIECE):
            crc = zlib.crc32(self.read(place, min(_PIECE, end - place)), crc)
        return crc

    def _unknown(self, offset: int, opcode: int, length: int) -> IntactRecord:
        """Read a record of a private kind, unless it is a damaged record of a defined kind."""
        with suppress(McapError):
            return self.chunk(offset)
        end = offset + HEAD.size + length
        flipped = [kind for kind in _VARIABLE if (kind ^ opcode).bit_count() == 1]
        if not self.plausible(end) or (end, end) in [self.ends(offset, kind) for kind in flipped]:
            raise McapError("a record of unknown kind, or too short")
        head = self.read(offset, min(MESSAGE.size, end - offset))
        return IntactRecord(offset, end, intact_records.UnknownRecord(head, (offset, end)))

    def _is_padded(self, inner: int, outer: int) -> bool:
        """Return whether a record has trailing fields of a later version of the format.

        Otherwise its length may be wrong, and its tail consists of the records behind it.
        """
        if not inner < outer <= min(inner + _LONGEST_PADDING, self.end):
            return False
        return self.plausible(outer) and not self._are_records(inner, outer)

    def _are_records(self, start: int, end: int) -> bool:
        """Return whether a byte range could consist of complete records."""
        while start + HEAD.size <= end and self.plausible(start):
            start += HEAD.size + self.head(start)[1]
        return start == end

    def _data(self, offset: int, length: int) -> memoryview:
        """Read the data of a chunk, of any length."""
        if not 0 <= length <= LIMIT:
            raise McapError("a chunk claims to be too large")
        if offset + length > self.end:
            raise McapError("a chunk claims to be longer than the file")
        return memoryview(self.read(offset, length))

    def _prove(self, head: ChunkHead, data: memoryview, crc: int) -> tuple[bytes, int]:
        """Decompress a chunk; return content and checksum, which must be `crc` unless that is 0."""
        self.work += head.size
        content = decompress(head, data)
        checksum = zlib.crc32(content)
        if crc not in {0, checksum}:
            raise McapError("a chunk has another checksum than it claims")
        return content, checksum

    def _message(self, offset: int, chained: int) -> IntactRecord:
        opcode, length = self.head(offset)
        end = offset + HEAD.size + length
        if length > LIMIT and chained > 1:
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
        if end - offset > LIMIT:
            return IntactRecord(offset, end, self._large_message(offset, end))
        raw = self.read(offset, end - offset)
        return IntactRecord(offset, end, intact_records.read_message(raw))

    def message_index(self, offset: int) -> tuple[int, NDArray[np.void], int]:
        """Read a message index: entries up to `LAST_TIME` [shape=(n,)], and the offset of its end.

        The entries are of dtype `INDEX_ENTRIES`. Raise `McapError` if there is no message index, or
        it is damaged.
        """
        if self.head(offset)[0] != Opcode.MESSAGE_INDEX:
            raise McapError("here should be a message index")
        outer, inner = self.ends(offset)
        exact = outer == inner or self._is_padded(inner, outer)
        if not exact or outer > self.end or outer - offset > LIMIT:
            raise McapError("a message index is damaged")
        raw = self.read(offset, inner - offset)
        channel, _ = MESSAGE_INDEX.unpack_from(raw, HEAD.size)
        entries = raw[HEAD.size + MESSAGE_INDEX.size :]
        if len(entries) % INDEX_ENTRIES.itemsize:
            raise McapError("a message index is damaged")
        rows = np.frombuffer(entries, INDEX_ENTRIES)
        return channel, rows[rows["time"].astype(np.uint64) <= LAST_TIME], outer
