"""Tries whether a device is there again, while another one is heard in its place."""

from collections.abc import Callable
from threading import Event as Flag
from threading import Lock, Thread

from hearthlog.recorder.errors import SourceError
from hearthlog.recorder.sources.process import Capture
from hearthlog.recorder.sources.sound_cards import cards_change

_RETRY_SECONDS = 10.0


class ReturnWatch:
    """Opens a device as soon as it is there, in a thread: that may take as long as it likes."""

    def __init__(self, open_device: Callable[[Flag], Capture]) -> None:
        self._open = open_device
        self._stop = Flag()
        self._lock = Lock()
        self._capture: Capture | None = None
        Thread(target=self._run, name="return of a microphone", daemon=True).start()

    @property
    def is_there(self) -> bool:
        """Whether there is a capture to take."""
        return self._capture is not None

    def take(self) -> Capture | None:
        """Return the capture once there is one, and have no more to do with it."""
        with self._lock:
            capture, self._capture = self._capture, None
        return capture

    def close(self) -> None:
        """Give up, and end what was opened and not taken."""
        with self._lock:
            self._stop.set()
            if self._capture is not None:
                self._capture.kill()

    def _run(self) -> None:
        while not self._stop.is_set():
            cards_change(self._stop, _RETRY_SECONDS)
            try:
                capture = self._open(self._stop)
            except SourceError:
                continue
            with self._lock:
                if self._stop.is_set():
                    capture.kill()
                self._capture = capture
            return
