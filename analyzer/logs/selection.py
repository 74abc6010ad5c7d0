"""Selection of topics and a time span of logs, read as columns."""

import json
import warnings
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from itertools import chain
from pathlib import Path
from threading import Lock
from typing import Any, NamedTuple, TypeVar

import numpy as np
from mcap.records import Channel, Schema

from hearthlog.analyzer.logs.catalog import LogSpans, find_spans
from hearthlog.schemas.errors import HearthlogWarning, LogError, Progress, abridged, ignore_progress
from hearthlog.schemas.files import map_logs
from hearthlog.schemas.logs.columns import Columns, decode, decode_readable, leave_out, unreadable
from hearthlog.schemas.logs.files import time_span
from hearthlog.schemas.logs.merged_reading import iterate_messages
from hearthlog.schemas.logs.metadata import read_provenance
from hearthlog.schemas.logs.writer import ENCODING
from hearthlog.schemas.mcap.chunks import read_definitions, verify_chunks
from hearthlog.schemas.mcap.logfile import RECOVER, LogFile
from hearthlog.schemas.mcap.raw_messages import RawMessages
from hearthlog.schemas.mcap.records import MESSAGE_HEAD
from hearthlog.schemas.messages.fields import Field, fields_of, missing_fields
from hearthlog.schemas.messages.type_definitions import message_type


class TypedColumns(NamedTuple):
    """Messages of one topic, with their fields by path."""

    columns: Columns
    fields: Mapping[str, Field]


def decode_types(
    path: Path, batch: Iterable[RawMessages], types: Mapping[str, Collection[str]]
) -> list[Columns]:
    """Decode the messages of the given types and drop all others.

    `types` has the paths of the fields to decode, by type name; `is_compatible` defines which
    fields a type may have. Raise `LogError` if a message does not match the type of its channel.
    """
    decoded: list[Columns] = []
    try:
        for type_, fields in types.items():
            same = [raw for raw in batch if is_compatible(raw.channel, raw.schema, type_, fields)]
            decoded += decode(same, fields)
    except LogError as error:
        raise LogError(f"{path}: {error}") from error
    return decoded


def decode_all(batch: Iterable[RawMessages]) -> list[TypedColumns]:
    """Decode all fields of messages of any type, grouped by topic and definition.

    Messages that cannot be decoded are dropped with a `HearthlogWarning`, as in
    `decode_readable`.
    """
    groups: dict[Any, list[RawMessages]] = {}
    for raw in batch:
        definition = None if raw.schema is None else (raw.schema.name, raw.schema.data)
        groups.setdefault((raw.channel.topic, definition), []).append(raw)
    decoded: list[TypedColumns] = []
    for group in groups.values():
        schema = group[0].schema
        if parts := decode_readable(group):
            assert schema is not None  # it was decoded
            fields = fields_of(message_type(schema.name, schema.encoding, schema.data))
            decoded += [TypedColumns(columns, fields) for columns in parts]
    return decoded


def is_compatible(
    channel: Channel, schema: Schema | None, type_: str, fields: Collection[str]
) -> bool:
    """Whether a channel has CDR messages of a type with the given fields.

    Any version of our types can be read: fields that were appended later have defaults. A
    definition that matches no version of the type causes a `HearthlogWarning`.
    """
    if schema is None or schema.name != type_ or channel.message_encoding != ENCODING:
        return False
    missing = missing_fields(type_, schema.encoding, schema.data, frozenset(fields))
    if missing:
        text = f"{type_} is defined without {missing} as hearthlog has it: not read"
        warnings.warn(HearthlogWarning(text, channel.topic), stacklevel=2)
    return not missing


_LAST = (1 << 63) - 1  # log time
_NAMED = 5  # maximum of undecodable topics in an error
Result = TypeVar("Result")
_CHUNKS_NAMED = 3  # maximum of damaged chunks of a log with a warning each
Described = tuple[Channel, Schema | None]


class Damages:
    """Collector of warnings about damaged chunks: the first few of each log, then a count."""

    def __init__(self) -> None:
        self._reported: dict[Path, set[str]] = {}
        self._lock = Lock()

    def add(self, path: Path, error: LogError) -> None:
        """Record a damaged chunk; thread-safe."""
        text = str(error)
        with self._lock:
            reported = self._reported.setdefault(path, set())
            is_new = text not in reported
            reported.add(text)
        if is_new and len(reported) <= _CHUNKS_NAMED:
            _warn(path, error)

    def warn_of_more(self) -> None:
        """Warn of the number of damaged chunks without a warning of their own."""
        for path, reported in self._reported.items():
            if (more := len(reported) - _CHUNKS_NAMED) > 0:
                _warn(path, LogError(f"{more:,} more chunks are damaged and left out{RECOVER}"))


