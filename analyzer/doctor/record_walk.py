"""The records of a file, read once from its beginning to its end, past what is damaged."""

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
_READ_ANYWAY = 1 << 30  # bytes; what is longer may be a hole in the file, and has no end


class ByteSource:
    """The bytes of a file, as many as it had when it was opened.

    Raise `OSError` if it cannot be opened, or is no regular file.
    """

    def __init__(self, path: Path) -> None:
        self._stream = os.fdopen(open_regular(path), "rb", buffering=_PIECE)
        self.size = os.fstat(self._stream.fileno()).st_size
        self.offset = 0  # of the next byte
        self.crc: int | None = 0  # checksum of all bytes before that; None if some were not read

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
        """Go on to a later byte; what is passed over is read for the checksum, up to 1 GiB.

        Parameters
        ----------
        offset : int
            Byte of the file, from 0; an earlier one than the next changes nothing.
        """
        if offset - self.offset > _READ_ANYWAY:
            self.crc = None
            self.offset = self._stream.seek(offset)
        while self.offset < offset and self.take(min(_PIECE, offset - self.offset)):
            pass

    def tail(self, length: int) -> bytes:
        """Read the last bytes of the file, and leave `offset` as it is.

        Parameters
        ----------
        length : int
            Bytes; fewer are returned of a shorter file.
        """
        return self.at(max(self.size - length, 0), length)

    def at(self, offset: int, length: int) -> bytes:
        """Read bytes anywhere in the file, and leave `offset` as it is.

        Parameters
        ----------
        offset : int
            Byte of the file, from 0.
        length : int
            Bytes; fewer are returned at the end of the file.
        """
        return os.pread(self._stream.fileno(), length, offset)


_WINDOW = 1 << 20  # bytes
_CUT = 2 << 20  # bytes; a longer end was not left by a writer that was killed


class Record(NamedTuple):
    """A record in a file."""

    opcode: int
    offset: int
    length: int  # in bytes, opcode and length included
    content: bytes
    crc: int | None  # CRC-32 of the file up to here, if all of it was read


class RecordWalk:
    """All records of a file, those inside chunks excepted.

    Parameters
    ----------
    offsets : sequence of int
        Bytes at which records begin, ascending, as the index of the file has them: here the walk
        goes on when it has lost its way.
    """

    def __init__(
        self, source: ByteSource, findings: Findings, offsets: Sequence[int], *, finished: bool
    ) -> None:
        self.losses = 0  # how often something was passed over
        self.skipped = False  # whether something was too large to be checked
        self._source = source
        self._findings = findings
        self._finished = finished
        self._offsets = offsets

    @property
    def damaged(self) -> bool:
        """Whether something was passed over."""
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
        """Say that here is no record; tell whether there is a place to go on from."""
        following = next(iter(self._offsets[bisect.bisect_right(self._offsets, offset) :]), None)
        if following is None:
            following = self._search(offset + 1)
        if following is None and not self._finished and rest < _CUT:
            return False  # which is reported as an unfinished file
        self.losses += 1
        where = "nor behind it" if following is None else f"the next one at byte {following}"
        self._findings.error("framing", f"no record begins here; {where}", RECOVER, offset=offset)
        if following is None:
            return False
        self._source.skip(following)
        return self._source.offset == following

    def _search(self, offset: int) -> int | None:
        """Find the next compressed chunk that is not longer than the file."""
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
