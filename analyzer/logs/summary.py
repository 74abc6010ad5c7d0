"""The summary of some logs: what is in them, and how to add what others hold."""

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.contents import LoggedGap, Status

Span = tuple[int, int]


@dataclass
class TopicSummary:
    """One topic."""

    type: str  # empty if there is no schema
    encoding: str  # of its messages
    messages: int = 0
    # of payloads before compression; None if the messages were counted by an index
    bytes: int | None = 0
    # first and last log time; by an index, those of the chunks that hold it
    span: Span | None = None

    @property
    def rate(self) -> float:
        """Messages a second between its first and its last one."""
        first, last = self.span or (0, 0)
        return (self.messages - 1) * NANOSECONDS / (last - first) if last > first else 0.0

    def add(self, count: int, size: int | None, span: Span | None) -> None:
        """Add messages of this topic.

        Parameters
        ----------
        size : int or None
            Bytes of their payloads before compression; None if that is not known.
        span : (int, int) or None
            Their first and last log time, in nanoseconds of UTC; None if that is not known.
        """
        self.messages += count
        self.bytes = None if self.bytes is None or size is None else self.bytes + size
        self.span = _hull(self.span, span)


@dataclass
class Summary:
    """What is in some logs."""

    files: list[Path] = field(default_factory=list)  # those that could be read
    # those that are still being written, or were cut short
    unfinished: list[Path] = field(default_factory=list)
    layers: list[Path] = field(default_factory=list)  # those that speak of another log
    damaged: dict[Path, str] = field(default_factory=dict)  # what is wrong with the others
    size: int = 0  # bytes on disk
    chunks: int = 0
    chunk_bytes: int = 0  # on disk
    raw_bytes: int = 0  # before compression
    profiles: set[str] = field(default_factory=set)  # names that occur in the files
    libraries: set[str] = field(default_factory=set)
    attachments: set[str] = field(default_factory=set)
    metadata: set[str] = field(default_factory=set)
    schema_versions: set[str] = field(default_factory=set)  # as their `hearthlog` records say
    topics: dict[str, TopicSummary] = field(default_factory=dict)
    # by microphone and label; those of a layer are under the name of its topic
    label_seconds: dict[str, Counter[str]] = field(default_factory=dict)
    segments: dict[str, Counter[str]] = field(default_factory=dict)  # their number, likewise
    segment_seconds: dict[str, Counter[str]] = field(default_factory=dict)  # but for reviews
    # `segments` and `seconds` of them whose labels are likelier wrong than right, likewise
    unsure: dict[str, Counter[str]] = field(default_factory=dict)
    gaps: list[LoggedGap] = field(default_factory=list)
    # what the files say of themselves: microphone, device, feature set, model
    streams: list[dict[str, Any]] = field(default_factory=list)
    health: Status | None = None  # the worst that was said, and of that the last
    latest_health: Status | None = None  # of the latest file; while it is written, of its end

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
        """Seconds that were not heard, of all microphones together."""
        return sum(gap.seconds for gap in self.gaps)

    @property
    def compression_ratio(self) -> float | None:
        """Bytes before compression for each byte on disk; None without chunks."""
        return self.raw_bytes / self.chunk_bytes if self.chunk_bytes else None

    def add(self, other: "Summary") -> None:
        """Add what other files hold to this summary.

        Parameters
        ----------
        other : Summary
            Of files that are not in this one; stays as it is.
        """
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
        for microphone, lengths in other.segment_seconds.items():
            self.segment_seconds.setdefault(microphone, Counter()).update(lengths)
        for microphone, amounts in other.unsure.items():
            self.unsure.setdefault(microphone, Counter()).update(amounts)
        self.gaps += other.gaps
        self.streams += [stream for stream in other.streams if stream not in self.streams]
        self.health = worse(self.health, other.health)
        both = [one for one in (self.latest_health, other.latest_health) if one is not None]
        self.latest_health = max(both, key=lambda status: status.time, default=None)


def worse(one: Status | None, other: Status | None) -> Status | None:
    """Return the status of the higher level, of equal levels the later one.

    Parameters
    ----------
    one, other : Status or None
        None where nothing was said.

    Returns
    -------
    Status or None
        None if nothing was said at all.
    """
    statuses = [status for status in (one, other) if status is not None]
    return max(statuses, key=lambda status: (status.level, status.time), default=None)


def _hull(one: Span | None, other: Span | None) -> Span | None:
    if one is None or other is None:
        return one or other
    return min(one[0], other[0]), max(one[1], other[1])
