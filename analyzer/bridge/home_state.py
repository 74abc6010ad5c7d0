"""State of a home's microphones, followed in the log of the recorder."""

import json
import math
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from operator import attrgetter
from pathlib import Path
from threading import Event as Flag
from typing import Any, NamedTuple

import numpy as np

from hearthlog.analyzer.activity import ActiveClasses, EventRecord, SoundEvent
from hearthlog.analyzer.activity.doubtful_sounds import is_too_doubtful
from hearthlog.analyzer.activity.event_counts import AROUND, MINUTE, television_minutes
from hearthlog.analyzer.activity.segments import (
    GrowingSpans,
    is_of_activity,
    is_of_scenario,
    source_of_topic,
)
from hearthlog.analyzer.bridge.corrections import NO_CORRECTIONS, EventCorrections
from hearthlog.analyzer.bridge.settings import RecorderAddress
from hearthlog.analyzer.bridge.state import Report
from hearthlog.analyzer.logs.hidden_classes import common_names_of, read_hidden_classes
from hearthlog.analyzer.logs.labelling import Labelling
from hearthlog.analyzer.logs.local_time import Today
from hearthlog.analyzer.logs.recorder_info import status_value
from hearthlog.analyzer.logs.spans import EVENT_PAUSE, NONE, Spans, joined, rows_at
from hearthlog.models.classes import (
    OF_EVERY_SCENARIO,
    ON_TELEVISION,
    SILENCE,
    UNKNOWN,
    WATER,
    class_name,
    ordered,
)
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS
from hearthlog.schemas.logs.columns import Columns, decode
from hearthlog.schemas.logs.files import is_layer, log_name
from hearthlog.schemas.logs.follow import follow_messages
from hearthlog.schemas.logs.metadata import provenance_records, unknown_version
from hearthlog.schemas.mcap.chunks import read_definitions
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.mcap.raw_messages import RawMessages
from hearthlog.schemas.messages import message_types

FIELDS = {
    message_types.LABEL: ("label", "confidence"),
    message_types.SEGMENT: ("header.stamp", "duration", "label", "confidence"),
    message_types.DIAGNOSTICS: ("status",),
    message_types.GAP: ("header.stamp", "duration"),
}
_AWAY_SECONDS = 15.0  # without messages
_DECIDED = EVENT_PAUSE + 5 * NANOSECONDS  # after the end of an event, no segment extends it
_MOST_CLASSES = 256
_MOST_MINUTES = 14 * 1440  # of which a television is looked for
MOST = 0.75  # least coverage of a night for a count of 0, as in the report
_START = attrgetter("start")


class Health(NamedTuple):
    """Latest diagnostics of one subject; `level` as in diagnostics, 0 for OK."""

    level: int
    text: str


class ClassSounds(NamedTuple):
    """Events of a class, those that count, the ids given by people and of too doubtful ones."""

    events: list[SoundEvent]
    counted: list[SoundEvent]
    given: set[str]
    doubtful: set[str]


