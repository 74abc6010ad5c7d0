"""What a saved piece of a log says of the frames of its microphones."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Message, Schema

from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import FRAME_NANOSECONDS
from hearthlog.schemas.logs.columns import decode
from hearthlog.schemas.mcap.definitions import Definitions
from hearthlog.schemas.mcap.formats import INDEX_ENTRIES, MESSAGE, MESSAGE_FIXED
from hearthlog.schemas.mcap.raw_messages import RawMessages, gather_heads
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.fields import lacking
from hearthlog.schemas.messages.topics import LIVE, parse_topic
from hearthlog.schemas.messages.type_definitions import message_type
from hearthlog.schemas.salvage.whole_records import WholeChunk

FEATURES, LABEL, GAP, INFO = "features", "label", "gap", "info"
_STAMP = "header.stamp"
_FIELDS = {
    (FEATURES, message_types.FEATURES): [_STAMP, "frame"],
    (LABEL, message_types.LABEL): [_STAMP, "frame"],
    (GAP, message_types.GAP): [_STAMP, "frames_lost", "duration"],
    (INFO, message_types.STREAM_INFO): [],
}
_MOST = 1000  # gaps of a piece that are looked at


class Mark(NamedTuple):
    """A message that tells of frames, or of their lack."""

    place: int  # byte of the content of its piece
    kind: str  # `features`, `label`, `gap` or `info`
    number: int  # of the frame; of a gap the frames that it lost
    start: int  # nanoseconds of UTC
    end: int


def read_marks(piece: WholeChunk | Message, definitions: Definitions) -> dict[str, list[Mark]]:
    """Read the gaps of a piece, and the first and the last of its frames.

    Returns
    -------
    dict of str to list of Mark
        By microphone, in the order of the piece. Messages that are not of the type that their
        channel names are left out.
    """
    marks: dict[str, list[Mark]] = {}
    content = b""
    for number, places in _places(piece):
        channel = definitions.channels[number]
        schema = definitions.schemas.get(channel.schema_id)
        topic = parse_topic(channel.topic)
        if schema is None or topic is None or topic.labelling != LIVE:
            continue
        fields = _FIELDS.get((topic.kind, schema.name))
        if fields is None or not _defines(schema, fields):
            continue
        content = content or _content(piece)  # that of other files is not looked at
        rows = places[:_MOST] if topic.kind in {GAP, INFO} else places[[0, -1]]
        buffer, heads = np.frombuffer(content, np.uint8), gather_heads(content, rows)
        raw = RawMessages(channel, schema, buffer, rows + MESSAGE.size, heads)
        marks.setdefault(topic.microphone, []).extend(_decode(raw, topic.kind, fields, rows))
    return {microphone: sorted(same) for microphone, same in marks.items()}


def _defines(schema: Schema, fields: Sequence[str]) -> bool:
    try:
        return not lacking(message_type(schema.name, schema.encoding, schema.data), fields)
    except LogError:
        return False


def _places(piece: WholeChunk | Message) -> Iterator[tuple[int, Int64]]:
    """Yield each channel of a piece, and where in its content the messages are."""
    if isinstance(piece, Message):
        yield piece.channel_id, np.zeros(1, np.int64)
    else:
        for number, entries in piece.stored.entries.items():
            yield number, np.frombuffer(entries, INDEX_ENTRIES)["offset"]


def _content(piece: WholeChunk | Message) -> bytes:
    if not isinstance(piece, Message):
        return piece.stored.content()
    length = MESSAGE_FIXED + len(piece.data)
    times = piece.log_time, piece.publish_time
    head = MESSAGE.pack(Opcode.MESSAGE, length, piece.channel_id, piece.sequence, *times)
    return head + piece.data


def _decode(raw: RawMessages, kind: str, fields: Sequence[str], places: Int64) -> Iterator[Mark]:
    try:
        (columns,) = decode([raw], fields)
    except LogError:
        return
    starts = columns.log_times if kind == INFO else columns[_STAMP]  # `cut` repeats an older one
    numbers = columns[fields[1]] if kind != INFO else np.zeros(len(starts), np.int64)
    lengths = columns[fields[2]] if kind == GAP else np.full(len(starts), FRAME_NANOSECONDS)
    rows = (places, numbers, starts, starts + lengths)
    for place, number, start, end in zip(*(row.tolist() for row in rows), strict=True):
        yield Mark(place, kind, number, start, end)
