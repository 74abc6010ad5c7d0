"""Sound events of a microphone, and the classes that are active now."""

from bisect import bisect_left, bisect_right, insort
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hearthlog.models.classes import SILENCE
from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.frames import NANOSECONDS

PAUSE_SECONDS = 10  # between the segments of one event, at most: as in the report


_MOST_AGAIN = 50  # segments that a recorder writes again after its disk was full


class SoundEvent(NamedTuple):
    """Segments of one class with at most ten seconds between them.

    Attributes
    ----------
    start, end : int
        In nanoseconds of UTC; the end as far as it is known.
    """

    microphone: str
    label: str
    start: int
    end: int
    confidence: float
    seconds: float

    @property
    def id(self) -> str:
        """What names the event wherever it is told of."""
        return f"{self.microphone}-{self.label}-{self.start}"


class EventRecord:
    """The events of one class of a microphone, since a time.

    Attributes
    ----------
    current : SoundEvent or None
        With which a segment may go on: the one that the last segment is of.
    """

    def __init__(self, microphone: str, label: str) -> None:
        self._microphone = microphone
        self._label = label
        self.events: list[SoundEvent] = []
        self.current: SoundEvent | None = None
        self._segments: deque[tuple[int, int]] = deque(maxlen=_MOST_AGAIN)  # the last ones

    def push(self, start: int, end: int, confidence: float) -> bool:
        """Add a segment; tell whether an event begins with it.

        Parameters
        ----------
        start, end : int
            In nanoseconds of UTC, in the order in which a log has segments.
        """
        if (start, end) in self._segments:  # written again, as the disk had refused it
            return False
        self._segments.append((start, end))
        seconds = (end - start) / NANOSECONDS
        current = self.current
        if current is None or not _goes_on(current, start):
            new = SoundEvent(self._microphone, self._label, start, end, confidence, seconds)
            insort(self.events, new, key=_start)  # not the last one if the clock was set back
            self.current = new
            return True
        self.current = current._replace(
            end=max(current.end, end),
            confidence=max(current.confidence, confidence),
            seconds=current.seconds + seconds,
        )
        place = bisect_left(self.events, current.start, key=_start)
        self.events[self.events.index(current, place)] = self.current
        return False

    def since(self, time: int) -> list[SoundEvent]:
        """Return the events that began at a time or later, in nanoseconds of UTC."""
        return self.events[bisect_left(self.events, time, key=_start) :]

    def forget(self, before: int, after: int) -> None:
        """Forget the events that began before a time, except the last, and those after another."""
        first = bisect_left(self.events, before, key=_start)
        end = bisect_right(self.events, after, key=_start)
        kept = self.events[min(first, max(end - 1, 0)) : end]
        if len(kept) < len(self.events):
            self.events = kept
            if self.current not in kept:
                self.current = None


def _start(event: SoundEvent) -> int:
    return event.start


def _goes_on(event: SoundEvent, start: int) -> bool:
    return event.start <= start <= event.end + PAUSE_SECONDS * NANOSECONDS


ANY_SOUND = ""  # in place of a class: whatever is not silence
HOLD_SECONDS = 10  # after the last frame of a class, it is over; as events are
_SECOND = 20  # frames
_LEAST = 8  # of them: fewer flicker, more come late


class ActiveClasses:
    """The classes that are heard now: at least eight labels of a second name them.

    The result does not depend on how the labels are divided among calls, and of labels older
    than a second and the hold nothing is left.

    Attributes
    ----------
    time : int
        Of the newest label, in nanoseconds of UTC; 0 before the first.
    """

    def __init__(self, classes: Sequence[str]) -> None:
        self.time = 0
        self._classes = list(classes)
        self._last_heard = dict.fromkeys([*classes, ANY_SOUND], 0)
        self._last_labels = np.empty(0, np.int64)  # of less than a second

    def push(self, labels: Sequence[str], times: Int64) -> None:
        """Add labels.

        Parameters
        ----------
        times : np.ndarray [shape=(n,)], int64
            When they were known, in nanoseconds of UTC.
        """
        if not len(times):
            return
        if times[0] < self.time:  # the clock was set back: what was heard then was not just now
            self._last_heard = dict.fromkeys(self._last_heard, 0)
            self._last_labels = self._last_labels[:0]
        places = {name: place for place, name in enumerate(self._classes)}
        new = np.array([places.get(label, -1) for label in labels])
        known = np.concatenate([self._last_labels, new])
        silence = places.get(SILENCE, -2)
        for name in self._last_heard:
            is_of = known != silence if name == ANY_SOUND else known == places[name]
            sums = np.concatenate([np.zeros(_SECOND, np.int64), np.cumsum(is_of)])
            heard = (sums[_SECOND:] - sums[:-_SECOND])[len(self._last_labels) :] >= _LEAST
            if heard.any():
                self._last_heard[name] = int(times[np.flatnonzero(heard)[-1]])
        self._last_labels = known[-_SECOND + 1 :]
        self.time = int(times[-1])

    def is_heard(self, name: str) -> bool:
        """Tell whether a class was heard in the last ten seconds before the newest label."""
        last = self._last_heard.get(name, 0)
        return last > 0 and self.time - last <= HOLD_SECONDS * NANOSECONDS
