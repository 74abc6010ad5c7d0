"""What one log consists of, from its index, or by walking from record to record."""

import io
import struct
import zlib
from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
from mcap import records
from mcap.opcode import Opcode
from mcap.records import McapRecord
from numpy.typing import NDArray

from hearthlog.schemas.errors import LogError
from hearthlog.schemas.mcap.formats import (
    CHUNK,
    CHUNK_INDEX,
    CHUNK_INDEX_TAIL,
    FOOTER,
    FOOTER_SIZE,
    HEAD,
    INDEX_OFFSET,
    MAGIC,
    MESSAGE,
    UINT16,
    UINT64,
)
from hearthlog.schemas.mcap.records import LIMIT, McapError, parse
from hearthlog.schemas.storage.byte_ranges import Section, open_file

CHUNKS = np.dtype(
    [
        ("offset", "<i8"),  # of the chunk, or of a run of messages outside of chunks
        ("length", "<i8"),  # in bytes, heads included
        ("index_length", "<i8"),  # of the message indexes behind it; -1 behind a run of messages
        ("size", "<i8"),  # uncompressed
        ("start", "<i8"),  # log time of its first message
        ("end", "<i8"),  # and of its last
        ("channels", "<i8"),  # a place in `LogFile.channel_sets`
    ]
)
ACTIVE_SUFFIX = ".mcap.active"  # of a file that is still being written
_RUN_LIMIT = 1 << 20  # bytes of messages outside of chunks that are read at once


class RecordLocation(NamedTuple):
    """A record in a file; its length includes opcode and length."""

    opcode: int
    offset: int
    length: int