@dataclass(frozen=True)
class LogSelection:
    """Topics and a span of time of some logs."""

    logs: Sequence[Path]  # logs with messages in the span
    empty: Sequence[Path]  # logs without any message
    unfinished: Sequence[Path]  # logs in `logs` or `empty` that were not completed
    channels: Mapping[str, Sequence[Described]]  # by topic, without duplicates
    # `hearthlog` records of the logs, without duplicates
    metadata: Sequence[Mapping[str, str]]
    topics: frozenset[str] | None  # None: all
    start: int | None  # log times in nanoseconds: from `start` on, before `end`
    end: int | None
    span: tuple[int, int]  # log times of the first and the last message
    spans: LogSpans = field(compare=False, repr=False)  # of all logs

    @property
    def earlier(self) -> Iterator[Path]:
        """The logs with messages before the span, latest first."""
        return self.spans.before(0 if self.start is None else self.start)

    @property
    def is_part(self) -> bool:
        """Whether the selection is limited to some topics or a span of time."""
        return any(limit is not None for limit in (self.topics, self.start, self.end))

    def messages(
        self, progress: Progress = ignore_progress, *, once: bool = False
    ) -> Iterator[list[RawMessages]]:
        """Read the messages of the selection, still encoded, in order of time.

        They are as from `iterate_messages`; damaged chunks are skipped with a warning, and so are,
        with `once`, chunks that repeat an earlier chunk of their log byte for byte. `progress`
        receives the share of the time span that is done, 0 to 1. Raise `LogError` if a log can no
        longer be read.
        """
        first, last = self.span
        damages = Damages()
        chosen = self.topics, self.start, self.end
        for batch in iterate_messages(self.logs, *chosen, on_damage=damages.add, once=once):
            yield batch
            now = max(int(messages.log_times[-1]) for messages in batch)
            progress((now - first) / max(last - first, 1))
        damages.warn_of_more()

    def verify(self) -> None:
        """Compare all chunks with their checksums, before reading messages.

        Raise `LogError` if a chunk is damaged.
        """
        for path in self.logs:
            with LogFile(path) as file:
                ends, starts = file.chunks["end"], file.chunks["start"]
                verify_chunks(
                    file, file.chunks[(ends >= (self.start or 0)) & (starts < (self.end or _LAST))]
                )

    def topics_of(self, type_: str, fields: Collection[str]) -> list[str]:
        """List the topics, in order of `channels`, of a type whose channels all have some fields.

        The type is a name such as in `message_types`; fields are given by their paths.
        """
        return [
            topic
            for topic, channels in self.channels.items()
            if all(is_compatible(*channel, type_, fields) for channel in channels)
        ]

    def only(self, topics: Collection[str]) -> "LogSelection":
        """Return the selection limited to some topics, by name."""
        left = {topic: same for topic, same in self.channels.items() if topic in topics}
        return replace(self, topics=frozenset(topics), channels=left)

    def decodable(self) -> "LogSelection":
        """Return the selection without undecodable channels, with a warning for each.

        Undecodable channels are not of ROS 2, or the log has no usable definition of their type.

        Raise `LogError` if no channel is left.
        """
        left: dict[str, Sequence[Described]] = {}
        faults: dict[str, str] = {}
        for topic, channels in self.channels.items():
            reasons = [unreadable(*channel) for channel in channels]
            readable = [channel for channel, why in zip(channels, reasons, strict=True) if not why]
            if readable:
                left[topic] = readable
            for why in filter(None, reasons):
                faults[topic] = why
        if not faults:
            return self
        if not left:
            named = [f"{topic}: {why}" for topic, why in faults.items()]
            more = [f"and {len(named) - _NAMED} more"] if len(named) > _NAMED else []
            raise LogError("; ".join([*named[:_NAMED], *more]))
        for topic, why in faults.items():
            leave_out(topic, why)
        return replace(self, topics=frozenset(left), channels=left)

    def no_messages(self) -> list[RawMessages]:
        """Return an empty batch per channel, which decoders turn into columns without rows."""
        buffer, offsets, heads = np.empty(0, np.uint8), np.empty(0, int), np.empty(0, MESSAGE_HEAD)
        channels = chain.from_iterable(self.channels.values())
        return [RawMessages(*channel, buffer, offsets, heads) for channel in channels]

    def nothing(self) -> LogError:
        """Return the error for a selection without messages."""
        topics = "" if not self.topics else f" of {abridged(sorted(self.topics))}"
        where = "these logs" if self.start is None and self.end is None else "this span of time"
        return LogError(f"no message{topics} in {where}; `hearthlog info` shows what there is")


