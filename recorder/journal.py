"""Lines on standard error, which a service manager keeps in its journal."""

import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from hearthlog.recorder.events import OK, SourceHealth

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
