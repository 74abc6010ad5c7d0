"""Sequential reader of a file's records that skips damaged parts."""

import bisect
import zlib
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import McapRecord

from hearthlog.analyzer.doctor.findings import RECOVER, Findings
from hearthlog.schemas.files import LocalFile
from hearthlog.schemas.mcap.raw_messages import CHUNK_HEAD_LIMIT, find_chunk_heads
from hearthlog.schemas.mcap.records import HEAD, LIMIT, MAGIC, encode, parse

_PIECE = 1 << 20  # bytes
_READ_ANYWAY = 1 << 30  # bytes; a longer skip may be a sparse hole of any length
_SIZE_LIMIT = 16 << 20  # bytes of a record other than a chunk or an attachment
_CUT = 2 << 20  # bytes; a killed writer leaves no longer remainder


class Record(NamedTuple):
    """A record in a file."""

    opcode: int
    offset: int
    length: int  # bytes, including opcode and length
    content: bytes
    crc: int | None  # CRC-32 of the file before the record; None if some bytes were not read


def parse_strictly(
    findings: Findings, opcode: int, offset: int, content: bytes
) -> McapRecord | None:
    """Parse the record at byte `offset` (or that of its chunk); report a damaged or too large one.

    A record is damaged if it is too short, has invalid UTF-8, or repeats a key of a map. None if
    the record cannot be parsed, is too large for hearthlog, or is of an unknown kind.
    """
    if len(content) > _SIZE_LIMIT and opcode != Opcode.ATTACHMENT:
        what = f"{name_of(opcode)} of {len(content)} bytes is larger than hearthlog reads"
        findings.error("too-large", what, RECOVER, offset=offset)
        return None
    try:
        record = parse(opcode, content)
    except (McapError, UnicodeDecodeError) as error:
        findings.error("fields", f"{name_of(opcode)}: {error}", RECOVER, offset=offset)
        return None
    if record is None or opcode == Opcode.ATTACHMENT:
        return record
    if not content.startswith(encode(record)[HEAD.size :]):  # later versions may append fields
        what = f"{name_of(opcode)}: a map in it has a key twice, or another length than it says"
        findings.error("fields", what, RECOVER, offset=offset)
    return record


def name_of(opcode: int) -> str:
    """Return the name of a kind of record, such as `Chunk index`."""
    try:
        return Opcode(opcode).name.capitalize().replace("_", " ")
    except ValueError:
        return f"record of opcode {opcode}"


class RecordWalk:
    """All records of a file, up to its size when opened, except those inside chunks.

    `offsets` are bytes at which records begin, ascending, from the index of the file: the walk
    resumes there after damage.
    """

    def __init__(
        self, file: LocalFile, findings: Findings, offsets: Sequence[int], *, finished: bool
    ) -> None:
        self.size = file.size
        self.offset = 0  # of the next byte
        self.losses = 0  # number of skipped places
        self.skipped = False  # whether a record was too large to be checked
        self._crc: int | None = 0  # of all bytes before `offset`; None after a long skip
        self._file = file
        self._findings = findings
        self._finished = finished
        self._offsets = offsets

    @property
    def damaged(self) -> bool:
        """Whether any part was skipped."""
        return self.losses > 0

    def __iter__(self) -> Iterator[Record]:
        self.take(len(MAGIC))
        while (rest := self.size - self.offset) > 0:
            offset, crc = self.offset, self._crc
            head = self.take(HEAD.size)
            if self._finished and head == MAGIC:
                return
            opcode, length = HEAD.unpack(head) if len(head) == HEAD.size else (0, 0)
            if opcode == 0 or length > rest - HEAD.size:
                if not self._lost(offset, rest):
                    return
            elif length > LIMIT:
                self.losses += 1
                self.skipped = True
                what = f"a record of {length} bytes is larger than hearthlog reads: not checked"
                self._findings.warning("too-large", what, offset=offset)
                self._skip(offset + HEAD.size + length)
            else:
                yield Record(opcode, offset, HEAD.size + length, self.take(length), crc)
                if opcode == Opcode.FOOTER:
                    return

    def take(self, length: int) -> bytes:
        """Read the next bytes; fewer at the end of the file."""
        data = self._file.read(self.offset, min(length, self.size - self.offset))
        self.offset += len(data)
        if self._crc is not None:
            self._crc = zlib.crc32(data, self._crc)
        return data

    def _skip(self, offset: int) -> None:
        """Move to a later byte; skipped bytes are read for the checksum, up to 1 GiB."""
        if offset - self.offset > _READ_ANYWAY:
            self._crc = None
            self.offset = offset
        while self.offset < offset and self.take(min(_PIECE, offset - self.offset)):
            pass

    def _lost(self, offset: int, rest: int) -> bool:
        """Report a missing record; return whether the walk can resume."""
        following = next(iter(self._offsets[bisect.bisect_right(self._offsets, offset) :]), None)
        if following is None:
            following = self._search(offset + 1)
        if following is None and not self._finished and rest < _CUT:
            return False  # reported as an unfinished file
        self.losses += 1
        where = "nor behind it" if following is None else f"the next one at byte {following}"
        self._findings.error("framing", f"no record begins here; {where}", RECOVER, offset=offset)
        if following is None:
            return False
        self._skip(following)
        return self.offset == following

    def _search(self, offset: int) -> int | None:
        """Find the next compressed chunk that ends within the file."""
        while offset < self.size:
            window = self._file.read(offset, _PIECE + CHUNK_HEAD_LIMIT)
            for place in find_chunk_heads(window):
                opcode, length = HEAD.unpack_from(window, place)
                end = offset + place + HEAD.size + length
                if opcode == Opcode.CHUNK and end <= self.size:
                    return offset + place
            offset += _PIECE
        return None