def select(
    paths: Iterable[Path],
    patterns: Sequence[str] = (),
    start: int | None = None,
    end: int | None = None,
) -> LogSelection:
    """Find the logs with messages in a span of time, and their topics.

    Paths are of logs or folders of logs. Patterns are names of topics, with `*` for any text; all
    topics by default. The log times are nanoseconds of UTC, from `start` on, before `end`; by
    default there is no limit. A damaged log is left out with a warning, unless there is no other.
    Raise `LogError` if there is no such log, if all logs are damaged, or if a pattern matches no
    topic.
    """
    damages: dict[Path, LogError] = {}

    def sound(function: Callable[[Path], Result]) -> Callable[[Path], Result | None]:
        def result(path: Path) -> Result | None:
            try:
                return function(path)
            except LogError as error:
                damages[path] = error
                return None

        return result

    silent: list[Path] = []

    def span_of(path: Path) -> tuple[int, int] | None:
        span = time_span(path, partial=True)
        if span is None:
            silent.append(path)
        return span

    spans = find_spans(paths, sound(span_of), start, end)
    chosen = spans.within(start, end)
    read = map_logs(sound(_Content), [path for _, _, path in chosen])
    contents = [content for content in read if content is not None]
    for path, error in damages.items():
        if not contents:
            raise error
        _warn(path, error)
    chosen = [row for row in chosen if row[2] not in damages]
    channels = _by_topic(channel for content in contents for channel in content.channels)
    topics = _matching(patterns, channels) if patterns else None
    metadata: list[Mapping[str, str]] = []
    for record in (record for content in contents for record in content.metadata):
        if record not in metadata:
            metadata.append(record)
    silent.sort(key=str)
    return LogSelection(
        logs=[path for _, _, path in chosen],
        empty=silent,
        unfinished=[
            *(content.path for content in contents if not content.complete),
            *(path for path in silent if _is_cut(path)),
        ],
        channels={t: same for t, same in channels.items() if topics is None or t in topics},
        metadata=metadata,
        topics=topics,
        start=start,
        end=end,
        span=(
            max([start or 0, *(first for first, _, _ in chosen[:1])]),
            max((last for _, last, _ in chosen), default=0),
        ),
        spans=spans,
    )


def _warn(path: Path, error: LogError) -> None:
    text = str(error).removeprefix(f"{path}: ")
    warnings.warn(HearthlogWarning(text, path, each=True), stacklevel=3)


def _is_cut(path: Path) -> bool:
    with LogFile(path, partial=True) as file:
        return not file.complete


class _Content:
    """Channels and metadata of one log."""

    def __init__(self, path: Path) -> None:
        self.path = path
        damages = Damages()
        with LogFile(path, partial=True) as file:
            self.complete = file.complete
            read_definitions(file, damages.add)
            damages.warn_of_more()
            self.channels = [(c, file.schemas.get(c.schema_id)) for c in file.channels.values()]
            self.metadata = read_provenance(file)


def identity(channel: Channel, schema: Schema | None) -> Hashable:
    """Return a hashable key, equal for channels that differ only in their numbers."""
    definition = None if schema is None else (schema.name, schema.encoding, schema.data)
    metadata = frozenset(channel.metadata.items())
    return channel.topic, channel.message_encoding, metadata, definition


def _by_topic(channels: Iterable[Described]) -> dict[str, list[Described]]:
    different: dict[Hashable, Described] = {}
    for channel, schema in channels:
        different.setdefault(identity(channel, schema), (channel, schema))
    topics: dict[str, list[Described]] = {}
    for channel, schema in different.values():
        topics.setdefault(channel.topic, []).append((channel, schema))
    return topics


def _matching(patterns: Sequence[str], topics: Iterable[str]) -> frozenset[str]:
    names = sorted(topics)
    if not names:  # logs without messages
        return frozenset(patterns)
    matching: set[str] = set()
    for pattern in patterns:
        fitting = [topic for topic in names if fnmatchcase(topic, pattern)]
        if not fitting:
            raise LogError(f"no topic {pattern}; there are {abridged(names)}")
        matching.update(fitting)
    return frozenset(matching)


_MOST_NAMES = 256


def array_names(metadata: Mapping[str, str], field: str) -> list[str]:
    """Return the names that a channel gives to the elements of an array such as `values`, in order.

    The metadata field `<field>_names` is a JSON list of texts. Empty if names are missing, not
    printable or not unique.
    """
    names = _names(metadata, field)
    fit = all(name.isprintable() for name in names) and len(set(names)) == len(names)
    return names if fit else []


def checked_array_names(path: Path, columns: Columns, field: str) -> tuple[str, ...]:
    """Return the names of the elements of an array such as `values`, exactly one per element.

    Raise `LogError` if the field is missing, if there are no names or more than 256, if names are
    not unique, or if the number of names differs from the number of elements.
    """
    where = f"{path}: {columns.topic}"
    names = _names(columns.metadata, field)
    if not names:
        raise LogError(f"{where}: the channel does not name its values")
    if len(names) > _MOST_NAMES or len(set(names)) < len(names):
        raise LogError(f"{where}: {len(names)} names, more than {_MOST_NAMES} or not all different")
    if columns[field].shape[1:] != (len(names),):
        raise LogError(f"{where}: some messages do not have a value for each of {len(names)} names")
    return tuple(names)


def _names(metadata: Mapping[str, str], field: str) -> list[str]:
    """Read a JSON list of texts; empty if the metadata holds anything else."""
    try:
        names: Any = json.loads(metadata.get(f"{field}_names", ""))
        "".join(names).encode()  # raises on other items than texts, and on lone surrogates
    except (ValueError, TypeError, RecursionError):
        return []
    return names if isinstance(names, list) else []
