"""List of sounds on the page: events of one class folded, doubts, what needs review, and sound."""

from collections import OrderedDict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime, tzinfo
from pathlib import Path
from threading import Lock, Thread
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from hearthlog.analyzer.activity import SoundEvent
from hearthlog.analyzer.activity.checked_minutes import SURE, UNMEASURED, Sureness
from hearthlog.analyzer.activity.doubtful_sounds import (
    DoubtfulSound,
    has_no_majority,
    is_too_doubtful,
    perhaps,
    read_doubtful_sounds,
)
from hearthlog.analyzer.activity.segments import source_microphone
from hearthlog.analyzer.bridge.home_state import LiveMicrophone
from hearthlog.analyzer.bridge.page import Translation, clock, room
from hearthlog.analyzer.bridge.state import BridgeError
from hearthlog.analyzer.logs.clips import kept_sound, kept_time, wav_bytes
from hearthlog.analyzer.logs.home_logs import HomeLog, find_home_logs
from hearthlog.analyzer.logs.labelling import Labelling
from hearthlog.analyzer.logs.spans import EVENT_PAUSE
from hearthlog.models.classes import (
    IMPORTANT,
    ON_TELEVISION,
    SILENCE,
    UNKNOWN,
    WORRYING,
    class_name,
    colour_on_paper,
)
from hearthlog.schemas.errors import HearthlogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.files import AUDIO_LAYER, find_logs, log_name
from hearthlog.schemas.messages.topics import LIVE, labelling_topic

_FINAL = 15 * NANOSECONDS  # after the end of an event, its frames are in the log
_LATEST = 600 * NANOSECONDS  # from then on, frames that are missing stay so
Doubts = Mapping[str, DoubtfulSound]  # by the ids of events


def doubtful(
    microphones: Iterable[LiveMicrophone], events: Iterable[SoundEvent]
) -> list[SoundEvent]:
    """Return the events that are in doubt, without those beside a television."""
    unsure = [event for event in events if has_no_majority(event.label, event.confidence)]
    return [
        event
        for microphone in microphones
        if (own := [event for event in unsure if event.microphone == microphone.name])
        for event in microphone.without_television(own)
    ]


def read_doubts(
    logs: Sequence[HomeLog], events: Collection[SoundEvent]
) -> dict[str, DoubtfulSound]:
    """Read level and probabilities of doubtful events; those without frames are left out."""
    spans = [(each.path, each.start, each.end) for each in logs]
    found: dict[str, DoubtfulSound] = {}
    for microphone in sorted({event.microphone for event in events}):
        own = sorted(
            (event for event in events if event.microphone == microphone),
            key=lambda event: event.start,
        )
        labelling = Labelling(
            np.array([event.start for event in own], np.int64),
            np.array([event.end for event in own], np.int64),
            np.array([event.label for event in own], object),
            np.array([event.confidence for event in own], np.float32),
        )
        topics = labelling_topic(microphone, LIVE, "label"), f"/{microphone}/features"
        ids = {(event.label, event.start): event.id for event in own}
        sounds = read_doubtful_sounds(spans, topics, labelling)
        found |= {ids[sound.label, sound.start]: sound for sound in sounds}
    return found


def events_to_review(
    doubts: Doubts,
    events: Iterable[SoundEvent],
    every: Iterable[SoundEvent],
    hidden: Collection[str] = (),
) -> Doubts:
    """Return the doubts on some events that need a review of their own."""
    worrying = [event for event in every if class_name(event.label) in WORRYING]

    def near(event: SoundEvent) -> set[str]:
        return {
            class_name(each.label)
            for each in worrying
            if each.microphone == event.microphone
            and each.start <= event.end + EVENT_PAUSE
            and event.start <= each.end + EVENT_PAUSE
        }

    own = ((event, doubts[event.id]) for event in events if event.id in doubts)
    return {event.id: doubt for event, doubt in own if doubt.needs_review(hidden, near(event))}


