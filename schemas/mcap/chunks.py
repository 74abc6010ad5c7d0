"""Batched reading of still encoded messages from chunks, through their message indexes."""

import hashlib
import warnings
from array import array
from collections.abc import Callable, Collection, Iterator, Sequence
from collections.abc import Set as AbstractSet
from itertools import chain, pairwise
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple

import numpy as np
from mcap import records
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from numpy.typing import NDArray

from hearthlog.schemas.arrays import Bytes, Int64, gather
from hearthlog.schemas.errors import HearthlogWarning, LogError
from hearthlog.schemas.frames import millisecond_text
from hearthlog.schemas.mcap.compressed_chunk import (
    ContentStream,
    Part,
    TooLargeError,
    decompress_together,
    read_parts,
)
from hearthlog.schemas.mcap.logfile import RECOVER, LogFile
from hearthlog.schemas.mcap.raw_messages import (
    RawMessages,
    gather_heads,
    index_messages,
    iterate_records,
)
from hearthlog.schemas.mcap.records import (
    CHUNKS,
    HEAD,
    INDEX_ENTRIES,
    LAST_TIME,
    LATE,
    LIMIT,
    MESSAGE,
    MESSAGE_FIXED,
    MESSAGE_HEAD,
    MESSAGE_INDEX_HEAD,
    ChunkHead,
    by_start,
    chunk_head,
    decompress_into,
    not_empty,
)

_LARGE = f"messages of more than {LIMIT >> 20} MiB are left out: larger than hearthlog reads"
_STREAMS = 3  # open content streams of a file: interleaved channels need one each
_AGAIN = 16  # limit of repeated decompression of a large chunk, as a multiple of its size
_INDEXES = "message indexes that do not belong to their chunks are not used"
_WRONG_INDEX = "the index of a chunk does not belong to it"
_ENTRY_SIZE = INDEX_ENTRIES.itemsize
_CHANNELS_LIMIT = 1 << 16
BATCH_SIZE = 4 << 20  # bytes, compressed plus decompressed

TopicChoice = Collection[str] | Callable[[str], bool]  # topic names, or a predicate

OnDamage = Callable[[Path, LogError], None]  # called with a log and its read error

Entries = tuple[Int64, NDArray[np.void]]  # chunk number and index entry of each row


def read_chunks(
    file: LogFile,
    chunks: NDArray[np.void],
    topics: TopicChoice | None = None,
) -> list[RawMessages]:
    """Read the messages of the selected topics from chunks of a log, rows of `file.chunks`.

    `topics` has names, or is a predicate: None for all; empty for none, which only adds
    definitions. Raise `LogError` if the log cannot be read, a chunk is damaged, an index does not
    match its chunk, or no undamaged chunk defines the channel of a message.
    """
    chunks = in_parts(file, chunks)
    apart = (chunks["part"] >= 0) | (chunks["size"] > LIMIT)
    read = [] if apart.all() else _messages(file, _read(file, chunks[~apart]), topics)
    for number in np.flatnonzero(apart).tolist():
        read += _read_part(file, chunks[number : number + 1], topics)
    return read


def read_sound(
    file: LogFile, chunks: NDArray[np.void], topics: TopicChoice | None, on_damage: OnDamage
) -> list[RawMessages]:
    """Read messages as `read_chunks` does, but skip unreadable chunks.

    The log must be `partial`: messages of undefined channels are skipped, too.
    """
    try:
        return read_chunks(file, chunks, topics)
    except LogError as error:
        if len(chunks) > 1:
            each = (read_sound(file, row, topics, on_damage) for row in _rows(chunks))
            return list(chain.from_iterable(each))
        damage = error
    without = chunks[chunks["index_length"] > 0]  # perhaps only its message indexes are damaged
    without["index_length"] = 0
    try:
        read = read_chunks(file, without, topics) if len(without) else None
    except LogError:
        read = None
    if read is None:
        on_damage(file.path, _left_out(chunks[0], damage))
        return []
    warnings.warn(HearthlogWarning(_INDEXES, file.path, each=True), stacklevel=2)
    return read


def _rows(chunks: NDArray[np.void]) -> Iterator[NDArray[np.void]]:
    return (chunks[number : number + 1] for number in range(len(chunks)))


