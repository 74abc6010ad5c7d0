"""The bridge: follows the log of a recorder, and tells everybody who is to know."""

import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from threading import Event as Flag

from hearthlog.analyzer.bridge.day import today
from hearthlog.analyzer.bridge.event_record import Event
from hearthlog.analyzer.bridge.follow_home import follow_home
from hearthlog.analyzer.bridge.home import Home
from hearthlog.analyzer.bridge.home_state import HomeState
from hearthlog.analyzer.bridge.output import RECENT, News, Output
from hearthlog.recorder.host import give_back, keep_one_heap, notify
from hearthlog.schemas.frames import NANOSECONDS

_WATCHDOG_SECONDS = 10.0
_MOST_EARLY = 1000  # events before all is read, of which only the recent ones are told of
_AHEAD = 3600 * NANOSECONDS  # of now: so much later no event can begin
_FORGOTTEN = 24 * 3600 * NANOSECONDS  # before the last midnight and evening


@dataclass
class Bridge:
    """Follows one recorder.

    Attributes
    ----------
    since : int
        From when on events are to be known, in nanoseconds of UTC.
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
        early: deque[Event] = deque(maxlen=_MOST_EARLY)
        had_caught_up = False
        try:
            for state, begun in follow_home(self.home, self.since, stop, self._damaged):
                self._live()
                early += begun
                if state.caught_up:
                    self._tell(state, list(early), is_first=not had_caught_up)
                    early.clear()
                had_caught_up = state.caught_up
        finally:
            notify(["STOPPING=1"])
            for name, output in self.outputs.items():
                self._try(name, output.close)

    def _live(self) -> None:
        """Tell systemd that the log is followed."""
        if time.monotonic() >= self._watchdog_due:
            self._watchdog_due = time.monotonic() + _WATCHDOG_SECONDS
            notify(["WATCHDOG=1"])

    def _tell(self, state: HomeState, begun: Sequence[Event], *, is_first: bool) -> None:
        now = time.time_ns()
        moment = today(now, self.home.zone)
        ended = [event for each in state.every() for event in each.ended_events()]
        if is_first:
            give_back()  # what it took to read the log
            ended = [event for event in ended if now - event.end <= RECENT]
        recent = [event for event in begun if now - event.end <= RECENT]
        news = News(state, recent, ended, moment, self.home.zone)
        for name, output in self.outputs.items():
            self._try(name, partial(output.update, news))
        for microphone in state.every():
            microphone.forget(min(moment.midnight, moment.night) - _FORGOTTEN, now + _AHEAD)

    def _try(self, name: str, step: Callable[[], None]) -> None:
        try:
            step()
        except Exception as error:  # noqa: BLE001  one that fails must not stop the others
            self.say(f"{name}: {type(error).__name__}: {error}")

    def _damaged(self, error: Exception) -> None:
        self.say(str(error))
