"""Records of a damaged file that are whole, and what is in them."""

import struct
import zlib
from array import array
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from mcap import records
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import McapRecord

from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.mcap.chunk_records import index_messages, iterate_records
from hearthlog.schemas.mcap.chunk_table import LAST_TIME
from hearthlog.schemas.mcap.definitions import Definition
from hearthlog.schemas.mcap.formats import ATTACHMENT, HEAD, INDEX_ENTRIES, MESSAGE, UINT32, UINT64
from hearthlog.schemas.mcap.raw_messages import gather_heads
from hearthlog.schemas.mcap.records import parse
from hearthlog.schemas.mcap.stored_chunk import StoredChunk, compress_chunk
from hearthlog.schemas.salvage.record_sizes import SHORTEST

_DEFINITIONS_LIMIT = 1 << 19


class WholeChunk(NamedTuple):
    """A chunk whose content is proved, and the definitions in it."""

    stored: StoredChunk
    definitions: list[Definition]
    leading: int  # how many of them stand before the first message
    late: Mapping[int, int] = {}  # by channel: messages that were left out of it for their log time


class LargeChunk(NamedTuple):
    """A chunk that is too large to be read at once, or a message that is to become one."""

    stored: StoredChunk  # without its data
    data: tuple[int, int]  # bytes of the file at which these begin, and before which they end
    definitions: list[Definition]
    leading: int  # how many of them stand before the first message
    unread: Mapping[int, int]  # by channel: messages that are themselves too large


class LargeAttachment(NamedTuple):
    """An attachment that is too large to be read."""

    index_record: records.AttachmentIndex
    data: tuple[int, int]  # bytes of the file at which it begins, and before which it ends


class UnknownRecord(NamedTuple):
    """A record of a later version of MCAP, or of an application, of any size."""

    head: bytes  # its first bytes
    data: tuple[int, int]  # bytes of the file at which it begins, and before which it ends


class WholeAttachment(NamedTuple):
    """An attachment as the file holds it, and what an index says of it."""

    record: bytes
    index_record: records.AttachmentIndex


class WholeRecord(NamedTuple):
    """A whole record."""

    offset: int
    end: int
    record: "McapRecord | Whole | None"  # None for a message index
    corrected: str = ""  # what of its head was wrong
    proved: bool = True  # False: without a checksum, what is in it may be wrong instead


Whole = WholeChunk | LargeChunk | WholeAttachment | LargeAttachment | UnknownRecord


def split_content(content: bytes) -> tuple[Int64, Int64]:
    """Find where the messages and the definitions of a chunk begin.

    Parameters
    ----------
    content : bytes
        Records of the chunk, uncompressed.

    Returns
    -------
    messages : np.ndarray [shape=(m,)], int64
        Bytes of the content at which messages begin, with their opcodes, ascending.
    definitions : np.ndarray [shape=(d,)], int64
        The same of schemas and channels.

    Raises
    ------
    McapError
        If a record is damaged, or of a kind that no chunk holds.
    """
    messages, definitions = array("q"), array("q")
    kind, shortest = int(Opcode.MESSAGE), MESSAGE.size
    for opcode, start, end in iterate_records(content):
        if opcode == kind and end - start >= shortest:
            messages.append(start)
        elif opcode > Opcode.DATA_END:
            continue  # of a later version of MCAP, or of an application
        elif opcode not in {Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL}:
            raise McapError("the records of a chunk are damaged")
        elif end - start < HEAD.size + SHORTEST[opcode]:
            raise McapError("a record in a chunk is too short")
        else:
            definitions.append(start)
    return np.frombuffer(messages, np.int64), np.frombuffer(definitions, np.int64)


