"""The recorder's host: health, systemd notifications, journal lines, heap, and child processes."""

import ctypes
import gc
import math
import os
import shutil
import socket
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import NamedTuple

from hearthlog.recorder.events import OK, WARNING, Event, Frames, SourceHealth

_ZONES = "class/thermal/thermal_zone*/temp"
_THROTTLED = "devices/platform/soc/soc:firmware/get_throttled"  # of a Raspberry Pi
_SYS = Path("/sys")
_SECONDS = 9.5  # microphones report their health every ten
_HOT = 80.0  # degrees Celsius; small boards throttle from here
_LOW_VOLTAGE, _SLOWED = 1 << 0, (1 << 1) | (1 << 2) | (1 << 3)
_TIME_ERROR = 5  # adjtimex state of an unsynchronised clock
_TIMEX_BYTES = 512  # more than any kernel writes
_STATUS = Path("/proc/self/status")
_TIMESYNC = Path("/run/systemd/timesync")  # for a service without access to adjtimex


class Disk(NamedTuple):
    """Size and free space of a disk, in bytes."""

    size: int
    free: int


def disk_of(folder: Path) -> Disk:
    """Measure the disk of a folder or its nearest existing parent; raise `OSError` on failure."""
    there = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    usage = shutil.disk_usage(there)
    return Disk(usage.total, usage.free)


class MachineWatch:
    """Checks the host's health every ten seconds."""

    def __init__(self, folder: Path, sys: Path = _SYS) -> None:
        self._folder = folder
        self._sys = sys
        self._checked = -math.inf

    def tick(self, stamp: int) -> SourceHealth | None:
        """Check the host if it is due; return the result, else None."""
        now = time.monotonic()
        if now - self._checked < _SECONDS:
            return None
        self._checked = now
        return machine_health(stamp, self._folder, self._sys)


def machine_health(stamp: int, folder: Path, sys: Path = _SYS) -> SourceHealth:
    """Return the host's health."""
    temperature, throttled = _temperature(sys), _throttled(sys)
    is_set = clock_is_synchronized()
    values = {
        "clock_synchronized": None if is_set is None else ("yes" if is_set else "no"),
        "temperature_celsius": None if temperature is None else f"{temperature:.1f}",
        "throttled": None if throttled is None else hex(throttled),
        "disk_free_bytes": _free_bytes(folder),
        "memory_bytes": memory("RssAnon"),
    }
    present = {name: str(value) for name, value in values.items() if value is not None}
    problem = _problem(temperature, throttled or 0)
    return SourceHealth(stamp, WARNING if problem else OK, problem or "well", present)


def clock_is_synchronized() -> bool | None:
    """Return whether the clock is synchronised; None if unknown."""
    try:
        libc = ctypes.CDLL(None, use_errno=True)
        state = libc.adjtimex(ctypes.create_string_buffer(_TIMEX_BYTES))
    except (OSError, AttributeError):
        return None
    if state < 0:
        return (_TIMESYNC / "synchronized").exists() if _TIMESYNC.is_dir() else None
    return bool(state != _TIME_ERROR)


def _problem(temperature: float | None, throttled: int) -> str:
    if throttled & _LOW_VOLTAGE:
        return "the power supply is too weak: use one made for this board"
    if throttled & _SLOWED:
        return "the board is throttled because it is too hot: improve its cooling"
    if temperature is not None and temperature >= _HOT:
        return f"the machine is {temperature:.0f} degrees hot: improve its cooling"
    return ""


def _temperature(sys: Path) -> float | None:
    """Return the highest temperature in degrees Celsius."""
    found = [value / 1000.0 for path in sys.glob(_ZONES) if (value := _number(path, 10))]
    return max(found, default=None)


def _throttled(sys: Path) -> int | None:
    return _number(sys / _THROTTLED, 16)


def _number(path: Path, base: int) -> int | None:
    with suppress(OSError, ValueError):
        return int(path.read_text(encoding="ascii"), base)
    return None


def _free_bytes(folder: Path) -> int | None:
    with suppress(OSError):
        return disk_of(folder).free
    return None


def memory(field: str) -> int | None:
    """Return a size in the status of this process, in bytes; `RssAnon` is its private memory.

    The peak `VmHWM` is its own; that of `getrusage` would include the parent process.
    """
    with suppress(OSError, ValueError, StopIteration):
        lines = _STATUS.read_text(encoding="ascii", errors="replace").splitlines()
        line = next(line for line in lines if line.startswith(f"{field}:"))
        return int(line.split()[1]) * 1024
    return None


_SEND_SECONDS = 5.0  # timeout of a message to systemd
_SILENT_SECONDS = 3.0


