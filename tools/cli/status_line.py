"""Live status line of a recorder on a terminal."""

import os
import sys
import termios
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime, tzinfo
from threading import Event as Flag
from threading import Thread
from typing import TYPE_CHECKING

import numpy as np
from rich.cells import cell_len, set_cell_size

from hearthlog.models.classes import in_words
from hearthlog.recorder.host import lines_to
from hearthlog.recorder.pause_schedule import time_zone
from hearthlog.schemas.errors import printable
from hearthlog.schemas.frames import FRAME_SECONDS

if TYPE_CHECKING:
    from hearthlog.recorder.config import Settings
    from hearthlog.recorder.recording_session import RecorderState


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
