"""Lost frames, found by frame numbers, and the channel of their gap messages."""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, Message, Schema

from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS
from hearthlog.schemas.logs.columns import decode
from hearthlog.schemas.logs.metadata import rosbag2_channel
from hearthlog.schemas.logs.writer import ENCODING, SCHEMA_ENCODING
from hearthlog.schemas.mcap.raw_messages import RawMessages, gather_heads
from hearthlog.schemas.mcap.records import INDEX_ENTRIES, MESSAGE, MESSAGE_FIXED, Definitions
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.fields import missing_fields
from hearthlog.schemas.messages.message_types import GAP, definition, type_hash
from hearthlog.schemas.messages.topics import LIVE, Quality, parse_topic, topic
from hearthlog.schemas.messages.type_definitions import message_type
from hearthlog.schemas.salvage import Salvage
from hearthlog.schemas.salvage.intact_records import IntactChunk

_FEATURES, _LABEL, _GAP, _INFO = "features", "label", "gap", "info"
_STAMP = "header.stamp"
_FIELDS = {
    (_FEATURES, message_types.FEATURES): [_STAMP, "frame"],
    (_LABEL, message_types.LABEL): [_STAMP, "frame"],
    (_GAP, message_types.GAP): [_STAMP, "frames_lost", "duration"],
    (_INFO, message_types.STREAM_INFO): [],
}
_MOST = 1000  # maximum number of gaps read per piece


class FramePosition(NamedTuple):
    """Message that gives the position of a frame or a gap."""

    place: int  # offset in the content of its piece
    kind: str  # `features`, `label`, `gap` or `info`
    number: int  # frame number; for a gap, the number of lost frames
    start: int  # nanoseconds of UTC
    end: int


def read_marks(
    piece: IntactChunk | Message, definitions: Definitions
) -> dict[str, list[FramePosition]]:
    """Read the gaps of a piece, and its first and last frames, by microphone, in order.

    Messages that do not match the type of their channel are skipped.
    """
    marks: dict[str, list[FramePosition]] = {}
    content = b""
    for number, places in _places(piece):
        channel = definitions.channels[number]
        schema = definitions.schemas.get(channel.schema_id)
        topic = parse_topic(channel.topic)
        if schema is None or topic is None or topic.labelling != LIVE:
            continue
        fields = _FIELDS.get((topic.kind, schema.name))
        if fields is None:
            continue
        if missing_fields(schema.name, schema.encoding, schema.data, frozenset(fields)):
            continue
        content = content or _content(piece)  # contents without such channels are not read
        rows = places[:_MOST] if topic.kind in {_GAP, _INFO} else places[[0, -1]]
        buffer, heads = np.frombuffer(content, np.uint8), gather_heads(content, rows)
        raw = RawMessages(channel, schema, buffer, rows + MESSAGE.size, heads)
        marks.setdefault(topic.microphone, []).extend(_decode(raw, topic.kind, fields, rows))
    return {microphone: sorted(same) for microphone, same in marks.items()}


def _places(piece: IntactChunk | Message) -> Iterator[tuple[int, Int64]]:
    """Yield each channel of a piece, with the offsets of its messages in the content."""
    if isinstance(piece, Message):
        yield piece.channel_id, np.zeros(1, np.int64)
    else:
        for number, entries in piece.stored.entries.items():
            yield number, np.frombuffer(entries, INDEX_ENTRIES)["offset"]


def _content(piece: IntactChunk | Message) -> bytes:
    if not isinstance(piece, Message):
        return piece.stored.content()
    length = MESSAGE_FIXED + len(piece.data)
    times = piece.log_time, piece.publish_time
    head = MESSAGE.pack(Opcode.MESSAGE, length, piece.channel_id, piece.sequence, *times)
    return head + piece.data


