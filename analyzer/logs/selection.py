"""Topics, by name or by pattern, and a span of time of some logs."""

import warnings
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from itertools import chain
from pathlib import Path
from threading import Lock
from typing import TypeVar

import numpy as np
from mcap.records import Channel, Schema

from hearthlog.analyzer.logs.log_spans import LogSpans, find_spans
from hearthlog.analyzer.logs.typed_columns import is_compatible
from hearthlog.schemas.errors import HearthlogWarning, LogError, Progress, abridged, ignore_progress
from hearthlog.schemas.files import map_logs
from hearthlog.schemas.logs.columns import leave_out, unreadable
from hearthlog.schemas.logs.files import time_span
from hearthlog.schemas.logs.merged_reading import iterate_messages
from hearthlog.schemas.logs.metadata import read_provenance
from hearthlog.schemas.mcap.chunks import read_definitions, verify_chunks
from hearthlog.schemas.mcap.logfile import RECOVER, LogFile
from hearthlog.schemas.mcap.raw_messages import RawMessages
from hearthlog.schemas.mcap.records import MESSAGE_HEAD

_LAST = (1 << 63) - 1  # log time
_NAMED = 5  # topics of which none can be decoded
Result = TypeVar("Result")
_CHUNKS_NAMED = 3  # damaged ones of a log
Described = tuple[Channel, Schema | None]


class Damages:
    """Warns of damaged chunks that are left out: of the first few of each log, then of the rest."""

    def __init__(self) -> None:
        self._told: dict[Path, set[str]] = {}
        self._lock = Lock()

    def add(self, path: Path, error: LogError) -> None:
        """Add a chunk; is called from threads that read."""
        text = str(error)
        with self._lock:
            told = self._told.setdefault(path, set())
            is_new = text not in told
            told.add(text)
        if is_new and len(told) <= _CHUNKS_NAMED:
            _warn(path, error)

    def warn_of_more(self) -> None:
        """Count those of which there was no warning."""
        for path, told in self._told.items():
            if (more := len(told) - _CHUNKS_NAMED) > 0:
                _warn(path, LogError(f"{more:,} more chunks are damaged and left out{RECOVER}"))


@dataclass(frozen=True)
class Selection:
    """Topics and a span of time of some logs."""

    logs: Sequence[Path]  # those with messages in the span
    empty: Sequence[Path]  # those that have no message at all
    unfinished: Sequence[Path]  # those of both that were not completed
    channels: Mapping[str, Sequence[Described]]  # by topic, equal ones once
    # the `hearthlog` records of the logs; equal ones are there once
    metadata: Sequence[Mapping[str, str]]
    topics: frozenset[str] | None  # None: all
    start: int | None  # log times in nanoseconds: from `start` on, before `end`
    end: int | None
    span: tuple[int, int]  # log times of the first and the last message
    spans: LogSpans = field(compare=False, repr=False)  # of all logs

    @property
    def earlier(self) -> Iterator[Path]:
        """The logs with messages before the span, the last first."""
        return self.spans.before(0 if self.start is None else self.start)

    @property
    def is_part(self) -> bool:
        """Whether only some topics or a span of time were asked for."""
        return any(limit is not None for limit in (self.topics, self.start, self.end))

    def messages(
        self, progress: Progress = ignore_progress, *, once: bool = False
    ) -> Iterator[list[RawMessages]]:
        """Read the messages of the selection, still encoded, in the order of time.

        Parameters
        ----------
        progress : callable, optional
            Is told the share of the time span that is done, 0 to 1.
        once : bool
            Leave out chunks that are byte for byte an earlier one of their log.

        Yields
        ------
        list of RawMessages
            As `iterate_messages` yields them; chunks that are damaged are left out, as `Damages`
            warns.

        Raises
        ------
        LogError
            If a log cannot be read any more.
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
        """Compare all chunks with their checksums, before a first message is read.

        Raises
        ------
        LogError
            If one is damaged.
        """
        for path in self.logs:
            with LogFile(path) as file:
                ends, starts = file.chunks["end"], file.chunks["start"]
                verify_chunks(
                    file, file.chunks[(ends >= (self.start or 0)) & (starts < (self.end or _LAST))]
                )

    def topics_of(self, type_: str, fields: Collection[str]) -> list[str]:
        """List the topics of a type whose channels all have some fields.

        Parameters
        ----------
        type_ : str
            Name of a message type, such as those in `message_types`.
        fields : collection of str
            Paths of the fields.

        Returns
        -------
        list of str
            In the order of `channels`.
        """
        return [
            topic
            for topic, channels in self.channels.items()
            if all(is_compatible(*channel, type_, fields) for channel in channels)
        ]

    def only(self, topics: Collection[str]) -> "Selection":
        """Return the selection without its other topics.

        Parameters
        ----------
        topics : collection of str
            Names of the topics that stay.
        """
        left = {topic: same for topic, same in self.channels.items() if topic in topics}
        return replace(self, topics=frozenset(topics), channels=left)

    def decodable(self) -> "Selection":
        """Return the selection without channels that cannot be decoded, each with a warning.

        These are not of ROS 2, or the log does not define their type as it can be understood.

        Raises
        ------
        LogError
            If no channel is left.
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
        """Return zero messages of each channel, of which a decoder makes columns without rows."""
        buffer, offsets, heads = np.empty(0, np.uint8), np.empty(0, int), np.empty(0, MESSAGE_HEAD)
        channels = chain.from_iterable(self.channels.values())
        return [RawMessages(*channel, buffer, offsets, heads) for channel in channels]

    def nothing(self) -> LogError:
        """Make the error that says that the selection has no message."""
        topics = "" if not self.topics else f" of {abridged(sorted(self.topics))}"
        where = "these logs" if self.start is None and self.end is None else "this span of time"
        return LogError(f"no message{topics} in {where}; `hearthlog info` shows what there is")


def select(
    paths: Iterable[Path],
    patterns: Sequence[str] = (),
    start: int | None = None,
    end: int | None = None,
) -> Selection:
    """Find the logs that have messages in a span of time, and their topics of some names.

    A log that is damaged is left out, with a warning, unless there is no other.

    Parameters
    ----------
    paths : iterable of Path
        Logs, or folders of logs.
    patterns : sequence of str
        Names of topics, in which `*` stands for anything; all topics by default.
    start, end : int, optional
        Log times in nanoseconds of UTC: from `start` on, before `end`. By default there is no
        limit.

    Raises
    ------
    LogError
        If there is no such log, if none of them is sound, or if a pattern fits no topic.
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
    return Selection(
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
    """What one log says of itself."""

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
    """Return a key that two channels share if they say the same, though their numbers differ.

    Parameters
    ----------
    schema : Schema or None
        Of the channel; None if it has none.
    """
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
    if not names:  # of logs without messages
        return frozenset(patterns)
    matching: set[str] = set()
    for pattern in patterns:
        fitting = [topic for topic in names if fnmatchcase(topic, pattern)]
        if not fitting:
            raise LogError(f"no topic {pattern}; there are {abridged(names)}")
        matching.update(fitting)
    return frozenset(matching)
