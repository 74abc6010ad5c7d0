"""Levels of microphones on a terminal, from which one is chosen by clapping."""

import os
import re
import select
import sys
import termios
import time
import tty
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Event, Thread
from typing import TYPE_CHECKING

import numpy as np

from hearthlog.recorder.errors import DeviceError, SourceError
from hearthlog.recorder.sources.process import open_device
from hearthlog.schemas.errors import printable, shortened
from hearthlog.tools.cli.terminal import long_bar

if TYPE_CHECKING:
    from rich.table import Table

    from hearthlog.recorder.sources.capture import Device

_CARDS = Path("/proc/asound")
_LATENCY = 0.1  # seconds: the bar follows a clap at once
_FIRST_SECONDS = 5.0  # until a device must have delivered something
_CLOSE_SECONDS = 5.0
_POLL_SECONDS = 0.1
_MOST = 8  # devices with a bar: ALSA's lists are long, and each takes a process
_QUIETEST, _LOUDEST = -70.0, 0.0  # dB of full scale at the ends of a bar
_BAR, _NAME = 24, 40  # columns


def show_level(device: str) -> None:
    """Wait for the first sound of a device.

    Raise `SourceError` if it cannot be opened or delivers nothing.
    """
    capture = open_device(device, latency=_LATENCY)
    try:
        end = time.monotonic() + _FIRST_SECONDS
        while time.monotonic() < end:
            blocks = capture.blocks(_POLL_SECONDS)
            if blocks is None:
                break
            if blocks:
                return
    finally:
        capture.kill()
    raise DeviceError(
        f"microphone {device!r} delivers no sound: connect it again, or choose another one"
    )


def users_of_microphones(cards: Path = _CARDS) -> list[str]:
    """Describe the sound cards that programs record from: PortAudio does not list these."""
    users = []
    for status in sorted(cards.glob("card*/pcm*c/sub*/status")):
        with suppress(OSError):
            owner = re.search(r"owner_pid *: *(\d+)", status.read_text("utf-8"))
            if owner is None:
                continue
            card = (status.parents[2] / "id").read_text("utf-8").strip()
            program = Path("/proc", owner[1], "comm").read_text("utf-8").strip()
            users.append(f"the card {card} is used by {program} (process {owner[1]})")
    return users


class _Meter:
    """The level of one device, heard in a thread."""

    def __init__(self, device: "Device", stop: Event) -> None:
        self.device = device
        self.peak = -np.inf  # dB of full scale, of the last block
        self.state = "opening"
        self._stop = stop
        self._thread = Thread(target=self._run, name="level", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            capture = open_device(self.device.identity, exact=True, latency=_LATENCY)
        except SourceError:
            self.state = "in use"  # by another program, or by the device of another line
            return
        self.state = ""
        try:
            while not self._stop.is_set():
                blocks = capture.blocks(_POLL_SECONDS)
                if blocks is None:
                    self.state = "lost"
                    return
                for block in blocks:
                    peak = np.abs(block.samples.astype(np.float32)).max(initial=0.0)
                    self.peak = 20 * np.log10(max(peak, 0.5) / 32_768)
        finally:
            capture.kill()

    def join(self) -> None:
        """Wait until the device is closed, but not for one that does not answer."""
        self._thread.join(_CLOSE_SECONDS)

    def text(self) -> str:
        """Return the bar, or why there is none."""
        if self.state or not np.isfinite(self.peak):
            return self.state
        share = (self.peak - _QUIETEST) / (_LOUDEST - _QUIETEST)
        return f"{long_bar(share, _BAR):<{_BAR}} {self.peak:4.0f} dB"


def choose_by_level(devices: "Sequence[Device]", default: Sequence[int]) -> list[int]:
    """Show the devices with their levels, until some are chosen; return their places.

    Raise `KeyboardInterrupt` or `EOFError` if nothing shall be chosen.
    """
    from rich.console import Console, Group
    from rich.live import Live

    stop, typed, note = Event(), "", ""
    meters = [_Meter(device, stop) for device in devices[:_MOST]]
    shown = ", ".join(str(place + 1) for place in default)
    console = Console(stderr=True, highlight=False, markup=False, emoji=False)
    print("The microphones: clap, and see which bar moves.", file=sys.stderr)
    try:
        with _keys() as keys, Live(console=console, auto_refresh=False) as live:
            while True:
                question = f"Number, or several with commas [{shown}]: {typed}"
                live.update(Group(_table(devices, meters), note, question), refresh=True)
                key = next(keys)
                if key in {"\r", "\n"}:
                    chosen = [int(each) - 1 for each in re.findall(r"\d+", typed)] or list(default)
                    if all(0 <= place < len(devices) for place in chosen):
                        return list(dict.fromkeys(chosen))
                    typed, note = "", f"there are numbers from 1 to {len(devices)}"
                elif key in {"\x7f", "\b"}:
                    typed = typed[:-1]
                elif key == "\x04":
                    raise EOFError
                elif key and key in "0123456789, ":
                    typed += key
    finally:
        stop.set()
        for meter in meters:
            meter.join()


def _table(devices: "Sequence[Device]", meters: list[_Meter]) -> "Table":
    from rich.table import Table

    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column(justify="right")
    for place, device in enumerate(devices):
        text = meters[place].text() if place < len(meters) else "is not shown"
        default = " (default)" if device.is_default else ""
        name = shortened(printable(device.name), _NAME)
        table.add_row(str(place + 1), f"{name}{default}", text)
    return table


@contextmanager
def _keys() -> Iterator[Iterator[str]]:
    """Yield pressed keys, and an empty text where none is pressed for a moment."""
    descriptor = sys.stdin.fileno()
    before = termios.tcgetattr(descriptor)

    def read() -> Iterator[str]:
        while True:
            if not select.select([descriptor], [], [], _POLL_SECONDS)[0]:
                yield ""
                continue
            if not (key := os.read(descriptor, 1)):  # one: the rest answers the next question
                raise EOFError
            yield key.decode("ascii", errors="replace")

    tty.setcbreak(descriptor)
    try:
        yield read()
    finally:
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)
