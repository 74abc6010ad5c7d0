"""Sequential reader of a file's records that skips damaged parts."""

import bisect
import os
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple, Self

from mcap.opcode import Opcode

from hearthlog.analyzer.doctor.findings import RECOVER, Findings
from hearthlog.schemas.files import open_regular
from hearthlog.schemas.mcap.raw_messages import CHUNK_HEAD_LIMIT, find_chunk_heads
from hearthlog.schemas.mcap.records import HEAD, LIMIT, MAGIC

_PIECE = 1 << 20  # bytes
_READ_ANYWAY = 1 << 30  # bytes; a longer skip may be a sparse hole of any length


class ByteSource:
    """Bytes of a file, up to its size when opened.

    Raise `OSError` if the file cannot be opened, or is no regular file.
    """

    def __init__(self, path: Path) -> None:
        self._stream = os.fdopen(open_regular(path), "rb", buffering=_PIECE)
        self.size = os.fstat(self._stream.fileno()).st_size
        self.offset = 0  # of the next byte
        self.crc: int | None = 0  # checksum of all bytes before `offset`; None after a long skip

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stream.close()

    def take(self, length: int) -> bytes:
        """Read the next bytes, and add them to the checksum.

        Parameters
        ----------
        length : int
            Bytes; fewer are returned at the end of the file.
        """
        data = self._stream.read(min(length, self.size - self.offset))
        self.offset += len(data)
        if self.crc is not None:
            self.crc = zlib.crc32(data, self.crc)
        return data

    def skip(self, offset: int) -> None:
        """Move to a later byte; skipped bytes are read for the checksum, up to 1 GiB.

        Parameters
        ----------
        offset : int
            Byte of the file, from 0; ignored if before the next byte.
        """
        if offset - self.offset > _READ_ANYWAY:
            self.crc = None
            self.offset = self._stream.seek(offset)
        while self.offset < offset and self.take(min(_PIECE, offset - self.offset)):
            pass

    def tail(self, length: int) -> bytes:
        """Read the last bytes of the file, without changing `offset`.

        Parameters
        ----------
        length : int
            Bytes; fewer are returned for a shorter file.
        """
        return self.at(max(self.size - length, 0), length)

    def at(self, offset: int, length: int) -> bytes:
        """Read bytes anywhere in the file, without changing `offset`.

        Parameters
        ----------
        offset : int
            Byte of the file, from 0.
        length : int
            Bytes; fewer are returned at the end of the file.
        """
        return os.pread(self._stream.fileno(), length, offset)


_WINDOW = 1 << 20  # bytes
_CUT = 2 << 20  # bytes; a killed writer leaves no longer remainder


class Record(NamedTuple):
    """A record in a file."""

    opcode: int
    offset: int
    length: int  # bytes, including opcode and length
    content: bytes
    crc: int | None  # CRC-32 of the file before the record; None if some bytes were not read


class RecordWalk:
    """All records of a file, except those inside chunks.

    Parameters
    ----------
    offsets : sequence of int
        Bytes at which records begin, ascending, from the index of the file: the walk resumes
        there after damage.
    """

    def __init__(
        self, source: ByteSource, findings: Findings, offsets: Sequence[int], *, finished: bool
    ) -> None:
        self.losses = 0  # number of skipped places
        self.skipped = False  # whether a record was too large to be checked
        self._source = source
        self._findings = findings
        self._finished = finished
        self._offsets = offsets

    @property
    def damaged(self) -> bool:
        """Whether any part was skipped."""
        return self.losses > 0

    def __iter__(self) -> Iterator[Record]:
        source = self._source
        while (rest := source.size - source.offset) > 0:
            offset, crc = source.offset, source.crc
            head = source.take(HEAD.size)
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
                source.skip(offset + HEAD.size + length)
            else:
                yield Record(opcode, offset, HEAD.size + length, source.take(length), crc)
                if opcode == Opcode.FOOTER:
                    return

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
        self._source.skip(following)
        return self._source.offset == following

    def _search(self, offset: int) -> int | None:
        """Find the next compressed chunk that ends within the file."""
        source = self._source
        while offset < source.size:
            window = source.at(offset, _WINDOW + CHUNK_HEAD_LIMIT)
            for place in find_chunk_heads(window):
                opcode, length = HEAD.unpack_from(window, place)
                end = offset + place + HEAD.size + length
                if opcode == Opcode.CHUNK and end <= source.size:
                    return offset + place
            offset += _WINDOW
        return None
