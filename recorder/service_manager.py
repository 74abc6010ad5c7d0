"""What systemd is told of a recorder: that it records, how its microphones are, that it lives."""

import math
import os
import socket
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from datetime import datetime

from hearthlog.recorder.events import OK, Event, Frames, SourceHealth

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