def without_late(chunk: WholeChunk, content: bytes, messages: Int64) -> WholeChunk:
    """Leave out of a chunk the messages whose log times are after `LAST_TIME`.

    Parameters
    ----------
    chunk : WholeChunk
    content : bytes
        Its records, uncompressed.
    messages : np.ndarray [shape=(m,)], int64
        As `split_content` returns it.
    """
    times = gather_heads(content, messages)["log_time"].astype(np.uint64)
    starts = messages[times > LAST_TIME]
    late = index_messages(content, starts)
    parts, place = [], 0
    for start in starts.tolist():
        parts.append(content[place:start])
        place = start + HEAD.size + HEAD.unpack_from(content, start)[1]
    content = b"".join([*parts, content[place:]])
    entries = index_messages(content, split_content(content)[0])
    stored = compress_chunk(memoryview(content), span_of(entries), entries)._replace(raw=None)
    counts = {channel: len(rows) // INDEX_ENTRIES.itemsize for channel, rows in late.items()}
    return chunk._replace(stored=stored, late=counts)


def read_definitions(content: bytes, starts: Int64) -> list[Definition]:
    """Read the schemas and channels of a chunk.

    Parameters
    ----------
    content : bytes
        Records of the chunk, uncompressed.
    starts : np.ndarray [shape=(d,)], int64
        Bytes of the content at which they begin, with their opcodes.

    Returns
    -------
    list of mcap.records.Schema and mcap.records.Channel
        In the order of `starts`.

    Raises
    ------
    McapError
        If one is damaged, or there are more than 524288.
    UnicodeDecodeError
        If a text in it is not UTF-8.
    """
    if len(starts) > _DEFINITIONS_LIMIT:
        raise McapError("a chunk holds more definitions than can be kept")
    definitions: list[Definition] = []
    for start in starts.tolist():
        opcode, length = HEAD.unpack_from(content, start)
        record = parse(opcode, content[start + HEAD.size : start + HEAD.size + length])
        assert isinstance(record, Definition)
        definitions.append(record)
    return definitions


def span_of(entries: Mapping[int, bytes | bytearray]) -> tuple[int, int]:
    """Find the first and the last log time of a message index.

    Parameters
    ----------
    entries : mapping of int to bytes-like
        By channel: rows of dtype `INDEX_ENTRIES`.

    Returns
    -------
    first, last : int
        Log times in nanoseconds; 0 and 0 if the index is empty.
    """
    if not entries:
        return 0, 0
    times = [np.frombuffer(e, INDEX_ENTRIES)["time"].view(np.uint64) for e in entries.values()]
    return min(int(each.min()) for each in times), max(int(each.max()) for each in times)


def chunk_messages(chunk: StoredChunk) -> Iterator[records.Message]:
    """Read the messages of a chunk one by one.

    Parameters
    ----------
    chunk : StoredChunk
        A chunk whose content is proved.

    Yields
    ------
    mcap.records.Message
        In the order of the chunk.
    """
    content = chunk.content()
    for opcode, start, end in iterate_records(content):
        if opcode == Opcode.MESSAGE:
            yield read_message(content[start:end])


def read_message(raw: bytes) -> records.Message:
    """Read a message from its record.

    Parameters
    ----------
    raw : bytes
        The whole record, with opcode and length.
    """
    _, _, channel, sequence, log_time, publish_time = MESSAGE.unpack_from(raw)
    return records.Message(channel, log_time, raw[MESSAGE.size :], publish_time, sequence)


def read_attachment(raw: bytes) -> WholeAttachment:
    """Read an attachment from its record.

    Parameters
    ----------
    raw : bytes
        The whole record, with opcode and length; the lengths inside of it add up to that.

    Returns
    -------
    WholeAttachment
        With an index record whose offset and length are 0.

    Raises
    ------
    McapError
        If its checksum is wrong.
    UnicodeDecodeError
        If a text in it is not UTF-8.
    """
    record = memoryview(raw)
    (crc,) = UINT32.unpack(record[-UINT32.size :])
    if crc not in {0, zlib.crc32(record[HEAD.size : -UINT32.size])}:
        raise McapError("an attachment has another checksum than it claims")
    return WholeAttachment(raw, index_attachment(raw))


def index_attachment(raw: bytes) -> records.AttachmentIndex:
    """Make the index record of an attachment, with an offset and a length of 0.

    Parameters
    ----------
    raw : bytes
        The record up to the data of the attachment, or more of it.

    Raises
    ------
    McapError
        If the record ends before that.
    UnicodeDecodeError
        If a text in it is not UTF-8.
    """
    record = memoryview(raw)
    try:
        log_time, create_time, name = ATTACHMENT.unpack_from(record, HEAD.size)
        first = HEAD.size + ATTACHMENT.size + name
        (media,) = UINT32.unpack_from(record, first)
        (size,) = UINT64.unpack_from(record, first + 4 + media)
    except struct.error as error:
        raise McapError("an attachment is damaged") from error
    texts = str(record[first - name : first], "utf-8"), str(record[first + 4 :][:media], "utf-8")
    return records.AttachmentIndex(0, 0, log_time, create_time, size, *texts)
