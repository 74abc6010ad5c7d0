"""The messages of many chunks at once, still encoded, found through the index behind each chunk."""

import struct
from collections.abc import Collection, Mapping, Sequence
from collections.abc import Set as AbstractSet
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from mcap import records
from mcap.opcode import Opcode
from numpy.typing import NDArray

from schemas.errors import LogError
from schemas.logfile import LogFile
from schemas.records import HEAD, McapError, chunk_head, decompress, parse
from schemas.rows import Bytes, Int64, gather

_INDEX = np.dtype([("time", "<i8"), ("offset", "<i8")])
_INDEX_HEAD = struct.Struct("<BQHI")
_ENTRY = struct.Struct("<QQ")
MESSAGE_HEAD = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<i8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<i8"),
        ("publish_time", "<i8"),
    ]
)
_WRONG_INDEX = "the index of a chunk does not belong to it"
_FIXED = MESSAGE_HEAD.itemsize - HEAD.size  # bytes of a message's content before its payload


@dataclass(frozen=True)
class RawMessages:
    """Some messages of one channel, in the order of their log times.

    Attributes
    ----------
    channel : mcap.records.Channel
    schema : mcap.records.Schema or None
    buffer : np.ndarray [shape=(b,)], uint8
        Holds their records, and others.
    offsets : np.ndarray [shape=(n,)], int64
        Where in the buffer their payloads begin.
    heads : np.ndarray [shape=(n,)], of dtype `MESSAGE_HEAD`
    """

    channel: records.Channel
    schema: records.Schema | None
    buffer: Bytes
    offsets: Int64
    heads: NDArray[np.void]

    def __len__(self) -> int:
        return len(self.offsets)

    @property
    def sizes(self) -> Int64:
        """Bytes of the payloads."""
        return self.heads["length"] - _FIXED

    @property
    def log_times(self) -> Int64:
        """Log times in nanoseconds."""
        return self.heads["log_time"]

    def between(self, start: int | None, end: int | None) -> "RawMessages":
        """Return those with start <= log time < end."""
        times = self.log_times
        first = 0 if start is None else int(np.searchsorted(times, start))
        last = len(times) if end is None else int(np.searchsorted(times, end))
        if last - first == len(times):
            return self
        return replace(self, offsets=self.offsets[first:last], heads=self.heads[first:last])


def read_chunks(
    file: LogFile,
    chunks: NDArray[np.void],
    topics: Collection[str] | None = None,
    *,
    check: bool = False,
) -> list[RawMessages]:
    """Read the messages of some topics, or of all, from some chunks of a log.

    Channels and schemas that the chunks define are added to those of the file.

    Parameters
    ----------
    file : LogFile
    chunks : np.ndarray [shape=(n,)], of dtype `CHUNKS`
    topics : collection of str, optional
    check : bool
        Whether to compare chunks with their checksums, which takes longer than to decompress.

    Raises
    ------
    LogError
        If a chunk is damaged, or its index does not belong to it.
    """
    contents: list[bytes] = []
    indices: dict[int, list[tuple[int, bytes | memoryview]]] = {}
    for number, chunk in enumerate(chunks):
        try:
            content, found = _read(file, chunk, check=check)
        except (McapError, UnicodeDecodeError) as error:
            raise file.damaged(int(chunk["offset"]), error) from error
        contents.append(content)
        for identity, entries in found.items():
            indices.setdefault(identity, []).append((number, entries))
    sizes = np.array([len(content) for content in contents], np.int64)
    buffer = np.frombuffer(b"".join(contents), np.uint8)
    _define(file, indices.keys())
    batch = _Batch(file, chunks, sizes, buffer)
    read = [
        batch.messages(identity, parts)
        for identity, parts in indices.items()
        if topics is None
        or identity not in file.channels
        or file.channels[identity].topic in topics
    ]
    return [messages for messages in read if len(messages)]


def _read(
    file: LogFile, chunk: np.void, *, check: bool
) -> tuple[bytes, Mapping[int, bytes | memoryview]]:
    """Read the records in one chunk, and by channel the entries of its index."""
    offset, length, index_length = chunk.item()[:3]
    raw = memoryview(file.read(offset, length + max(index_length, 0)))
    if index_length < 0:
        return bytes(raw), _walk(file, raw)
    if len(raw) < HEAD.size or HEAD.unpack_from(raw) != (Opcode.CHUNK, length - HEAD.size):
        raise McapError("here should be a chunk")
    record = raw[HEAD.size : length]
    content = decompress(chunk_head(record), record, check=check)
    found: Mapping[int, bytes | memoryview] = _indices(raw[length:])
    if not found or not found.keys() <= file.channels.keys():
        walked = _walk(file, memoryview(content))
        found = found or walked
    return content, found


