"""The bridge: follows the log of a recorder, and tells everybody who is to know."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from threading import Event as Flag

from hearthlog.analyzer.bridge.day import today
from hearthlog.analyzer.bridge.event_record import Event
from hearthlog.analyzer.bridge.follow_home import follow_home
from hearthlog.analyzer.bridge.home import Home
from hearthlog.analyzer.bridge.home_state import HomeState
from hearthlog.analyzer.bridge.output import RECENT, News, Output
from hearthlog.recorder.memory import give_back, keep_one_heap
from hearthlog.recorder.service_manager import notify
from hearthlog.schemas.times import NANOSECONDS

_WATCHDOG_SECONDS = 10.0
_MOST_EARLY = 1000  # events before all is read, of which only the recent ones are told of
_FORGOTTEN = 24 * 3600 * NANOSECONDS  # before the last midnight and evening


@dataclass
class Bridge:
    """Follows one recorder.

    Attributes
    ----------
    home : Home
    since : int
        From when on events are to be known, in nanoseconds of UTC.
    outputs : dict of str to Output
        By what they are called where one of them fails.
    say : callable
        Told what is wrong, in a line.
    """

    home: Home
    since: int
    outputs: dict[str, Output]
    say: Callable[[str], None]
    _watchdog_due: float = 0.0

    def run(self, stop: Flag) -> None:
        """Tell what is heard until `stop` is set."""
        keep_one_heap()
        notify(["READY=1"])
        has_caught_up = False
        early: list[Event] = []
        try:
            followed = follow_home(
                self.home.folder, self.home.node, self.since, stop, self._damaged
            )
            for state, begun in followed:
                self._live()
                if state.caught_up:
                    if not has_caught_up:
                        has_caught_up = True
                        give_back()  # what it took to read the log
                    self._tell(state, [*early, *begun])
                    early = []
                else:
                    early = [*early, *begun][-_MOST_EARLY:]
        finally:
            notify(["STOPPING=1"])
            for output in self.outputs.values():
                output.close()

    def _live(self) -> None:
        """Tell systemd that the log is followed."""
        if time.monotonic() >= self._watchdog_due:
            self._watchdog_due = time.monotonic() + _WATCHDOG_SECONDS
            notify(["WATCHDOG=1"])

    def _tell(self, state: HomeState, begun: Sequence[Event]) -> None:
        now = time.time_ns()
        moment = today(now, self.home.zone)
        ended = [event for each in state.microphones.values() for event in each.ended_events()]
        for microphone in state.microphones.values():
            microphone.forget_before(min(moment.midnight, moment.night) - _FORGOTTEN)
        recent = [event for event in begun if now - event.end <= RECENT]
        news = News(state, recent, ended, moment, self.home.zone)
        for name, output in self.outputs.items():
            try:
                output.update(news)
            except Exception as error:  # noqa: BLE001  one that fails must not stop the others
                self.say(f"{name}: {type(error).__name__}: {error}")

    def _damaged(self, error: Exception) -> None:
        self.say(str(error))