class LiveMicrophone:
    """Current labels and recent events of one microphone, by one of its models.

    Parameters
    ----------
    unnamed : collection of str, optional
        Classes without events; except for silence they are left out of `classes`.

    Attributes
    ----------
    names : list of str
        Classes of the model, empty while unknown.
    label, confidence : str, float
        The newest label; empty before the first.
    level_dbfs : float
        Mean level of ten seconds; NaN if unknown.
    gaps : list of (int, int)
        Gaps in the audio, in nanoseconds of UTC, in log order.
    since : int
        Start of the first label or segment, in nanoseconds of UTC; 0 before there is any.
    """

    def __init__(self, name: str, unnamed: Collection[str] = (SILENCE,)) -> None:
        self.name = name
        self._unnamed = unnamed
        self.hidden_classes: frozenset[str] = frozenset()  # classes that no output shows
        self.common_names: Mapping[str, str] = {}  # of classes that the model takes for one another
        self.names: list[str] = []
        self.active = ActiveClasses([])
        self.label, self.confidence = "", 0.0
        self.level_dbfs = math.nan
        self.gaps: list[tuple[int, int]] = []
        self.since = 0
        self.seen = -math.inf  # time of the last label, by CLOCK_MONOTONIC
        self._records: dict[str, EventRecord] = {}
        self._unended: set[str] = set()  # classes with an event that may go on
        self._latest = 0  # end of the last segment, in nanoseconds of UTC
        self._coverage = GrowingSpans()  # segments tile the time that was listened to
        self._sounds: list[tuple[int, int, str]] = []  # segments other than silence
        self._changes = 0  # of the sounds
        self._television = 0, NONE  # number of changes; minutes with one
        self._counts: tuple[Any, dict[str, tuple[int, int]]] = (None, {})  # and their key
        self._replaced: list[SoundEvent] = []  # ended by the start of another event of the class

    @property
    def classes(self) -> list[str]:
        """Classes of the model that outputs show, silence among them."""
        left_out = {*self._unnamed, *self.hidden_classes} - {SILENCE}
        return [name for name in self.names if name not in left_out]

    @property
    def shown_label(self) -> str:
        """The newest label; `unknown` in place of a class that no output shows."""
        return UNKNOWN if self.label in self.hidden_classes else self.label

    def is_listening(self) -> bool:
        """Whether labels have arrived in the last fifteen seconds."""
        return time.monotonic() - self.seen <= _AWAY_SECONDS

    def events(self, label: str, since: int) -> list[SoundEvent]:
        """Return the events of a class that began at a time or later, in nanoseconds of UTC."""
        record = self._records.get(label)
        return [] if record is None else record.since(since)

    def labels(self) -> list[str]:
        """Return the classes with recorded events that outputs show."""
        return [label for label in self._records if label not in self.hidden_classes]

    def _named_events(self, name: str, since: int, names: Mapping[str, str]) -> list[SoundEvent]:
        """Return the events of the classes that share a name."""
        labels = [each for each in self.labels() if names.get(each, each) == name]
        every = sorted((e for each in labels for e in self.events(each, since)), key=_START)
        if len(labels) == 1 and labels[0] == name:
            return every
        record = EventRecord(self.name, name)
        for event in every:
            record.push(event.start, event.end, event.confidence)
        return record.events

    def all_labels(self) -> list[str]:
        """Return the classes with recorded events, shown or not."""
        return list(self._records)

    def last_event(self, label: str) -> SoundEvent | None:
        """Return the last event of a class; None if there is none."""
        record = self._records.get(label)
        return record.events[-1] if record is not None and record.events else None

    def push_labels(self, columns: Columns) -> None:
        """Add labels, with the fields of `FIELDS`."""
        classes = _class_names(columns)
        if classes and classes != self.names:
            self.names = classes
            self.active = ActiveClasses(classes)
        self.active.push(columns["label"].tolist(), columns.log_times)
        self.since = self.since or int(columns.log_times[0])
        self.label = str(columns["label"][-1])
        self.confidence = float(columns["confidence"][-1])

    def push_segments(self, columns: Columns) -> list[SoundEvent]:
        """Add segments, with the fields of `FIELDS`; return the events that they begin."""
        begun = []
        first = int(columns["header.stamp"][0])
        self.since = min(self.since or first, first)
        self._latest = max(
            self._latest, int(np.max(columns["header.stamp"] + columns["duration"], initial=0))
        )
        fields = (columns[name].tolist() for name in FIELDS[message_types.SEGMENT])
        for start, duration, label, confidence in zip(*fields, strict=True):
            self._coverage.add(start, start + max(duration, 0), FRAME_NANOSECONDS)
            is_full = len(self._records) >= _MOST_CLASSES
            if label != SILENCE:
                self._sounds.append((start, start + max(duration, 0), label))
                self._changes += 1
            if label in self._unnamed or (label not in self._records and is_full):
                continue
            record = self._records.setdefault(label, EventRecord(self.name, label))
            before = record.current
            if record.push(start, start + max(duration, 0), confidence) and record.current:
                if label not in self.hidden_classes:
                    begun.append(record.current)
                if before is not None and label in self._unended:
                    self._replaced.append(before)
            if record.current is not before:
                self._unended.add(label)
        return begun

    def push_gaps(self, columns: Columns) -> None:
        """Add gaps, with the fields of `FIELDS`."""
        starts, durations = columns["header.stamp"].tolist(), columns["duration"].tolist()
        spans = zip(starts, durations, strict=True)
        self.gaps += [(start, start + length) for start, length in spans if length > 0]

    def sounds(
        self, since: int, corrections: EventCorrections, names: Mapping[str, str]
    ) -> dict[str, ClassSounds]:
        """Return the events of each shown class since a time, as the report counts them.

        `ON_TELEVISION` classes do not count beside a television, but where a person confirmed them.
        `names` are common names of classes; empty for the classes of the model.
        """
        shown = [names.get(label, label) for label in [*self.classes, *self.labels()]]
        found = {
            name: ClassSounds([], [], set(), set()) for name in ordered(shown) if name != SILENCE
        }
        every: list[SoundEvent] = []
        for label in [*found]:
            events = self._named_events(label, since, names)
            every += events
            given = corrections.labels(events)
            counted = {event.id for event in self.counted(events)}
            for event in events:
                is_doubtful = is_too_doubtful(event.label, event.confidence)
                name = given.get(event.id, UNKNOWN if is_doubtful else label)
                if name == UNKNOWN != label:
                    found[label].doubtful.add(event.id)
                own = found.get(names.get(name, name))
                if own is not None:
                    own.events.append(event)
                    own.given.update({event.id} & given.keys())
                    if event.id in counted or event.id in given:
                        own.counted.append(event)
        for event in corrections.sounds_without_event(self.name, every, since):
            own = found.get(names.get(event.label, event.label))
            if own is not None:
                own.events.append(event)
                own.counted.append(event)
        for events in (part for own in found.values() for part in (own.events, own.counted)):
            events.sort(key=_START)
        return found

    def counts(
        self, today: Today, corrections: EventCorrections = NO_CORRECTIONS
    ) -> dict[str, tuple[int | None, int | None]]:
        """Count the events that began since midnight, and those of the last night, by class.

        A count is None in place of 0 if coverage is too low for a count of 0.
        """
        key = self._changes, corrections.number, today[1:], self.hidden_classes, *self.classes
        if key != self._counts[0]:
            counts = {}
            for name, own in self.sounds(min(today.midnight, today.night), corrections, {}).items():
                of_night = (today.night <= event.start < today.morning for event in own.counted)
                of_day = (event.start >= today.midnight for event in own.counted)
                counts[name] = sum(of_day), sum(of_night)
            self._counts = key, counts
        has_day = self.listened_share(today.midnight, today.now) > 0
        has_night = self.is_night_covered(today)
        return {
            name: (day if day or has_day else None, night if night or has_night else None)
            for name, (day, night) in self._counts[1].items()
        }

    def counted(self, events: Sequence[SoundEvent]) -> list[SoundEvent]:
        """Return the events that count: `ON_TELEVISION` ones only without a television."""
        apart = [event for event in events if event.label in ON_TELEVISION]
        left = {*self.without_television(apart)}
        return [event for event in events if event.label not in ON_TELEVISION or event in left]

    def without_television(self, events: Sequence[SoundEvent]) -> list[SoundEvent]:
        """Return the events of a class, or of several, that begin without a television beside."""
        starts = np.array([event.start for event in events], np.int64)
        is_apart = rows_at(self.television(), starts) >= 0
        return [event for event, apart in zip(events, is_apart, strict=True) if not apart]

    def television(self) -> Spans:
        """Return the minutes that resemble a television."""
        if self._television[0] != self._changes:
            rows = sorted(self._sounds)
            starts, ends = (np.array([row[i] for row in rows], np.int64) for i in (0, 1))
            labels = np.array([class_name(row[2]) for row in rows], object)
            end = int(ends.max(initial=0))
            first, last = int(starts.min(initial=end)) // MINUTE - AROUND, end // MINUTE + AROUND
            edges = np.arange(max(first, last - _MOST_MINUTES), last + 1) * MINUTE
            minutes = edges[:-1][television_minutes(Labelling(starts, ends, labels), edges)]
            self._television = self._changes, joined(minutes, minutes + MINUTE)
        return self._television[1]

    def is_night_covered(self, today: Today) -> bool:
        """Return whether enough of the night was listened to for a count of 0."""
        return self.listened_share(today.night, min(today.morning, today.now)) >= MOST

    def listened_share(self, start: int, end: int) -> float:
        """Return the share of a time span, up to now, in which the microphone listened."""
        return 1 - self.not_listened(start, end).length / max(end - start, 1)

    def not_listened(self, start: int, end: int) -> Spans:
        """Return the parts of a time span, up to now, in which the microphone did not listen.

        A log without messages of gaps has them between its segments.
        """
        own = self._coverage.spans(FRAME_NANOSECONDS)
        spans = [(start, self.since or end), *self.gaps]
        spans += zip(own.ends[:-1].tolist(), own.starts[1:].tolist(), strict=True)
        if not self.is_listening():
            spans.append((max(self.active.time, self._latest), end))
        inside = [(max(a, start), min(b, end)) for a, b in spans]
        starts, ends = np.array([(a, b) for a, b in inside if a < b], np.int64).reshape(-1, 2).T
        return joined(starts, ends)

    def ended_events(self) -> list[SoundEvent]:
        """Return the events that have ended since the last call."""
        ended, self._replaced = self._replaced, []
        for label in sorted(self._unended):
            event = self._records[label].current
            # The label may precede the event if the clock was set back. Ongoing sound has no
            # segment yet.
            is_quiet = event is None or abs(self.active.time - event.end) > _DECIDED
            if not self.is_listening() or (is_quiet and not self.active.is_active(label)):
                self._unended.remove(label)
                ended += [] if event is None else [event]
        return [event for event in ended if event.label not in self.hidden_classes]

    def forget(self, before: int, after: int) -> None:
        """Drop events before `before`, except the last of each class, and events after `after`."""
        for record in self._records.values():
            record.forget(before, after)
        self._coverage.forget_before(before)
        first, last = before - AROUND * MINUTE, after + AROUND * MINUTE
        kept = [row for row in self._sounds if first <= row[1] and row[0] <= last]
        if len(kept) < len(self._sounds):
            self._sounds = kept
            self._changes += 1
        if self.gaps and self.gaps[0][1] < before:
            self.gaps = [gap for gap in self.gaps if gap[1] >= before]


