"""The clock of a fast month: it goes on when somebody waits, and stands still while they work."""

import time
from threading import Event as Flag

from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.tools.lab.month.shared_state import SharedState

START = 1_767_225_600 * NANOSECONDS  # 2026-01-01, true time at which the month begins


class FastClock:
    """The clocks of the machine that is simulated.

    Parameters
    ----------
    state : SharedState
    """

    def __init__(self, state: SharedState) -> None:
        self._state = state

    def monotonic(self) -> int:
        """Return CLOCK_MONOTONIC in nanoseconds."""
        return self._state.now - self._state.boot

    def realtime(self) -> int:
        """Return CLOCK_REALTIME in nanoseconds of UTC."""
        return START + self._state.now + self._state.clock_error

    def install(self) -> None:
        """Let the module `time` of this process tell these times."""
        time.monotonic_ns = self.monotonic
        time.monotonic = lambda: self.monotonic() / NANOSECONDS
        time.time_ns = self.realtime
        time.time = lambda: self.realtime() / NANOSECONDS


class FastFlag(Flag):
    """A flag on which nobody waits: the clock goes on instead.

    Parameters
    ----------
    state : SharedState
    """

    def __init__(self, state: SharedState) -> None:
        super().__init__()
        self._state = state

    def wait(self, timeout: float | None = None) -> bool:
        """Let the clock go on by a time, in seconds; return whether the flag is set.

        Parameters
        ----------
        timeout : float
        """
        self._state.now += int((timeout or 0.0) * NANOSECONDS)
        return self.is_set()
