"""Summary of logs: topics, sizes, labels, gaps and health."""

import struct
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import reduce
from pathlib import Path
from typing import Any

from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from hearthlog.analyzer.logs.selection import Damages, is_compatible
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import FRAME_SECONDS, NANOSECONDS
from hearthlog.schemas.logs.contents import (
    LogContents,
    LoggedGap,
    Status,
    has_contents,
    is_review,
    stated_contents,
)
from hearthlog.schemas.logs.files import is_layer
from hearthlog.schemas.logs.metadata import read_provenance, version_text
from hearthlog.schemas.mcap.chunks import read_in_batches
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.mcap.records import HEAD, RecordLocation

Span = tuple[int, int]


@dataclass
class TopicSummary:
    """Messages of one topic."""

    type: str  # empty without a schema
    encoding: str  # message encoding
    messages: int = 0
    # payload bytes before compression; None if the messages were counted by an index
    bytes: int | None = 0
    # first and last log time; if counted by an index, of the chunks with this topic
    span: Span | None = None

    @property
    def rate(self) -> float:
        """Messages per second between the first and the last message."""
        first, last = self.span or (0, 0)
        return (self.messages - 1) * NANOSECONDS / (last - first) if last > first else 0.0

    def add(self, count: int, size: int | None, span: Span | None) -> None:
        """Add messages of this topic; `size` is payload bytes before compression, None if unknown.

        The span has the first and last log time, in nanoseconds of UTC; None if unknown.
        """
        self.messages += count
        self.bytes = None if self.bytes is None or size is None else self.bytes + size
        self.span = _hull(self.span, span)


