"""What the messages of a log say, counted."""

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple

from mcap.records import Channel, Schema

from hearthlog.schemas.logs.columns import Columns, decode
from hearthlog.schemas.logs.statuses import Status, statuses_of
from hearthlog.schemas.mcap.raw_messages import RawMessages
from hearthlog.schemas.messages import message_types, topics
from hearthlog.schemas.messages.fields import missing_fields
from hearthlog.schemas.messages.labels import is_sound
from hearthlog.schemas.times import NANOSECONDS

STREAM = {
    "microphone": "header.frame_id",
    "device": "device",
    "feature_set": "feature_set",
    "frame_seconds": "frame_seconds",
    "model": "model",
    "model_sha256": "model_sha256",
}
FIELDS: Mapping[str, Collection[str]] = {
    message_types.STREAM_INFO: STREAM.values(),
    message_types.LABEL: ("label",),
    message_types.SEGMENT: ("label", "duration", "confidence"),
    message_types.GAP: ("header.stamp", "duration", "reason", "frames_lost"),
    message_types.DIAGNOSTICS: ("status",),
}
_UNSURE = 0.5  # of a segment with a lower confidence another label is likelier than its own

IsReadable = Callable[[Channel, Schema | None, str, Collection[str]], bool]


class TopicContents(NamedTuple):
    """Messages of a topic, bytes of their payloads, and their first and last log time (ns)."""

    messages: int
    bytes: int
    start: int
    end: int


class Gap(NamedTuple):
    """Audio that was not heard: when (ns of UTC), for how long (s), and why."""

    microphone: str
    start: int
    seconds: float
    reason: str
    frames_lost: int


@dataclass
class Contents:
    """What the messages of a log say, by microphone; of a layer, by the name of its topic."""

    topics: dict[str, TopicContents] = field(default_factory=dict)
    frames: dict[str, Counter[str]] = field(default_factory=dict)  # by label
    segments: dict[str, Counter[str]] = field(default_factory=dict)  # their number, by label
    seconds: dict[str, Counter[str]] = field(default_factory=dict)  # of segments, by label
    # `segments` and `seconds` of sounds whose labels are likelier wrong than right
    unsure: dict[str, Counter[str]] = field(default_factory=dict)
    gaps: list[Gap] = field(default_factory=list)
    streams: list[dict[str, Any]] = field(default_factory=list)  # with the keys of `STREAM`
    health: Status | None = None  # the worst that was said, and of that the last
    # the last that each part of the box said; not in what a log says of itself
    last: dict[str, Status] = field(default_factory=dict, compare=False)

    def add(self, batch: Sequence[RawMessages], readable: IsReadable | None = None) -> None:
        """Count some messages.

        Raise `LogError` if a message is not of the type that its channel says.
        """
        for raw in batch:
            self._add_topic(raw)
        for columns in _decoded(batch, readable or is_readable):
            self._add(columns)

    def differing(self, other: "Contents") -> list[str]:
        """Name what is counted otherwise elsewhere; the order of gaps makes no difference."""
        mine, theirs = (replace(each, gaps=sorted(each.gaps)) for each in (self, other))
        names = [each.name for each in fields(Contents) if each.compare]
        return [name for name in names if getattr(mine, name) != getattr(theirs, name)]

    def _add_topic(self, raw: RawMessages) -> None:
        size, start, end = int(raw.sizes.sum()), int(raw.log_times[0]), int(raw.log_times[-1])
        before = self.topics.get(raw.channel.topic, TopicContents(0, 0, start, end))
        self.topics[raw.channel.topic] = TopicContents(
            before.messages + len(raw),
            before.bytes + size,
            min(before.start, start),
            max(before.end, end),
        )

    def _add(self, columns: Columns) -> None:
        microphone = columns.topic.strip("/").rpartition("/")[0]
        if columns.type == message_types.LABEL:
            _counter(self.frames, microphone).update(columns["label"].tolist())
        elif columns.type == message_types.SEGMENT:
            self._add_segments(microphone, columns)
        elif columns.type == message_types.GAP:
            starts, seconds = columns["header.stamp"], columns["duration"] / NANOSECONDS
            parts = starts, seconds, columns["reason"], columns["frames_lost"]
            rows = zip(*(part.tolist() for part in parts), strict=True)
            self.gaps += [Gap(microphone, *row) for row in rows]
        elif columns.type == message_types.STREAM_INFO:
            for row in zip(*(columns[path].tolist() for path in STREAM.values()), strict=True):
                stream = dict(zip(STREAM, row, strict=True))
                if stream not in self.streams:
                    self.streams.append(stream)
        else:
            self._add_health(columns)

    def _add_segments(self, microphone: str, columns: Columns) -> None:
        labels = columns["label"].tolist()
        durations = (columns["duration"] / NANOSECONDS).tolist()
        _counter(self.segments, microphone).update(labels)
        seconds = _counter(self.seconds, microphone)
        for label, duration in zip(labels, durations, strict=True):
            seconds[label] += duration
        if not is_review(microphone):
            unsure = _counter(self.unsure, microphone)
            for row in (columns["confidence"] < _UNSURE).nonzero()[0].tolist():
                if is_sound(labels[row]):
                    unsure.update({"segments": 1, "seconds": durations[row]})

    def _add_health(self, columns: Columns) -> None:
        said = list(statuses_of(columns))
        self.last |= {status.name: status for status in said}
        said += [] if self.health is None else [self.health]
        self.health = max(said, key=lambda status: (status.level, status.time), default=None)


def is_review(microphone: str) -> bool:
    """Tell whether what stands for a microphone is a layer of marks."""
    return topics.is_review(microphone.partition("/")[2])


def is_readable(
    channel: Channel, schema: Schema | None, type_: str, paths: Collection[str]
) -> bool:
    """Tell whether a channel has messages of a type, from which some fields can be read.

    Parameters
    ----------
    schema : Schema or None
        Of the channel; None if it has none.
    """
    if schema is None or schema.name != type_ or channel.message_encoding != "cdr":
        return False
    return not missing_fields(type_, schema.encoding, schema.data, frozenset(paths))


def has_contents(
    channel: Channel, schema: Schema | None, readable: IsReadable = is_readable
) -> bool:
    """Tell whether `Contents` reads the messages of a channel.

    Parameters
    ----------
    schema : Schema or None
        Of the channel; None if it has none.
    """
    return any(readable(channel, schema, *kind) for kind in FIELDS.items())


def _decoded(batch: Sequence[RawMessages], readable: IsReadable) -> Iterator[Columns]:
    for type_, paths in FIELDS.items():
        same = [raw for raw in batch if readable(raw.channel, raw.schema, type_, paths)]
        yield from decode(same, paths)


def _counter(counters: dict[str, Counter[str]], name: str) -> Counter[str]:
    return counters.setdefault(name, Counter())
