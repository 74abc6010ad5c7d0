"""Activity of a home: segments, coverage and classes, read from its logs or followed live."""

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.activity import ANY_SOUND
from hearthlog.analyzer.logs.home_logs import HomeLogs
from hearthlog.analyzer.logs.layers import readable_span
from hearthlog.analyzer.logs.selection import array_names, select
from hearthlog.analyzer.logs.spans import (
    NEVER,
    NONE,
    SEGMENT_DELAY,
    Rows,
    Spans,
    cut,
    joined,
    single_span,
    union,
)
from hearthlog.models.classes import OF_EVERY_SCENARIO, SILENCE, class_name
from hearthlog.schemas.arrays import Bool, Float32, Int64
from hearthlog.schemas.errors import LogError, Progress, ignore_progress
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS
from hearthlog.schemas.logs.columns import Columns, read_columns
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import (
    DIAGNOSTICS,
    LIVE,
    SCENARIO,
    TopicName,
    is_scenario,
    labelling_topic,
    parse_topic,
)

_BETWEEN = "-"


def labelling_source(topic: TopicName) -> str | None:
    """Return the labelling source of a topic; None if the topic is not labelled live."""
    if topic.labelling == LIVE:
        return topic.microphone
    if is_scenario(topic.labelling):
        return source_name(topic.microphone, topic.labelling.removeprefix(f"{SCENARIO}/"))
    return None


def source_of_topic(topic: str) -> str | None:
    """Return the labelling source of a topic by its name; None as `labelling_source`."""
    name = parse_topic(topic)
    return None if name is None else labelling_source(name)


def source_name(microphone: str, scenario: str) -> str:
    """Return the labelling source of a scenario: `<microphone>-<scenario>`."""
    return f"{microphone}{_BETWEEN}{scenario}"


def source_parts(source: str) -> tuple[str, str]:
    """Return microphone and scenario of a labelling source; no scenario for the home's model."""
    microphone, _, scenario = source.partition(_BETWEEN)
    return microphone, scenario


def source_microphone(source: str) -> str:
    """Return the microphone of a labelling source."""
    return source_parts(source)[0]


def is_of_scenario(source: str) -> bool:
    """Whether a labelling source is the model of a scenario."""
    return _BETWEEN in source


def is_of_activity(topic: str) -> bool:
    """Whether a topic shows the activity of a home, or the health of its recorder."""
    name = parse_topic(topic)
    if name is None or labelling_source(name) is None:
        return topic == DIAGNOSTICS
    return name.kind in {"label", "segment"} or (name.kind == "gap" and name.labelling == LIVE)


@dataclass(frozen=True)
class Sounds:
    """Segments of one or several classes as columns, sorted by start, in nanoseconds of UTC."""

    starts: Int64
    ends: Int64
    confidences: Float32
    microphones: NDArray[np.object_]

    def rows(self, rows: Bool | Rows) -> "Sounds":
        """Return the segments that a boolean mask or row numbers select."""
        return Sounds(
            self.starts[rows], self.ends[rows], self.confidences[rows], self.microphones[rows]
        )


NO_SOUNDS = Sounds(NONE.starts, NONE.ends, np.empty(0, np.float32), np.empty(0, object))


def sounds_of(parts: Sequence[Sounds]) -> Sounds:
    """Merge segments, sorted by start."""
    if len(parts) == 1:
        return parts[0]
    columns = [
        np.concatenate([getattr(part, field.name) for part in (NO_SOUNDS, *parts)])
        for field in fields(Sounds)
    ]
    order = np.argsort(columns[0], kind="stable")
    return Sounds(*(column[order] for column in columns))


Key = tuple[str, bool]  # a class, and whether the model of a scenario has it


def _between(classes: Mapping[Key, Sounds], start: int, end: int, pause: int) -> dict[Key, Sounds]:
    """Return segments in a span, with the complete events, pauses in ns, ongoing at its start.

    An event has sounds of any class, as in a rule of any sound: such a rule needs its start too.
    """
    own = {key: sounds.rows(sounds.starts < end) for key, sounds in classes.items()}
    own = {key: replace(sounds, ends=np.minimum(sounds.ends, end)) for key, sounds in own.items()}
    every = sounds_of([*own.values()])
    events = joined(every.starts, every.ends, pause)
    first = np.searchsorted(events.ends, start)
    begin = events.starts[first] if first < len(events.starts) else end
    return {key: sounds.rows(sounds.starts >= begin) for key, sounds in own.items()}