class HomeState:
    """State of one recorder's microphones.

    Attributes
    ----------
    scenarios : dict of str to LiveMicrophone
        States by scenario models; the key `<microphone>-<scenario>` is no valid microphone name.
    caught_up : bool
        Whether all earlier messages have been read, so that further ones are live.
    common_names : mapping of str to str
        Names that people are shown for classes that a model takes for one another.
    sources : collection of str or None
        Labelling sources of the newest log; None while unknown.
    corrections : EventCorrections
        What people said of recent events.
    """

    def __init__(self) -> None:
        self.microphones: dict[str, LiveMicrophone] = {}
        self.scenarios: dict[str, LiveMicrophone] = {}
        self.health: dict[str, Health] = {}
        self.caught_up = False
        self.sources: Collection[str] | None = None
        self.corrections = NO_CORRECTIONS
        self._hidden_classes: frozenset[str] = frozenset()
        self.common_names: Mapping[str, str] = {}
        self._seen = -math.inf  # time of the last message, by CLOCK_MONOTONIC
        self._diagnosed: set[str] = set()  # subjects with diagnostics in the current log

    def is_recording(self) -> bool:
        """Whether anything was written in the last fifteen seconds."""
        return time.monotonic() - self._seen <= _AWAY_SECONDS

    @property
    def hidden_classes(self) -> frozenset[str]:
        """Classes that no output shows."""
        return self._hidden_classes

    @hidden_classes.setter
    def hidden_classes(self, names: frozenset[str]) -> None:
        if names != self._hidden_classes:
            self._hidden_classes = names
            for microphone in self.every():
                microphone.hidden_classes = names

    def every(self) -> list[LiveMicrophone]:
        """Return the states of all microphones and scenarios."""
        return [*self.microphones.values(), *self.scenarios.values()]

    def present(self) -> list[LiveMicrophone]:
        """Return the states of the microphones in the newest log."""
        return [each for each in self.microphones.values() if not self.is_removed(each.name)]

    def is_removed(self, name: str) -> bool:
        """Whether the recorder no longer has a microphone or scenario."""
        return self.sources is not None and name not in self.sources

    def name_in_common(self, names: Mapping[str, str]) -> None:
        """Show classes that a model takes for one another under their common names."""
        self.common_names = names
        for microphone in self.every():
            microphone.common_names = names

    def begin_log(self) -> None:
        """Begin a new log: drop the health of subjects without diagnostics in the last log."""
        self.health = {name: each for name, each in self.health.items() if name in self._diagnosed}
        self._diagnosed.clear()

    def find_event(self, identifier: str) -> SoundEvent | None:
        """Return the event with an id; None if unknown or dropped."""
        for microphone in list(self.microphones.values()):  # may run in another thread
            for label in microphone.labels():
                for event in microphone.events(label, 0):
                    if event.id == identifier:
                        return event
        return None

    def push(self, columns: Sequence[Columns]) -> list[SoundEvent]:
        """Add messages, with the fields of `FIELDS`; return the events that they begin."""
        begun = []
        for part in (each for each in columns if len(each)):
            seen = self._time_seen(part)
            self._seen = max(self._seen, seen)
            if part.type == message_types.DIAGNOSTICS:
                self._push_diagnostics(part)
                continue
            microphone = self._state_of(part.topic)
            if part.type == message_types.LABEL:
                microphone.push_labels(part)
                microphone.seen = max(microphone.seen, seen)
            elif part.type == message_types.GAP:
                microphone.push_gaps(part)
            else:
                begun += microphone.push_segments(part)
        return begun

    def _state_of(self, topic: str) -> LiveMicrophone:
        name = source_of_topic(topic)
        assert name is not None
        is_scenario = is_of_scenario(name)
        own = self.scenarios if is_scenario else self.microphones
        if name not in own:
            own[name] = LiveMicrophone(name, OF_EVERY_SCENARIO if is_scenario else {SILENCE})
            own[name].hidden_classes = self._hidden_classes
            own[name].common_names = self.common_names
        return own[name]

    def _time_seen(self, columns: Columns) -> float:
        """Return when messages were written, by CLOCK_MONOTONIC.

        Messages read while catching up are as old as their log times; live messages were written
        now, whatever the clock of the recorder shows.
        """
        if self.caught_up:
            return time.monotonic()
        age = (time.time_ns() - int(columns.log_times[-1])) / NANOSECONDS
        return time.monotonic() - max(age, 0.0)

    def _push_diagnostics(self, columns: Columns) -> None:
        for status in (each for same in columns["status"] for each in same):
            subject = message_types.status_subject(str(status["name"]))
            if subject in self.health or len(self.health) < _MOST_CLASSES:
                self._diagnosed.add(subject)
                self.health[subject] = Health(int(status["level"]), str(status["message"]))
            microphone = self.microphones.get(subject)
            if microphone is not None:
                microphone.level_dbfs = status_value(status, "level_dbfs")


