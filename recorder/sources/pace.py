"""When sound from a network was taken, told from when it arrived: live, ahead of time, or late."""

from collections import deque
from math import ceil, inf

from hearthlog.schemas.frames import SAMPLE_RATE

_WINDOW_SAMPLES = 30 * SAMPLE_RATE  # longer than a network that is heard again may stall
_WINDOWS = 10  # five minutes, in which two clocks do not drift apart by so much
_TOLERANCE_SECONDS = 1.0


class Pace:
    """Follows when sound arrives, by the time at which its first sample must have been taken.

    That is the earliest one that any arrival allows: sound can be late, and cannot be early.

    Parameters
    ----------
    began : float
        Time at which the source was called, in seconds of CLOCK_MONOTONIC.
    """

    def __init__(self, began: float) -> None:
        self.count = 0
        self._began = began
        self._window = inf
        self._window_end = _WINDOW_SAMPLES
        self._windows: deque[float] = deque(maxlen=_WINDOWS)

    def add(self, count: int, arrival: float) -> None:
        """Note that so many samples have come until now, in seconds of CLOCK_MONOTONIC."""
        self.count += count
        self._window = min(self._window, arrival - self.count / SAMPLE_RATE)

    def settle(self) -> tuple[int, float]:
        """Tell live sound from what a server had kept for its listeners, and sends at first.

        Returns
        -------
        older : int
            How many of the samples are from before the source was called.
        now : float
            When the last one was taken, in seconds of CLOCK_MONOTONIC.
        """
        start = self._window
        self._windows.append(start)
        older = ceil((self._began - start) * SAMPLE_RATE)
        return min(max(older, 0), self.count), start + self.count / SAMPLE_RATE

    def trouble(self) -> str:
        """Say what is wrong with a source that has settled, if something is."""
        if self._window < min(self._windows) - _TOLERANCE_SECONDS:
            return "sends sound faster than it sounds; give the address of a live source"
        if self.count < self._window_end:
            return ""
        late = self._window - min(self._windows)
        self._windows.append(self._window)
        self._window = inf
        self._window_end = self.count + _WINDOW_SAMPLES
        return f"lost {late:.1f} s of sound on the way" if late > _TOLERANCE_SECONDS else ""
