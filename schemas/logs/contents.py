"""Message counts, labels, gaps and health of a log, and their record `hearthlog_contents`."""

import hashlib
import json
import math
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple

from mcap.opcode import Opcode
from mcap.records import Channel, Metadata, Schema

from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import Columns, decode
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.mcap.raw_messages import RawMessages
from hearthlog.schemas.messages import message_types, topics
from hearthlog.schemas.messages.fields import missing_fields
from hearthlog.schemas.messages.topics import is_sound


class Status(NamedTuple):
    """Health status of a component of the recorder, at a log time (ns of UTC).

    `level` is that of `diagnostic_msgs/DiagnosticStatus`: 0 is OK, higher is worse.
    """

    name: str
    time: int
    level: int
    message: str


def statuses_of(columns: Columns) -> Iterator[Status]:
    """Yield each status of diagnostic messages; raise `LogError` if the field is missing."""
    for time, statuses in zip(columns.log_times.tolist(), columns["status"], strict=True):
        for status in statuses:
            yield Status(status["name"], time, int(status["level"]), status["message"])


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
_UNSURE = 0.5  # below this confidence, another label is likelier than that of the segment

IsReadable = Callable[[Channel, Schema | None, str, Collection[str]], bool]


class TopicContents(NamedTuple):
    """Message count of a topic, bytes of the payloads, and first and last log time (ns)."""

    messages: int
    bytes: int
    start: int
    end: int


class LoggedGap(NamedTuple):
    """Gap in the audio: start (ns of UTC), duration (s), and reason."""

    microphone: str
    start: int
    seconds: float
    reason: str
    frames_lost: int


@dataclass
class LogContents:
    """Summary of the messages of a log by microphone; of a layer, by topic name."""

    topics: dict[str, TopicContents] = field(default_factory=dict)
    frames: dict[str, Counter[str]] = field(default_factory=dict)  # by label
    segments: dict[str, Counter[str]] = field(default_factory=dict)  # number by label
    seconds: dict[str, Counter[str]] = field(default_factory=dict)  # duration of segments by label
    # `segments` and `seconds` of sounds with labels that are likelier wrong than right
    unsure: dict[str, Counter[str]] = field(default_factory=dict)
    gaps: list[LoggedGap] = field(default_factory=list)
    streams: list[dict[str, Any]] = field(default_factory=list)  # with the keys of `STREAM`
    health: Status | None = None  # the worst status, and the last of equal ones
    # last status of each component; not in the contents record
    last: dict[str, Status] = field(default_factory=dict, compare=False)

    def add(self, batch: Sequence[RawMessages], readable: IsReadable | None = None) -> None:
        """Add messages; raise `LogError` if one does not match the type of its channel."""
        for raw in batch:
            self._add_topic(raw)
        fits = readable or is_readable
        for type_, paths in FIELDS.items():
            same = [raw for raw in batch if fits(raw.channel, raw.schema, type_, paths)]
            for columns in decode(same, paths):
                self._add(columns)

    def differing(self, other: "LogContents") -> list[str]:
        """List the names of counts that differ from another summary, ignoring the order of gaps."""
        mine, theirs = (replace(each, gaps=sorted(each.gaps)) for each in (self, other))
        names = [each.name for each in fields(LogContents) if each.compare]
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
            self.gaps += [LoggedGap(microphone, *row) for row in rows]
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
        statuses = list(statuses_of(columns))
        self.last |= {status.name: status for status in statuses}
        statuses += [] if self.health is None else [self.health]
        self.health = max(statuses, key=lambda status: (status.level, status.time), default=None)


def is_review(microphone: str) -> bool:
    """Return whether a key in place of a microphone is a review layer."""
    return topics.is_review(microphone.partition("/")[2])


def is_readable(
    channel: Channel, schema: Schema | None, type_: str, paths: Collection[str]
) -> bool:
    """Return whether a channel has messages of a type with the required fields."""
    if schema is None or schema.name != type_ or channel.message_encoding != "cdr":
        return False
    return not missing_fields(type_, schema.encoding, schema.data, frozenset(paths))


def has_contents(
    channel: Channel, schema: Schema | None, readable: IsReadable = is_readable
) -> bool:
    """Return whether `LogContents` reads the messages of a channel."""
    return any(readable(channel, schema, *kind) for kind in FIELDS.items())


