"""Activity of a home up to now, with segments that are still open."""

from collections import Counter, deque
from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

from hearthlog.analyzer.bridge.alerts.activity import SEGMENT_FIELDS, HomeActivity, SegmentCollector
from hearthlog.analyzer.bridge.alerts.rules import LONGEST_PAUSE
from hearthlog.analyzer.bridge.home import (
    is_of_scenario,
    labelling_source,
    source_microphone,
)
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import Columns
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import DIAGNOSTICS, LIVE, parse_topic

_UNDECIDED = 5 * NANOSECONDS  # of the newest labels: a segment may still begin among them
_SETTLED = 5 * NANOSECONDS  # of a run, before it is taken for one
_SURE = 30 * NANOSECONDS  # after which most labels decide, few as they may be
_FEWEST, _MOST = 5, 0.6  # labels of a run, and the share of one class
_REMEMBERED = 100


class LiveLabel(NamedTuple):
    """A label: when it was known, in nanoseconds of UTC, the class and how sure it is."""

    time: int
    label: str
    confidence: float


class SegmentEstimate(NamedTuple):
    """A segment that goes on: of one class, as far as it is decided, in nanoseconds of UTC."""

    start: int
    end: int
    label: str
    confidence: float


class PendingSegment:
    """The time of a microphone after its last segment: one segment, which is not yet written.

    A segment is written when another class follows, so that in what is after the last one there
    is one class, whatever single labels say. Most of them say which.

    Attributes
    ----------
    start : int
        End of the last segment, or of a gap after it, in nanoseconds of UTC; 0 before the first.
    last : int
        Time of the newest label; 0 before the first.
    """

    def __init__(self) -> None:
        self.start = self.last = 0
        self._recent: deque[LiveLabel] = deque(maxlen=_REMEMBERED)
        self._counts: Counter[str] = Counter()
        self._sums: Counter[str] = Counter()  # of confidences, in millionths

    def add(self, label: LiveLabel) -> None:
        """Add a label; older ones than the newest are left out."""
        if label.time > self.last:
            self.last = label.time
            self._recent.append(label)
            self._count(label)

    def begin(self, time: int) -> None:
        """Let the segment begin at a time, in nanoseconds of UTC, unless it began later."""
        if time > self.start:
            self.start = time
            self._counts.clear()
            self._sums.clear()
            for label in self._recent:
                self._count(label)

    def estimate(self) -> SegmentEstimate | None:
        """Return the segment so far; None while its class is not known."""
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
_GONE = 600_000_000_000  # ns without a label of a scenario, which another configuration has not
_CUT = 1_000_000_000  # ns of a run that no segment has, where a gap follows


def is_of_alerts(topic: str) -> bool:
    """Whether alerts subscribe to a topic."""
    if topic == DIAGNOSTICS:
        return True
    name = parse_topic(topic)
    if name is None or labelling_source(name) is None:
        return False
    return name.kind == "segment" or (name.kind == "gap" and name.labelling == LIVE)


class LiveActivity:
    """What the microphones of one recorder have heard up to now.

    Parameters
    ----------
    start : int
        From when on it is known, in nanoseconds of UTC.
    patience : int
        How late what a recorder writes may be read, in nanoseconds.
    """

    def __init__(self, start: int, patience: int) -> None:
        self._start = start
        self._patience = patience
        self._collector = SegmentCollector()
        self._pending: dict[str, PendingSegment] = {}

    def push(self, columns: Sequence[Columns]) -> None:
        """Add messages, with the fields of `FIELDS`."""
        for part in (each for each in columns if len(each)):
            self._collector.add_written(part.log_times)
            name = parse_topic(part.topic)
            source = None if name is None else labelling_source(name)
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

    def known_until(self, now: int) -> int:
        """Return up to when everything is known that can have been heard."""
        until = now
        for source, pending in self._pending.items():
            run = pending.estimate()
            if is_of_scenario(source) and 0 < pending.last < now - _GONE:
                self._cut(source, pending.last)
                pending.begin(pending.last)
                continue
            known = pending.start if run is None else run.end
            is_away = pending.last < now - self._patience
            until = min(until, max(known, now - self._patience) if is_away else known)
        return until if self._pending else now - self._patience

    def heard(self) -> HomeActivity:
        """Return what was heard, with what goes on."""
        return self._collector.heard(self.open_segments())

    @property
    def classes(self) -> Mapping[str, Collection[str]]:
        """By source, the classes that its model knows."""
        return self._collector.classes

    def open_segments(self) -> list[tuple[str, int, int, str, float]]:
        """Return what goes on and has no segment yet, as `SegmentCollector.heard` takes it."""
        runs = ((name, each.estimate()) for name, each in self._pending.items())
        return [(name, *run) for name, run in runs if run is not None]

    def forget_before(self, time: int) -> None:
        """Forget what was over before a time, in nanoseconds of UTC."""
        self._collector.forget_before(time, LONGEST_PAUSE)

    def _segment(self, source: str) -> PendingSegment:
        return self._pending.setdefault(source, PendingSegment())

    def _add_gap(self, microphone: str, start: int, end: int) -> None:
        """Let all that listen by a microphone begin anew after a gap."""
        self._segment(microphone)
        for source, run in self._pending.items():
            if source_microphone(source) == microphone:
                self._cut(source, start)
                run.begin(end)

    def _cut(self, source: str, start: int) -> None:
        """Keep what was heard before a gap although its segment was never written."""
        run = self._segment(source).estimate()
        if run is not None and start - run.start > _CUT:
            end = min(run.end, start)
            self._collector.add_segment(source, run.start, end, run.label, run.confidence)