class ServiceManager:
    """Reports a recorder's state to systemd, if started by it; the protocol is `sd_notify(3)`.

    A watchdog message is sent once every microphone has given frames or a health report: also while
    a microphone is missing or the disk refuses the log, but not while a microphone hangs.
    """

    def __init__(self, microphones: Iterable[str]) -> None:
        self._is_there = _address() is not None
        self._feed_seconds = _watchdog_seconds() / 4 or math.inf
        self._health = dict.fromkeys(microphones, "starting")
        self._last_sound: dict[str, float] = {}  # when, by CLOCK_MONOTONIC
        self._awaited = set(self._health)  # no event since the last watchdog message
        self._fed = 0.0
        self._is_ready = False
        self._status = ""

    def add(self, microphone: str, event: Event) -> None:
        """Send systemd the changes after a recorded event."""
        if not self._is_there:
            return
        now = time.monotonic()
        if isinstance(event, Frames):
            self._last_sound[microphone] = now
        if isinstance(event, SourceHealth):
            self._health[microphone] = self._describe(microphone, event, now)
        self._awaited.discard(microphone)
        lines = []
        if not self._is_ready:
            self._is_ready = True
            lines.append("READY=1")
        if not self._awaited and now - self._fed >= self._feed_seconds:
            self._fed = now
            self._awaited = set(self._health)
            lines.append("WATCHDOG=1")
        status = "; ".join(f"{name}: {health}" for name, health in self._health.items())
        if status != self._status:
            self._status = status
            lines.append(f"STATUS={status}")
        notify(lines)

    def stop(self, *, restarts: bool) -> None:
        """Report that the recorder completes its log and ends."""
        now = time.monotonic_ns() // 1000
        state = [f"RELOADING=1\nMONOTONIC_USEC={now}"] if restarts else ["STOPPING=1"]
        notify([*state, "STATUS=completing the log"])

    def _describe(self, microphone: str, health: SourceHealth, now: float) -> str:
        summary = " ".join(health.summary.split())
        silent = now - self._last_sound.get(microphone, now)
        if health.level == OK or silent < _SILENT_SECONDS:
            return summary
        last = datetime.fromtimestamp(time.time() - silent).astimezone()
        return f"{summary}; last heard {last:%Y-%m-%d %H:%M}"


def notify(lines: Sequence[str]) -> None:
    """Send lines of `sd_notify(3)`, such as `READY=1`, to systemd, if it started this process."""
    address = _address()
    if address is None or not lines:
        return
    with (
        suppress(OSError),  # the next message makes up for it
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as connection,
    ):
        connection.settimeout(_SEND_SECONDS)
        connection.sendto("\n".join(lines).encode(), address)


def _address() -> str | None:
    """Return the address of systemd's socket; None if systemd has not started this process."""
    path = os.environ.get("NOTIFY_SOCKET", "")
    if path.startswith("@"):
        return f"\0{path[1:]}"
    return path or None


def _watchdog_seconds() -> float:
    """Return systemd's watchdog timeout of this process; 0 for none."""
    microseconds = os.environ.get("WATCHDOG_USEC", "")
    process = os.environ.get("WATCHDOG_PID", str(os.getpid()))
    is_watched = microseconds.isdecimal() and process == str(os.getpid())
    return int(microseconds) / 1e6 if is_watched else 0.0


_AGAIN_SECONDS = 600.0
_takers: list[Callable[[str], None]] = []


@contextmanager
def lines_to(take: Callable[[str], None]) -> Iterator[None]:
    """Redirect the recorder's lines to a callable for the duration of the block."""
    _takers.append(take)
    try:
        yield
    finally:
        _takers.remove(take)


def announce(text: str) -> None:
    """Print a line on standard error."""
    if _takers:
        _takers[-1](f"hearthlog: {text}")
        return
    with suppress(OSError):  # the log has it too
        sys.stderr.write(f"hearthlog: {text}\n")
        sys.stderr.flush()


def writes_to_journal() -> bool:
    """Return whether standard error is the systemd journal (JOURNAL_STREAM is DEVICE:INODE)."""
    with suppress(OSError):
        status = os.fstat(2)
        return os.environ.get("JOURNAL_STREAM") == f"{status.st_dev}:{status.st_ino}"
    return False


class HealthJournal:
    """Prints faults of microphones, repeated from time to time, and their end."""

    def __init__(self) -> None:
        self._trouble: dict[str, str] = {}
        self._reported_at: dict[str, float] = {}

    def add(self, microphone: str, health: SourceHealth) -> None:
        """Print the state of a microphone, if it changed or is due again."""
        before = self._trouble.get(microphone, "")
        trouble = self._trouble[microphone] = health.summary if health.level != OK else ""
        now = time.monotonic()
        is_old = now - self._reported_at.get(microphone, 0.0) >= _AGAIN_SECONDS
        if trouble != before or (trouble and is_old):
            self._reported_at[microphone] = now
            announce(f"{microphone}: {health.summary}")


_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8  # of malloc.h
_MMAP_BYTES = 32 << 20  # glibc's own maximum for its dynamic threshold


def keep_one_heap() -> None:
    """Make all threads share one heap, if the C library can: others never return memory."""
    with suppress(OSError, AttributeError):  # not every C library has it
        ctypes.CDLL(None).mallopt(_ARENA_MAX, 1)


@cache
def keep_freed_blocks() -> None:
    """Reuse freed arrays instead of returning their memory to the system.

    glibc then keeps up to 64 MB of free memory at the top of the heap. Otherwise a tenth of the
    time of relabelling goes into allocating it again, and half of it under a Dask nanny that has
    set less.
    """
    with suppress(OSError, AttributeError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(_MMAP_THRESHOLD, _MMAP_BYTES)
        mallopt(_TRIM_THRESHOLD, 2 * _MMAP_BYTES)


def give_back() -> None:
    """Collect reference cycles, and return free memory to the system, if the C library can."""
    gc.collect()
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


def module_command(module: str) -> list[str]:
    """Return the command that runs a module without the current folder on its path."""
    return [sys.executable, "-P", "-m", module]