def _decode(
    raw: RawMessages, kind: str, fields: Sequence[str], places: Int64
) -> Iterator[FramePosition]:
    try:
        (columns,) = decode([raw], fields)
    except LogError:
        return
    starts = columns.log_times if kind == _INFO else columns[_STAMP]  # `cut` repeats an older one
    numbers = columns[fields[1]] if kind != _INFO else np.zeros(len(starts), np.int64)
    lengths = columns[fields[2]] if kind == _GAP else np.full(len(starts), FRAME_NANOSECONDS)
    rows = (places, numbers, starts, starts + lengths)
    for place, number, start, end in zip(*(row.tolist() for row in rows), strict=True):
        yield FramePosition(place, kind, number, start, end)


_OF_SOUND = {"features", "statistics", "label", "segment"}  # prove that there was sound
_LATEST = NANOSECONDS << 31  # stamps have 32-bit seconds


class LostFrames(NamedTuple):
    """Consecutive lost frames of a microphone."""

    end: int  # nanoseconds of UTC
    start: int
    microphone: str
    frames: int


class FrameSearch:
    """Search for frames missing between the saved pieces of a log.

    `before` must be called with each piece of `salvage` as it is read.
    """

    def __init__(self, salvage: Salvage) -> None:
        self._salvage = salvage
        self._followers: dict[str, _FrameFollower] = {}

    def before(self, piece: IntactChunk | Message) -> list[LostFrames]:
        """Return the frames missing before the first frames of a piece."""
        lost: list[LostFrames] = []
        for microphone, marks in read_marks(piece, self._salvage.definitions).items():
            if microphone not in self._followers:
                self._followers[microphone] = _FrameFollower(microphone, self._salvage)
            lost += self._followers[microphone].follow(marks)
        return sorted(lost)

    def at_end(self, ends: Mapping[int, int]) -> list[LostFrames]:
        """Return the frames missing behind the last piece; none ends before the last of `ends`.

        These are the last saved log times by channel, in nanoseconds of UTC.
        """
        recorded_until: dict[str, int] = {}
        for number, end in ends.items():
            name = parse_topic(self._salvage.definitions.channels[number].topic)
            if name is not None and name.labelling == LIVE and name.kind in _OF_SOUND:
                recorded_until[name.microphone] = max(recorded_until.get(name.microphone, 0), end)
        last = max(ends.values(), default=0)
        followers = self._followers.items()
        return sorted(
            each
            for name, one in followers
            for each in one.at_end(recorded_until.get(name, 0), last)
        )


class _Place(NamedTuple):
    """Expected position of the next frame behind a mark."""

    number: int | None  # number of the next frame
    time: int  # its time in nanoseconds of UTC
    of_frame: bool  # whether the mark is a frame


