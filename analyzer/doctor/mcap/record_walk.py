"""From record to record through a file, over what is damaged to where it goes on."""

import bisect
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from mcap.opcode import Opcode

from hearthlog.analyzer.doctor.findings import RECOVER, Findings
from hearthlog.analyzer.doctor.mcap.byte_source import ByteSource
from hearthlog.schemas.mcap.raw_messages import CHUNK_HEAD_LIMIT, find_chunk_heads
from hearthlog.schemas.mcap.records import HEAD, LIMIT, MAGIC

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