class CurrentDoubts:
    """The doubtful sounds of the current day.

    `found` has them by the ids of events, and is replaced when there are more; `is_up_to_date` if
    every event has been looked for in the logs.
    """

    def __init__(self, folder: Path, node: str) -> None:
        self.found: Doubts = {}
        self.is_up_to_date = False
        self._folder, self._node = folder, node
        self._done: set[str] = set()
        self._missing: set[str] = set()
        self._thread: Thread | None = None

    def update(self, events: Iterable[SoundEvent], now: int) -> None:
        """Begin to read the frames of events that have ended, unless others are being read."""
        if self._thread is not None and self._thread.is_alive():
            return
        current = {event.id: event for event in events}
        self._done &= current.keys()
        self.found = {name: own for name, own in self.found.items() if name in current}
        new = [e for e in current.values() if now - e.end > _FINAL and e.id not in self._done]
        self.is_up_to_date = {event.id for event in new} <= self._missing
        if new:
            self._thread = Thread(target=self._read, args=(new, now), daemon=True)
            self._thread.start()

    def _read(self, events: Sequence[SoundEvent], now: int) -> None:
        start, end = min(event.start for event in events), max(event.end for event in events)
        found: Doubts = {}
        with suppress(HearthlogError, OSError):  # tried again
            logs = find_home_logs([self._folder]).between(start - _FINAL, end + _FINAL)
            found = read_doubts([each for each in logs if each.node == self._node], events)
        self._done |= found.keys() | {each.id for each in events if now - each.end > _LATEST}
        self._missing = {each.id for each in events} - found.keys()
        if found:
            self.found = {**self.found, **found}


_PAUSE = 300 * NANOSECONDS  # longest between two events of a bout
_MOMENT = 60 * NANOSECONDS  # longest between two doubtful events of a bout
_MOST_OF_BOUT = 50  # events
_MOST_DOUBTFUL = 4  # bouts of a day
_LONG = 60 * NANOSECONDS  # a shorter event is shown with its start alone


class Bout(NamedTuple):
    """Events of one class at one microphone, with pauses of five minutes at most.

    Doubtful events have pauses of a minute at most, and may be of several classes: a model that is
    not sure of a sound changes between them.
    """

    events: Sequence[SoundEvent]  # the oldest first; its id is that of the bout
    doubts: Sequence[DoubtfulSound] = ()  # the same events if they are in doubt and need review

    @property
    def first(self) -> SoundEvent:
        """The oldest event."""
        return self.events[0]

    @property
    def last(self) -> SoundEvent:
        """The newest event."""
        return self.events[-1]

    @property
    def end(self) -> int:
        """End of the last event to end."""
        return max(event.end for event in self.events)

    @property
    def labels(self) -> list[str]:
        """The different labels, the longest in all first."""
        seconds: dict[str, float] = {}
        for event in self.events:
            seconds[event.label] = seconds.get(event.label, 0.0) + event.seconds
        return sorted(seconds, key=lambda label: -seconds[label])

    @property
    def is_important(self) -> bool:
        """Whether the bout needs review, if any of it counts."""
        return bool(self.doubts) or self.first.label in IMPORTANT


def needs_review(bout: Bout, uncounted: int) -> bool:
    """Whether a bout needs review, of which so many events do not count.

    Nobody has to look at a telephone that may be something else.
    """
    doubtful = [is_too_doubtful(event.label, event.confidence) for event in bout.events]
    is_uncounted = not bout.doubts and all(doubtful)
    return bout.is_important and uncounted < len(bout.events) and not is_uncounted


def bouts(events: Iterable[SoundEvent], doubts: Doubts = MappingProxyType({})) -> list[Bout]:
    """Fold events to bouts, the newest first.

    Events that need review are in `doubts`, by id: the loudest of them are bouts of their own, at
    most four.
    """
    events = list(events)
    folded = _folded(events, doubts)
    doubtful = [bout for bout in folded if bout.doubts]
    if len(doubtful) > _MOST_DOUBTFUL:
        doubtful.sort(key=lambda bout: -max(doubt.level_db for doubt in bout.doubts))
        ids = {event.id for bout in doubtful[:_MOST_DOUBTFUL] for event in bout.events}
        folded = _folded(events, {each: doubts[each] for each in ids})
    return sorted(folded, key=lambda bout: (bout.last.start, bout.last.id), reverse=True)


def _folded(events: Sequence[SoundEvent], doubts: Doubts) -> list[Bout]:
    found: list[list[SoundEvent]] = []
    going: dict[tuple[str, str], list[SoundEvent]] = {}
    for event in sorted(events, key=lambda event: event.start):
        is_doubtful = event.id in doubts
        key = event.microphone, "" if is_doubtful else event.label
        pause = _MOMENT if is_doubtful else _PAUSE
        own = going.get(key)
        is_near = own and event.start - max(each.end for each in own) <= pause
        if own and is_near and len(own) < _MOST_OF_BOUT:
            own.append(event)
        else:
            going[key] = [event]
            found.append(going[key])
    return [Bout(own, [doubts[e.id] for e in own if e.id in doubts]) for own in found]


