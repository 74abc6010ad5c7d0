"""The records inside of a chunk, and the chunks inside of a file that has lost its way."""

import re
import struct
from collections.abc import Iterator

import numpy as np
from mcap.exceptions import McapError

from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.mcap.formats import CHUNK, HEAD, INDEX_ENTRIES
from hearthlog.schemas.mcap.raw_messages import gather_heads

_COMPRESSED = re.compile(  # from the length of the compression's name on, with the data's magic
    rb"\x04\0\0\0zstd.{8}\x28\xb5\x2f\xfd|\x03\0\0\0lz4.{8}\x04\x22\x4d\x18", re.DOTALL
)
_BEFORE_COMPRESSED = HEAD.size + CHUNK.size - 4
CHUNK_HEAD_LIMIT = 64  # bytes, in which the head of a compressed chunk and its data's magic fit


def iterate_records(
    content: bytes | memoryview, start: int = 0, end: int | None = None
) -> Iterator[tuple[int, int, int]]:
    """Go from record to record in the content of a chunk.

    Parameters
    ----------
    start : int
        Byte of the content at which the first record begins.
    end : int, optional
        Byte before which the last record ends; None for the end of the content.

    Yields
    ------
    start, end : int
        Bytes of the content at which the record begins, with its opcode, and before which it ends.

    Raises
    ------
    McapError
        If the last one is cut, or claims to be longer than the content.
    """
    last = len(content) if end is None else end
    unpack = HEAD.unpack_from
    try:
        while start < last:
            opcode, length = unpack(content, start)
            following = start + 9 + length
            if following > last:
                raise McapError("a record in a chunk claims to be longer than the chunk")
            yield opcode, start, following
            start = following
    except struct.error as error:
        raise McapError("a record in a chunk is cut") from error


def index_messages(content: bytes | memoryview, starts: Int64) -> dict[int, bytes]:
    """Make the message index of a chunk.

    Parameters
    ----------
    starts : np.ndarray [shape=(n,)], int64
        Bytes of the content at which whole message records begin, with their opcodes, ascending.

    Returns
    -------
    dict of int to bytes
        By channel, in the order of their first messages: rows of dtype `INDEX_ENTRIES`.
    """
    if not len(starts):
        return {}
    heads = gather_heads(content, starts)
    channels = heads["channel"]
    entries = np.empty(len(starts), INDEX_ENTRIES)
    entries["time"], entries["offset"] = heads["log_time"], starts
    channels = channels.copy()
    del heads  # a copy of millions
    if (channels == channels[0]).all():  # no need to sort them
        return {int(channels[0]): entries.tobytes()}
    order = np.argsort(channels, kind="stable")
    numbers, firsts, counts = np.unique(channels, return_index=True, return_counts=True)
    ends = np.cumsum(counts)
    return {
        int(numbers[i]): entries[order[ends[i] - counts[i] : ends[i]]].tobytes()
        for i in np.argsort(firsts)
    }


def find_chunk_heads(window: bytes) -> Iterator[int]:
    """Search for the heads of compressed chunks, damaged or not.

    Parameters
    ----------
    window : bytes
        Any part of a file. A head is found if `CHUNK_HEAD_LIMIT` bytes are there from its beginning
        on.

    Yields
    ------
    int
        Bytes of the window at which the opcode of a chunk may stand, ascending.
    """
    for match in _COMPRESSED.finditer(window):
        if match.start() >= _BEFORE_COMPRESSED:
            yield match.start() - _BEFORE_COMPRESSED
