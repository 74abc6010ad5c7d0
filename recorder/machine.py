"""The machine of the recorder: its clock, temperature and power supply, as Linux tells them."""

import ctypes
import math
import time
from contextlib import suppress
from pathlib import Path

from hearthlog.recorder.disk.retention import disk_of
from hearthlog.recorder.events import OK, WARNING, SourceHealth

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
