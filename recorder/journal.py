"""Lines on standard error, which a service manager keeps in its journal."""

import sys
import time
from contextlib import suppress

from hearthlog.recorder.events import OK, SourceHealth

_AGAIN_SECONDS = 600.0


def say(text: str) -> None:
    """Print a line on standard error.

    Parameters
    ----------
    text : str
    """
    with suppress(OSError):  # the log says it too
        sys.stderr.write(f"hearthlog: {text}\n")
        sys.stderr.flush()


class HealthJournal:
    """Says what is wrong with a microphone, from time to time again, and when nothing is."""

    def __init__(self) -> None:
        self._trouble: dict[str, str] = {}
        self._said_at: dict[str, float] = {}

    def add(self, microphone: str, health: SourceHealth) -> None:
        """Say the state of a microphone, if that is news.

        Parameters
        ----------
        microphone : str
            Its name.
        health : SourceHealth
        """
        before = self._trouble.get(microphone, "")
        trouble = self._trouble[microphone] = health.summary if health.level != OK else ""
        now = time.monotonic()
        is_old = now - self._said_at.get(microphone, 0.0) >= _AGAIN_SECONDS
        if trouble != before or (trouble and is_old):
            self._said_at[microphone] = now
            say(f"{microphone}: {health.summary}")
