"""Corrections of events by people, as marks in the review layers of the logs."""

import errno
import threading
import time
from bisect import bisect_right
from collections.abc import Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from hearthlog.analyzer.activity import SoundEvent
from hearthlog.analyzer.bridge.state import BridgeError, Report
from hearthlog.analyzer.logs.spans import EVENT_PAUSE
from hearthlog.analyzer.marks.marks import Mark, read_marks, write_marks
from hearthlog.models.classes import SILENCE, TELEVISION, UNKNOWN, class_name
from hearthlog.schemas.errors import HearthlogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import find_logs, log_name, review_path, time_span
from hearthlog.schemas.messages.topics import LIVE, labelling_topic

_LATER = 60 * NANOSECONDS  # longest delay from the end of a segment to its message
_FIELDS = "header.stamp", "duration", "label"


def correct_event(
    folder: Path, node: str, event: SoundEvent, label: str, reviewer: str
) -> list[Path]:
    """Mark the segments of an event with another class; return the review layers written.

    Raise `BridgeError` if no log has the event any more, or a layer cannot be written.
    """
    try:
        logs = _logs_of(folder, node, event)
        spans = _segments(list(logs), event)
        made = time.time_ns()
        layers = []
        for log, (first, end) in logs.items():
            pieces = ((max(a, first), min(b, end)) for a, b in spans)
            marks = [
                Mark(event.microphone, a, b, label, reviewer, made, LIVE)
                for a, b in pieces
                if a < b
            ]
            if marks:
                layers.append(write_marks(log, marks))
    except (HearthlogError, OSError) as error:
        raise BridgeError(f"{event.id}: cannot be marked ({error})") from error
    if not layers:
        raise BridgeError(f"{event.id}: no log in {folder} has this event")
    return layers


def _logs_of(folder: Path, node: str, event: SoundEvent) -> dict[Path, tuple[int, int]]:
    """Return the logs that cover an event, and the part of its time span in each."""
    begins = {}
    for log in reversed(find_logs(folder)):
        name = log_name(log)
        span = time_span(log) if name.node == node and not name.layer else None
        if span is None or span[0] > event.end:
            continue
        if span[1] < event.start:
            break
        begins[log] = span[0]
    logs = sorted(begins)
    edges = [event.start, *(begins[log] for log in logs[1:]), event.end]
    return dict(zip(logs, pairwise(edges), strict=True)) if logs else {}


def _segments(logs: list[Path], event: SoundEvent) -> list[tuple[int, int]]:
    """Return the time spans of the segments of an event."""
    if not logs:
        return []
    segments = labelling_topic(event.microphone, LIVE, "segment")
    columns = read_columns(logs, [segments], event.start, event.end + _LATER, _FIELDS)
    if segments not in columns:
        return [(event.start, event.end)]
    starts, durations, labels = (columns[segments][name].tolist() for name in _FIELDS)
    return [
        (start, start + duration)
        for start, duration, label in zip(starts, durations, labels, strict=True)
        if label == event.label and event.start <= start and start + duration <= event.end
    ]


REVIEWER = "page of the home"
READ_ONLY = (
    "It was not saved: the bridge may only read the folder of logs. Whoever set up the box can "
    "change that."
)
_NO_SOUNDS = {SILENCE, TELEVISION, UNKNOWN}
_EVERY_SECONDS = 60.0
_MOST_OWN = 1000
_MOST_LOGS = 64  # newest logs from which marks are read: more than a day and a half
_FORBIDDEN = {errno.EACCES, errno.EPERM, errno.EROFS}


class Correction(NamedTuple):
    """Correction of an event by a person; `is_own` if it was made on the page."""

    label: str
    is_own: bool


