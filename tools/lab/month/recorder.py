"""The recorder of a fast month, a process of its own: `FOLDER DAYS SEED`."""

import os
import resource
import signal
import sys
from pathlib import Path

import numpy as np

from hearthlog.recorder.config import load_settings
from hearthlog.recorder.recording import record_microphones
from hearthlog.recorder.sources import microphone
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.tools.lab.month.fast_clock import START, FastClock, FastFlag
from hearthlog.tools.lab.month.fast_microphone import FastMicrophone, Sound
from hearthlog.tools.lab.month.faults import Fault
from hearthlog.tools.lab.month.folders import MonthFolder
from hearthlog.tools.lab.month.shared_state import SharedState, shared_state

_SLEW = 500e-6
_AHEAD = 60 * 86_400 * NANOSECONDS
_WHILE = 60 * NANOSECONDS
_FROM_OUTSIDE = {"killed", "power cut", "restarted", "second recorder"}


class Month:
    """Brings about what happens while the recorder runs.

    Parameters
    ----------
    faults : list of Fault
    state : SharedState
    folder : MonthFolder
    end : int
        Of the month, in nanoseconds since it began.
    stop : FastFlag
        Set at the end.
    """

    def __init__(
        self, faults: list[Fault], state: SharedState, folder: MonthFolder, end: int, stop: FastFlag
    ) -> None:
        self._faults = faults
        self._state = state
        self._folder = folder
        self._end = end
        self._stop = stop
        self._lasting: Fault | None = None
        self._clock_error = 0  # before the fault that lasts
        self._limit = resource.getrlimit(resource.RLIMIT_FSIZE)
        self._watcher = os.getppid()

    def active(self) -> Fault | None:
        """Bring about what is due; return the fault that lasts, or None."""
        state = self._state
        if state.now >= self._end or os.getppid() != self._watcher:
            self._stop.set()
        if self._lasting is not None and state.now >= self._lasting.end:
            self._finish(self._lasting)
            self._lasting = None
        if state.next_fault < len(self._faults):
            fault = self._faults[state.next_fault]
            if state.now >= fault.start:
                state.next_fault += 1
                self._begin(fault)
                self._lasting = fault if state.now < fault.end else None
        if self._lasting is not None and self._lasting.kind == "clock slewed":
            state.clock_error = self._clock_error + int((state.now - self._lasting.start) * _SLEW)
        return self._lasting

    def is_quiet(self) -> bool:
        """Tell whether nothing has happened, or will happen, for a while."""
        now, number = self._state.now, self._state.next_fault
        if self._state.request:
            return False
        since = now - self._faults[number - 1].end if number else now
        until = self._faults[number].start - now if number < len(self._faults) else _WHILE
        return min(since, until, self._end - now) >= _WHILE

    def _begin(self, fault: Fault) -> None:
        state = self._state
        self._clock_error = state.clock_error
        if fault.kind in _FROM_OUTSIDE:
            state.request = state.next_fault
        elif fault.kind == "clock set":
            state.clock_error += fault.length
        elif fault.kind == "clock in 1970":
            state.clock_error = -(START + state.now)
        elif fault.kind == "clock ahead":
            state.clock_error += _AHEAD
        elif fault.kind == "suspended":
            state.now += fault.length
            state.boot += fault.length
        elif fault.kind == "disk refuses":
            resource.setrlimit(resource.RLIMIT_FSIZE, (0, self._limit[1]))
        elif fault.kind == "model broken":
            self._folder.replace_model(b"no model")

    def _finish(self, fault: Fault) -> None:
        if fault.kind in {"clock in 1970", "clock ahead"}:
            self._state.clock_error = self._clock_error
        elif fault.kind == "disk refuses":
            resource.setrlimit(resource.RLIMIT_FSIZE, self._limit)
        elif fault.kind == "model broken":
            self._folder.replace_model(self._folder.whole_model.read_bytes())


def main() -> None:
    """Record until the month is over, or until somebody ends this process."""
    folder = MonthFolder(Path(sys.argv[1]))
    days, seed = float(sys.argv[2]), int(sys.argv[3])
    state = shared_state(folder.state)
    FastClock(state).install()
    stop = FastFlag(state)
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    end = int(days * 86_400) * NANOSECONDS
    month = Month(folder.faults(), state, folder, end, stop)
    sound, rng = Sound(folder.sound), np.random.default_rng(seed)

    def capture(
        _device: str,
        *,
        exact: bool = False,
        channels: int | None = None,
        channel: int | None = None,
        latency: float = 0.0,
    ) -> FastMicrophone:
        del exact, channels, channel, latency
        return FastMicrophone(state, sound, month, rng)

    setattr(microphone, "open_device", capture)  # noqa: B010  it is imported there
    setattr(os, "fsync", folder.note_synced)  # noqa: B010  a power cut takes what is not synced
    record_microphones(load_settings(None, folder.settings(), {}), stop)


if __name__ == "__main__":
    main()
