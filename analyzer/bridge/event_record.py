"""The events of one class that a microphone heard lately, put together segment by segment."""

from bisect import bisect_left
from typing import NamedTuple

from hearthlog.schemas.times import NANOSECONDS

PAUSE_SECONDS = 10  # between the segments of one event, at most: as in the report


class Event(NamedTuple):
    """Segments of one class with at most ten seconds between them.

    Attributes
    ----------
    microphone, label : str
    start, end : int
        In nanoseconds of UTC; the end as far as it is known.
    confidence : float
        The highest of its segments.
    seconds : float
        That it was heard, without the pauses.
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

    Parameters
    ----------
    microphone, label : str
    """

    def __init__(self, microphone: str, label: str) -> None:
        self._microphone = microphone
        self._label = label
        self.events: list[Event] = []  # in the order of time

    def push(self, start: int, end: int, confidence: float) -> bool:
        """Add a segment; tell whether an event begins with it.

        Parameters
        ----------
        start, end : int
            In nanoseconds of UTC, in the order in which a log has segments.
        confidence : float
            Of the segment.
        """
        seconds = (end - start) / NANOSECONDS
        last = self.events[-1] if self.events else None
        if last is None or not self._goes_on(last, start):
            new = Event(self._microphone, self._label, start, end, confidence, seconds)
            self.events.append(new)
            return True
        self.events[-1] = last._replace(
            end=max(last.end, end),
            confidence=max(last.confidence, confidence),
            seconds=last.seconds + seconds,
        )
        return False

    def since(self, time: int) -> list[Event]:
        """Return the events that began at a time or later, in nanoseconds of UTC."""
        return self.events[bisect_left(self.events, time, key=lambda event: event.start) :]

    def forget_before(self, time: int) -> None:
        """Forget the events that began before a time, but for the last one."""
        first = bisect_left(self.events, time, key=lambda event: event.start)
        del self.events[: min(first, max(len(self.events) - 1, 0))]

    @staticmethod
    def _goes_on(last: Event, start: int) -> bool:
        return last.start <= start <= last.end + PAUSE_SECONDS * NANOSECONDS
