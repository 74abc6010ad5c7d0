"""What is in a log, or in a folder of logs."""

import struct
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from hearthlog.analyzer.logs.typed_columns import decode_types, is_compatible
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import FRAME_SECONDS
from hearthlog.schemas.logs.columns import Columns
from hearthlog.schemas.logs.files import is_layer
from hearthlog.schemas.logs.provenance import read_provenance, version_text
from hearthlog.schemas.mcap.chunks import read_in_batches
from hearthlog.schemas.mcap.formats import HEAD
from hearthlog.schemas.mcap.logfile import LogFile, RecordLocation
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.times import NANOSECONDS

_STREAM = {
    "microphone": "header.frame_id",
    "device": "device",
    "feature_set": "feature_set",
    "frame_seconds": "frame_seconds",
    "model": "model",
    "model_sha256": "model_sha256",
}
_FIELDS = {
    message_types.STREAM_INFO: _STREAM.values(),
    message_types.LABEL: ("label",),
    message_types.SEGMENT: ("label", "duration"),
    message_types.GAP: ("header.stamp", "duration", "reason", "frames_lost"),
    message_types.DIAGNOSTICS: ("status",),
}
_NAME_LENGTH = struct.Struct("<I")
_NAME_LIMIT = 1000
_TIMES = 16  # bytes of an attachment before its name

Span = tuple[int, int]


@dataclass
class TopicSummary:
    """One topic.

    Attributes
    ----------
    type : str
        Empty if there is no schema.
    encoding : str
        Of its messages.
    messages : int
    bytes : int or None
        Of their payloads before compression; None if the messages were counted by an index.
    span : (int, int) or None
        First and last log time; by an index, those of the chunks that hold it.
    """

    type: str
    encoding: str
    messages: int = 0
    bytes: int | None = 0
    span: Span | None = None

    @property
    def rate(self) -> float:
        """Messages a second between its first and its last one."""
        first, last = self.span or (0, 0)
        return (self.messages - 1) * NANOSECONDS / (last - first) if last > first else 0.0

    def add(self, count: int, size: int | None, span: Span | None) -> None:
        """Add messages of this topic: how many, their bytes and their first and last log time."""
        self.messages += count
        self.bytes = None if self.bytes is None or size is None else self.bytes + size
        self.span = _hull(self.span, span)


@dataclass(frozen=True)
class GapSummary:
    """Audio that was not heard: when (ns of UTC), for how long (s), and why."""

    microphone: str
    start: int
    seconds: float
    reason: str
    frames_lost: int


@dataclass(frozen=True)
class Health:
    """What a diagnostic message said, and when (ns of UTC); level 0 is well, higher is worse."""

    level: int
    time: int
    name: str
    message: str


