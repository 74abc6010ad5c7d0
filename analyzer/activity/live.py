"""Activity of a home, followed live: written segments, and the open ones so far."""

from collections import Counter, deque
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from hearthlog.analyzer.activity import LONGEST_PAUSE
from hearthlog.analyzer.activity.segments import (
    SEGMENT_FIELDS,
    HomeActivity,
    SegmentCollector,
    is_of_activity,
    is_of_scenario,
    source_microphone,
    source_of_topic,
)
from hearthlog.analyzer.logs.home_logs import HomeLogs
from hearthlog.analyzer.logs.selection import select
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import Columns, read_columns
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import parse_topic

_UNDECIDED = 5 * NANOSECONDS  # span of the newest labels, in which a segment may still begin
_SETTLED = 5 * NANOSECONDS  # shortest open segment
_SURE = 30 * NANOSECONDS  # length from which the most frequent label decides, whatever its share
_FEWEST, _MOST = 5, 0.6  # fewest labels of an open segment, and least share of its class
_REMEMBERED = 100


class LiveLabel(NamedTuple):
    """A live label; `time` is when it became available, in nanoseconds of UTC."""

    time: int
    label: str
    confidence: float


class SegmentEstimate(NamedTuple):
    """An open segment up to its decided part, in nanoseconds of UTC."""

    start: int
    end: int
    label: str
    confidence: float


class PendingSegment:
    """The open segment of a microphone, after its last written segment.

    A segment is written when another class follows, so the time after the last written segment has
    a single class, whatever individual labels are. The most frequent label gives the class. `start`
    is the end of the last segment, or of a later gap; `last` is the time of the newest label; both
    in nanoseconds of UTC, 0 before the first.
    """

    def __init__(self) -> None:
        self.start = self.last = 0
        self._recent: deque[LiveLabel] = deque(maxlen=_REMEMBERED)
        self._counts: Counter[str] = Counter()
        self._sums: Counter[str] = Counter()  # of confidences, in millionths

    def add(self, label: LiveLabel) -> None:
        """Add a label; labels not newer than the last are ignored."""
        if label.time > self.last:
            self.last = label.time
            self._recent.append(label)
            self._count(label)

    def begin(self, time: int) -> None:
        """Move the start of the segment forward to a time, in nanoseconds of UTC."""
        if time > self.start:
            self.start = time
            self._counts.clear()
            self._sums.clear()
            for label in self._recent:
                self._count(label)

    def estimate(self) -> SegmentEstimate | None:
        """Return the segment so far; None while its class is undecided."""
        length = self.last - _UNDECIDED - self.start
        number = sum(self._counts.values())
        if length < _SETTLED or number < _FEWEST or not self.start:
            return None
        label, count = self._counts.most_common(1)[0]
        if count < _MOST * number and length < _SURE:
            return None
        confidence = self._sums[label] / count / 1e6
        return SegmentEstimate(self.start, self.start + length, label, confidence)

    def _count(self, label: LiveLabel) -> None:
        if label.time > self.start:
            self._counts[label.label] += 1
            self._sums[label.label] += round(1e6 * label.confidence)


FIELDS = {
    message_types.SEGMENT: SEGMENT_FIELDS,
    message_types.GAP: ("header.stamp", "duration"),
    message_types.DIAGNOSTICS: (),
}
_READ = {kind: fields for kind, fields in FIELDS.items() if fields}
_GONE = 600 * NANOSECONDS  # without labels after which a scenario counts as removed
_CUT = NANOSECONDS  # longer open segments are kept when a gap follows


def is_of_alerts(topic: str) -> bool:
    """Whether alerts are evaluated on the messages of a topic; labels come one by one."""
    name = parse_topic(topic)
    return is_of_activity(topic) and (name is None or name.kind != "label")


