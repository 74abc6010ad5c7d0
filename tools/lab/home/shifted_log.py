"""A log moved in time: its stamps, log times and frame numbers, all at once."""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.records import Channel, Metadata
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype

from hearthlog.schemas.arrays import Bool, Bytes, Indices, Int64, scatter
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.writer import ENCODING, PROFILE, CountedWriter
from hearthlog.schemas.mcap.compressed_chunk import StoredChunk, compress_chunk
from hearthlog.schemas.mcap.raw_messages import gather_heads
from hearthlog.schemas.mcap.records import HEAD, INDEX_ENTRIES, MESSAGE_FIXED, MESSAGE_HEAD
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.cdr_codec import rows_by_layout
from hearthlog.schemas.messages.topics import is_review, parse_topic
from hearthlog.schemas.messages.type_definitions import MessageType, message_type
from hearthlog.schemas.salvage import Salvage
from hearthlog.schemas.salvage.intact_records import IntactAttachment, IntactChunk

_TIME = "builtin_interfaces/msg/Time"
_SPAN = np.dtype([("sec", "<i4"), ("nanosec", "<u4")])  # of a stamp, and of a duration
_MOST_BYTES = 1 << 30  # of one log, uncompressed
_FRAMED = {
    message_types.FEATURES,
    message_types.STATISTICS,
    message_types.LABEL,
    message_types.DIRECTION,
}

# What a metadata record says in the copy, which has so many messages of each topic less.
Edit = Callable[[Metadata, Mapping[str, int]], dict[str, str]]


class Shift(NamedTuple):
    """By how much a log is moved.

    Attributes
    ----------
    seconds : int
    frames : mapping of str to int
        By microphone: what is added to frame numbers.
    not_before : mapping of str to int
        By topic of segments: nanoseconds of UTC before which none begins in the copy; those that
        end before it are left out.
    """

    seconds: int
    frames: Mapping[str, int]
    not_before: Mapping[str, int]


class _Numbers(NamedTuple):
    """Numbers of one dtype, and the bytes of a buffer at which they lie."""

    offsets: Int64
    values: NDArray[Any]

    def put(self, values: NDArray[Any], buffer: Bytes) -> None:
        """Write other numbers to the same places."""
        rows = values.astype(self.values.dtype).view(f"V{self.values.dtype.itemsize}")
        scatter(rows, buffer, self.offsets)


class _Records(NamedTuple):
    """Records of messages: the bytes of a buffer at which they begin, and their lengths."""

    offsets: Int64
    sizes: Int64

    def only(self, rows: Bool | Indices) -> "_Records":
        return _Records(self.offsets[rows], self.sizes[rows])


class _Segments(NamedTuple):
    """Segments of one topic: places and values of their starts and durations (`_SPAN`)."""

    topic: str
    records: _Records
    starts: _Numbers
    durations: _Numbers

    def put(self, shift: Shift, buffer: Bytes) -> _Records:
        """Move the segments, and cut off what lies before the time that the shift names.

        Returns the records of those that lie before it.
        """
        starts, durations = (_nanoseconds(each.values) for each in (self.starts, self.durations))
        starts = starts + shift.seconds * NANOSECONDS
        first = shift.not_before.get(self.topic, 0)
        begins = np.minimum(np.maximum(starts, first), starts + durations)
        self.starts.put(_spans(begins), buffer)
        self.durations.put(_spans(durations + starts - begins), buffer)
        return self.records.only((starts < first) & (starts + durations <= first))


