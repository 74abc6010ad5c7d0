"""A microphone on a fast clock: sound as fast as it is read, and what goes wrong with it."""

import time
from pathlib import Path
from typing import Protocol

import numpy as np

from hearthlog.recorder.sources.capture import BLOCK_SECONDS, CaptureFormat
from hearthlog.recorder.sources.framing import SampleBlock
from hearthlog.schemas.arrays import Int16
from hearthlog.schemas.errors import DeviceError, SourceError
from hearthlog.schemas.frames import NANOSECONDS, SAMPLE_RATE
from hearthlog.tools.lab.month.faults import Fault, Kind
from hearthlog.tools.lab.month.shared_state import SharedState

DEVICE = "simulated microphone"
_BLOCK = int(SAMPLE_RATE * BLOCK_SECONDS)
_QUIET_BLOCK = 10 * _BLOCK  # where nothing happens: most of the work is by the block
PPM = 30.0  # by which its crystal is slow
_LATE_SECONDS = 0.0002  # on average, of the times that the sound card tells
_DELAY_SECONDS = 0.004  # from the last sample of a block to its arrival
_HELD_SECONDS = 32.0  # in the pipe, while the recorder stands still
_OPEN_SECONDS = 0.3
_DISTURBED: set[Kind] = {"muted", "stuck", "clipping"}
_MOST_CHILDREN = 2  # that rewrite logs: on this clock an hour has not the time for it


class Sound:
    """Composed sound, again and again, and never the same: its last bit is noise.

    Parameters
    ----------
    path : Path
        Samples at 16 kHz, int16, as `numpy.save` writes them.
    """

    def __init__(self, path: Path) -> None:
        self._samples: Int16 = np.load(path, mmap_mode="r")
        self._noise = np.random.default_rng(0).integers(0, 2, 1 << 20, np.int16)

    def at(self, first: int, count: int) -> Int16:
        """Return samples by the number of the first one since the month began.

        Parameters
        ----------
        first, count : int
        """
        place = first % (len(self._samples) - count)
        dither = first * 7919 % (len(self._noise) - count)
        return np.asarray(
            self._samples[place : place + count] & ~1 | self._noise[dither : dither + count]
        )


class Course(Protocol):
    """What happens in the month."""

    def active(self) -> Fault | None:
        """Bring about what is due; return the fault that lasts, or None."""

    def is_quiet(self) -> bool:
        """Tell whether nothing has happened, or will happen, for a while."""


class FastMicrophone:
    """One run of the capture process, as `Capture` has it.

    Parameters
    ----------
    state : SharedState
    sound : Sound
    course : Course
    rng : np.random.Generator

    Raises
    ------
    DeviceError, SourceError
        If it is unplugged or crashes.
    """

    def __init__(
        self,
        state: SharedState,
        sound: Sound,
        course: Course,
        rng: np.random.Generator,
    ) -> None:
        self._state = state
        self._sound = sound
        self._course = course
        self._rng = rng
        self.format = CaptureFormat(DEVICE, DEVICE, SAMPLE_RATE)
        self._advance(int(_OPEN_SECONDS * NANOSECONDS))
        self._refuse()
        self._begin = self._monotonic()
        self._index = 0  # of the next sample that is sent
        self._lost = 0  # samples that the sound card lost
        self._begun: Fault | None = None

    def blocks(self, timeout: float) -> list[SampleBlock] | None:
        """Return the next block, however long that takes by the clock.

        Parameters
        ----------
        timeout : float
            Seconds for which the clock goes on where there is no sound.
        """
        _wait_for_children()
        fault = self._course.active()
        kind = fault.kind if fault is not None else None
        is_new = fault is not self._begun
        self._begun = fault
        if kind in {"unplugged", "capture crashes"}:
            return None
        if kind == "stalled":
            self._advance(int(timeout * NANOSECONDS))
            return []
        if kind == "samples lost" and is_new and fault is not None:
            self._lost += max(fault.length * SAMPLE_RATE // NANOSECONDS, 1)
            return [self._block(overflowed=True)]
        if kind == "standstill" and fault is not None:
            return self._after_standstill(fault)
        return [self._block(_QUIET_BLOCK if self._course.is_quiet() else _BLOCK, kind=kind)]

    def kill(self) -> None:
        """End it."""

    def _after_standstill(self, fault: Fault) -> list[SampleBlock]:
        """Return what the pipe holds after a time in which nobody has read it."""
        length = fault.end - self._state.now
        count = max(length // int(BLOCK_SECONDS * NANOSECONDS), 1)
        kept = min(count, int(_HELD_SECONDS / BLOCK_SECONDS))
        blocks = [self._block() for _ in range(kept)]
        self._index += (count - kept) * _BLOCK
        self._state.now = max(self._state.now, fault.end)
        return blocks

    def _refuse(self) -> None:
        fault = self._course.active()
        if fault is not None and fault.kind == "unplugged":
            raise DeviceError(f"no microphone is called {DEVICE!r}; there are none")
        if fault is not None and fault.kind == "capture crashes":
            raise SourceError("PortAudio crashed: check ALSA's configuration")

    def _block(
        self, count: int = _BLOCK, *, overflowed: bool = False, kind: Kind | None = None
    ) -> SampleBlock:
        """Let the clock go on to the end of the next block, and return it."""
        index, self._index = self._index, self._index + count
        begin = self._time_of(index + self._lost)
        end = self._time_of(self._index + self._lost)
        self._advance(end + int(_DELAY_SECONDS * NANOSECONDS) - self._monotonic())
        if not self._state.last_sound:
            self._state.first_sound = begin
        self._state.last_sound = end
        late = float(self._rng.exponential(_LATE_SECONDS))
        adc = 0.0 if kind == "no ADC clock" else begin / NANOSECONDS + late
        samples = self._sound.at((begin + self._state.boot) * SAMPLE_RATE // NANOSECONDS, count)
        if kind in _DISTURBED:
            samples = _disturbed(samples, kind)
        return SampleBlock(index, samples, overflowed, adc, time.monotonic())

    def _time_of(self, sample: int) -> int:
        return self._begin + int(sample * NANOSECONDS / SAMPLE_RATE * (1 + PPM * 1e-6))

    def _monotonic(self) -> int:
        return self._state.now - self._state.boot

    def _advance(self, nanoseconds: int) -> None:
        self._state.now += max(nanoseconds, 0)


def _disturbed(samples: Int16, kind: Kind | None) -> Int16:
    if kind == "muted":
        return np.zeros_like(samples)
    if kind == "stuck":
        return np.full_like(samples, 77)
    return np.clip(samples.astype(np.int32) * 60, -32768, 32767).astype(np.int16)


def _wait_for_children() -> None:
    """Wait, by the true clock, while too many processes of this one are at work."""
    while len(_working_children()) > _MOST_CHILDREN:
        _sleep(0.02)


def _working_children() -> list[str]:
    children = Path("/proc/thread-self/children").read_text().split()
    return [child for child in children if _command_line(child)]


def _command_line(child: str) -> bytes:
    """Read the command line of a process; empty when it has ended."""
    try:
        return Path(f"/proc/{child}/cmdline").read_bytes()
    except (FileNotFoundError, ProcessLookupError):  # it ended since it was listed
        return b""


_sleep = time.sleep
