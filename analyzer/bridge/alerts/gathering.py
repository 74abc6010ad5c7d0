"""Gather what was heard, segment by segment, as a log has it."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from hearthlog.analyzer.bridge.alerts.home_heard import NO_SOUNDS, HomeHeard, Sounds, sounds_of
from hearthlog.analyzer.bridge.listeners import is_of_scenario, microphone_of_listener
from hearthlog.analyzer.logs.spans import NONE, Spans, joined
from hearthlog.models.classes import OF_EVERY_SCENARIO, SILENCE, class_name
from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS
from hearthlog.schemas.logs.columns import Columns

SEGMENT_FIELDS = "header.stamp", "duration", "label", "confidence"
_PAUSE = 60 * NANOSECONDS  # between what the recorder writes, as one span


@dataclass
class _Rows:
    """Segments of one class, of which more come."""

    starts: list[int] = field(default_factory=list)
    ends: list[int] = field(default_factory=list)
    confidences: list[float] = field(default_factory=list)
    microphones: list[str] = field(default_factory=list)
    known: Sounds | None = None

    def sounds(self) -> Sounds:
        if self.known is None:
            rows = Sounds(
                np.array(self.starts, np.int64),
                np.array(self.ends, np.int64),
                np.array(self.confidences, np.float32),
                np.array(self.microphones, object),
            )
            self.known = sounds_of([rows])
        return self.known

    def keep(self, sounds: Sounds) -> None:
        columns = sounds.starts, sounds.ends, sounds.confidences, sounds.microphones
        self.starts, self.ends, self.confidences, self.microphones = (c.tolist() for c in columns)
        self.known = None


class _GrowingSpans:
    """Spans of time that come one after the other, for the most part in order."""

    def __init__(self) -> None:
        self._spans: list[list[int]] = []

    def add(self, start: int, end: int, pause: int) -> None:
        """Add a span, which goes on with the last one after no more than a pause."""
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
        """Forget the spans that end before a time."""
        self._spans = [span for span in self._spans if span[1] >= time]

    @property
    def last_start(self) -> int | None:
        """When the last span begins."""
        return self._spans[-1][0] if self._spans else None


class Gathered:
    """What was heard, as far as segments say."""

    def __init__(self) -> None:
        self.classes: dict[str, set[str]] = {}
        self._rows: dict[str, _Rows] = {}
        self._scenario_rows: dict[str, _Rows] = {}
        self._coverage: dict[str, _GrowingSpans] = {}
        self._written = _GrowingSpans()

    def add_segments(self, listener: str, columns: Columns) -> None:
        """Add segments, with the fields `SEGMENT_FIELDS`."""
        rows = zip(*(columns[name].tolist() for name in SEGMENT_FIELDS), strict=True)
        for start, duration, label, confidence in rows:
            if duration > 0:
                self.add_segment(listener, start, start + duration, label, confidence)

    def add_segment(
        self, listener: str, start: int, end: int, label: str, confidence: float
    ) -> None:
        """Add a segment."""
        covered = self._coverage.setdefault(listener, _GrowingSpans())
        covered.add(start, end, FRAME_NANOSECONDS)
        self._written.add(start, end, _PAUSE)  # a long one has a message at its end alone
        name = class_name(label)
        if not _is_told(listener, name):
            return
        every = self._scenario_rows if is_of_scenario(listener) else self._rows
        rows = every.setdefault(name, _Rows())
        rows.starts.append(start)
        rows.ends.append(end)
        rows.confidences.append(confidence)
        rows.microphones.append(microphone_of_listener(listener))
        rows.known = None
        if listener in self.classes:
            self.classes[listener].add(name)

    def add_classes(self, listener: str, names: Iterable[str]) -> None:
        """Add the classes that the model of a listener knows.

        Parameters
        ----------
        names : iterable of str
            None: nothing is known of them.
        """
        own = {class_name(name) for name in names}
        if is_of_scenario(listener):
            own -= OF_EVERY_SCENARIO
        if own:
            self.classes.setdefault(listener, set()).update(own)

    def add_written(self, times: Int64) -> None:
        """Add times at which the recorder wrote.

        Parameters
        ----------
        times : np.ndarray [shape=(n,)], int64
            Ascending, in nanoseconds of UTC.
        """
        spans = joined(times, times, _PAUSE)
        for start, end in zip(spans.starts.tolist(), spans.ends.tolist(), strict=True):
            self.add_written_span(start, end)

    def add_written_span(self, start: int, end: int) -> None:
        """Add a span of time in which the recorder wrote at least once a minute."""
        self._written.add(start, end, _PAUSE)

    @property
    def recorder_began(self) -> int | None:
        """When the recorder last began to write; None if it never did."""
        return self._written.last_start

    def heard(self, others: Sequence[tuple[str, int, int, str, float]] = ()) -> HomeHeard:
        """Return what was heard."""
        sounds = {label: rows.sounds() for label, rows in self._rows.items()}
        of_scenarios = {label: rows.sounds() for label, rows in self._scenario_rows.items()}
        coverage = {name: own.spans(FRAME_NANOSECONDS) for name, own in self._coverage.items()}
        written = self._written.spans(_PAUSE)
        for listener, start, end, label, confidence in others:
            written = _with(written, start, end, _PAUSE)
            spans = coverage.get(listener, NONE)
            coverage[listener] = _with(spans, start, end, FRAME_NANOSECONDS)
            name = class_name(label)
            if _is_told(listener, name):
                more = Sounds(
                    np.array([start]),
                    np.array([end]),
                    np.array([confidence], np.float32),
                    np.array([microphone_of_listener(listener)], object),
                )
                every = of_scenarios if is_of_scenario(listener) else sounds
                every[name] = sounds_of([every.get(name, NO_SOUNDS), more])
        classes = {name: frozenset(own) for name, own in self.classes.items()}
        return HomeHeard(sounds, of_scenarios, coverage, classes, written)

    def forget_before(self, time: int, pause: int) -> None:
        """Forget the events that were over before a time.

        Parameters
        ----------
        pause : int
            Within an event, at most.
        """
        for rows in (*self._rows.values(), *self._scenario_rows.values()):
            if rows.starts:
                rows.keep(rows.sounds().between(time, 1 << 62, pause))
        for own in (*self._coverage.values(), self._written):
            own.forget_before(time)


def _is_told(listener: str, name: str) -> bool:
    """Tell whether a class is one that a rule may be about."""
    return name not in (OF_EVERY_SCENARIO if is_of_scenario(listener) else {SILENCE})


def _with(spans: Spans, start: int, end: int, pause: int) -> Spans:
    return joined(np.append(spans.starts, start), np.append(spans.ends, end), pause)