def _left_out(chunk: np.void, error: LogError) -> LogError:
    """Return the error that describes what an unreadable chunk loses."""
    text = str(error)
    hint = RECOVER if text.endswith(RECOVER) else ""
    end = int(chunk["offset"] + chunk["length"])
    where = f" up to byte {end}" if chunk["part"] < 0 else ""
    first, last = (millisecond_text(int(chunk[name])) for name in ("start", "end"))
    return LogError(f"{text.removesuffix(hint)}: left out{where}, {first} to {last}{hint}")


def _messages(file: LogFile, batch: "_Batch", topics: TopicChoice | None) -> list[RawMessages]:
    """Find the messages of the selected topics in a batch of chunks."""
    indices = batch.indices(_other_channels(file, topics))
    if not indices.keys() - file.undefined <= file.channels.keys():
        _define(file, indices.keys())
    if file.partial and (unknown := indices.keys() - file.channels.keys()):
        file.undefined |= unknown
        text = "messages of channels that nothing in the file defines are left out"
        warnings.warn(HearthlogWarning(text, file.path, each=True), stacklevel=2)
        indices = {number: found for number, found in indices.items() if number not in unknown}
    for identity in [*_other_channels(file, topics), *file.doubtful]:
        indices.pop(identity, None)
    read = [batch.messages(identity, parts) for identity, parts in indices.items()]
    return [messages for messages in read if len(messages)]


def read_in_batches(
    file: LogFile,
    chunks: NDArray[np.void],
    topics: TopicChoice | None = None,
    on_damage: OnDamage | None = None,
) -> Iterator[list[RawMessages]]:
    """Read chunks as `read_chunks` does, in batches of `BATCH_SIZE`."""
    chunks = in_parts(file, chunks, on_damage)
    batches = np.cumsum(chunks["size"] + chunks["length"]) // BATCH_SIZE
    for batch in np.split(chunks, np.flatnonzero(np.diff(batches)) + 1):
        if on_damage is None:
            yield read_chunks(file, batch, topics)
        else:
            yield read_sound(file, batch, topics, on_damage)


def in_parts(
    file: LogFile, chunks: NDArray[np.void], on_damage: OnDamage | None = None
) -> NDArray[np.void]:
    """Split `CHUNKS` [shape=(n,)] larger than `LIMIT` into parts, and verify their checksums.

    They are sorted by start time if any was split; a message larger than `LIMIT` is a part. Raise
    `LogError` if the log cannot be read, or a large chunk is damaged.
    """
    large = (chunks["part"] < 0) & (chunks["index_length"] >= 0)
    large &= (chunks["size"] > LIMIT) | (chunks["length"] > LIMIT)
    if not large.any():
        return chunks
    divided = [chunks[~large]]
    for chunk in chunks[large]:
        try:
            divided.append(_parts(file, int(chunk["offset"])))
        except LogError as error:
            if on_damage is None:
                raise
            on_damage(file.path, _left_out(chunk, error))
    return by_start(np.concatenate(divided))


def _parts(file: LogFile, offset: int) -> NDArray[np.void]:
    """Split a large chunk into parts, and add its definitions to the file."""
    rows = array("q")
    try:
        for part in _parts_of(ContentStream(file.read, offset)):
            if part.size > LIMIT:
                opcode, _, channel, _, time, _ = MESSAGE.unpack(part.content)
                if opcode != Opcode.MESSAGE:
                    continue
                channels, times = np.array([channel]), np.array([time], np.uint64)
            else:
                _add_definitions(file, part.content, part.others)
                heads = gather_heads(part.content, np.frombuffer(part.messages, np.int64))
                channels, times = heads["channel"], heads["log_time"].astype(np.uint64)
            if not len(times):
                continue
            span = int(times.min()), int(times.max())
            file.late |= span[1] > LAST_TIME
            ids = file.channel_set(frozenset(np.unique(channels).tolist()))
            rows.extend([offset, 0, 0, part.size, *(min(time, LAST_TIME) for time in span)])
            rows.extend([ids, part.first])
    except TooLargeError as error:
        raise LogError(f"{file.path}: {error}, at byte {offset}") from error
    except McapError as error:
        raise file.damaged(offset, error) from error
    return np.frombuffer(rows, CHUNKS)


