"""Keys that are pressed in a terminal, one by one; where there is none, lines of input."""

import os
import stat
import sys
import termios
import threading
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from queue import SimpleQueue


@contextmanager
def read_keys(keys: "SimpleQueue[str]") -> Iterator[threading.Event]:
    """Put keys into a queue as they are pressed; the end of the input is `q`, and sets the event.

    Not that of /dev/null: what is started from a desktop has no other input, and has a window.
    """
    ended = threading.Event()
    if not sys.stdin.isatty():
        threading.Thread(target=_read_lines, args=[keys, ended], daemon=True).start()
        yield ended
        return
    before = termios.tcgetattr(sys.stdin)
    tty.setcbreak(sys.stdin)
    try:
        threading.Thread(target=_read_terminal, args=[keys], daemon=True).start()
        yield ended
    finally:
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)


def _read_terminal(keys: "SimpleQueue[str]") -> None:
    while key := sys.stdin.read(1):
        keys.put("q" if key == "\x04" else key)


def _read_lines(keys: "SimpleQueue[str]", ended: threading.Event) -> None:
    for line in sys.stdin:
        for key in line.strip():
            keys.put(key)
    if not stat.S_ISCHR(os.fstat(sys.stdin.fileno()).st_mode):
        keys.put("q")
        ended.set()