def _class_names(columns: Columns) -> list[str]:
    """Return the class names of a model, from the metadata of its label channel."""
    with suppress(ValueError, RecursionError):
        names = json.loads(columns.metadata.get("probabilities_names", ""))
        if isinstance(names, list) and all(isinstance(name, str) for name in names):
            return names[:_MOST_CLASSES]
    return []


_EVERY = {message_types.SEGMENT, message_types.GAP}  # types whose old messages count, too
_LATEST = 60 * NANOSECONDS  # older labels and diagnostics have no effect on the state
_WAIT_SECONDS = 1.0
_TICK_SECONDS = 0.5
_REVIEWS_SECONDS = 10.0  # longest wait for the reviews of the newest logs at the start


def follow_home(
    home: RecorderAddress, start: int, stop: Flag, report: Report
) -> Iterator[tuple[HomeState, list[SoundEvent], list[Columns]]]:
    """Follow the logs of a recorder, and update the state of its home.

    Events are read from log time `start`, in nanoseconds of UTC. `report` receives problems: a log
    that can be read no further, or a missing folder. After each batch of messages, and twice a
    second without any, yield the same state, the events that began with the batch, and its
    messages, with the fields of `FIELDS`.
    """
    state, folder = HomeState(), home.folder
    state.corrections = EventCorrections(folder, home.node)
    state.hidden_classes = home.never_tell
    _hide(state, home, report)
    while not folder.is_dir():
        report(f"{folder}: no such folder yet; waiting for a recorder")
        state.caught_up = True
        yield state, [], []
        if stop.wait(_WAIT_SECONDS):
            return
    state.caught_up = False
    messages = follow_messages(
        folder, is_of_activity, start, stop, lambda error: report(str(error)), ticks=True
    )
    yielded, current, described = -math.inf, folder, folder
    for path, batch in messages:
        if path == folder:  # a tick: everything written so far has been read
            if current != described and (names := _labelling_sources(current)) is not None:
                state.sources, described = names, current
            if not state.caught_up or time.monotonic() - yielded >= _TICK_SECONDS:
                _renew(state, home, report, has_log=current != folder)
                state.caught_up = True
                yielded = time.monotonic()
                yield state, [], []
        elif log_name(path).node == home.node:
            if path != current and not is_layer(path):
                current = path
                state.begin_log()
                _check_version(path, report)
                state.name_in_common(common_names_of(path, WATER))
            yielded = time.monotonic()
            yield state, *_push(state, path, batch, report)
        if stop.is_set():
            return