@dataclass(frozen=True)
class HomeActivity:
    """Activity of a home in a time span."""

    # segments without silence, by class and whether of a scenario's model
    sounds: Mapping[Key, Sounds]
    coverage: Mapping[str, Spans]  # listening time by labelling source
    # of the model by labelling source; unknown ones are absent
    classes: Mapping[str, frozenset[str]]
    written: Spans  # writes of the recorder; at most a minute apart, one span

    def of(self, label: str) -> Sounds:
        """Return the segments of a class, or of all classes of the home for `ANY_SOUND`."""
        return sounds_of(
            [
                sounds
                for (name, of_scenario), sounds in self.sounds.items()
                if (not of_scenario if label == ANY_SOUND else name == label)
            ]
        )

    def listened(self, label: str, microphone: str) -> Spans:
        """Return the time spans in which a class could have been detected.

        An empty `microphone` is any one with a model that has the class.
        """
        knowing = [
            spans
            for name, spans in self.coverage.items()
            if microphone in {"", source_microphone(name)} and self._has_class(name, label)
        ]
        return union(*knowing)

    def _has_class(self, source: str, label: str) -> bool:
        classes = self.classes.get(source)
        if is_of_scenario(source):
            return classes is not None and label in classes
        return classes is None or label == ANY_SOUND or label in classes

    def between(self, start: int, end: int, pause: int) -> "HomeActivity":
        """Return the activity in a span, with the complete events ongoing at its start.

        `pause` is the longest pause within an event, in nanoseconds.
        """
        return HomeActivity(
            _between(self.sounds, start, end, pause),
            {name: cut(spans, start, end) for name, spans in self.coverage.items()},
            self.classes,
            cut(self.written, start, end),
        )


SEGMENT_FIELDS = "header.stamp", "duration", "label", "confidence"
_PAUSE = 60 * NANOSECONDS  # longest pause between writes of one span


class _Rows:
    """Growing segments of one class, with a cache of the columns."""

    def __init__(self) -> None:
        self._rows: list[tuple[int, int, float, str]] = []
        self._joined: Sounds | None = NO_SOUNDS

    def add(self, *row: *tuple[int, int, float, str]) -> None:
        self._rows.append(row)
        self._joined = None

    def sounds(self) -> Sounds:
        if self._joined is None:
            kinds = np.int64, np.int64, np.float32, object
            columns = zip(*self._rows, strict=True)
            every = Sounds(*(np.array(c, kind) for c, kind in zip(columns, kinds, strict=True)))
            self._joined = every.rows(np.argsort(every.starts, kind="stable"))
        return self._joined

    def keep(self, sounds: Sounds) -> None:
        if len(sounds.starts) < len(self._rows):
            columns = sounds.starts, sounds.ends, sounds.confidences, sounds.microphones
            self._rows = [*zip(*(column.tolist() for column in columns), strict=True)]
            self._joined = sounds


class GrowingSpans:
    """Growing list of time spans, added mostly in order."""

    def __init__(self) -> None:
        self._spans: list[list[int]] = []

    def add(self, start: int, end: int, pause: int) -> None:
        """Add a span, or extend the last span if the pause between is short enough."""
        last = self._spans[-1] if self._spans else None
        if last is not None and last[0] <= start <= last[1] + pause:
            last[1] = max(last[1], end)
        else:
            self._spans.append([start, end])

    def spans(self, pause: int) -> Spans:
        """Return the spans as arrays."""
        if not self._spans:
            return NONE
        starts, ends = np.array(self._spans, np.int64).T
        return joined(starts, ends, pause)

    def forget_before(self, time: int) -> None:
        """Drop the spans that end before a time."""
        self._spans = [span for span in self._spans if span[1] >= time]

    @property
    def last_start(self) -> int | None:
        """Start of the last span."""
        return self._spans[-1][0] if self._spans else None