class LogFile:
    """A log, open for reading.

    Parameters
    ----------
    path : Path
        On this machine, or a `upath.UPath` of a store, which is read by ranges.
    indexed : bool
        Whether to look for the chunks at once; without that, `scan_new` finds them.

    Attributes
    ----------
    complete : bool
        Whether the file was finished.
    ended : bool
        Whether `scan_new` came to the end of a finished log.
    header : mcap.records.Header or None
    schemas, channels : dict of int to mcap.records.Schema, mcap.records.Channel
        Of a file without an index, those inside chunks are not among them.
    chunks : np.ndarray [shape=(n,)], of dtype `CHUNKS`
        All that are known so far, by start time.
    channel_sets : list of frozenset of int
        Channels with messages in a chunk. An empty set: it is not known which.
    statistics : mcap.records.Statistics or None
    record_locations : list of RecordLocation
        Of metadata records and attachments.

    Raises
    ------
    LogError
        If it cannot be read, is no MCAP file, or is damaged.
    """

    def __init__(self, path: Path, *, indexed: bool = True) -> None:
        self.path = path
        self.complete = False
        self.ended = False
        self.header: records.Header | None = None
        self.schemas: dict[int, records.Schema] = {}
        self.channels: dict[int, records.Channel] = {}
        self.statistics: records.Statistics | None = None
        self.record_locations: list[RecordLocation] = []
        self.channel_sets: list[frozenset[int]] = []
        self.chunks = np.empty(0, CHUNKS)
        self.end = len(MAGIC)  # of the records that were walked through
        self._file = open_file(path)
        self._sets: dict[frozenset[int], int] = {}
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
        """Bytes of the file: one of this machine may grow, one of a store does not."""
        return self._file.size

    def is_at(self, path: Path) -> bool:
        """Tell whether the file of this name is this one."""
        return self._file.is_at(path)

    def read(self, offset: int, length: int) -> bytes:
        """Read some bytes; fewer at the end of the file."""
        return self._file.read(offset, length)

    def read_into(self, out: memoryview, offset: int) -> None:
        """Read as many bytes as there is room for, or fewer at the end of the file."""
        self._file.read_into(out, offset)

    def record(self, place: RecordLocation) -> McapRecord | None:
        """Read a metadata record, an attachment, or another one that holds no messages."""
        if place.length > LIMIT:
            raise self.damaged(place.offset, "a record claims to be too large")
        content = self.read(place.offset, place.length)[HEAD.size :]
        try:
            return parse(place.opcode, content)
        except (McapError, UnicodeDecodeError) as error:
            raise self.damaged(place.offset, error) from error

    def damaged(self, offset: int, what: object) -> LogError:
        """Make the error that says where this file is damaged."""
        return LogError(
            f"{self.path}: damaged at byte {offset} ({what}); `hearthlog recover` saves the rest"
        )

    def _check_magic(self) -> None:
        magic = self.read(0, len(MAGIC))
        if magic == MAGIC or (self.path.name.endswith(ACTIVE_SUFFIX) and MAGIC.startswith(magic)):
            return  # at first a writer has written less than that
        raise LogError(f"{self.path}: is no MCAP file")

    def _find_chunks(self) -> None:
        size = self.size
        tail = self.read(max(size - FOOTER_SIZE, 0), FOOTER_SIZE)
        self.complete = tail.endswith(MAGIC) and tail[:1] == bytes([Opcode.FOOTER])
        if self.complete:
            footer = parse(Opcode.FOOTER, tail[HEAD.size :])
            assert isinstance(footer, records.Footer)
            if self._read_summary(footer, size - FOOTER_SIZE):
                return
        self.scan_new()

    def _read_summary(self, footer: records.Footer, end: int) -> bool:
        """Read the summary, and return whether it has an index and is sound."""
        start = footer.summary_start
        if not len(MAGIC) <= start < end:
            return False
        rows = array("q")
        crc = 0
        try:
            for place, raw in self._records(start, end):
                crc = zlib.crc32(raw, crc)
                content = raw[HEAD.size :]
                if place.opcode == Opcode.CHUNK_INDEX:
                    rows.extend(self._chunk_index(content))
                else:
                    self._add(parse(place.opcode, content))
            crc = zlib.crc32(self.read(end, HEAD.size + FOOTER.size), crc)
        except (McapError, UnicodeDecodeError, struct.error):
            crc = -1
        counted = self.statistics.message_count if self.statistics else -1
        if crc < 0 or footer.summary_crc not in {0, crc} or (not rows and counted):
            self._forget()
            return False
        opcode, length = HEAD.unpack(self.read(len(MAGIC), HEAD.size))
        self._note(RecordLocation(opcode, len(MAGIC), HEAD.size + length))
        self.chunks = _by_start(np.frombuffer(rows, CHUNKS))
        return True

    def _records(self, start: int, end: int) -> Iterator[tuple[RecordLocation, bytes]]:
        """Read the records of a section one by one, heads included."""
        with io.BufferedReader(Section(self._file, start), 1 << 20) as stream:
            while start < end:
                head = stream.read(HEAD.size)
                opcode, length = HEAD.unpack(head)
                if length > min(LIMIT, end - start - HEAD.size):
                    raise McapError("a record claims to be too large")
                yield RecordLocation(opcode, start, HEAD.size + length), head + stream.read(length)
                start += HEAD.size + length

    def scan_new(self) -> NDArray[np.void]:
        """Walk through the records that were written since the last walk.

        Returns
        -------
        np.ndarray [shape=(n,)], of dtype `CHUNKS`
            The chunks that were met, and the messages outside of chunks.
        """
        rows = array("q")
        chunk: list[int] = []
        ids: set[int] = set()
        for place in self._places(self.size):
            if place.opcode == Opcode.MESSAGE_INDEX and chunk:
                chunk[2] += place.length
                ids.update(UINT16.unpack(self.read(place.offset + HEAD.size, UINT16.size)))
            elif place.opcode == Opcode.MESSAGE and chunk and self._continues(chunk, place):
                _, _, _, size, start, end = self._chunk(place)
                chunk[1:] = [chunk[1] + size, -1, chunk[3] + size, *_span(chunk, start, end)]
            else:
                if chunk:
                    rows.extend([*chunk, self._channel_set(frozenset(ids))])
                chunk, ids = self._chunk(place), set()
                self._note(place)
        if chunk:  # its indexes may not all be there yet
            rows.extend([*chunk[:2], min(chunk[2], 0), *chunk[3:], self._channel_set(frozenset())])
        chunks = _by_start(np.frombuffer(rows, CHUNKS))
        if len(chunks):
            self.chunks = _by_start(np.concatenate([self.chunks, chunks]))
        return chunks

    @staticmethod
    def _continues(run: list[int], place: RecordLocation) -> bool:
        return run[2] < 0 and run[0] + run[1] == place.offset and run[1] < _RUN_LIMIT

    def _note(self, place: RecordLocation) -> None:
        if place.opcode in {Opcode.METADATA, Opcode.ATTACHMENT}:
            self.record_locations.append(place)
        elif place.opcode in {Opcode.HEADER, Opcode.SCHEMA, Opcode.CHANNEL}:
            self._add(self.record(place))

    def _places(self, size: int) -> Iterator[RecordLocation]:
        """Go from record to record, up to where the file ends or is cut."""
        while True:
            head = self.read(self.end, HEAD.size)
            if len(head) < HEAD.size and not self.complete:
                return
            opcode, length = HEAD.unpack(head) if len(head) == HEAD.size else (0, 0)
            if opcode in {Opcode.DATA_END, Opcode.FOOTER}:
                self.ended = True
                return
            if opcode == 0 or self.end + HEAD.size + length > size:
                if self.complete:
                    raise self.damaged(self.end, "a record claims to be longer than the file")
                return
            yield RecordLocation(opcode, self.end, HEAD.size + length)
            self.end += HEAD.size + length

    def _chunk(self, place: RecordLocation) -> list[int]:
        """Describe a chunk, or a message outside of one; nothing if this is neither."""
        if place.opcode not in {Opcode.CHUNK, Opcode.MESSAGE}:
            return []
        head = self.read(place.offset, min(place.length, HEAD.size + CHUNK.size))
        try:
            if place.opcode == Opcode.CHUNK:
                start, end, size, _, _ = CHUNK.unpack_from(head, HEAD.size)
                index_length = 0
            else:
                start = end = MESSAGE.unpack_from(head)[4]
                size, index_length = place.length, -1
        except struct.error as error:
            raise self.damaged(place.offset, "a record is too short") from error
        if max(start, end, size) >= 1 << 63:
            raise self.damaged(place.offset, "a number is out of range")
        return [place.offset, place.length, index_length, size, start, end]

    def _chunk_index(self, content: bytes) -> tuple[int, ...]:
        start, end, offset, length, entries = CHUNK_INDEX.unpack_from(content)
        first = CHUNK_INDEX.size
        offsets = INDEX_OFFSET.iter_unpack(content[first : first + entries])
        ids = frozenset(channel for channel, _ in offsets)
        first += entries
        index_length, text = CHUNK_INDEX_TAIL.unpack_from(content, first)
        (size,) = UINT64.unpack_from(content, first + CHUNK_INDEX_TAIL.size + text + UINT64.size)
        if max(offset + length + index_length, start, end, size) >= 1 << 63:
            raise McapError("a number is out of range")
        return offset, length, index_length, size, start, end, self._channel_set(ids)

    def _channel_set(self, ids: frozenset[int]) -> int:
        if ids not in self._sets:
            self._sets[ids] = len(self.channel_sets)
            self.channel_sets.append(ids)
        return self._sets[ids]

    def _add(self, record: McapRecord | None) -> None:
        if isinstance(record, records.Header):
            self.header = record
        elif isinstance(record, records.Schema):
            self.schemas.setdefault(record.id, record)
        elif isinstance(record, records.Channel):
            self.channels.setdefault(record.id, record)
        elif isinstance(record, records.Statistics):
            self.statistics = record
        elif isinstance(record, records.AttachmentIndex):
            self._add_location(Opcode.ATTACHMENT, record)
        elif isinstance(record, records.MetadataIndex):
            self._add_location(Opcode.METADATA, record)

    def _add_location(
        self, opcode: int, index: records.AttachmentIndex | records.MetadataIndex
    ) -> None:
        self.record_locations.append(RecordLocation(opcode, index.offset, index.length))

    def _forget(self) -> None:
        self.schemas.clear()
        self.channels.clear()
        self.record_locations.clear()
        self.channel_sets.clear()
        self._sets.clear()
        self.statistics = None


def _span(chunk: list[int], start: int, end: int) -> tuple[int, int]:
    return min(chunk[4], start), max(chunk[5], end)


def _by_start(chunks: NDArray[np.void]) -> NDArray[np.void]:
    return chunks[np.argsort(chunks["start"], kind="stable")]