def _parts_of(stream: ContentStream) -> Iterator[Part]:
    """Iterate over the parts of a large chunk; stop if it has more records than its size allows."""
    left = (1 << 20) + 4 * stream.head.data.stop
    for part in read_parts(stream):
        left -= len(part.messages) + len(part.others)
        if left < 0:
            raise TooLargeError("a chunk holds more messages than one of its size can")
        yield part


def _read_part(
    file: LogFile, row: NDArray[np.void], topics: TopicChoice | None
) -> list[RawMessages]:
    """Read the messages of a part of a large chunk; skip a message that is too large."""
    offset, first, size = (int(row[name][0]) for name in ("offset", "part", "size"))
    if size > LIMIT:
        (channel,) = file.channel_sets[int(row["channels"][0])] or _channel_of(file, offset)
        topic = file.channels[channel].topic if channel in file.channels else f"channel {channel}"
        if is_chosen(topic, topics):
            warnings.warn(
                HearthlogWarning(_LARGE, f"{file.path}: {topic}", each=True), stacklevel=2
            )
        return []
    if topics is not None and not callable(topics) and not topics:
        return []
    try:
        content = _part_content(file, offset, first, size)
    except TooLargeError as error:
        raise LogError(f"{file.path}: {error}, at byte {offset}") from error
    except McapError as error:
        raise file.damaged(offset, error) from error
    if len(content) < size:
        raise file.damaged(offset, "a chunk is shorter than it was")
    row = row.copy()
    row["index_length"] = -1  # forces a walk through its records
    buffer, start = np.frombuffer(content, np.uint8), np.zeros(1, np.int64)
    return _messages(file, _Batch(file, row, np.array([size]), buffer, buffer, start), topics)


def _channel_of(file: LogFile, offset: int) -> tuple[int]:
    """Read the channel ID of a message outside of chunks."""
    return (MESSAGE.unpack(file.read(offset, MESSAGE.size))[2],)


def _part_content(file: LogFile, offset: int, first: int, size: int) -> bytes:
    """Decompress a part of a large chunk, resuming the stream where the last part ended."""
    with file.lock:
        before = [s for s in file.streams if s.offset == offset and s.position <= first]
        stream = max(before, key=attrgetter("position"), default=None)
        if stream is None:
            stream = ContentStream(file.read, offset)
            file.again[offset] += first
            if file.again[offset] > _AGAIN * stream.head.size:
                raise TooLargeError("a chunk is too large for the order of its messages")
        others = [other for other in file.streams if other is not stream]
        file.streams = [*others[1 - _STREAMS :], stream]
        stream.skip(first - stream.position)
        return stream.read(size)


def verify_chunks(file: LogFile, chunks: NDArray[np.void]) -> None:
    """Verify the checksums of chunks, rows of `file.chunks`.

    Raise `LogError` if the log cannot be read, a chunk is damaged, or a record behind one is no
    message index.
    """
    for _ in read_in_batches(file, chunks, topics=()):
        pass


def repeated_chunks(file: LogFile, chunks: NDArray[np.void]) -> NDArray[np.bool_]:
    """Return whether chunks repeat an earlier one of the file byte for byte [shape=(n,)].

    They are rows of `file.chunks`. Chunks of a single log time are excluded: a writer with one
    message per chunk writes equal chunks for equal messages.
    """
    repeated = np.zeros(len(chunks), bool)
    candidates: dict[tuple[int, ...], list[int]] = {}
    span = chunks["end"] - chunks["start"]
    for row in np.flatnonzero((span > 0) & (chunks["index_length"] >= 0)).tolist():
        start, end, size, length = chunks[["start", "end", "size", "length"]][row].tolist()
        candidates.setdefault((start, end, size, length), []).append(row)
    for rows in candidates.values():
        digests: set[bytes] = set()
        for row in sorted(rows, key=chunks["offset"].__getitem__) if len(rows) > 1 else ():
            stored = file.read(int(chunks["offset"][row]), int(chunks["length"][row]))
            digest = hashlib.sha256(stored).digest()
            repeated[row] = digest in digests
            digests.add(digest)
    return repeated


