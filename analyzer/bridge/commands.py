"""Commands to the bridge: corrections of events, pauses, and muting of classes."""

import errno
import queue
import time
from bisect import bisect_right
from collections.abc import Callable, Sequence
from contextlib import suppress
from datetime import timedelta
from itertools import pairwise
from pathlib import Path
from threading import Lock, Thread
from typing import Annotated, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from hearthlog.analyzer.activity.events import SoundEvent
from hearthlog.analyzer.bridge.state import BridgeError
from hearthlog.analyzer.marks.marks import Mark, read_marks, write_marks
from hearthlog.models.classes import CLASS_NAME, CLASSES, class_name
from hearthlog.recorder import pause_schedule
from hearthlog.schemas.errors import HearthlogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import find_logs, log_name, review_path, time_span
from hearthlog.schemas.messages.topics import LIVE, labelling_topic, spelt

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
_MOST_LOGS = 64  # newest logs from which marks are read: more than a day and a half
_FORBIDDEN = {errno.EACCES, errno.EPERM, errno.EROFS}
_BY_WORDS = {spelt(row.words): row.name for row in CLASSES}


class Correction(NamedTuple):
    """Correction of an event by a person; `is_own` if it was made on the page."""

    label: str
    is_own: bool


class EventCorrections:
    """Corrections of a recorder's events by people.

    Attributes
    ----------
    number : int
        Grows with each change.
    """

    def __init__(self, folder: Path, node: str) -> None:
        self.number = 0
        self._folder = folder
        self._node = node
        self._marks: list[Mark] = []
        self._own: dict[str, str] = {}  # labels by the ids of events
        self._lock = Lock()

    def read_back(self) -> None:
        """Read the marks in the review layers of the newest logs.

        Raise `HearthlogError` if a layer is damaged.
        """
        names = ((log, log_name(log)) for log in find_logs(self._folder))
        logs = [log for log, name in names if name.node == self._node and not name.layer]
        marked = [log for log in logs[-_MOST_LOGS:] if review_path(log).exists()]
        self._marks = [mark for log in marked for mark in read_marks(log)]
        self.number += 1

    def of(self, event: SoundEvent, marks: Sequence[Mark] | None = None) -> Correction | None:
        """Return the correction of an event; None if there is none.

        Parameters
        ----------
        marks : sequence of Mark, optional
            Marks of the day of the event; by default those of the newest logs.
        """
        label = self._own.get(event.id)
        if label is not None:
            return Correction(label, True)
        known = self._marks if marks is None else marks
        own = [mark for mark in known if mark.microphone == event.microphone]
        common = [min(mark.end, event.end) - max(mark.start, event.start) for mark in own]
        if max(common, default=0) <= 0:
            return None
        mark = own[common.index(max(common))]
        return Correction(mark.label, mark.reviewer == REVIEWER)

    def labels(
        self, events: Sequence[SoundEvent], marks: Sequence[Mark] | None = None
    ) -> dict[str, str]:
        """Return the classes that people gave to events of one class and microphone, by id.

        Parameters
        ----------
        events : sequence of SoundEvent
            Sorted by start; they do not overlap.
        marks : sequence of Mark, optional
            As for `of`.
        """
        found: dict[str, str] = {}
        longest: dict[str, int] = {}
        ends = [event.end for event in events]
        for mark in self._marks if marks is None else marks:
            if not events or mark.microphone != events[0].microphone:
                continue
            for event in events[bisect_right(ends, mark.start) :]:
                if event.start >= mark.end:
                    break
                common = min(mark.end, event.end) - max(mark.start, event.start)
                if common > longest.get(event.id, 0):
                    longest[event.id], found[event.id] = common, class_name(mark.label)
        own = self._own
        return found | {event.id: own[event.id] for event in events if event.id in own}

    def add(self, event: SoundEvent, label: str) -> None:
        """Correct the class of an event; raise `BridgeError` if it cannot be marked."""
        with self._lock:
            try:
                correct_event(self._folder, self._node, event, label, REVIEWER)
            except BridgeError as error:
                raise explained(error) from error
            self._own[event.id] = label
            self.number += 1
            while len(self._own) > 1000:
                del self._own[next(iter(self._own))]