@dataclass
class LogSummary:
    """Contents of some logs."""

    files: list[Path] = field(default_factory=list)  # readable files
    # still being written, or cut short
    unfinished: list[Path] = field(default_factory=list)
    layers: list[Path] = field(default_factory=list)  # files that are layers of another log
    damaged: dict[Path, str] = field(default_factory=dict)  # error per damaged file
    size: int = 0  # bytes on disk
    chunks: int = 0
    chunk_bytes: int = 0  # bytes on disk
    raw_bytes: int = 0  # bytes before compression
    profiles: set[str] = field(default_factory=set)  # names in any of the files
    libraries: set[str] = field(default_factory=set)
    attachments: set[str] = field(default_factory=set)
    metadata: set[str] = field(default_factory=set)
    schema_versions: set[str] = field(default_factory=set)  # from the `hearthlog` records
    topics: dict[str, TopicSummary] = field(default_factory=dict)
    # by microphone and label; for a layer, by topic name and label
    label_seconds: dict[str, Counter[str]] = field(default_factory=dict)
    segments: dict[str, Counter[str]] = field(default_factory=dict)  # number of segments, likewise
    segment_seconds: dict[str, Counter[str]] = field(default_factory=dict)  # likewise, no reviews
    # `segments` and `seconds` of segments that are more likely wrong than right, likewise
    unsure: dict[str, Counter[str]] = field(default_factory=dict)
    gaps: list[LoggedGap] = field(default_factory=list)
    # microphone, device, feature set and model, as recorded in the files
    streams: list[dict[str, Any]] = field(default_factory=list)
    health: Status | None = None  # worst status; of equal levels the latest
    latest_health: Status | None = None  # of the latest file; at its end while it is being written

    @property
    def span(self) -> Span | None:
        """First and last log time, in nanoseconds of UTC; None if there is no message."""
        span = None
        for topic in self.topics.values():
            span = _hull(span, topic.span)
        return span

    @property
    def seconds(self) -> float:
        """Seconds from the first message to the last."""
        first, last = self.span or (0, 0)
        return (last - first) / NANOSECONDS

    @property
    def gap_seconds(self) -> float:
        """Seconds in gaps, summed over all microphones."""
        return sum(gap.seconds for gap in self.gaps)

    @property
    def compression_ratio(self) -> float | None:
        """Bytes before compression per byte on disk; None without chunks."""
        return self.raw_bytes / self.chunk_bytes if self.chunk_bytes else None

    def add(self, other: "LogSummary") -> None:
        """Merge the summary of other files into this one; `other` is not modified."""
        for name in ("files", "unfinished", "layers", "gaps"):
            getattr(self, name).extend(getattr(other, name))
        for name in ("size", "chunks", "chunk_bytes", "raw_bytes"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        for name in ("profiles", "libraries", "attachments", "metadata", "schema_versions"):
            getattr(self, name).update(getattr(other, name))
        self.damaged |= other.damaged
        for name, topic in other.topics.items():
            own = self.topics.setdefault(name, TopicSummary(topic.type, topic.encoding))
            own.add(topic.messages, topic.bytes, topic.span)
        for name in ("label_seconds", "segments", "segment_seconds", "unsure"):
            mine = getattr(self, name)
            for microphone, amounts in getattr(other, name).items():
                mine.setdefault(microphone, Counter()).update(amounts)
        self.streams += [stream for stream in other.streams if stream not in self.streams]
        self.health = worse(self.health, other.health)
        both = [one for one in (self.latest_health, other.latest_health) if one is not None]
        self.latest_health = max(both, key=lambda status: status.time, default=None)


def worse(one: Status | None, other: Status | None) -> Status | None:
    """Return the status with the higher level; of equal levels the later one; None without any."""
    statuses = [status for status in (one, other) if status is not None]
    return max(statuses, key=lambda status: (status.level, status.time), default=None)


def _hull(one: Span | None, other: Span | None) -> Span | None:
    if one is None or other is None:
        return one or other
    return min(one[0], other[0]), max(one[1], other[1])


_NAME_LENGTH = struct.Struct("<I")
_NAME_LIMIT = 1000
_TIMES = 16  # bytes of an attachment before its name


def summarise(paths: Iterable[Path]) -> LogSummary:
    """Summarise the contents of some logs."""
    total = LogSummary()
    for path in paths:
        try:
            total.add(_summarise(path))
        except LogError as error:
            total.damaged[path] = str(error)
    return total


def _summarise(path: Path) -> LogSummary:
    with LogFile(path, partial=True) as file:
        summary = _without_messages(file)
        ours = [has_contents(*channel, is_compatible) for channel in _channels(file)]
        for channel in _channels(file):
            _topic(summary, *channel)
        if _is_counted(file) and not any(ours):
            _count_by_index(file, summary)
        else:
            _add_contents(summary, stated_contents(file) or _read(file, summary))
    return summary


def _channels(file: LogFile) -> list[tuple[Channel, Schema | None]]:
    return [(channel, file.schemas.get(channel.schema_id)) for channel in file.channels.values()]


def _without_messages(file: LogFile) -> LogSummary:
    """Summarise a log without reading its messages."""
    chunks = file.chunks[file.chunks["index_length"] >= 0]
    summary = LogSummary(
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
    for location in file.record_locations:
        names = summary.metadata if location.opcode == Opcode.METADATA else summary.attachments
        names.add(_name(file, location))
    summary.schema_versions |= {version_text(record) for record in read_provenance(file)}
    return summary


def _name(file: LogFile, location: RecordLocation) -> str:
    """Read only the name of a metadata record or an attachment."""
    head = file.read(location.offset + HEAD.size, _TIMES + _NAME_LENGTH.size + _NAME_LIMIT)
    start = 0 if location.opcode == Opcode.METADATA else _TIMES
    try:
        (length,) = _NAME_LENGTH.unpack_from(head, start)
    except struct.error as error:
        raise file.damaged(location.offset, "a record is too short") from error
    start += _NAME_LENGTH.size
    return head[start : start + min(length, _NAME_LIMIT)].decode(errors="replace")


def _is_counted(file: LogFile) -> bool:
    """Whether the index has the message counts of all channels and defines these channels."""
    if file.statistics is None or file.late:
        return False
    counts = file.statistics.channel_message_counts
    is_complete = sum(counts.values()) == file.statistics.message_count
    indexed = (file.chunks["index_length"] > 0).any()
    is_complete &= bool(not indexed or file.lists_all_messages())
    return is_complete and counts.keys() <= file.channels.keys()


def _count_by_index(file: LogFile, summary: LogSummary) -> None:
    assert file.statistics is not None
    counts = file.statistics.channel_message_counts
    for identity, channel in file.channels.items():
        chunks = file.with_channels(file.chunks, {identity})
        count = counts.get(identity, 0)
        if count and len(chunks):
            span = int(chunks["start"].min()), int(chunks["end"].max())
            summary.topics[channel.topic].add(count, None, span)


def _read(file: LogFile, summary: LogSummary) -> LogContents:
    """Read all messages of a log."""
    contents = LogContents()
    damages = Damages()
    for batch in read_in_batches(file, file.chunks, on_damage=damages.add):
        for raw in batch:
            _topic(summary, raw.channel, raw.schema)
        try:
            contents.add(batch, is_compatible)
        except LogError as error:
            raise LogError(f"{file.path}: {error}") from error
    damages.warn_of_more()
    return contents


def _topic(summary: LogSummary, channel: Channel, schema: Schema | None) -> None:
    new = TopicSummary("" if schema is None else schema.name, channel.message_encoding)
    summary.topics.setdefault(channel.topic, new)


def _add_contents(summary: LogSummary, contents: LogContents) -> None:
    for name, counted in contents.topics.items():
        span = counted.start, counted.end
        summary.topics[name].add(counted.messages, counted.bytes, span)
    summary.segments = contents.segments
    summary.unsure = contents.unsure
    for microphone, seconds in contents.seconds.items():
        of_review = is_review(microphone)  # reviews have no frame labels
        (summary.label_seconds if of_review else summary.segment_seconds)[microphone] = seconds
    lengths = {stream["microphone"]: stream["frame_seconds"] for stream in contents.streams}
    for microphone, counts in contents.frames.items():
        length = lengths.get(microphone.partition("/")[0], FRAME_SECONDS)
        frames = {label: round(count * length, 3) for label, count in counts.items()}
        summary.label_seconds[microphone] = Counter(frames)
    summary.gaps = contents.gaps
    summary.streams = contents.streams
    summary.health = contents.health
    last = contents.last.values()  # a finished log is not read: its worst status stands in
    summary.latest_health = reduce(worse, last, None) if last else contents.health