class SegmentCollector:
    """Collects the segments of a home, source by source."""

    def __init__(self) -> None:
        self.classes: dict[str, set[str]] = {}
        self._rows: defaultdict[Key, _Rows] = defaultdict(_Rows)
        self._coverage: dict[str, GrowingSpans] = {}
        self._written = GrowingSpans()

    def add_segments(self, source: str, columns: Columns) -> None:
        """Add segments, with the fields `SEGMENT_FIELDS`."""
        rows = zip(*(columns[name].tolist() for name in SEGMENT_FIELDS), strict=True)
        for start, duration, label, confidence in rows:
            if duration > 0:
                self.add_segment(source, start, start + duration, label, confidence)

    def add_segment(self, source: str, start: int, end: int, label: str, confidence: float) -> None:
        """Add a segment."""
        covered = self._coverage.setdefault(source, GrowingSpans())
        covered.add(start, end, FRAME_NANOSECONDS)
        self._written.add(start, end, _PAUSE)  # a long segment has one message, at its end
        name = class_name(label)
        if not _is_reported(source, name):
            return
        row = start, end, confidence, source_microphone(source)
        self._rows[name, is_of_scenario(source)].add(*row)
        if source in self.classes:
            self.classes[source].add(name)

    def add_classes(self, source: str, names: Iterable[str]) -> None:
        """Add the classes of a source's model; without names the classes stay unknown."""
        own = {class_name(name) for name in names}
        if is_of_scenario(source):
            own -= OF_EVERY_SCENARIO
        if own:
            self.classes.setdefault(source, set()).update(own)

    def add_written(self, times: Int64) -> None:
        """Add times at which the recorder wrote, ascending, in nanoseconds of UTC."""
        spans = joined(times, times, _PAUSE)
        for start, end in spans.pairs():
            self.add_written_span(start, end)

    def add_written_span(self, start: int, end: int) -> None:
        """Add a time span in which the recorder wrote at least once a minute."""
        self._written.add(start, end, _PAUSE)

    @property
    def recorder_began(self) -> int | None:
        """Start of the recorder's last uninterrupted writing; None if it never wrote."""
        return self._written.last_start

    def activity(self, others: Sequence[tuple[str, int, int, str, float]] = ()) -> HomeActivity:
        """Return the activity so far, with open segments: source, start, end, label, confidence."""
        sounds = {key: rows.sounds() for key, rows in self._rows.items()}
        coverage = {name: own.spans(FRAME_NANOSECONDS) for name, own in self._coverage.items()}
        written = self._written.spans(_PAUSE)
        for source, start, end, label, confidence in others:
            span, spans = single_span(start, end), coverage.get(source, NONE)
            written = union(written, span, pause=_PAUSE)
            coverage[source] = union(spans, span, pause=FRAME_NANOSECONDS)
            name = class_name(label)
            if _is_reported(source, name):
                more, key = _Rows(), (name, is_of_scenario(source))
                more.add(start, end, confidence, source_microphone(source))
                sounds[key] = sounds_of([sounds.get(key, NO_SOUNDS), more.sounds()])
        classes = {name: frozenset(own) for name, own in self.classes.items()}
        return HomeActivity(sounds, coverage, classes, written)

    def forget_before(self, time: int, pause: int) -> None:
        """Drop the events, with pauses of at most `pause` ns, that ended before a time."""
        every = {key: rows.sounds() for key, rows in self._rows.items()}
        for key, sounds in _between(every, time, NEVER, pause).items():
            self._rows[key].keep(sounds)
        for own in (*self._coverage.values(), self._written):
            own.forget_before(time)


def _is_reported(source: str, name: str) -> bool:
    """Whether a rule may apply to a class."""
    return name not in (OF_EVERY_SCENARIO if is_of_scenario(source) else {SILENCE})


def read_activity(  # noqa: PLR0913, PLR0917
    logs: HomeLogs,
    node: str,
    start: int,
    end: int,
    lose: Callable[[str], None],
    progress: Progress = ignore_progress,
    others: Sequence[tuple[str, int, int, str, float]] = (),
) -> HomeActivity:
    """Read the activity of a span in nanoseconds of UTC, with segments ending up to 12 hours later.

    `lose` is called with a message for each log that is damaged or unfinished, `progress` with the
    share of the logs read so far, 0 to 1. `others` are open segments that are in no log yet, as for
    `SegmentCollector.activity`.
    """
    collector = SegmentCollector()
    entries = [
        entry.path for entry in logs.between(start, end + SEGMENT_DELAY) if entry.node == node
    ]
    for number, path in enumerate(entries, 1):
        try:
            _add_log(collector, path, start, end + SEGMENT_DELAY, lose)
        except LogError as error:
            lose(str(error))
        progress(number / len(entries))
    return collector.activity(others)


def _add_log(
    collector: SegmentCollector, path: Path, start: int, end: int, lose: Callable[[str], None]
) -> None:
    with LogFile(path) as file:
        for first, last in file.chunks[["start", "end"]].tolist():
            collector.add_written_span(first, last)
    selection = select([path])
    if selection.unfinished:
        lose(f"unfinished, read up to the last whole chunk: {path}")
    sources = {}
    for topic in selection.topics_of(message_types.SEGMENT, set(SEGMENT_FIELDS)):
        name = parse_topic(topic)
        if name is not None and (source := labelling_source(name)) is not None:
            sources[topic] = source
            labels = labelling_topic(name.microphone, name.labelling, "label")
            for channel, _ in selection.channels.get(labels, ()):
                collector.add_classes(source, array_names(channel.metadata, "probabilities"))
    segments = read_columns([path], list(sources), start, end, SEGMENT_FIELDS)
    for topic, columns in segments.items():
        collector.add_segments(sources[topic], columns)


def nodes_of(logs: HomeLogs) -> list[str]:
    """List the recorder names of logs."""
    return sorted({entry.node for entry in logs.entries if not entry.layer})


def span_of(logs: HomeLogs, node: str) -> tuple[int, int]:
    """Return the start and end of a recorder's logs, in nanoseconds of UTC.

    Raise `LogError` if no log has a readable message.
    """
    own = [entry.path for entry in logs.entries if entry.node == node and not entry.layer]
    first, last = readable_span(own), readable_span(reversed(own))
    if first is None or last is None:
        raise LogError(f"the logs of {node} have no message that can be read")
    return first[0], last[1]
