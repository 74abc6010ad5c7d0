"""What the bridge says of its troubles: each once an hour, for it runs for years."""

import time
from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from threading import Lock

_AGAIN_SECONDS = 3600.0
_MOST = 100  # texts that are remembered


class Saying:
    """Passes lines on, from any thread; the same one again an hour later at the earliest."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._said: OrderedDict[str, float] = OrderedDict()
        self._lock = Lock()

    def __call__(self, text: object) -> None:
        """Say something, unless it was said of late."""
        line, now = str(text), time.monotonic()
        with self._lock:
            if now - self._said.get(line, -_AGAIN_SECONDS) < _AGAIN_SECONDS:
                return
            self._said[line] = now
            self._said.move_to_end(line)
            if len(self._said) > _MOST:
                self._said.popitem(last=False)
        with suppress(OSError, ValueError):  # a full disk, or nobody who reads it
            self._say(line)