def read_definitions(file: LogFile, on_damage: OnDamage | None = None) -> None:
    """Add the schemas and channels to a log that only its chunks define.

    Raise `LogError` if the log cannot be read, or one of these chunks is damaged.
    """
    chunks = not_empty(file.chunks[file.chunks["index_length"] >= 0])  # a run has no definitions
    for number, channels in enumerate(chunks["channels"].tolist()):
        identities = file.channel_sets[channels]
        if not identities or not identities <= file.channels.keys():
            for _ in read_in_batches(file, chunks[number : number + 1], (), on_damage):
                pass


def _other_channels(file: LogFile, topics: TopicChoice | None) -> list[int]:
    """Return the channels of a file whose topics are not selected."""
    return [
        number for number, channel in file.channels.items() if not is_chosen(channel.topic, topics)
    ]


def is_chosen(topic: str, topics: TopicChoice | None) -> bool:
    """Return whether a topic is selected; None selects all."""
    if topics is None:
        return True
    return topics(topic) if callable(topics) else topic in topics


def _read(file: LogFile, chunks: NDArray[np.void]) -> "_Batch":
    """Read and decompress chunks, and verify their checksums."""
    raw, starts = _read_stored(file, chunks)
    limit = int(np.clip(chunks["size"], 0, LIMIT).sum()) + LIMIT
    read = None
    if (chunks["index_length"] >= 0).all():
        read = decompress_together(raw, starts, chunks["length"], limit)
    buffer, sizes = read or _decompress_each(file, chunks, raw, starts, limit)
    return _Batch(file, chunks, sizes, buffer, raw, starts)


def _decompress_each(
    file: LogFile, chunks: NDArray[np.void], raw: Bytes, starts: Int64, limit: int
) -> tuple[Bytes, Int64]:
    """Decompress chunks one by one, to find the damaged one."""
    lengths, indexed = chunks["length"], chunks["index_length"] >= 0
    records: list[tuple[ChunkHead | None, memoryview]] = []
    for number, (start, length) in enumerate(zip(starts.tolist(), lengths.tolist(), strict=True)):
        record = raw[start : start + length].data
        try:
            records.append(_chunk(record) if indexed[number] else (None, record))
        except McapError as error:
            raise file.damaged(int(chunks["offset"][number]), error) from error
    sizes = np.array([len(record) if head is None else head.size for head, record in records], int)
    if sizes.sum() > limit:
        raise file.damaged(int(chunks["offset"][0]), "chunks are larger than their index claims")
    buffer = np.empty(sizes.sum(), np.uint8)
    end = 0
    for number, (head, record) in enumerate(records):
        first, end = end, end + int(sizes[number])
        if head is None:
            buffer[first:end] = record
            continue
        try:
            decompress_into(buffer[first:end].data, head, record)
        except McapError as error:
            raise file.damaged(int(chunks["offset"][number]), error) from error
    return buffer, sizes


def _read_stored(file: LogFile, chunks: NDArray[np.void]) -> tuple[Bytes, Int64]:
    """Read chunks and their message indexes, adjacent ones at once; return their start offsets."""
    offsets = chunks["offset"]
    lengths = chunks["length"] + np.maximum(chunks["index_length"], 0)
    size = file.size
    cut = offsets + lengths > size
    if cut.any():
        raise file.damaged(int(offsets[cut.argmax()]), "a chunk is shorter than it claims")
    if lengths.sum() > size:
        raise file.damaged(int(offsets[0]), "chunks overlap")
    ends = np.cumsum(lengths)
    raw = np.empty(lengths.sum(), np.uint8)
    apart = np.flatnonzero(offsets[1:] != (offsets + lengths)[:-1]) + 1
    for first, last in pairwise([0, *apart.tolist(), len(chunks)]):
        start = int(ends[first] - lengths[first])
        file.read_into(raw[start : ends[last - 1]].data, int(offsets[first]))
    return raw, ends - lengths


def _chunk(record: memoryview) -> tuple[ChunkHead, memoryview]:
    expected = Opcode.CHUNK, len(record) - HEAD.size
    if len(record) < HEAD.size or HEAD.unpack_from(record) != expected:
        raise McapError("here should be a chunk")
    content = record[HEAD.size :]
    return chunk_head(content), content