class _FrameFollower:
    """Tracker of the frames of one microphone, by its features or, without features, its labels."""

    def __init__(self, microphone: str, salvage: Salvage) -> None:
        self._name = microphone
        self._salvage = salvage
        # Without an index, bytes can be missing between two records without visible damage.
        gaps = topic(microphone, _GAP)
        has_gaps = any(c.topic == gaps for c in salvage.definitions.channels.values())
        self._has_all_gaps = has_gaps and not salvage.complete
        self._kind = _LABEL
        self._place: _Place | None = None  # behind the last mark
        self._damages = 0  # number of damages before the last mark

    def follow(self, marks: Sequence[FramePosition]) -> list[LostFrames]:
        if any(mark.kind == _FEATURES for mark in marks):
            self._kind = _FEATURES
        lost: list[LostFrames] = []
        has_frames = False
        for mark in marks:
            # A damaged file may hold a piece twice.
            is_repeated = self._place is not None and mark.end <= self._place.time
            if mark.kind not in {self._kind, _GAP, _INFO} or is_repeated:
                continue
            count = 0 if has_frames else self._missing(mark)  # a piece has no internal losses
            if count:
                lost += self._lost(self._start(mark, count), mark.start, count)
            has_frames |= mark.kind == self._kind
            self._place = self._behind(mark, count)
            self._damages = self._salvage.damage_count
        return lost

    def at_end(self, recorded_until: int, last: int) -> list[LostFrames]:
        """Return the frames missing behind the last known sound."""
        if self._place is None or self._place.number is None or not self._is_damaged():
            return []
        start = self._place.time
        count = self._counted()
        if not count and self._kind == _FEATURES:  # labels end before the sound
            count = (recorded_until - start) // FRAME_NANOSECONDS
        return self._lost(start, max(start + count * FRAME_NANOSECONDS, last), count)

    def _missing(self, mark: FramePosition) -> int:
        """Count the frames missing before a mark."""
        if mark.kind == _INFO:  # start of another recording, or of the next log of a merged one
            return 0
        if self._place is None:
            return self._counted()
        number, time, of_frame = self._place
        if not self._is_damaged() and not (of_frame and mark.kind != _GAP and self._has_all_gaps):
            return 0
        by_time = max(round((mark.start - time) / FRAME_NANOSECONDS), 0)
        if mark.kind == _GAP:
            return by_time
        return min(by_time, mark.number) if number is None else max(mark.number - number, 0)

    def _start(self, mark: FramePosition, count: int) -> int:
        if self._place is None or self._place.number is None:
            return mark.start - count * FRAME_NANOSECONDS
        return self._place.time

    def _behind(self, mark: FramePosition, missing: int) -> _Place:
        if mark.kind == _INFO:
            return _Place(None, mark.start, of_frame=False)
        if mark.kind != _GAP:
            return _Place(mark.number + 1, mark.end, of_frame=True)
        number = None if self._place is None else self._place.number
        if number is not None:
            number += missing + mark.number
        return _Place(number, mark.end, of_frame=False)

    def _is_damaged(self) -> bool:
        return self._salvage.damage_count > self._damages

    def _counted(self) -> int:
        """Count the frames in the damages since the last mark; 0 if unknown."""
        damages = self._salvage.damages()[self._damages :]
        if not all(damage.exact for damage in damages):
            return 0
        return sum(damage.messages.get(topic(self._name, self._kind), 0) for damage in damages)

    def _lost(self, start: int, end: int, count: int) -> list[LostFrames]:
        if count <= 0 or not 0 <= start < end < _LATEST:
            return []
        return [LostFrames(end, start, self._name, count)]


_LAST = 0xFFFF  # maximum schema or channel ID


def gap_channel(definitions: Definitions, microphone: str) -> int | None:
    """Return the ID of a microphone's channel for gaps; add a missing one to `definitions`.

    None if the topic has a channel of another type.
    """
    name = topic(microphone, "gap")
    for number, channel in definitions.channels.items():
        if channel.topic == name:
            is_ours = definitions.defines(number) and _is_ours(definitions, channel)
            return number if is_ours else None
    number = _free(definitions.channels)
    metadata = rosbag2_channel(type_hash(GAP), Quality())
    definitions.add(Channel(number, name, ENCODING, metadata, _schema(definitions)))
    return number


def _is_ours(definitions: Definitions, channel: Channel) -> bool:
    schema = definitions.schemas.get(channel.schema_id)
    if schema is None or schema.name != GAP or channel.message_encoding != ENCODING:
        return False
    try:
        kind = message_type(schema.name, schema.encoding, schema.data)
    except LogError:
        return False
    return kind.types[GAP] == message_type(GAP).types[GAP]


def _schema(definitions: Definitions) -> int:
    """Return the schema ID of gaps; define a missing schema."""
    data = definition(GAP).encode()
    for number, schema in definitions.schemas.items():
        if (schema.name, schema.encoding, schema.data) == (GAP, SCHEMA_ENCODING, data):
            return number
    number = _free(definitions.schemas)
    definitions.add(Schema(number, data, SCHEMA_ENCODING, GAP))
    return number


def _free(numbers: dict[int, Channel] | dict[int, Schema]) -> int:
    """Return an ID that later definitions of the file are unlikely to use."""
    return next(number for number in range(_LAST, 0, -1) if number not in numbers)