class LiveActivity:
    """Activity of one recorder's microphones from `start` (nanoseconds of UTC) up to now.

    `patience` is the longest delay between writing and reading of a message, in nanoseconds.
    """

    def __init__(self, start: int, patience: int) -> None:
        self._start = start
        self._patience = patience
        self._collector = SegmentCollector()
        self._pending: dict[str, PendingSegment] = {}
        self._read: dict[str, int] = {}  # log time of the last message read, by topic

    def read(self, logs: HomeLogs, node: str, end: int, lose: Callable[[str], None]) -> None:
        """Read the activity so far from logs, before any message is pushed.

        Messages after log time `end`, in nanoseconds of UTC, are skipped; `lose` is called with a
        message for each damaged log.
        """
        for entry in logs.between(self._start, end):
            if entry.node == node:
                try:
                    self._read_log(entry.path, end)
                except LogError as error:
                    lose(str(error))

    def _read_log(self, path: Path, end: int) -> None:
        with LogFile(path) as file:
            spans = zip(file.chunks["start"].tolist(), file.chunks["end"].tolist(), strict=True)
            for first, last in spans:
                if first < end:
                    self._collector.add_written_span(first, min(last, end))
        selection = select([path])
        for kind, fields in _READ.items():
            topics = filter(is_of_alerts, selection.topics_of(kind, set(fields)))
            columns = read_columns([path], list(topics), self._start, end, fields)
            self.push([*columns.values()])
            for topic, part in columns.items():
                if len(part):
                    self._read[topic] = int(part.log_times[-1])

    def push(self, columns: Sequence[Columns]) -> None:
        """Add messages, with the fields of `FIELDS`; those that were read are ignored."""
        new = (each.between(self._read.get(each.topic, -1) + 1, None) for each in columns)
        for part in (each for each in new if len(each)):
            self._collector.add_written(part.log_times)
            source = source_of_topic(part.topic)
            if source is None:
                continue
            if part.type == message_types.SEGMENT:
                self._collector.add_segments(source, part)
                self._segment(source).begin(int((part["header.stamp"] + part["duration"]).max()))
            elif part.type == message_types.GAP:
                rows = zip(part["header.stamp"].tolist(), part["duration"].tolist(), strict=True)
                for start, duration in rows:
                    self._add_gap(source, start, start + max(duration, 0))

    def add_label(self, source: str, label: LiveLabel, classes: Sequence[str]) -> None:
        """Add a label of a source."""
        run = self._segment(source)
        if label.time > run.last:
            self._collector.add_classes(source, classes)
            self._collector.add_written_span(label.time, label.time)
            run.add(label)
        if not run.start:
            run.begin(max(self._start, self._collector.recorder_began or 0))

    def complete_until(self, now: int) -> int:
        """Return the time up to which the activity is complete, in nanoseconds of UTC."""
        until = now
        for source, pending in self._pending.items():
            run = pending.estimate()
            if is_of_scenario(source) and 0 < pending.last < now - _GONE:
                self._cut(source, pending.last)
                pending.begin(pending.last)
                continue
            reached = pending.start if run is None else run.end
            is_away = pending.last < now - self._patience
            until = min(until, max(reached, now - self._patience) if is_away else reached)
        return until if self._pending else now - self._patience

    def activity(self) -> HomeActivity:
        """Return the activity, with open segments."""
        return self._collector.activity(self.open_segments())

    @property
    def classes(self) -> Mapping[str, Collection[str]]:
        """Classes of the model by labelling source."""
        return self._collector.classes

    def open_segments(self) -> list[tuple[str, int, int, str, float]]:
        """Return the open segments, as input of `SegmentCollector.activity`."""
        runs = ((name, each.estimate()) for name, each in self._pending.items())
        return [(name, *run) for name, run in runs if run is not None]

    def forget_before(self, time: int) -> None:
        """Drop the events that ended before a time, in nanoseconds of UTC."""
        self._collector.forget_before(time, LONGEST_PAUSE)

    def _segment(self, source: str) -> PendingSegment:
        return self._pending.setdefault(source, PendingSegment())

    def _add_gap(self, microphone: str, start: int, end: int) -> None:
        """Restart the open segments of all sources of a microphone after a gap."""
        self._segment(microphone)
        for source, run in self._pending.items():
            if source_microphone(source) == microphone:
                self._cut(source, start)
                run.begin(end)

    def _cut(self, source: str, start: int) -> None:
        """Add the open segment before a gap as a segment: the recorder never writes it."""
        run = self._segment(source).estimate()
        if run is not None and start - run.start > _CUT:
            end = min(run.end, start)
            self._collector.add_segment(source, run.start, end, run.label, run.confidence)