class ShiftedLog:
    """A log or a layer, read whole, of which copies at other times are written.

    Parameters
    ----------
    path : Path
        On this machine; unfinished copies are made of an unfinished log.

    Attributes
    ----------
    first_starts : dict of str to int
        By topic of segments, a review's left out: start of the first, in nanoseconds of UTC.

    Raises
    ------
    LogError
        If it is damaged, or is none that hearthlog writes.
    """

    def __init__(self, path: Path) -> None:
        with Salvage(path) as salvage:
            self._pieces = list(salvage.pieces())
            attachments = [each for each in self._pieces if isinstance(each, IntactAttachment)]
            self._attached = [b"".join(salvage.stored(*each.inner)) for each in attachments]
            self._complete = salvage.complete
            self._definitions = salvage.definitions
            header = salvage.header
            if salvage.damages():
                raise LogError(f"{path}: is damaged, and not copied; see `hearthlog recover`")
        self._library = "hearthlog" if header is None else header.library
        self._profile = PROFILE if header is None else header.profile
        self._times: list[_Numbers] = []  # log and publish times, in nanoseconds
        self._stamps: list[_Numbers] = []  # their seconds
        self._frames: list[tuple[str, _Numbers]] = []  # by microphone
        self._segments: list[_Segments] = []
        self._read_chunks(path)
        for number, channel in self._definitions.channels.items():
            self._find_numbers(path, number, channel)
        del self._starts
        self.first_starts: dict[str, int] = {}
        for segments in self._segments:
            first = int(_nanoseconds(segments.starts.values).min())
            known = self.first_starts.get(segments.topic, first)
            self.first_starts[segments.topic] = min(first, known)

    def write(self, path: Path, shift: Shift, edit: Edit) -> None:
        """Write a copy.

        Parameters
        ----------
        path : Path
            Must not exist.
        shift : Shift
        edit : callable
            Told a metadata record, and by topic how many messages are left out; returns what it
            says in the copy.

        Raises
        ------
        OSError
            If it cannot be written.
        """
        buffer, time = self._buffer.copy(), shift.seconds * NANOSECONDS
        for numbers in self._times:
            numbers.put(numbers.values + time, buffer)
        for numbers in self._stamps:
            numbers.put(numbers.values + shift.seconds, buffer)
        for microphone, numbers in self._frames:
            numbers.put(numbers.values + shift.frames.get(microphone, 0), buffer)
        dropped = [segments.put(shift, buffer) for segments in self._segments]
        fewer: Counter[str] = Counter()
        for segments, records in zip(self._segments, dropped, strict=True):
            fewer[segments.topic] += len(records.offsets)
        entries = self._entries.copy()
        entries["time"] += time
        chunks = self._moved_chunks(buffer, entries.view(np.uint8).data, time, _joined(dropped))
        with path.open("xb") as stream:
            writer = CountedWriter(stream, self._definitions)
            writer.start(self._profile, self._library)
            defined: set[tuple[type, int]] = set()
            attached = iter(self._attached)
            for piece in self._pieces:
                if isinstance(piece, IntactChunk):
                    self._define(writer, piece, defined)
                    writer.copy_chunk(next(chunks))
                elif isinstance(piece, Metadata):
                    writer.add_metadata(piece.name, edit(piece, fewer))
                elif isinstance(piece, IntactAttachment):
                    _copy_attachment(writer, piece, next(attached), time)
            if self._complete:
                definitions = self._definitions
                writer.define(
                    list(definitions.schemas.values()), list(definitions.channels.values())
                )
                writer.finish()

    def _read_chunks(self, path: Path) -> None:
        """Decompress all chunks into one buffer, and join their message indexes."""
        contents: list[bytes] = []
        rows: list[bytes | bytearray | memoryview] = []
        starts: defaultdict[int, list[Int64]] = defaultdict(list)
        self._chunks: list[tuple[StoredChunk, int, dict[int, tuple[int, int]]]] = []
        base = end = 0
        for number, piece in enumerate(self._pieces):
            if not isinstance(piece, IntactChunk):
                if not isinstance(piece, Metadata | IntactAttachment):
                    raise LogError(f"{path}: has messages outside of chunks, and is not copied")
                continue
            stored, places = piece.stored, {}
            for channel, entries in stored.entries.items():
                places[channel] = end, end + len(entries)
                end += len(entries)
                rows.append(entries)
                offsets = np.frombuffer(entries, INDEX_ENTRIES)["offset"]
                starts[channel].append(offsets + base)
            if base + stored.size > _MOST_BYTES:
                raise LogError(f"{path}: is too large to be copied; a day has 24 logs")
            contents.append(stored.content())
            self._chunks.append((stored._replace(data=b"", entries={}), base, places))
            self._pieces[number] = piece._replace(stored=stored._replace(data=b""))
            base += stored.size
        self._buffer = np.frombuffer(b"".join(contents), np.uint8)
        self._entries = np.frombuffer(b"".join(rows), INDEX_ENTRIES)
        self._starts = {channel: np.concatenate(parts) for channel, parts in starts.items()}

    def _find_numbers(self, path: Path, number: int, channel: Channel) -> None:
        """Note where the times and frame numbers of a channel lie."""
        starts = self._starts.get(number)
        if starts is None:
            return
        schema = self._definitions.schemas.get(channel.schema_id)
        if schema is None or channel.message_encoding != ENCODING:
            raise LogError(f"{path}: {channel.topic} is no topic of ROS 2, and not copied")
        heads = gather_heads(self._buffer, starts)
        for name in ("log_time", "publish_time"):
            place = _place(MESSAGE_HEAD, name)
            self._times.append(_Numbers(starts + place, heads[name].copy()))
        offsets, sizes = starts + MESSAGE_HEAD.itemsize, heads["length"] - MESSAGE_FIXED
        kind = message_type(schema.name, schema.encoding, schema.data)
        parts = parse_topic(channel.topic)
        if schema.name == message_types.SEGMENT and parts and not is_review(parts.labelling):
            records = _Records(starts, heads["length"] + HEAD.size)
            for layout, rows, block in rows_by_layout(kind, self._buffer, offsets, sizes):
                spans = (
                    _Numbers(offsets[rows] + _place(layout.dtype, name), block[name].copy())
                    for name in ("header.stamp", "duration")
                )
                self._segments.append(_Segments(channel.topic, records.only(rows), *spans))
            return
        for name in _time_fields(kind.types, kind.name):
            for numbers in self._numbers(kind, offsets, sizes, name):
                known = _nanoseconds(numbers.values) != 0  # 0: nobody knows
                seconds = numbers.values["sec"][known]
                self._stamps.append(_Numbers(numbers.offsets[known], seconds))
        if schema.name in _FRAMED and parts:
            for numbers in self._numbers(kind, offsets, sizes, "frame"):
                self._frames.append((parts.microphone, numbers))

    def _numbers(
        self, kind: MessageType, offsets: Int64, sizes: Int64, name: str
    ) -> Iterator[_Numbers]:
        """Find a field in messages, and read it."""
        for layout, rows, block in rows_by_layout(kind, self._buffer, offsets, sizes):
            yield _Numbers(offsets[rows] + _place(layout.dtype, name), block[name].copy())

    def _moved_chunks(
        self, buffer: Bytes, entries: memoryview, time: int, dropped: _Records
    ) -> Iterator[StoredChunk]:
        for stored, base, places in self._chunks:
            index = {channel: entries[first:last] for channel, (first, last) in places.items()}
            span = stored.start + time, stored.end + time
            content = buffer[base : base + stored.size]
            inside = (dropped.offsets >= base) & (dropped.offsets < base + stored.size)
            if inside.any():
                here = dropped.only(inside)
                content, index = _without(
                    content, index, here._replace(offsets=here.offsets - base)
                )
                times = [np.frombuffer(each, INDEX_ENTRIES)["time"] for each in index.values()]
                if times:
                    span = min(int(t.min()) for t in times), max(int(t.max()) for t in times)
            yield compress_chunk(content.data, span, index)

    def _define(
        self, writer: CountedWriter, piece: IntactChunk, defined: set[tuple[type, int]]
    ) -> None:
        """Write what defines the channels of a chunk before it, unless it stands in it."""
        defined.update((type(record), record.id) for record in piece.definitions[: piece.leading])
        for number in piece.stored.entries:
            channel = self._definitions.channels[number]
            schema = self._definitions.schemas[channel.schema_id]
            for record in (schema, channel):
                if (type(record), record.id) not in defined:
                    writer.write_definition(record)
                    defined.add((type(record), record.id))