def _add_definitions(
    file: LogFile, content: bytes | memoryview, places: Sequence[tuple[int, int]]
) -> None:
    """Add the schemas and channels at these offsets of a chunk to a file."""
    for start, end in places:
        record = file.parse(content[start], bytes(content[start + HEAD.size : end]))
        if isinstance(record, records.Schema | records.Channel):
            file.define(record)


def _index_records(file: LogFile, content: memoryview) -> dict[int, NDArray[np.void]]:
    """Walk through the records of a chunk: add its definitions to the file, build its index."""
    starts = array("q")
    for opcode, start, end in iterate_records(content):
        if opcode == Opcode.MESSAGE and end - start >= MESSAGE_HEAD.itemsize:
            starts.append(start)
        elif opcode in {Opcode.SCHEMA, Opcode.CHANNEL}:
            _add_definitions(file, content, [(start, end)])
        elif opcode <= Opcode.DATA_END and opcode != Opcode.MESSAGE:
            raise McapError("the records of a chunk are damaged")
    made = index_messages(content, np.frombuffer(starts, np.int64))
    return {channel: np.frombuffer(rows, INDEX_ENTRIES) for channel, rows in made.items()}


def _define(file: LogFile, identities: AbstractSet[int]) -> None:
    """Search the chunks for the definitions of undefined channels, from the first chunk on."""
    damage = None
    chunks = file.chunks[file.chunks["index_length"] >= 0]
    for chunk in chunks[np.argsort(chunks["offset"])]:
        row = np.array([chunk])
        try:
            if in_parts(file, row) is row:
                _read(file, row).index_records()
        except LogError as error:  # another chunk may define them
            damage = damage or error
        if identities <= file.channels.keys():
            return
    if damage is not None and not file.partial:
        raise damage


