"""The pace of a replay."""

import time
from threading import Event as Flag

from hearthlog.schemas.times import NANOSECONDS


class Pace:
    """Waits until the time of a sound has come; `rate` is that of `ReplayOptions`."""

    def __init__(self, rate: float | None) -> None:
        self._rate = rate
        self._last: int | None = None
        self._anchor = 0.0, 0  # a time of the clock, and the time of the sound then

    def wait(self, start: int, end: int, stop: Flag) -> None:
        """Wait until the end of frames from `start` to `end` (ns of UTC), or until stopped."""
        if self._rate is None:
            return
        if self._last is None or start < self._last:  # the clock was set back
            self._anchor = time.monotonic(), start
        self._last = start
        began, first = self._anchor
        due = began + (end - first) / NANOSECONDS / self._rate
        while (left := due - time.monotonic()) > 0 and not stop.wait(min(left, 1.0)):
            pass