def _joined(records: Sequence[_Records]) -> _Records:
    nothing = np.empty(0, np.int64)
    offsets = np.concatenate([nothing, *(each.offsets for each in records)])
    sizes = np.concatenate([nothing, *(each.sizes for each in records)])
    return _Records(offsets, sizes).only(np.argsort(offsets))


def _without(
    content: Bytes, index: Mapping[int, memoryview], dropped: _Records
) -> tuple[Bytes, dict[int, memoryview]]:
    """Return a chunk and its message index without some records, in the order of their places."""
    keeps = np.ones(len(content), bool)
    for offset, size in zip(dropped.offsets.tolist(), dropped.sizes.tolist(), strict=True):
        keeps[offset : offset + size] = False
    kept: dict[int, memoryview] = {}
    before = np.concatenate([[0], np.cumsum(dropped.sizes)])
    for channel, rows in index.items():
        entries = np.frombuffer(rows, INDEX_ENTRIES)
        entries = entries[~np.isin(entries["offset"], dropped.offsets)]
        entries["offset"] -= before[np.searchsorted(dropped.offsets, entries["offset"])]
        if len(entries):
            kept[channel] = entries.view(np.uint8).data
    return content[keeps], kept


def _place(dtype: np.dtype[Any], name: str) -> int:
    assert dtype.fields is not None
    return int(dtype.fields[name][1])


def _time_fields(types: Mapping[str, Any], name: str, prefix: str = "") -> Iterator[str]:
    """List the fields of a message type that are points in time; none is in an array."""
    for field, (node, kind) in types[name]:
        if node is Nodetype.NAME and kind == _TIME:
            yield f"{prefix}{field}"
        elif node is Nodetype.NAME and kind in types and not kind.startswith("builtin_interfaces/"):
            yield from _time_fields(types, kind, f"{prefix}{field}.")


def _nanoseconds(spans: NDArray[Any]) -> Int64:
    total: Int64 = spans["sec"].astype(np.int64) * NANOSECONDS + spans["nanosec"]
    return total


def _spans(nanoseconds: Int64) -> NDArray[Any]:
    spans = np.empty(len(nanoseconds), _SPAN)
    spans["sec"], spans["nanosec"] = np.divmod(nanoseconds, NANOSECONDS)
    return spans


def _copy_attachment(
    writer: CountedWriter, piece: IntactAttachment, data: bytes, time: int
) -> None:
    index = piece.index_record
    created, logged = (each + time if each else 0 for each in (index.create_time, index.log_time))
    writer.add_attachment(created, logged, index.name, index.media_type, data)