def events_between(microphones: Iterable[LiveMicrophone], start: int, end: int) -> list[SoundEvent]:
    """Return the events of microphones that begin in a time span and may be shown."""
    return [
        event
        for microphone in microphones
        for label in microphone.labels()
        if label != SILENCE
        for event in microphone.events(label, start)
        if event.start < end
    ]


def uncounted_ids(
    microphones: Iterable[LiveMicrophone], events: Iterable[SoundEvent]
) -> frozenset[str]:
    """Return the ids of the events that do not count, because a television was on."""
    own = {each.name: each for each in microphones}
    apart = [event for event in events if event.label in ON_TELEVISION]
    by_room = {name: [e for e in apart if e.microphone == name] for name in own}
    counted = {e.id for name, same in by_room.items() for e in own[name].counted(same)}
    return frozenset(event.id for event in apart) - counted


class ShownBouts(NamedTuple):
    """How bouts are shown."""

    now: int
    zone: tzinfo
    words: Translation
    correction: Callable[[SoundEvent], str]  # of an event in words; empty if there is none
    is_alone: bool
    sureness: Sureness = UNMEASURED
    common_names: Mapping[str, str] = MappingProxyType({})
    uncounted: Collection[str] = ()  # ids of events that do not count, because of a television
    hidden: Collection[str] = ()
    is_past: bool = False

    def describe(self, bout: Bout) -> Any:
        """Return a bout for JSON."""
        words, first = self.words, bout.first
        is_mixed = len(bout.labels) > 1  # events that are no count of one sound
        count = len(bout.events)
        start = words.when(first.start, self.now, self.zone, is_past=self.is_past)
        end = clock(bout.end, self.zone)
        is_long = count > 1 or bout.end - first.start >= _LONG
        is_range = is_long and end != clock(first.start, self.zone)
        corrections = [text for text in map(self.correction, bout.events) if text]
        length = words.length(sum(event.seconds for event in bout.events))
        return {
            "id": first.id,
            "label": first.label,
            "words": self._heading(bout),
            "colour": colour_on_paper(UNKNOWN if bout.doubts else first.label),
            "times": words.times(count) if count > 1 and not is_mixed else "",
            "time": words.text("range", first=start, last=end) if is_range else start,
            "length": "" if is_mixed else length,
            "sure": self._sureness(bout),
            "unsure": self._unsure_of(bout.events),
            "beside": self._uncounted_note(bout),
            "is_uncounted": self._uncounted_of(bout) == count,
            "span": (first.start // NANOSECONDS, bout.end // NANOSECONDS),
            "span_words": (start, end),
            "doubtful": bool(bout.doubts),
            "room": "" if self.is_alone else room(first.microphone),
            "said": corrections[-1] if corrections else "",
            "look": needs_review(bout, self._uncounted_of(bout)),
            "ids": [event.id for event in reversed(bout.events)],
        }

    def _heading(self, bout: Bout) -> str:
        if not bout.doubts:
            label = bout.first.label
            words = self.words.class_words(self.common_names.get(label, label))
            perhaps_only = self._are_too_doubtful(bout.events)
            inside = self.words.inside(words)
            return self.words.text("doubt.perhaps", classes=inside) if perhaps_only else words
        names = [self.words.class_words(name) for name in perhaps(bout.doubts, self.hidden)]
        if not names:
            return self.words.text("doubt.loud")
        classes = self.words.listed([*map(self.words.inside, names)], "or")
        return self.words.text("doubt.perhaps", classes=classes)

    def _sureness(self, bout: Bout) -> str:
        if not bout.doubts:
            return self._sureness_of(bout.events)
        is_loud = any(doubt.is_loud for doubt in bout.doubts)
        text = self.words.text("doubt.why loud" if is_loud else "doubt.why")
        if perhaps(bout.doubts, self.hidden):
            return text
        labels = (self.common_names.get(label, label) for label in bout.labels)
        names = [name for name in dict.fromkeys(labels) if class_name(name) != UNKNOWN]
        classes = [self.words.inside(self.words.class_words(name)) for name in names]
        listed = self.words.listed(classes, "or")
        return self.words.text("doubt.labels", why=text, classes=listed) if names else text

    def _sureness_of(self, events: Sequence[SoundEvent]) -> str:
        """Return how many of some events are not sure; whether the likeliest is if none are."""
        unsure = self._unsure_of(events)
        if self._are_too_doubtful(events):
            return self.words.text("not sure.not counted")
        if 0 < unsure < len(events):
            return self.words.count("not sure.some", unsure)
        word = self.sureness.word(max(event.confidence for event in events))
        return self.words.text(word) if word == SURE or unsure else ""

    def _are_too_doubtful(self, events: Sequence[SoundEvent]) -> bool:
        return all(
            is_too_doubtful(each.label, each.confidence) and not self.correction(each)
            for each in events
        )

    def _unsure_of(self, events: Sequence[SoundEvent]) -> int:
        return sum(
            class_name(e.label) != UNKNOWN
            and self.sureness.is_unsure(e.confidence)
            and not self.correction(e)
            for e in events
        )

    def _uncounted_note(self, bout: Bout) -> str:
        """Return how many events of a bout do not count, because a television was on."""
        number = self._uncounted_of(bout)
        if not number:
            return ""
        if number == len(bout.events):
            return self.words.text("beside")
        return self.words.count("beside.some", number)

    def _uncounted_of(self, bout: Bout) -> int:
        return sum(e.id in self.uncounted and not self.correction(e) for e in bout.events)


_LONGEST_SOUND = 60 * NANOSECONDS
_NEAR = 10 * NANOSECONDS  # a clip may lie so far from its log time
_MOST_KEPT = 2000  # remembered events with kept sound


class KeptSounds:
    """Kept sound of the events of a home."""

    def __init__(self, folder: Path, node: str) -> None:
        self._folder = folder
        self._node = node
        self._found: OrderedDict[str, None] = OrderedDict()  # ids of events with kept sound
        self._lock = Lock()  # one reader at a time

    def has(self, event: SoundEvent) -> bool:
        """Whether any sound of an event was kept; `False` if its layers cannot be read."""
        if event.id in self._found:
            return True
        start, end = _limits(event)
        with self._lock:
            try:
                layers = self._layers(start, end)
                kept = bool(layers) and bool(kept_time(layers, _topic(event), start, end).length)
            except (HearthlogError, OSError):
                return False
            if kept:
                self._found[event.id] = None
                if len(self._found) > _MOST_KEPT:
                    self._found.popitem(last=False)
        return kept

    def wav(self, event: SoundEvent, hidden: Iterable[SoundEvent]) -> bytes:
        """Return the sound of an event, up to its first minute, as a WAV file.

        Silence takes the place of hidden events, which nobody may hear. Raise `BridgeError` if no
        sound was kept, or it cannot be read.
        """
        start, end = _limits(event)
        try:
            with self._lock:
                rate, samples = kept_sound(self._layers(start, end), _topic(event), start, end)
        except (HearthlogError, OSError) as error:
            raise BridgeError(f"The sound cannot be read: {error}") from error
        if not rate:
            raise BridgeError("No sound was kept of this.")
        for other in hidden:
            if source_microphone(other.microphone) == event.microphone:
                first, last = (
                    min(max((edge - start) * rate // NANOSECONDS, 0), len(samples))
                    for edge in (other.start, other.end)
                )
                samples[first : last + 1] = 0
        return wav_bytes(samples, rate)

    def _layers(self, start: int, end: int) -> list[Path]:
        """Return the layers that may have sound of a time span."""
        named = ((log, log_name(log)) for log in find_logs(self._folder))
        layers = [
            (begin, log)
            for log, name in named
            if (name.layer, name.node) == (AUDIO_LAYER, self._node)
            and (begin := _begin(name.time)) is not None
            and begin <= end + _NEAR
        ]
        last = max((begin for begin, _ in layers if begin <= start - _NEAR), default=0)
        return [log for begin, log in layers if begin >= last]


def _limits(event: SoundEvent) -> tuple[int, int]:
    return event.start, min(event.end, event.start + _LONGEST_SOUND)


def _topic(event: SoundEvent) -> str:
    return labelling_topic(event.microphone, LIVE, "audio")


def _begin(name: str) -> int | None:
    """Return the start of a log by its name, in nanoseconds of UTC; None if it has none."""
    try:
        begin = datetime.strptime(name[:16], "%Y%m%dT%H%M%SZ").replace(tzinfo=UTC)
    except ValueError:
        return None
    return int(begin.timestamp()) * NANOSECONDS
