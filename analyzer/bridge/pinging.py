"""Signs of life to a watchdog on the network, again and again."""

import time
from collections.abc import Callable
from threading import Event as Flag
from threading import Thread

from hearthlog.analyzer.bridge.output import News
from hearthlog.analyzer.bridge.secret_files import secret_path
from hearthlog.analyzer.bridge.settings import PingSettings
from hearthlog.analyzer.ping import ping, read_ping_address

_ERROR = 2  # level of diagnostics
_SOON = 10.0  # seconds after the start
_JUDGED_SECONDS = 60.0  # after which what was known of the recorder counts no more


class Pinging:
    """Asks for an address again and again, and for `/fail` below it while something is wrong.

    All is well while the recorder writes and says of nothing that it fails. A bridge that hangs
    pings no more.

    Raise `HearthlogError` if the file of the address cannot be used.
    """

    def __init__(self, settings: PingSettings, say: Callable[[str], None]) -> None:
        self._settings = settings
        self._url = settings.url
        if settings.url_file is not None:
            self._url = read_ping_address(secret_path(settings.url_file))
        self._say = say
        self._is_well = False
        self._judged = 0.0  # when, by CLOCK_MONOTONIC
        self._stop = Flag()
        Thread(target=self._ping, daemon=True).start()

    def update(self, news: News) -> None:
        """Note whether all is well."""
        fails = any(health.level >= _ERROR for health in news.state.health.values())
        self._is_well = news.state.is_recording() and not fails
        self._judged = time.monotonic()

    def close(self) -> None:
        """Ping no more."""
        self._stop.set()

    def _ping(self) -> None:
        pause = min(self._settings.every_seconds, _SOON)
        while not self._stop.wait(pause):
            pause = self._settings.every_seconds
            if time.monotonic() - self._judged <= _JUDGED_SECONDS:
                problem = ping(self._url, is_well=self._is_well)
                if problem:
                    self._say(f"ping: nobody there has taken it ({problem}); trying again")