def _counter(counters: dict[str, Counter[str]], name: str) -> Counter[str]:
    return counters.setdefault(name, Counter())


CONTENTS_METADATA = "hearthlog_contents"
_VERSION = "1"  # other versions are not read
_LARGEST = 1 << 16  # bytes of the text
_ROOM = 1 << 10  # maximum bytes of the rest of the record
_MOST = 1 << 63


def as_metadata(contents: LogContents) -> dict[str, str] | None:
    """Build the contents record; None if it would be large."""
    recorded = [each.name for each in fields(contents) if each.compare]
    text = json.dumps({name: getattr(contents, name) for name in recorded})
    if len(text) > _LARGEST:
        return None
    return {"version": _VERSION, "contents": text, "sha256": _digest(text)}


def stated_contents(file: LogFile) -> LogContents | None:
    """Read the contents record of a finished log.

    None without a record, or if it contradicts the statistics: the messages must be counted. Raise
    `LogError` if the file cannot be read, or its last metadata record is damaged.
    """
    places = [place for place in file.record_locations if place.opcode == Opcode.METADATA]
    if file.statistics is None or not places or places[-1].length > _LARGEST + _ROOM:
        return None
    record = file.record(places[-1])  # position at which the writer puts the record
    if not isinstance(record, Metadata) or record.name != CONTENTS_METADATA:
        return None
    contents = from_metadata(record.metadata)
    return contents if contents is not None and _fits(file, contents) else None


def from_metadata(record: Mapping[str, str]) -> LogContents | None:
    """Parse the contents record of an untrusted file: its form is checked, but not its truth.

    None if it is damaged, or of another version.
    """
    text = record.get("contents", "")
    if record.get("version") != _VERSION or record.get("sha256") != _digest(text):
        return None
    try:
        return _contents(json.loads(text))
    except (ValueError, TypeError, KeyError, AttributeError, ArithmeticError, RecursionError):
        return None


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode(errors="replace")).hexdigest()


def _contents(values: Any) -> LogContents:
    health = values["health"]
    return LogContents(
        topics={name: TopicContents(*map(_count, row)) for name, row in values["topics"].items()},
        frames=_counters(values["frames"], _count),
        segments=_counters(values["segments"], _count),
        seconds=_counters(values["seconds"], _amount),
        unsure=_counters(values["unsure"], _amount),
        gaps=[
            LoggedGap(_text(mic), _count(start), _amount(seconds), _text(reason), _count(lost))
            for mic, start, seconds, reason, lost in values["gaps"]
        ],
        streams=[_stream(stream) for stream in values["streams"]],
        health=None if health is None else _health(*health),
    )


def _health(name: Any, time: Any, level: Any, message: Any) -> Status:
    return Status(_text(name), _count(time), _count(level), _text(message))


def _stream(values: Any) -> dict[str, Any]:
    return {name: (_amount if name == "frame_seconds" else _text)(values[name]) for name in STREAM}


def _counters(values: Any, number: Any) -> dict[str, Counter[str]]:
    return {
        name: Counter({label: number(value) for label, value in row.items()})
        for name, row in values.items()
    }


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError(value)
    return value


def _count(value: Any) -> int:
    if type(value) is not int or not -_MOST <= value < _MOST:
        raise ValueError(value)
    return value


def _amount(value: Any) -> float:
    if type(value) not in {int, float} or not math.isfinite(value) or abs(value) >= _MOST:
        raise ValueError(value)
    number: float = value  # an empty sum is the integer 0
    return number


def _fits(file: LogFile, contents: LogContents) -> bool:
    """Compare the contents record of a file with its statistics."""
    statistics = file.statistics
    assert statistics is not None
    counts: Counter[str] = Counter()
    for number, count in statistics.channel_message_counts.items():
        if count and number not in file.channels:
            return False
        if count:
            counts[file.channels[number].topic] += count
    topics = contents.topics
    if counts != {name: topic.messages for name, topic in topics.items()}:
        return False
    if not topics:
        return True
    span = min(t.start for t in topics.values()), max(t.end for t in topics.values())
    return span == (statistics.message_start_time, statistics.message_end_time)