@dataclass
class Summary:
    """What was found in some logs.

    Attributes
    ----------
    files : list of Path
        Those that could be read.
    unfinished : list of Path
        Those of them that are still being written, or were cut short.
    layers : list of Path
        Those of them that speak about another log.
    damaged : dict of Path to str
        What is wrong with the others.
    size : int
        Bytes on disk.
    chunks, chunk_bytes, raw_bytes : int
        Number of chunks, their bytes on disk and before compression.
    profiles, libraries, attachments, metadata : set of str
        Names that occur in the files.
    schema_versions : set of str
        As their `hearthlog` records say.
    topics : dict of str to TopicSummary
    label_seconds : dict of str to dict of str to float
        By microphone and label. The labels of a layer are under the name of its topic.
    segments : dict of str to dict of str to int
        Their number, likewise.
    gaps : list of GapSummary
    streams : list of dict
        What the files say of themselves: microphone, device, feature set, model.
    health : Health or None
        The worst that was said, and of that the last.
    """

    files: list[Path] = field(default_factory=list)
    unfinished: list[Path] = field(default_factory=list)
    layers: list[Path] = field(default_factory=list)
    damaged: dict[Path, str] = field(default_factory=dict)
    size: int = 0
    chunks: int = 0
    chunk_bytes: int = 0
    raw_bytes: int = 0
    profiles: set[str] = field(default_factory=set)
    libraries: set[str] = field(default_factory=set)
    attachments: set[str] = field(default_factory=set)
    metadata: set[str] = field(default_factory=set)
    schema_versions: set[str] = field(default_factory=set)
    topics: dict[str, TopicSummary] = field(default_factory=dict)
    label_seconds: dict[str, Counter[str]] = field(default_factory=dict)
    segments: dict[str, Counter[str]] = field(default_factory=dict)
    gaps: list[GapSummary] = field(default_factory=list)
    streams: list[dict[str, Any]] = field(default_factory=list)
    health: Health | None = None

    @property
    def span(self) -> Span | None:
        """Log times of the first and the last message; None if there is none."""
        span = None
        for topic in self.topics.values():
            span = _hull(span, topic.span)
        return span

    @property
    def seconds(self) -> float:
        """Time from the first message to the last."""
        first, last = self.span or (0, 0)
        return (last - first) / NANOSECONDS

    @property
    def gap_seconds(self) -> float:
        """Time that was not heard, of all microphones together."""
        return sum(gap.seconds for gap in self.gaps)

    @property
    def compression_ratio(self) -> float | None:
        """Bytes before compression for each on disk; None without chunks."""
        return self.raw_bytes / self.chunk_bytes if self.chunk_bytes else None

    def add(self, other: "Summary") -> None:
        """Add what other files hold."""
        self.files += other.files
        self.unfinished += other.unfinished
        self.layers += other.layers
        self.damaged |= other.damaged
        self.size += other.size
        self.chunks += other.chunks
        self.chunk_bytes += other.chunk_bytes
        self.raw_bytes += other.raw_bytes
        self.profiles |= other.profiles
        self.libraries |= other.libraries
        self.attachments |= other.attachments
        self.metadata |= other.metadata
        self.schema_versions |= other.schema_versions
        for name, topic in other.topics.items():
            mine = self.topics.setdefault(name, TopicSummary(topic.type, topic.encoding))
            mine.add(topic.messages, topic.bytes, topic.span)
        for microphone, seconds in other.label_seconds.items():
            self.label_seconds.setdefault(microphone, Counter()).update(seconds)
        for microphone, counts in other.segments.items():
            self.segments.setdefault(microphone, Counter()).update(counts)
        self.gaps += other.gaps
        self.streams += [stream for stream in other.streams if stream not in self.streams]
        self.health = _worse(self.health, other.health)


def summarise(paths: Iterable[Path]) -> Summary:
    """Count what is in some logs; those that are damaged are only named."""
    total = Summary()
    for path in paths:
        try:
            total.add(_summarise(path))
        except LogError as error:
            total.damaged[path] = str(error)
    return total


def _summarise(path: Path) -> Summary:
    with LogFile(path) as file:
        summary = _about(file)
        ours = any(
            is_compatible(*channel, *wanted)
            for channel in _channels(file)
            for wanted in _FIELDS.items()
        )
        if _is_counted(file) and not ours:
            _count_by_index(file, summary)
        else:
            _read_through(file, summary)
    return summary


def _channels(file: LogFile) -> list[tuple[Channel, Schema | None]]:
    return [(channel, file.schemas.get(channel.schema_id)) for channel in file.channels.values()]


def _about(file: LogFile) -> Summary:
    """Tell what is known without a look at the messages."""
    chunks = file.chunks[file.chunks["index_length"] >= 0]
    summary = Summary(
        files=[file.path],
        unfinished=[] if file.complete else [file.path],
        layers=[file.path] if is_layer(file.path) else [],
        size=file.size,
        chunks=len(chunks),
        chunk_bytes=int(chunks["length"].sum()),
        raw_bytes=int(chunks["size"].sum()),
    )
    if file.header is not None:
        summary.profiles |= {file.header.profile} - {""}
        summary.libraries |= {file.header.library} - {""}
    for place in file.record_locations:
        names = summary.metadata if place.opcode == Opcode.METADATA else summary.attachments
        names.add(_name(file, place))
    summary.schema_versions |= {version_text(record) for record in read_provenance(file)}
    return summary


def _name(file: LogFile, place: RecordLocation) -> str:
    """Read the name of a metadata record or an attachment, and nothing else of it."""
    head = file.read(place.offset + HEAD.size, _TIMES + _NAME_LENGTH.size + _NAME_LIMIT)
    start = 0 if place.opcode == Opcode.METADATA else _TIMES
    try:
        (length,) = _NAME_LENGTH.unpack_from(head, start)
    except struct.error as error:
        raise file.damaged(place.offset, "a record is too short") from error
    start += _NAME_LENGTH.size
    return head[start : start + min(length, _NAME_LIMIT)].decode(errors="replace")


