"""The pages of the pictures: the page of the home, served at a time, and a report."""

import http.client
import json
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import date, tzinfo
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event as Flag
from threading import Thread
from unittest.mock import patch

from hearthlog.analyzer.bridge import home_state
from hearthlog.analyzer.bridge.bridge import Bridge
from hearthlog.analyzer.bridge.page.home_page import HomePage
from hearthlog.analyzer.bridge.settings import PageSettings, RecorderAddress
from hearthlog.analyzer.http import free_port
from hearthlog.analyzer.logs.home_logs import find_home_logs
from hearthlog.analyzer.logs.local_time import today
from hearthlog.analyzer.report.report import Period, make_report
from hearthlog.schemas.errors import HearthlogError
from hearthlog.schemas.frames import NANOSECONDS

_WAIT_SECONDS = 60.0
_HISTORY = 36 * 3600 * NANOSECONDS


class ServedPage:
    """The page of a home as a browser gets it."""

    def __init__(self, page: HomePage, address: str) -> None:
        self._page = page
        self.address = address

    def parts(self, language: str) -> dict[str, bytes]:
        """Wait for all parts of the page in a language, and return them by name."""
        board = self._page.view(language).board
        deadline = time.monotonic() + _WAIT_SECONDS
        while time.monotonic() < deadline:
            is_settled = self._page.is_settled
            found = {name: part.content for name, part in board.wait({}, 1.0).items()}
            if is_settled and {"now", "day", "events", "health"} <= found.keys():
                return found
            time.sleep(0.05)
        raise HearthlogError("the page of the home gets no news")

    def get(self, path: str, language: str) -> bytes:
        """Return what a browser gets for a path."""
        host, _, token = self.address.removeprefix("http://").partition("/?token=")
        connection = http.client.HTTPConnection(host, timeout=_WAIT_SECONDS)
        try:
            connection.request("GET", f"/?token={token}")
            answer = connection.getresponse()
            answer.read()
            cookie = answer.headers["Set-Cookie"].partition(";")[0]
            fields = {"Cookie": cookie, "Accept-Language": language}
            connection.close()
            connection.request("GET", path, headers=fields)
            answer = connection.getresponse()
            if answer.status != http.client.OK:
                raise HearthlogError(f"the page answers {path} with {answer.status}")
            return answer.read()
        finally:
            connection.close()


@contextmanager
def served_page(logs: Path, zone: tzinfo, now: int) -> Iterator[ServedPage]:
    """Serve the page of a home as it is at a time, in nanoseconds of UTC."""
    home = RecorderAddress(logs, "home", zone, frozenset())
    with (
        TemporaryDirectory() as folder,
        patch("time.time_ns", lambda: now),
        patch.object(home_state, "_AWAY_SECONDS", math.inf),  # its recorder still writes
    ):
        state, stop = Path(folder, "state"), Flag()
        state.mkdir(mode=0o700)
        said: list[str] = []
        page = HomePage(PageSettings(port=free_port()), home, state, said.append)
        moment = today(now, zone)
        bridge = Bridge(home, moment.midnight - _HISTORY, {"page": page}, said.append)
        thread = Thread(target=bridge.run, args=(stop,))
        thread.start()
        try:
            address = (state / "page-address").read_text("utf-8").strip()
            yield ServedPage(page, address)
        finally:
            stop.set()
            thread.join()


def write_report(logs: Path, zone: tzinfo, day: date, page: Path) -> None:
    """Write the report of a day."""
    make_report(find_home_logs([logs]), Period(day, 1, zone), page)


def as_json(content: bytes) -> str:
    """Return JSON in one order, without the blanks."""
    return json.dumps(json.loads(content), sort_keys=True, separators=(",", ":"))
