"""Undamaged pieces of a truncated or damaged MCAP file, and its damages.

The file is scanned record by record. Behind damaged data, the next complete record is searched for,
so a wrong length hides nothing behind it.
"""

from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
from mcap import records
from mcap.exceptions import McapError
from mcap.opcode import Opcode

from hearthlog.schemas.files import LocalFile
from hearthlog.schemas.mcap.raw_messages import CHUNK_HEAD_LIMIT, find_chunk_heads
from hearthlog.schemas.mcap.records import LAST_TIME, LIMIT, MAGIC, MESSAGE, Definition, Definitions
from hearthlog.schemas.salvage.damage import Damage, DamageList, loss_in
from hearthlog.schemas.salvage.index import MessageIndexes, read_index
from hearthlog.schemas.salvage.intact_records import (
    SHORTEST,
    IntactAttachment,
    IntactChunk,
    IntactPiece,
    IntactRecord,
    LargeChunk,
    UnknownRecord,
    chunk_messages,
    find_record_heads,
)
from hearthlog.schemas.salvage.record_verifier import RecordVerifier

_VAIN = 8
_KEPT_LIMIT = 128 << 20  # maximum bytes of definitions, names and indexes kept in memory
_KEPT_EACH = 256
_WINDOW = 1 << 20
_FRAMED = {Opcode.CHUNK, Opcode.ATTACHMENT, Opcode.MESSAGE_INDEX, Opcode.METADATA}

_LATE = "log times after the year 2262"

Piece = records.Metadata | records.Message | IntactPiece


class _Places(NamedTuple):
    """Candidate record offsets in a window of the file, ascending: chunks, and all records."""

    window: int
    chunks: list[int]
    heads: list[int]


