"""What a microphone hears now, of which there is no segment yet."""

from collections import Counter, deque
from typing import NamedTuple

from hearthlog.schemas.frames import NANOSECONDS

_UNDECIDED = 5 * NANOSECONDS  # of the newest labels: a segment may still begin among them
_SETTLED = 5 * NANOSECONDS  # of a run, before it is taken for one
_SURE = 30 * NANOSECONDS  # after which most labels decide, few as they may be
_FEWEST, _MOST = 5, 0.6  # labels of a run, and the share of one class
_REMEMBERED = 100


class Label(NamedTuple):
    """A label: when it was known, in nanoseconds of UTC, the class and how sure it is."""

    time: int
    label: str
    confidence: float


class Run(NamedTuple):
    """A segment that goes on: of one class, as far as it is decided, in nanoseconds of UTC."""

    start: int
    end: int
    label: str
    confidence: float


class OpenRun:
    """The time of a microphone after its last segment: one segment, which is not yet written.

    A segment is written when another class follows, so that in what is after the last one there
    is one class, whatever single labels say. Most of them say which.

    Attributes
    ----------
    start : int
        End of the last segment, or of a gap after it, in nanoseconds of UTC; 0 before the first.
    last : int
        Time of the newest label; 0 before the first.
    """

    def __init__(self) -> None:
        self.start = self.last = 0
        self._recent: deque[Label] = deque(maxlen=_REMEMBERED)
        self._counts: Counter[str] = Counter()
        self._sums: Counter[str] = Counter()  # of confidences, in millionths

    def add(self, label: Label) -> None:
        """Add a label; older ones than the newest are left out."""
        if label.time > self.last:
            self.last = label.time
            self._recent.append(label)
            self._count(label)

    def begin(self, time: int) -> None:
        """Let the run begin at a time, in nanoseconds of UTC, unless it began later."""
        if time > self.start:
            self.start = time
            self._counts.clear()
            self._sums.clear()
            for label in self._recent:
                self._count(label)

    def run(self) -> Run | None:
        """Return the run; None while it is not known which class it has."""
        length = self.last - _UNDECIDED - self.start
        number = sum(self._counts.values())
        if length < _SETTLED or number < _FEWEST or not self.start:
            return None
        label, count = self._counts.most_common(1)[0]
        if count < _MOST * number and length < _SURE:
            return None
        confidence = self._sums[label] / count / 1e6
        return Run(self.start, self.start + length, label, confidence)

    def _count(self, label: Label) -> None:
        if label.time > self.start:
            self._counts[label.label] += 1
            self._sums[label.label] += round(1e6 * label.confidence)
