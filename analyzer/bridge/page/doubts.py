"""Doubtful sounds on the page: read from the logs, those of the current day in a thread."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from threading import Thread

import numpy as np

from hearthlog.analyzer.activity import SoundEvent
from hearthlog.analyzer.activity.doubtful_sounds import (
    DoubtfulSound,
    has_no_majority,
    read_doubtful_sounds,
)
from hearthlog.analyzer.bridge.home_state import LiveMicrophone
from hearthlog.analyzer.logs.home_logs import HomeLog, find_home_logs
from hearthlog.analyzer.logs.labelling import Labelling
from hearthlog.analyzer.logs.spans import EVENT_PAUSE
from hearthlog.models.classes import WORRYING, class_name
from hearthlog.schemas.errors import HearthlogError
from hearthlog.schemas.frames import NANOSECONDS
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