def _renew(state: HomeState, home: RecorderAddress, report: Report, *, has_log: bool) -> None:
    """Read again what people have corrected and hidden; the first counts wait for it."""
    if has_log:
        state.corrections.refresh(report, 0.0 if state.caught_up else _REVIEWS_SECONDS)
    _hide(state, home, report)


def _hide(state: HomeState, home: RecorderAddress, report: Report) -> None:
    """Hide the classes of the configuration and of the list beside the logs.

    While the list cannot be read, what it hid last stays hidden.
    """
    try:
        state.hidden_classes = home.never_tell | read_hidden_classes(home.folder)
    except (LogError, OSError) as error:
        report(f"{error}; until then, classes hidden since the start of the bridge stay hidden")


def _push(
    state: HomeState, log: Path, batch: list[RawMessages], report: Report
) -> tuple[list[SoundEvent], list[Columns]]:
    """Add a batch of messages from a log; return the events that they begin, and the messages."""
    try:
        columns = _decode(batch)
        return state.push(columns), columns
    except LogError as error:
        report(f"{log}: {error}")
        return [], []


def _check_version(log: Path, report: Report) -> None:
    """Report a log written by a later version, which is read only in part."""
    with suppress(LogError), LogFile(log) as file:  # the file may be renamed at this moment
        for record in provenance_records(file):
            if text := unknown_version(record):
                report(f"{log}: {text}")


def _labelling_sources(log: Path) -> set[str] | None:
    """Return the labelling sources of a log; None if the log cannot be read at this moment."""
    with suppress(LogError), LogFile(log) as file:
        read_definitions(file)
        topics = [channel.topic for channel in file.channels.values()]
        return {name for topic in topics if (name := source_of_topic(topic)) is not None}
    return None


def _decode(batch: list[RawMessages]) -> list[Columns]:
    """Decode the messages of the types of `FIELDS`, without old ones that have no effect."""
    latest = [
        raw
        if raw.schema is None or raw.schema.name in _EVERY or not len(raw)
        else raw.between(int(np.max(raw.log_times)) - _LATEST, None)
        for raw in batch
    ]
    return [
        columns
        for raw in latest
        if raw.schema is not None and raw.schema.name in FIELDS and len(raw)
        for columns in decode([raw], FIELDS[raw.schema.name])
    ]
