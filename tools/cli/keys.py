"""Keys that are pressed in a terminal, one by one; where there is none, lines of input."""

import sys
import termios
import threading
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from queue import SimpleQueue


@contextmanager
def read_keys(keys: "SimpleQueue[str]") -> Iterator[None]:
    """Put keys into a queue as they are pressed; the end of the input, after some, is `q`."""
    if not sys.stdin.isatty():
        threading.Thread(target=_read_lines, args=[keys], daemon=True).start()
        yield
        return
    before = termios.tcgetattr(sys.stdin)
    tty.setcbreak(sys.stdin)
    try:
        threading.Thread(target=_read_terminal, args=[keys], daemon=True).start()
        yield
    finally:
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)


def _read_terminal(keys: "SimpleQueue[str]") -> None:
    while key := sys.stdin.read(1):
        keys.put("q" if key == "\x04" else key)


def _read_lines(keys: "SimpleQueue[str]") -> None:
    pressed = False
    for line in sys.stdin:
        for key in line.strip():
            pressed = True
            keys.put(key)
    if pressed:
        keys.put("q")