class Salvage:
    """Reader of the undamaged pieces of a truncated or damaged MCAP file.

    The time grows with the actual `size` of the file, in bytes, not with stated sizes: undamaged
    data are read once, and futile reads of false records are limited to `_VAIN` times the bytes
    passed so far (`offset`) plus `4 * LIMIT`. Beyond the limit, data are skipped and reported.
    `unnamed` has, by channel without a definition before its messages, their number, first and last
    log time, and byte range in the file. `escaped` has the names found so far that are not UTF-8,
    or of records with other texts that are not. Raise `LogError` if the file cannot be read.
    """

    def __init__(self, path: Path, definitions: Iterable[Definition] = ()) -> None:
        self.path = path
        self.header: records.Header | None = None
        self.definitions = Definitions()
        self._damages = DamageList()
        self.unnamed = self._damages.unnamed
        self._file = LocalFile(path)
        self.size = self._file.size
        self.offset = 0
        self.escaped: dict[str, None] = {}
        self._reader = RecordVerifier(self._file, self.size)
        start = self._reader.read(0, len(MAGIC))
        self.is_mcap = bool(start) and MAGIC.startswith(start)
        self._index = read_index(RecordVerifier(self._file, self.size), _KEPT_LIMIT)
        self.complete = self._index is not None and not self._index.moved
        self.expected = None if self._index is None else self._index.messages
        if self._index is not None:
            self._reader.end = self._index.start
            definitions = [*self._index.definitions, *definitions]
        for record in definitions:
            self.definitions.add(record)
        self._message_indexes = MessageIndexes(self._reader)
        self._next: IntactRecord | None = None  # found by the last search
        self._places = _Places(-1, [], [])  # of the last searched window
        self._vain = self._kept = 0
        self._cost = 0  # bytes of the last futile read
        self._has_chunks = False
        self._ended = False  # whether the data ended: the index follows
        self._astray = False  # whether the position may be inside a damaged chunk
        self._last_index: int | None = None  # start of the last record, if it is a message index

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def damages(self) -> list[Damage]:
        """List the damages found so far by offset, then the messages of undefined channels."""
        return self._damages.resolve(self.definitions)

    @property
    def damage_count(self) -> int:
        """Number of damages found so far; they are the first entries of `damages`."""
        return len(self._damages)

    def pieces(self) -> Iterator[Piece]:
        """Read all undamaged pieces, in file order: `Metadata`, `Message` or an `IntactPiece`.

        Chunks have verified checksums and a rebuilt message index. They hold no messages of
        undefined channels: in chunks with such messages, the other messages are yielded one by one.
        """
        yield from self._walk()
        if self._index is not None:
            self._damages.add_unmet(self._index.unmet(), self._index.unmet_names())
        else:
            self._damages.add_listed(self._message_indexes.unmet(self.offset))

    def _walk(self) -> Iterator[Piece]:
        self.offset = len(MAGIC) if self.is_mcap else 0
        while self.offset < self._reader.end:
            offset = self.offset
            try:
                intact = self._at(offset)
            except McapError as error:
                if self._ended and MAGIC.startswith(self._reader.read(offset, len(MAGIC) + 1)):
                    return
                self.offset = self._pass(offset, str(error))
                continue
            if intact.corrected:
                why = f"{intact.corrected} is wrong"
                self._damages.add(Damage(offset, intact.end, why, exact=intact.proved))
            self.escaped.update(dict.fromkeys(intact.escaped))
            self.offset = intact.end
            self._last_index = offset if intact.record is None else None
            (self._index or self._message_indexes).meet(intact)
            yield from self._take(intact)
            del intact  # frees memory before the next record, which may be as large

    def _at(self, offset: int, *, searching: bool = False, chunk: bool = False) -> IntactRecord:
        """Read the record at an offset; raise McapError if there is no complete one."""
        if self._next is not None and self._next.offset == offset:
            intact, self._next = self._next, None
            return intact
        reader = self._reader
        self._cost = 0
        if self._vain > 4 * LIMIT + _VAIN * offset:
            raise McapError("too much looks like records here and is none")
        if reader.inner > (1 << 20) + 4 * self.size:
            raise McapError("the file holds more messages than one of its size can")
        work = reader.work
        try:
            intact = reader.chunk(offset) if chunk else reader.intact(offset, 3 if searching else 1)
            self._count_kept(intact)
            self._doubt(intact, searching=searching)
        except McapError:
            self._cost = reader.work - work
            raise
        return intact

    def _count_kept(self, intact: IntactRecord) -> None:
        """Count the bytes to keep of a record; raise McapError if they are too many."""
        record, size = intact.record, _KEPT_EACH
        if isinstance(record, IntactChunk | LargeChunk):
            size += 16 * len(record.stored.entries)
            size += sum(_size(definition) for definition in record.definitions)
        elif isinstance(record, Definition):
            size += _size(record)
        elif isinstance(record, IntactAttachment):
            size += len(record.index_record.name) + len(record.index_record.media_type)
        elif isinstance(record, records.Metadata):
            size += len(record.name)
        else:
            return
        if self._kept + size > _KEPT_LIMIT:
            raise McapError("the file holds more definitions than can be kept")
        self._kept += size

    def _doubt(self, intact: IntactRecord, *, searching: bool) -> None:
        """Raise McapError for a possibly misread or accidental record."""
        unproved = records.Message | Definition | UnknownRecord
        if self._astray and isinstance(intact.record, unproved):
            raise McapError("what is in a damaged chunk is not proved")
        if isinstance(intact.record, records.Message) and self._has_chunks:
            if searching or self._ended:
                raise McapError("messages are in chunks here")
            if self._reader.like_message_index(intact.offset):
                raise McapError("a message index has become a message")
        if isinstance(intact.record, UnknownRecord) and self._like_message(intact.record.head):
            raise McapError("a message has become another record")
        if not searching:
            return
        if isinstance(intact.record, records.Message) and intact.record.log_time > LAST_TIME:
            raise McapError("a log time is out of range")
        if not isinstance(intact.record, IntactChunk) and not self._reader.plausible(intact.end):
            raise McapError("no record begins where this one ends")

    def _like_message(self, record: bytes) -> bool:
        """Return whether an unknown record is a message of a channel with a flipped bit."""
        if len(record) < MESSAGE.size or (record[0] ^ Opcode.MESSAGE).bit_count() != 1:
            return False
        _, _, channel, _, log_time, _ = MESSAGE.unpack_from(record)
        return self.definitions.defines(channel) and 0 < log_time <= LAST_TIME

    def _pass(self, offset: int, why: str) -> int:
        """Record a damage at an offset; return the offset of the next complete record."""
        reader, cost = self._reader, self._cost
        self._message_indexes.give_up(offset)
        if (chunk := self._chunk_in_last_index(offset)) is not None:
            return chunk
        opcode = reader.read(offset, 1)[0]
        ends: tuple[int, ...] = ()
        with suppress(McapError):
            ends = reader.ends(offset)
        if opcode == Opcode.CHUNK:
            self._has_chunks = True
        else:  # perhaps only this byte is damaged
            try:
                self._next = self._at(offset, chunk=True)
            except McapError:
                cost += self._cost
            else:
                return offset
        end = -1
        if opcode in _FRAMED:
            end = next((e for e in sorted(ends) if e < reader.end and reader.plausible(e)), -1)
        if end < 0:
            self._vain += cost  # as its bytes are read again
            self._astray = opcode == Opcode.CHUNK
            end = self._search(offset + 1)
        cut = end == self.size and SHORTEST[opcode] < LIMIT and min(ends, default=end + 1) > end
        if cut:
            why = "the file ends within a record"
        elif not any(reader.read(offset, 64)):
            why = "zeros"
        if self._ended:  # part of the index
            self._damages.add(Damage(offset, end, why, cut=cut))
        else:
            lost = loss_in(reader, offset, end, ends, self._index)
            self._damages.add(Damage(offset, end, why, {}, *lost[1:], cut), lost.messages)
        return end

    def _chunk_in_last_index(self, offset: int) -> int | None:
        """Return the offset of a complete chunk within the supposed message index before an offset.

        A message index has no checksum: if bytes are missing, its end may be inside a later chunk.
        """
        index, self._last_index = self._last_index, None
        if index is None:
            return None
        place = self._search(index + 1, before=offset)
        if place == offset:
            return None
        self._damages.add(Damage(index, place, "a message index is damaged"))
        return place

    def _search(self, start: int, *, before: int | None = None) -> int:
        """Return the offset of the next complete record, or of the end of the data.

        With `before`, search only for chunks up to this offset; return it if there is none.
        """
        end = self._reader.end if before is None else before
        while start < end:
            window = start // _WINDOW
            if self._places.window != window:
                self._places = self._find_places(window)
            chunks, heads = self._places.chunks, self._places.heads
            places = heads if before is None else chunks
            for number in range(bisect_left(places, start), bisect_left(places, end)):
                place = places[number]
                try:
                    self._next = self._at(place, searching=True, chunk=_is_in(chunks, place))
                except McapError:
                    self._vain += self._cost
                else:
                    return place
            start = (window + 1) * _WINDOW
        return end

    def _find_places(self, window: int) -> "_Places":
        start = window * _WINDOW
        size = min(_WINDOW + CHUNK_HEAD_LIMIT, self._reader.end - start)
        data = self._file.read(start, size)
        chunks = {start + place for place in find_chunk_heads(data) if place < _WINDOW}
        heads = {start + place for place in find_record_heads(data[: _WINDOW + 8])}
        chunks |= {place for place in heads if data[place - start] == Opcode.CHUNK}
        return _Places(window, sorted(chunks), sorted(chunks | heads))

    def _take(self, intact: IntactRecord) -> Iterator[Piece]:
        """Register the contents of a record; yield it if it belongs into the new log."""
        record = intact.record
        if isinstance(record, records.Header):
            self.header = self.header or record
            self._ended = False
        elif isinstance(record, records.DataEnd | records.Footer):
            self._ended = True
        elif isinstance(record, Definition):
            if not self.definitions.add(record) and not self._ended and self._index is None:
                self.definitions.doubt(record)
        elif isinstance(record, IntactChunk):
            self._ended, self._astray, self._has_chunks = False, False, True
            yield from self._take_chunk(record, intact)
        elif isinstance(record, LargeChunk):
            self._ended = False
            self._has_chunks |= record.data[0] != intact.offset
            yield from self._take_large(record, intact)
        elif isinstance(record, records.Message):
            self._ended = False
            yield from self._take_message(record, intact)
        elif isinstance(record, records.Metadata | IntactAttachment) or (
            isinstance(record, UnknownRecord) and not self._ended
        ):
            yield record

    def _take_large(self, chunk: LargeChunk, intact: IntactRecord) -> Iterator[Piece]:
        """Yield a chunk for an unchanged copy, if all its channels are defined."""
        for record in chunk.definitions:
            if not self.definitions.add(record):
                self.definitions.doubt(record)
        if chunk.unopened:
            why = f"{chunk.unopened}, and is copied unopened,"
            self._damages.add(Damage(intact.offset, intact.end, why, sound=True))
            entries = {n: e for n, e in chunk.stored.entries.items() if self.definitions.defines(n)}
            yield chunk._replace(stored=chunk.stored._replace(entries=entries))
            return
        late: Counter[int] = Counter()
        unknown = 0
        for number in chunk.stored.entries:
            times = chunk.stored.times(number).astype(np.uint64)
            late[number] = int((times > LAST_TIME).sum())
            if not self.definitions.defines(number):
                span = int(times.min()), int(times.max())
                self._damages.add_unnamed(number, len(times), span, intact)
                unknown += 1
        self._add_late(intact, +late)
        if chunk.stored.entries and not unknown:
            yield chunk

    def stored(self, start: int, end: int) -> Iterator[bytes]:
        """Read a byte range of the file in pieces of 1 MiB."""
        for place in range(start, end, _WINDOW):
            yield self._file.read(place, min(_WINDOW, end - place))

    def _take_message(self, message: records.Message, intact: IntactRecord) -> Iterator[Piece]:
        """Yield a message outside of chunks, if its channel is defined and its time is valid."""
        if message.log_time > LAST_TIME:
            self._add_late(intact, {message.channel_id: 1})
        elif self.definitions.defines(message.channel_id):
            yield message
        else:
            times = message.log_time, message.log_time
            self._damages.add_unnamed(message.channel_id, 1, times, intact)

    def _add_late(self, intact: IntactRecord, messages: Mapping[int, int]) -> None:
        """Register messages that are skipped because readers cannot represent their log times."""
        if messages:
            self._damages.add(Damage(intact.offset, intact.end, _LATE, sound=True), dict(messages))

    def _take_chunk(self, chunk: IntactChunk, intact: IntactRecord) -> Iterator[Piece]:
        """Yield a chunk if all its channels are defined; else its messages of defined ones."""
        self._add_late(intact, chunk.late)
        agree = True
        for record in chunk.definitions:
            if not self.definitions.add(record):
                self.definitions.doubt(record)
                agree = False
        defined = {number: self.definitions.defines(number) for number in chunk.stored.entries}
        if agree and all(defined.values()):
            if defined:
                yield chunk
            return
        for number in chunk.stored.entries:
            if not defined[number]:
                times = chunk.stored.times(number)
                span = int(times.min()), int(times.max())
                self._damages.add_unnamed(number, len(times), span, intact)
        if any(defined.values()):
            for message in chunk_messages(chunk.stored):
                if defined[message.channel_id]:
                    yield message


def _is_in(ascending: list[int], number: int) -> bool:
    place = bisect_left(ascending, number)
    return place < len(ascending) and ascending[place] == number


def _size(record: Definition) -> int:
    if isinstance(record, records.Schema):
        return _KEPT_EACH + len(record.data) + len(record.name)
    texts = [record.topic, record.message_encoding, *record.metadata, *record.metadata.values()]
    return _KEPT_EACH + sum(map(len, texts))