class _Batch(NamedTuple):
    """The decompressed records of some chunks of a log, in one buffer, and their stored bytes."""

    file: LogFile
    chunks: NDArray[np.void]
    sizes: Int64
    buffer: Bytes
    raw: Bytes
    starts: Int64

    def indices(self, others: Sequence[int]) -> dict[int, list[Entries]]:
        """Return the index entries of all other channels; build the index of chunks without one."""
        ends = self.starts + self.chunks["length"]
        parts = self._index_parts(ends, ends + np.maximum(self.chunks["index_length"], 0))
        without = np.bincount(parts[:, 0], minlength=len(self.chunks)) == 0
        parts = parts[~np.isin(parts[:, 1], others)]
        identities, firsts, counts = np.unique(parts[:, 1], return_index=True, return_counts=True)
        # By channel, then by chunk, so that the entries of a channel are in the order of the file.
        ordered = parts[np.lexsort((parts[:, 0], parts[:, 1]))]
        by_channel = np.split(ordered, np.cumsum(counts)[:-1])
        entries_of = {
            int(identities[i]): [self._entries(by_channel[i])] for i in np.argsort(firsts).tolist()
        }
        channels = self.file.channels.keys()
        complete = entries_of.keys() <= channels
        for number in np.flatnonzero(without).tolist() if complete else range(len(self.chunks)):
            if not without[number] and entries_of.keys() <= channels:
                continue  # earlier chunks define all channels
            made = self.index_records(number)
            for identity, entries in made.items() if without[number] else ():
                of_chunk = np.full(len(entries), number)
                entries_of.setdefault(identity, []).append((of_chunk, entries))
        return entries_of

    def _entries(self, parts: Int64) -> Entries:
        """Collect the index entries of the parts that `_index_parts` returns."""
        width = INDEX_ENTRIES.itemsize
        counts = parts[:, 3] // width
        before = np.cumsum(counts) - counts
        places = np.repeat(parts[:, 2] - width * before, counts) + width * np.arange(counts.sum())
        entries = gather(self.raw, places, width).view(INDEX_ENTRIES)
        return np.repeat(parts[:, 0], counts), entries

    def _index_parts(self, starts: Int64, ends: Int64) -> Int64:
        """Walk through the message indexes of all chunks in parallel, one per chunk and step.

        Return chunk number, channel ID, offset and size of the entries [shape=(n, 4)].
        """
        index_head = MESSAGE_INDEX_HEAD
        parts = [np.empty((0, 4), np.int64)]
        numbers = np.flatnonzero(starts < ends)
        starts, ends = starts[numbers], ends[numbers]
        while len(numbers):
            if len(parts) > _CHANNELS_LIMIT:
                raise self._damaged(numbers[0], "a chunk has more indexes than there are channels")
            first = starts + index_head.itemsize
            if (first > ends).any():
                raise self._damaged(numbers[(first > ends).argmax()], "a message index is cut")
            heads = gather(self.raw, starts, index_head.itemsize).view(index_head)
            length, size = heads["length"], heads["size"].astype(np.int64)
            # Records may have trailing fields, but smaller than an entry: the size is wrong then.
            content = size + index_head.itemsize - HEAD.size
            sound = (
                (heads["opcode"] == Opcode.MESSAGE_INDEX)
                & (length >= content)
                & ((length == content) | ((length - content) % _ENTRY_SIZE > 0))
                & (length <= ends - starts - HEAD.size)
                & (size % _ENTRY_SIZE == 0)
            )
            if not sound.all():
                raise self._damaged(numbers[sound.argmin()], "here should be a message index")
            part = np.stack([numbers, heads["channel"], first, size], axis=1)
            parts.append(part[size > 0])
            starts = starts + HEAD.size + length
            going = starts < ends
            numbers, starts, ends = numbers[going], starts[going], ends[going]
        return np.concatenate(parts)

    def index_records(self, number: int = 0) -> dict[int, NDArray[np.void]]:
        """Walk through the records of a chunk: add its channels to the file, build its index."""
        end = int(self.sizes[: number + 1].sum())
        content = self.buffer[end - int(self.sizes[number]) : end].data
        try:
            return _index_records(self.file, content)
        except McapError as error:
            raise self.file.damaged(int(self.chunks["offset"][number]), error) from error

    def messages(self, identity: int, parts: Sequence[Entries]) -> RawMessages:
        """Read the messages of a channel at its index entries, and check each message."""
        number = np.concatenate([numbers for numbers, _ in parts])
        entries = np.concatenate([entries for _, entries in parts])
        channel = self.file.channels.get(identity)
        if channel is None:
            raise self._damaged(number[0], "a message of a channel that is not defined")
        if (entries["time"][1:] < entries["time"][:-1]).any():
            order = np.argsort(entries["time"], kind="stable")  # the heads must have these times
            number, entries = number[order], entries[order]
        rest = self.sizes[number] - entries["offset"]
        inside = (entries["offset"] >= 0) & (rest >= MESSAGE_HEAD.itemsize)
        if not inside.all():
            raise self._damaged(number[inside.argmin()], _WRONG_INDEX)
        starts = entries["offset"] + (np.cumsum(self.sizes) - self.sizes)[number]
        heads = gather_heads(self.buffer, starts)
        late = (heads["log_time"] < 0) | (heads["log_time"] > LAST_TIME)
        if late.any() and self.file.late:
            warnings.warn(HearthlogWarning(LATE, self.file.path, each=True), stacklevel=2)
            entries, number, rest = entries[~late], number[~late], rest[~late]
            starts, heads = starts[~late], heads[~late]
        sound = (
            (heads["opcode"] == Opcode.MESSAGE)
            & (heads["channel"] == identity)
            & (heads["log_time"] == entries["time"])
            & (heads["length"] >= MESSAGE_FIXED)
            & (heads["length"] <= rest - HEAD.size)
            & (heads["log_time"] >= self.chunks["start"][number])
            & (heads["log_time"] <= self.chunks["end"][number])
        )
        if not sound.all():
            raise self._damaged(number[sound.argmin()], _WRONG_INDEX)
        repeated = np.zeros(0, bool)  # entries that point at the message of another one
        if (starts[1:] <= starts[:-1]).any():
            repeated = np.diff(np.sort(starts)) == 0
        if repeated.any() or (heads["length"] + HEAD.size).sum() > len(self.buffer):
            raise self._damaged(number[0], _WRONG_INDEX)
        offsets = starts + MESSAGE_HEAD.itemsize
        schema = self.file.schemas.get(channel.schema_id)
        return RawMessages(channel, schema, self.buffer, offsets, heads, self.file.path)

    def _damaged(self, chunk: np.intp, what: str) -> LogError:
        return self.file.damaged(int(self.chunks["offset"][chunk]), what)