def _is_counted(file: LogFile) -> bool:
    """Tell whether the file says how many messages each of its channels has."""
    about = file.statistics
    return about is not None and sum(about.channel_message_counts.values()) == about.message_count


def _count_by_index(file: LogFile, summary: Summary) -> None:
    assert file.statistics is not None
    counts = file.statistics.channel_message_counts
    for identity, channel in file.channels.items():
        topic = _topic(summary, channel, file.schemas.get(channel.schema_id))
        holds = [not ids or identity in ids for ids in file.channel_sets]
        chunks = file.chunks[np.array(holds, bool)[file.chunks["channels"]]]
        count = counts.get(identity, 0)
        if count and len(chunks):
            topic.add(count, None, (int(chunks["start"].min()), int(chunks["end"].max())))


def _read_through(file: LogFile, summary: Summary) -> None:
    for about in _channels(file):
        _topic(summary, *about)
    frames: dict[str, Counter[str]] = {}
    for batch in read_in_batches(file, file.chunks, check=True):
        for raw in batch:
            times = raw.log_times
            topic = _topic(summary, raw.channel, raw.schema)
            topic.add(len(raw), int(raw.sizes.sum()), (int(times[0]), int(times[-1])))
        for columns in decode_types(file.path, batch, _FIELDS):
            _note(summary, frames, columns)
    lengths = {stream["microphone"]: stream["frame_seconds"] for stream in summary.streams}
    for microphone, counts in frames.items():
        length = lengths.get(microphone.partition("/")[0], FRAME_SECONDS)
        seconds = {label: round(count * length, 3) for label, count in counts.items()}
        summary.label_seconds[microphone] = Counter(seconds)


def _topic(summary: Summary, channel: Channel, schema: Schema | None) -> TopicSummary:
    new = TopicSummary("" if schema is None else schema.name, channel.message_encoding)
    return summary.topics.setdefault(channel.topic, new)


def _note(summary: Summary, frames: dict[str, Counter[str]], columns: Columns) -> None:
    microphone = columns.topic.strip("/").rpartition("/")[0]
    if columns.type == message_types.LABEL:
        frames.setdefault(microphone, Counter()).update(columns["label"].tolist())
    elif columns.type == message_types.SEGMENT:
        summary.segments.setdefault(microphone, Counter()).update(columns["label"].tolist())
        if microphone.endswith("/review"):  # which has no labels frame by frame
            _note_marks(summary.label_seconds.setdefault(microphone, Counter()), columns)
    elif columns.type == message_types.GAP:
        starts, seconds = columns["header.stamp"], columns["duration"] / NANOSECONDS
        fields = starts, seconds, columns["reason"], columns["frames_lost"]
        rows = zip(*(column.tolist() for column in fields), strict=True)
        summary.gaps += [GapSummary(microphone, *row) for row in rows]
    elif columns.type == message_types.STREAM_INFO:
        for row in zip(*(columns[path].tolist() for path in _STREAM.values()), strict=True):
            stream = dict(zip(_STREAM, row, strict=True))
            if stream not in summary.streams:
                summary.streams.append(stream)
    else:
        for time, statuses in zip(columns.log_times.tolist(), columns["status"], strict=True):
            for status in statuses:
                said = Health(status["level"], time, status["name"], status["message"])
                summary.health = _worse(summary.health, said)


def _note_marks(seconds: Counter[str], columns: Columns) -> None:
    durations = (columns["duration"] / NANOSECONDS).tolist()
    for label, duration in zip(columns["label"].tolist(), durations, strict=True):
        seconds[label] += duration


def _worse(one: Health | None, other: Health | None) -> Health | None:
    """Return the worse of two, of equal ones the later."""
    said = [health for health in (one, other) if health is not None]
    return max(said, key=lambda health: (health.level, health.time), default=None)


def _hull(one: Span | None, other: Span | None) -> Span | None:
    if one is None or other is None:
        return one or other
    return min(one[0], other[0]), max(one[1], other[1])
