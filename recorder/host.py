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
_SECONDS = 9.5  # the health of a microphone comes every ten
_HOT = 80.0  # degrees Celsius, from which on small boards slow down
_LOW_VOLTAGE, _SLOWED = 1 << 0, (1 << 1) | (1 << 2) | (1 << 3)
_TIME_ERROR = 5  # the state of a clock that nobody sets
_TIMEX_BYTES = 512  # more than any kernel writes
_STATUS = Path("/proc/self/status")
_TIMESYNC = Path("/run/systemd/timesync")  # for a service, which may not ask the kernel


class Disk(NamedTuple):
    """How large a disk is, and how much of it is free, in bytes."""

    size: int
    free: int


def disk_of(folder: Path) -> Disk:
    """Measure the disk of a folder, or of the one that it will be made in.

    Raise `OSError` if it cannot be.
    """
    there = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    usage = shutil.disk_usage(there)
    return Disk(usage.total, usage.free)


class MachineWatch:
    """Looks at the machine every ten seconds."""

    def __init__(self, folder: Path, sys: Path = _SYS) -> None:
        self._folder = folder
        self._sys = sys
        self._looked = -math.inf

    def tick(self, stamp: int) -> SourceHealth | None:
        """Look if it is time; return what was seen then."""
        now = time.monotonic()
        if now - self._looked < _SECONDS:
            return None
        self._looked = now
        return machine_health(stamp, self._folder, self._sys)


def machine_health(stamp: int, folder: Path, sys: Path = _SYS) -> SourceHealth:
    """Look at the machine."""
    temperature, throttled = _temperature(sys), _throttled(sys)
    is_set = clock_is_synchronized()
    values = {
        "clock_synchronized": None if is_set is None else ("yes" if is_set else "no"),
        "temperature_celsius": None if temperature is None else f"{temperature:.1f}",
        "throttled": None if throttled is None else hex(throttled),
        "disk_free_bytes": _free_bytes(folder),
        "memory_bytes": _memory(),
    }
    known = {name: str(value) for name, value in values.items() if value is not None}
    problem = _problem(temperature, throttled or 0)
    return SourceHealth(stamp, WARNING if problem else OK, problem or "well", known)


def clock_is_synchronized() -> bool | None:
    """Tell whether something keeps the clock right; None if the machine does not say."""
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
        return "the power supply is too weak: take one that is made for this board"
    if throttled & _SLOWED:
        return "the board is slowed down, for it is too hot: give it air"
    if temperature is not None and temperature >= _HOT:
        return f"the machine is {temperature:.0f} degrees hot: give it air"
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


def _memory() -> int | None:
    """Return how much memory this process has to itself, in bytes."""
    with suppress(OSError, ValueError, StopIteration):
        lines = _STATUS.read_text(encoding="ascii").splitlines()
        line = next(line for line in lines if line.startswith("RssAnon:"))
        return int(line.split()[1]) * 1024
    return None


_SEND_SECONDS = 5.0  # at most to wait for systemd
_SILENT_SECONDS = 3.0


class ServiceManager:
    """Tells systemd of a recorder, where it has started it; the protocol is `sd_notify(3)`.

    It is told that the recorder lives once every microphone has given frames or a report of its
    health: so also while one is gone or the disk refuses the log, but not when one of them hangs.
    """

    def __init__(self, microphones: Iterable[str]) -> None:
        self._is_there = _address() is not None
        self._feed_seconds = _watchdog_seconds() / 4 or math.inf
        self._health = dict.fromkeys(microphones, "starting")
        self._heard: dict[str, float] = {}  # when, by CLOCK_MONOTONIC
        self._awaited = set(self._health)  # before systemd is told that the recorder lives
        self._fed = 0.0
        self._is_ready = False
        self._status = ""

    def add(self, microphone: str, event: Event) -> None:
        """Tell what there is to tell, after an event was recorded."""
        if not self._is_there:
            return
        now = time.monotonic()
        if isinstance(event, Frames):
            self._heard[microphone] = now
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
        """Tell that the recorder completes its log and ends."""
        now = time.monotonic_ns() // 1000
        state = [f"RELOADING=1\nMONOTONIC_USEC={now}"] if restarts else ["STOPPING=1"]
        notify([*state, "STATUS=completing the log"])

    def _describe(self, microphone: str, health: SourceHealth, now: float) -> str:
        summary = " ".join(health.summary.split())
        silent = now - self._heard.get(microphone, now)
        if health.level == OK or silent < _SILENT_SECONDS:
            return summary
        last = datetime.fromtimestamp(time.time() - silent).astimezone()
        return f"{summary}; last heard {last:%Y-%m-%d %H:%M}"


