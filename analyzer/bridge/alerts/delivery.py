"""Tell targets of rings, each in a thread of its own, again and again with growing pauses."""

import time
from collections.abc import Callable, Sequence
from datetime import tzinfo
from threading import Event as Flag
from threading import Thread

from hearthlog.analyzer.bridge.alerts.outbox import Outbox
from hearthlog.analyzer.bridge.alerts.ring import Ring
from hearthlog.analyzer.bridge.alerts.targets import Target
from hearthlog.analyzer.logs.local_time import local_time
from hearthlog.schemas.frames import NANOSECONDS

_LOOK_SECONDS = 0.5
_CLOSE_SECONDS = 2.0
_LATE = 5 * 60 * NANOSECONDS


class Delivery:
    """Tells each target of the rings that wait for it; none of them waits for another.

    Parameters
    ----------
    first_pause, longest_pause : float, optional
        Seconds after the first failure, and at most; each pause is twice the one before.
    """

    def __init__(  # noqa: PLR0913
        self,
        outbox: Outbox,
        targets: Sequence[Target],
        node: str,
        zone: tzinfo,
        say: Callable[[str], None],
        *,
        first_pause: float = 5.0,
        longest_pause: float = 900.0,
    ) -> None:
        self._outbox = outbox
        self._node = node
        self._zone = zone
        self._say = say
        self._pauses = first_pause, longest_pause
        self._threads: dict[str, tuple[Thread, Flag]] = {}  # by name of the target
        self.set_targets(targets)

    def set_targets(self, targets: Sequence[Target]) -> None:
        """Tell these from now on; who was told before goes on as he was."""
        names = {target.name for target in targets}
        for name in self._threads.keys() - names:
            self._threads.pop(name)[1].set()
        for target in targets:
            if target.name not in self._threads:
                stop = Flag()
                thread = Thread(
                    target=self._run, args=(target, stop), daemon=True, name="alerts, to a target"
                )
                self._threads[target.name] = thread, stop
                thread.start()

    def close(self) -> None:
        """End within seconds, whatever a target does; the rest waits for the next start."""
        until = time.monotonic() + _CLOSE_SECONDS
        for _, stop in self._threads.values():
            stop.set()
        for thread, _ in self._threads.values():
            thread.join(max(until - time.monotonic(), 0.0))

    def _run(self, target: Target, stop: Flag) -> None:
        first, longest = self._pauses
        pause = first
        while not stop.wait(_LOOK_SECONDS):
            told, failed = self._tell(target, stop)
            if told:
                pause = first
            if failed:
                stop.wait(pause)
                pause = min(2 * pause, longest)

    def _tell(self, target: Target, stop: Flag) -> tuple[int, bool]:
        """Tell a target of all that waits for it; return of how much, and whether it failed."""
        told = 0
        for ring in self._outbox.waiting_for(target.name, time.time_ns()):
            if stop.is_set():
                break
            try:
                reason = target.deliver(f"{self._node}: {ring.rule}", message(ring, self._zone))
            except Exception as error:  # noqa: BLE001  hundreds of services, each with its own
                reason = type(error).__name__
            if reason:
                self._say(
                    f"{target.place}: an alert could not be told ({reason}); it is kept, and tried "
                    "again, a quarter of an hour apart at most"
                )
                return told, True
            self._outbox.note_told(target.name, ring)
            told += 1
        return told, False


def message(ring: Ring, zone: tzinfo, now: int | None = None) -> str:
    """Write what is told of a ring: when it rang, what was the case, and whether that was long ago.

    Parameters
    ----------
    now : int, optional
        In nanoseconds of UTC; by default it is now.
    """
    late = (time.time_ns() if now is None else now) - ring.due > _LATE
    moment = f"{local_time(ring.time, zone):%Y-%m-%d %H:%M}"
    return f"{moment}: {ring.text}{' (told late)' if late else ''}"