class EventCorrections:
    """Corrections of a recorder's events by people; `number` grows with each change."""

    def __init__(self, folder: Path, node: str) -> None:
        self.number = 0
        self._folder = folder
        self._node = node
        self._marks: list[Mark] = []
        self._pending: dict[str, Correction] = {}  # by the ids of events: not read back yet
        self._lock = threading.Lock()
        self._reader = threading.Lock()  # one at a time
        self._read: dict[Path, tuple[int, int]] = {}  # layers that were read: time and size
        self._due = 0.0  # by CLOCK_MONOTONIC
        self._reading: threading.Thread | None = None

    def refresh(self, report: Report, wait: float = 0.0) -> None:
        """Read marks made elsewhere, such as in a review, in a thread; wait for it up to `wait` s.

        A call within a minute of the last reading does nothing.
        """
        is_reading = self._reading is not None and self._reading.is_alive()
        if is_reading or time.monotonic() < self._due:
            return
        self._due = time.monotonic() + _EVERY_SECONDS

        def read() -> None:
            try:
                self.read_back()
            except (HearthlogError, OSError) as error:
                report(f"marks of people are not counted: {error}")

        self._reading = threading.Thread(target=read, daemon=True, name="corrections")
        self._reading.start()
        self._reading.join(wait)

    def read_back(self) -> None:
        """Read the marks in the review layers of the newest logs, if a layer has changed.

        Raise `HearthlogError` if a layer is damaged.
        """
        with self._reader:
            names = ((log, log_name(log)) for log in find_logs(self._folder))
            logs = [log for log, name in names if name.node == self._node and not name.layer]
            found, written = {}, list(self._pending.items())
            for log in logs[-_MOST_LOGS:]:
                with suppress(FileNotFoundError):
                    state = review_path(log).stat()
                    found[log] = state.st_mtime_ns, state.st_size
            if found == self._read:
                return
            self._read = found  # a damaged layer is read again once it has changed
            self._marks = [mark for log in found for mark in read_marks(log)]
            with self._lock:
                for identifier, correction in written:
                    if self._pending.get(identifier) == correction:
                        del self._pending[identifier]
                self.number += 1

    def of_day(self, marks: Sequence[Mark]) -> "EventCorrections":
        """Return the corrections by the marks of a past day in place of the newest logs."""
        past = EventCorrections(self._folder, self._node)
        past._marks, past._pending, past.number = [*marks], self._pending, self.number
        return past

    def correction_of(self, event: SoundEvent) -> Correction | None:
        """Return the correction of an event; None if there is none."""
        written = self._pending.get(event.id)
        if written is not None:
            return written
        own = [mark for mark in self._marks if mark.microphone == event.microphone]
        common = [min(mark.end, event.end) - max(mark.start, event.start) for mark in own]
        if max(common, default=0) <= 0:
            return None
        mark = own[common.index(max(common))]
        return Correction(mark.label, mark.reviewer == REVIEWER)

    def labels(self, events: Sequence[SoundEvent]) -> dict[str, str]:
        """Return the classes that people gave to events of one class and microphone, by id.

        Events are sorted by start, and do not overlap.
        """
        found: dict[str, str] = {}
        longest: dict[str, int] = {}
        ends = [event.end for event in events]
        for mark in self._marks:
            if not events or mark.microphone != events[0].microphone:
                continue
            for event in events[bisect_right(ends, mark.start) :]:
                if event.start >= mark.end:
                    break
                common = min(mark.end, event.end) - max(mark.start, event.start)
                if common > longest.get(event.id, 0):
                    longest[event.id], found[event.id] = common, class_name(mark.label)
        own = self._pending
        return found | {event.id: own[event.id].label for event in events if event.id in own}

    def sounds_without_event(
        self, microphone: str, events: Sequence[SoundEvent], since: int
    ) -> list[SoundEvent]:
        """Return the marked sounds since a time that no event of the microphone (any class) has."""
        marks = [
            mark
            for mark in self._marks
            if mark.microphone == microphone
            and mark.start >= since
            and class_name(mark.label) not in _NO_SOUNDS
        ]
        return [
            SoundEvent(
                microphone,
                class_name(mark.label),
                mark.start,
                mark.end,
                1.0,
                (mark.end - mark.start) / NANOSECONDS,
            )
            for mark in marks
            if not any(
                event.start - _pause(event, mark) < mark.end
                and mark.start < event.end + _pause(event, mark)
                for event in events
            )
        ]

    def add(self, event: SoundEvent, label: str, reviewer: str = REVIEWER) -> None:
        """Correct the class of an event; raise `BridgeError` if it cannot be marked."""
        with self._lock:
            correct_event(self._folder, self._node, event, label, reviewer)
            self._pending[event.id] = Correction(label, reviewer == REVIEWER)
            self.number += 1
            while len(self._pending) > _MOST_OWN:
                del self._pending[next(iter(self._pending))]


NO_CORRECTIONS = EventCorrections(Path(), "")


def _pause(event: SoundEvent, mark: Mark) -> int:
    """Return the pause over which a mark and an event are one event."""
    return EVENT_PAUSE if event.label == class_name(mark.label) else 0


def user_error(error: Exception) -> HearthlogError:
    """Convert an error to one with a message for people at home."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, OSError) and cause.errno in _FORBIDDEN:
            return BridgeError(READ_ONLY)
        cause = cause.__cause__
    return BridgeError(f"It was not saved: {error}")