def notify(lines: Sequence[str]) -> None:
    """Tell systemd something, if it has started this process.

    Parameters
    ----------
    lines : sequence of str
        Such as `READY=1`, as of `sd_notify(3)`.
    """
    address = _address()
    if address is None or not lines:
        return
    with (
        suppress(OSError),  # it is asked again, by what comes next
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as connection,
    ):
        connection.settimeout(_SEND_SECONDS)
        connection.sendto("\n".join(lines).encode(), address)


def _address() -> str | None:
    """Return the address of systemd's socket; None if it has not started this process."""
    path = os.environ.get("NOTIFY_SOCKET", "")
    if path.startswith("@"):
        return f"\0{path[1:]}"
    return path or None


def _watchdog_seconds() -> float:
    """Return after how long without a word systemd kills this process; 0 if it does not."""
    microseconds = os.environ.get("WATCHDOG_USEC", "")
    process = os.environ.get("WATCHDOG_PID", str(os.getpid()))
    is_asked = microseconds.isdecimal() and process == str(os.getpid())
    return int(microseconds) / 1e6 if is_asked else 0.0


_AGAIN_SECONDS = 600.0
_takers: list[Callable[[str], None]] = []


@contextmanager
def lines_to(take: Callable[[str], None]) -> Iterator[None]:
    """Give the lines of the recorder to somebody else while the block runs."""
    _takers.append(take)
    try:
        yield
    finally:
        _takers.remove(take)


def say(text: str) -> None:
    """Print a line on standard error."""
    if _takers:
        _takers[-1](f"hearthlog: {text}")
        return
    with suppress(OSError):  # the log says it too
        sys.stderr.write(f"hearthlog: {text}\n")
        sys.stderr.flush()


def writes_to_journal() -> bool:
    """Return whether standard error is the journal of systemd, which says so as DEVICE:INODE."""
    with suppress(OSError):
        status = os.fstat(2)
        return os.environ.get("JOURNAL_STREAM") == f"{status.st_dev}:{status.st_ino}"
    return False


class HealthJournal:
    """Says what is wrong with a microphone, from time to time again, and when nothing is."""

    def __init__(self) -> None:
        self._trouble: dict[str, str] = {}
        self._said_at: dict[str, float] = {}

    def add(self, microphone: str, health: SourceHealth) -> None:
        """Say the state of a microphone, if that is news."""
        before = self._trouble.get(microphone, "")
        trouble = self._trouble[microphone] = health.summary if health.level != OK else ""
        now = time.monotonic()
        is_old = now - self._said_at.get(microphone, 0.0) >= _AGAIN_SECONDS
        if trouble != before or (trouble and is_old):
            self._said_at[microphone] = now
            say(f"{microphone}: {health.summary}")


_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8  # of malloc.h
_MMAP_BYTES = 32 << 20  # up to which glibc raises it by itself, if nobody sets either


def keep_one_heap() -> None:
    """Let all threads use one heap, where the C library can: others are never given back."""
    with suppress(OSError, AttributeError):  # not every C library has it
        ctypes.CDLL(None).mallopt(_ARENA_MAX, 1)


@cache
def keep_freed_blocks() -> None:
    """Let freed arrays be used again, instead of giving them back to the system.

    Of what is free above the last block in use, glibc keeps 64 MB then. Otherwise a tenth of the
    time of relabelling goes into having it again, and half where a nanny of Dask has set less.
    """
    with suppress(OSError, AttributeError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(_MMAP_THRESHOLD, _MMAP_BYTES)
        mallopt(_TRIM_THRESHOLD, 2 * _MMAP_BYTES)


def give_back() -> None:
    """Free what only refers to itself, and give free memory back, where the C library can."""
    gc.collect()
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


def module_command(module: str) -> list[str]:
    """Return the command that runs a module, with the current folder not on its path."""
    return [sys.executable, "-P", "-m", module]