def class_of(text: str) -> str:
    """Convert text to a class name: `Water tap` to `tap_water`.

    Raise `BridgeError` if the text is no valid class name.
    """
    spelling = spelt(text.strip()).strip("_")
    label = class_name(_BY_WORDS.get(spelling, spelling))
    if not CLASS_NAME.fullmatch(label):
        raise BridgeError(
            "This name cannot be used: write it with the letters a to z, digits and spaces, "
            "beginning with a letter."
        )
    return label


def explained(error: Exception) -> HearthlogError:
    """Convert an error to one with a message for people at home."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, OSError) and cause.errno in _FORBIDDEN:
            return BridgeError(READ_ONLY)
        cause = cause.__cause__
    return BridgeError(f"It was not saved: {error}")


_WAITING = 20  # commands; more are refused
_LONGEST = 4096  # bytes of a command
_MOST_MINUTES = 7 * 24 * 60

FindEvent = Callable[[str], SoundEvent | None]


class Answer(NamedTuple):
    """Result of a command."""

    done: bool
    text: str


class _Command(BaseModel):
    """One of `correct` and `told`, both with `label`, `pause_minutes` and `resume`."""

    model_config = ConfigDict(extra="forbid", strict=True)

    by: Annotated[str, Field(max_length=100, pattern=r"^[^\x00-\x1f\x7f]*$")] = ""
    correct: str | None = None
    told: bool | None = None
    label: str | None = None
    pause_minutes: Annotated[float, Field(gt=0, le=_MOST_MINUTES)] | None = None
    resume: bool = False

    def check(self) -> None:
        """Check which fields are there, or raise `BridgeError`."""
        of_class = self.correct is not None, self.told is not None
        if sum([*of_class, self.pause_minutes is not None, self.resume]) != 1:
            raise BridgeError("one of correct, told, pause_minutes and resume is required")
        if (self.label is not None) != any(of_class):
            raise BridgeError("label belongs to correct and told")


class Commands:
    """Runs commands one after the other in a separate thread."""

    def __init__(
        self,
        folder: Path,
        node: str,
        switch: Callable[[str, bool], None],
        answered: Callable[[Answer], None],
    ) -> None:
        self._folder = folder
        self._node = node
        self._switch = switch
        self._answered = answered
        self._waiting: queue.Queue[tuple[bytes, FindEvent] | None] = queue.Queue(_WAITING)
        self._thread = Thread(target=self._work, daemon=True)
        self._thread.start()

    def add(self, payload: bytes, find_event: FindEvent) -> None:
        """Queue a command, or refuse it if the queue is full."""
        try:
            self._waiting.put_nowait((payload[: _LONGEST + 1], find_event))
        except queue.Full:
            self._answered(Answer(False, f"refused: {_WAITING} commands are waiting already"))

    def close(self) -> None:
        """Drop queued commands, and stop after the running one."""
        with suppress(queue.Empty):
            while True:
                self._waiting.get_nowait()
        self._waiting.put(None)

    def _work(self) -> None:
        while (item := self._waiting.get()) is not None:
            try:
                self._answered(Answer(True, self._carry_out(*item)))
            except Exception as error:  # noqa: BLE001  a failing command must not stop the next
                self._answered(Answer(False, f"refused: {error}"))

    def _carry_out(self, payload: bytes, find_event: FindEvent) -> str:
        command = _parse(payload)
        by = command.by or "mqtt"
        if command.resume:
            was_paused = pause_schedule.resume(self._folder)
            return "it listens again" if was_paused else "it was not paused"
        if command.pause_minutes is not None:
            pause_schedule.pause(self._folder, timedelta(minutes=command.pause_minutes), by)
            return f"paused for {command.pause_minutes:g} minutes by {by}"
        label = spelt(command.label or "")
        if not CLASS_NAME.fullmatch(label):
            raise BridgeError(f"{label[:64]!r} cannot be the name of a class")
        if command.told is not None:
            self._switch(label, command.told)
            return f"{label} is {'' if command.told else 'not '}told of, says {by}"
        event = find_event(command.correct or "")
        if event is None:
            raise BridgeError(f"{(command.correct or '')[:100]!r} is no event since last evening")
        correct_event(self._folder, self._node, event, label, by)
        return f"{event.id} was {label}, says {by}"


def _parse(payload: bytes) -> _Command:
    if len(payload) > _LONGEST:
        raise BridgeError(f"a command has {_LONGEST} bytes at most")
    try:
        command = _Command.model_validate_json(payload)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "command"
        raise BridgeError(f"{where}: {first['msg']}") from error
    command.check()
    return command
