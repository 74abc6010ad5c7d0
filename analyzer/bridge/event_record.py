"""The events of one class that a microphone heard lately, put together segment by segment."""

from bisect import bisect_left, bisect_right, insort
from collections import deque
from typing import NamedTuple

from hearthlog.schemas.frames import NANOSECONDS

PAUSE_SECONDS = 10  # between the segments of one event, at most: as in the report


_MOST_AGAIN = 50  # segments that a recorder writes again after its disk was full


class Event(NamedTuple):
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
    current : Event or None
        With which a segment may go on: the one that the last segment is of.
    """

    def __init__(self, microphone: str, label: str) -> None:
        self._microphone = microphone
        self._label = label
        self.events: list[Event] = []
        self.current: Event | None = None
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
            new = Event(self._microphone, self._label, start, end, confidence, seconds)
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

    def since(self, time: int) -> list[Event]:
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


def _start(event: Event) -> int:
    return event.start


def _goes_on(event: Event, start: int) -> bool:
    return event.start <= start <= event.end + PAUSE_SECONDS * NANOSECONDS
