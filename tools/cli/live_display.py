"""Live displays of a recorder on a terminal: its status line, and levels of its microphones."""

import os
import re
import select
import sys
import termios
import time
import tty
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime, tzinfo
from pathlib import Path
from threading import Event, Thread
from threading import Event as Flag
from typing import TYPE_CHECKING

import numpy as np
from rich.cells import cell_len, set_cell_size

from hearthlog.models.classes import in_words
from hearthlog.recorder.host import lines_to
from hearthlog.recorder.pause_schedule import time_zone
from hearthlog.recorder.sources.process import open_device
from hearthlog.schemas.errors import DeviceError, SourceError, printable, shortened
from hearthlog.schemas.frames import FRAME_SECONDS
from hearthlog.tools.cli.terminal import long_bar

if TYPE_CHECKING:
    from rich.table import Table

    from hearthlog.recorder.config import Settings
    from hearthlog.recorder.recording_session import RecorderState
    from hearthlog.recorder.sources.capture import Device


_SECONDS = 0.5  # between two updates
_LAST_FRAMES = 10  # half a second; probabilities are averaged over it
_LOWEST = -120.0  # dB of full scale
_CLOSING_SECONDS = 1.0  # wait for a blocked terminal
_WAITING = 200  # lines queued for a blocked terminal
_WIDTH = 80


@contextmanager
def living_line(state: "RecorderState", settings: "Settings") -> Iterator[None]:
    """Show a status line on standard error, a terminal, while the block runs.

    A thread writes, so that a blocked terminal (Ctrl-S) never delays the recorder, whose own lines
    take the same way.
    """
    lines: deque[str] = deque(maxlen=_WAITING)
    closed = Flag()
    zone = time_zone(settings.timezone)
    thread = Thread(target=_write, args=(state, lines, zone, closed), daemon=True)
    with lines_to(lines.append):
        thread.start()
        try:
            yield
        finally:
            closed.set()
            thread.join(_CLOSING_SECONDS)
            if thread.is_alive():
                _wake_terminal(thread)


def _wake_terminal(thread: Thread) -> None:
    """Resume a stopped terminal; give up if it stays blocked, or the process would not end."""
    with suppress(termios.error):
        termios.tcflow(sys.stderr.fileno(), termios.TCOON)
    thread.join(_CLOSING_SECONDS)
    if thread.is_alive():
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for stream in (sys.stderr, sys.stdout):
            if os.isatty(stream.fileno()):
                os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


def _write(state: "RecorderState", lines: deque[str], zone: tzinfo, closed: Flag) -> None:
    shown = 0  # columns of the shown line
    with suppress(OSError):  # the terminal is gone
        while True:
            ends = closed.wait(_SECONDS)
            text = ""
            while lines or state.news:
                line = lines.popleft() if lines else f"hearthlog: {state.news.popleft()}"
                text += f"\r{set_cell_size(printable(line), max(shown, cell_len(line)))}\n"
                shown = 0
            line = "" if ends else _cropped(line_of(state, datetime.now(zone)))
            text += f"\r{set_cell_size(line, max(shown, cell_len(line)))}\r"
            shown = cell_len(line)
            _put(text if ends else f"{text[:-1]}")
            if ends:
                return


def line_of(state: "RecorderState", now: datetime) -> str:
    """Return a line with sounds, confidence, level, and amount of kept audio."""
    names = [*state.sound, *(name for name in list(state.trouble) if name not in state.sound)]
    parts = [_microphone(state, name, named=len(names) > 1) for name in names] or ["starting"]
    if state.keeps:
        seconds = state.clip_frames * FRAME_SECONDS
        kept = f"{seconds:.0f} s" if seconds < 60 else f"{seconds // 60:.0f} min"
        parts.append(f"{kept} of clips")
    return printable("  ".join([f"{now:%H:%M}", *parts]))


def _microphone(state: "RecorderState", name: str, *, named: bool) -> str:
    start = [f"{name}:"] if named else []
    if trouble := state.trouble.get(name):
        return " ".join([*start, trouble])
    frames = state.sound.get(name)
    if frames is None:
        return " ".join([*start, "starting"])
    labels = state.labels.get(name)
    if labels is not None and len(labels.probabilities):
        probabilities = labels.probabilities[-_LAST_FRAMES:].mean(axis=0)
        most = int(probabilities.argmax())
        start.append(f"{in_words(labels.classes[most]).lower()} {probabilities[most]:.0%}")
    samples = frames.samples[-_LAST_FRAMES:]
    power = float(np.square(samples, dtype=np.float64).mean()) if samples.size else 0.0
    level = max(10.0 * np.log10(max(power, 1e-12)), _LOWEST)
    return "  ".join([" ".join(start), f"{level:.0f} dB"] if start else [f"{level:.0f} dB"])


def _cropped(line: str) -> str:
    try:
        width = os.get_terminal_size(sys.stderr.fileno()).columns or _WIDTH
    except OSError:
        width = _WIDTH
    return set_cell_size(line, width - 1) if cell_len(line) >= width else line


def _put(text: str) -> None:
    """Write past Python's buffer, whose lock a waiting thread would hold to the end."""
    data = text.encode(sys.stderr.encoding or "utf-8", "replace")
    while data:
        data = data[os.write(sys.stderr.fileno(), data) :]


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
