"""The newest of what a page shows, for any number of readers who come when they can."""

from collections.abc import Mapping
from threading import Condition
from time import monotonic
from typing import NamedTuple

_STALE_SECONDS = 15.0


class Part(NamedTuple):
    """A part of the page: how often it has changed, and its content as JSON."""

    number: int
    content: bytes


class Board:
    """Parts of a page, each the newest; a reader who is slow misses those between."""

    def __init__(self) -> None:
        self._parts: dict[str, Part] = {}
        self._changed = Condition()
        self._seen = monotonic()
        self.is_closed = False

    def put(self, name: str, content: bytes) -> None:
        """Replace a part, if it is another one than before."""
        with self._changed:
            part = self._parts.get(name)
            if part is None or part.content != content:
                self._parts[name] = Part(part.number + 1 if part else 1, content)
                self._changed.notify_all()

    def keep_fresh(self) -> None:
        """Note that the parts are right now."""
        self._seen = monotonic()

    def is_fresh(self) -> bool:
        """Tell whether the parts were right in the last fifteen seconds."""
        return monotonic() - self._seen <= _STALE_SECONDS

    def wait(self, known: Mapping[str, int], seconds: float) -> dict[str, Part]:
        """Wait for parts that a reader does not know.

        Parameters
        ----------
        seconds : float
            To wait, at most.

        Returns
        -------
        dict of str to Part
            Empty if there are none.
        """

        def newer() -> dict[str, Part]:
            return {
                name: part for name, part in self._parts.items() if part.number != known.get(name)
            }

        with self._changed:
            self._changed.wait_for(lambda: newer() or self.is_closed, seconds)
            return newer()

    def close(self) -> None:
        """Let no reader wait any more."""
        with self._changed:
            self.is_closed = True
            self._changed.notify_all()
