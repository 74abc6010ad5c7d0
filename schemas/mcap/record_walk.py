"""From record to record through a file that may be written still."""

import io
from collections.abc import Callable, Iterator

from mcap.exceptions import McapError

from hearthlog.schemas.mcap.chunk_table import RecordLocation
from hearthlog.schemas.mcap.formats import CHUNK, HEAD
from hearthlog.schemas.mcap.records import LIMIT
from hearthlog.schemas.storage.byte_ranges import LocalFile, Section, StoredFile

_RECORD_HEAD = HEAD.size + CHUNK.size  # bytes that tell where a record ends and what it spans
_WINDOW = 1 << 14  # bytes that are read at once: an hour has half a million records


def walk_records(
    read: Callable[[int, int], bytes], start: int
) -> Iterator[tuple[int, int, int, bytes]]:
    """Go from record to record, as long as there is the head of one.

    Parameters
    ----------
    read : callable
        Returns bytes of the file from an offset on, fewer than asked for at its end.

    Yields
    ------
    opcode, offset, length : int
        Of the record, which may claim to be longer than the file; with opcode and length.
    head : bytes
        Its first bytes, opcode and length included, or all of them.
    """
    window, first = b"", start
    while True:
        place = start - first
        if not 0 <= place <= len(window) - _RECORD_HEAD:
            window, first, place = read(start, _WINDOW), start, 0
        head = window[place : place + _RECORD_HEAD]
        if len(head) < HEAD.size:
            return
        opcode, length = HEAD.unpack_from(head)
        length += HEAD.size
        yield opcode, start, length, head[:length]
        start += length


def read_records(
    file: LocalFile | StoredFile, start: int, end: int
) -> Iterator[tuple[RecordLocation, bytes]]:
    """Read the records of a section one by one.

    Parameters
    ----------
    start, end : int
        Of the section, in bytes.

    Raises
    ------
    McapError
        If a record is longer than the section, or than `LIMIT`.
    """
    with io.BufferedReader(Section(file, start), 1 << 20) as stream:
        while start < end:
            head = stream.read(HEAD.size)
            opcode, length = HEAD.unpack(head)
            if length > min(LIMIT, end - start - HEAD.size):
                raise McapError("a record claims to be too large")
            yield RecordLocation(opcode, start, HEAD.size + length), head + stream.read(length)
            start += HEAD.size + length