def _indices(raw: memoryview) -> dict[int, memoryview]:
    """Split the message indexes behind a chunk into their entries, by channel."""
    found: dict[int, memoryview] = {}
    start = 0
    while start < len(raw):
        first = start + _INDEX_HEAD.size
        if first > len(raw):
            raise McapError("a message index is cut")
        opcode, length, identity, size = _INDEX_HEAD.unpack_from(raw, start)
        start += HEAD.size + length
        if opcode != Opcode.MESSAGE_INDEX or start > len(raw) or size > start - first or size % 16:
            raise McapError("here should be a message index")
        if size:
            found[identity] = raw[first : first + size]
    return found


def _walk(file: LogFile, content: memoryview) -> dict[int, bytes]:
    """Go through all records of a chunk: note its channels, make the index it should have."""
    found: dict[int, list[bytes]] = {}
    start = 0
    while start < len(content):
        if start + HEAD.size > len(content):
            raise McapError("a record in a chunk is cut")
        opcode, length = HEAD.unpack_from(content, start)
        first, start = start + HEAD.size, start + HEAD.size + length
        if start > len(content):
            raise McapError("a record in a chunk claims to be longer than the chunk")
        if opcode == Opcode.MESSAGE and length >= _FIXED:
            identity, time = struct.unpack_from("<H4xQ", content, first)
            found.setdefault(identity, []).append(_ENTRY.pack(time, first - HEAD.size))
        elif opcode in {Opcode.SCHEMA, Opcode.CHANNEL}:
            record = parse(opcode, bytes(content[first:start]))
            if isinstance(record, records.Schema):
                file.schemas.setdefault(record.id, record)
            elif isinstance(record, records.Channel):
                file.channels.setdefault(record.id, record)
    return {identity: b"".join(entries) for identity, entries in found.items()}


def _define(file: LogFile, identities: AbstractSet[int]) -> None:
    """Look for channels that nothing read so far defines, from the first chunk on."""
    if identities <= file.channels.keys():
        return
    for chunk in file.chunks[np.argsort(file.chunks["offset"])]:
        with suppress(McapError, UnicodeDecodeError):  # it is not this one that was asked for
            content, _ = _read(file, chunk, check=False)
            _walk(file, memoryview(content))
        if identities <= file.channels.keys():
            return


class _Batch(NamedTuple):
    """The records of some chunks of a log, in one buffer."""

    file: LogFile
    chunks: NDArray[np.void]
    sizes: Int64
    buffer: Bytes

    def messages(
        self, identity: int, parts: Sequence[tuple[int, bytes | memoryview]]
    ) -> RawMessages:
        """Follow the index entries of a channel to its messages, and check every one of them."""
        entries = np.frombuffer(b"".join(part for _, part in parts), _INDEX)
        counts = [len(part) // _INDEX.itemsize for _, part in parts]
        number = np.repeat([number for number, _ in parts], counts)
        channel = self.file.channels.get(identity)
        if channel is None:
            raise self._damaged(number[0], "a message of a channel that is not defined")
        rest = self.sizes[number] - entries["offset"]
        inside = (entries["offset"] >= 0) & (rest >= MESSAGE_HEAD.itemsize)
        if not inside.all():
            raise self._damaged(number[inside.argmin()], _WRONG_INDEX)
        starts = entries["offset"] + (np.cumsum(self.sizes) - self.sizes)[number]
        heads = gather(self.buffer, starts, MESSAGE_HEAD.itemsize).view(MESSAGE_HEAD)
        sound = (
            (heads["opcode"] == Opcode.MESSAGE)
            & (heads["channel"] == identity)
            & (heads["log_time"] == entries["time"])
            & (heads["length"] >= _FIXED)
            & (heads["length"] <= rest - HEAD.size)
            & (heads["log_time"] >= self.chunks["start"][number])
            & (heads["log_time"] <= self.chunks["end"][number])
        )
        if not sound.all():
            raise self._damaged(number[sound.argmin()], _WRONG_INDEX)
        offsets = starts + MESSAGE_HEAD.itemsize
        if (np.diff(heads["log_time"]) < 0).any():
            order = np.argsort(heads["log_time"], kind="stable")
            offsets, heads = offsets[order], heads[order]
        schema = self.file.schemas.get(channel.schema_id)
        return RawMessages(channel, schema, self.buffer, offsets, heads)

    def _damaged(self, chunk: np.intp, what: str) -> LogError:
        return self.file.damaged(int(self.chunks["offset"][chunk]), what)
