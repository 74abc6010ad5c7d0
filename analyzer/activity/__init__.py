"""Activity of a home: sound events of a microphone, and its currently active classes."""

from bisect import bisect_left, bisect_right, insort
from collections import deque
from collections.abc import Sequence
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.logs.spans import EVENT_PAUSE
from hearthlog.models.classes import SILENCE
from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.frames import NANOSECONDS

LONGEST_PAUSE = 600 * NANOSECONDS  # longest pause within an event that may be configured
_START = attrgetter("start")
_MOST_AGAIN = 50  # segments that a recorder may write twice after its disk was full


class SoundEvent(NamedTuple):
    """Segments of one class with at most ten seconds between them."""

    microphone: str
    label: str
    start: int  # in nanoseconds of UTC
    end: int  # likewise; may still grow
    confidence: float  # highest of the segments
    seconds: float  # total length of the segments

    @property
    def id(self) -> str:
        """Identifier of the event in every output."""
        return f"{self.microphone}-{self.label}-{self.start}"


class EventRecord:
    """Recent events of one class of a microphone; the next segment may extend `current`."""

    def __init__(self, microphone: str, label: str) -> None:
        self._microphone = microphone
        self._label = label
        self.events: list[SoundEvent] = []
        self.current: SoundEvent | None = None
        self._segments: deque[tuple[int, int]] = deque(maxlen=_MOST_AGAIN)  # the last ones

    def push(self, start: int, end: int, confidence: float) -> bool:
        """Add a segment in log order (nanoseconds of UTC); return whether it begins a new event."""
        if (start, end) in self._segments:  # written again after a failed write
            return False
        self._segments.append((start, end))
        seconds = (end - start) / NANOSECONDS
        current = self.current
        if current is None or not current.start <= start <= current.end + EVENT_PAUSE:
            new = SoundEvent(self._microphone, self._label, start, end, confidence, seconds)
            insort(self.events, new, key=_START)  # not the last if the clock was set back
            self.current = new
            return True
        self.current = current._replace(
            end=max(current.end, end),
            confidence=max(current.confidence, confidence),
            seconds=current.seconds + seconds,
        )
        place = bisect_left(self.events, current.start, key=_START)
        self.events[self.events.index(current, place)] = self.current
        return False

    def since(self, time: int) -> list[SoundEvent]:
        """Return the events that began at a time or later, in nanoseconds of UTC."""
        return self.events[bisect_left(self.events, time, key=_START) :]

    def forget(self, before: int, after: int) -> None:
        """Drop events that began before `before`, except the last one, or later than `after`."""
        first = bisect_left(self.events, before, key=_START)
        end = bisect_right(self.events, after, key=_START)
        kept = self.events[min(first, max(end - 1, 0)) : end]
        if len(kept) < len(self.events):
            self.events = kept
            if self.current not in kept:
                self.current = None


ANY_SOUND = ""  # in place of a class: everything except silence
HOLD_SECONDS = 10  # from the last frame of a class to its end, like the pause of events
_SECOND = 20  # frames
_LEAST = 8  # frames of a second: fewer flicker, more react late


class ActiveClasses:
    """Currently active classes: those with at least eight labels in a second.

    The result does not depend on how labels are split over calls. Labels older than a second plus
    the hold time have no effect. `time` is that of the newest label, in nanoseconds of UTC; 0
    before the first.
    """

    def __init__(self, classes: Sequence[str]) -> None:
        self.time = 0
        self._classes = list(classes)
        self._last_active = dict.fromkeys([*classes, ANY_SOUND], 0)
        self._last_labels = np.empty(0, np.int64)  # less than a second of them

    def push(self, labels: Sequence[str], times: Int64) -> None:
        """Add labels, with the times when they became available, in nanoseconds of UTC."""
        if not len(times):
            return
        if times[0] < self.time:  # the clock was set back: earlier labels are not recent
            self._last_active = dict.fromkeys(self._last_active, 0)
            self._last_labels = self._last_labels[:0]
        places = {name: place for place, name in enumerate(self._classes)}
        new = np.array([places.get(label, -1) for label in labels])
        recent = np.concatenate([self._last_labels, new])
        silence = places.get(SILENCE, -2)
        for name in self._last_active:
            is_of = recent != silence if name == ANY_SOUND else recent == places[name]
            sums = np.concatenate([np.zeros(_SECOND, np.int64), np.cumsum(is_of)])
            active = (sums[_SECOND:] - sums[:-_SECOND])[len(self._last_labels) :] >= _LEAST
            if active.any():
                self._last_active[name] = int(times[np.flatnonzero(active)[-1]])
        self._last_labels = recent[-_SECOND + 1 :]
        self.time = int(times[-1])

    def is_active(self, name: str) -> bool:
        """Whether a class was active in the last ten seconds before the newest label."""
        last = self._last_active.get(name, 0)
        return last > 0 and self.time - last <= HOLD_SECONDS * NANOSECONDS
