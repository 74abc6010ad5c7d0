"""The page of the home, made of what the bridge knows, once a second where something changed."""

import json
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hearthlog.analyzer.bridge.errors import BridgeError
from hearthlog.analyzer.bridge.event_record import Event
from hearthlog.analyzer.bridge.home import Home
from hearthlog.analyzer.bridge.output import News
from hearthlog.analyzer.bridge.page.admission import PageAdmission
from hearthlog.analyzer.bridge.page.board import Board
from hearthlog.analyzer.bridge.page.day_picture import BIN, day_picture
from hearthlog.analyzer.bridge.page.event_list import last_events
from hearthlog.analyzer.bridge.page.health_list import health_list
from hearthlog.analyzer.bridge.page.now_heard import NowHeard
from hearthlog.analyzer.bridge.page.page_token import cookie_key, keep_address, page_token
from hearthlog.analyzer.bridge.page.recurring import Recurring
from hearthlog.analyzer.bridge.page.recurring_list import Moment
from hearthlog.analyzer.bridge.page.said import Said
from hearthlog.analyzer.bridge.page.scenario_lines import scenario_lines
from hearthlog.analyzer.bridge.page.server import PageServer
from hearthlog.analyzer.bridge.page.words import clock, room
from hearthlog.analyzer.bridge.settings import PageSettings
from hearthlog.analyzer.ports import ip_of
from hearthlog.recorder.host import writes_to_journal
from hearthlog.schemas.errors import HearthlogError

_EVERY_SECONDS = 1.0


class HomePage:
    """Shows a home to browsers, and takes what people say that its sounds were.

    Raise `BridgeError` if the token cannot be read or made, or nothing can listen there.
    """

    def __init__(
        self, settings: PageSettings, home: Home, state: Path, say: Callable[[str], None]
    ) -> None:
        bind = ip_of(settings.bind)
        if bind is None:
            raise BridgeError(
                f"bind = {settings.bind!r} in [bridge.page] is no address: write one of this "
                "machine in digits, such as 127.0.0.1"
            )
        self._node, self._say = home.node, say
        self._started = time.time_ns()
        self._made = -_EVERY_SECONDS
        self._day_key: Any = None
        self._events: dict[str, Event] = {}
        self._now = NowHeard()
        self._said = Said(home.folder, home.node)
        self._recurring = Recurring(home.folder)
        self._is_read_back = False
        token = page_token(settings.token_file, state)
        names = frozenset(settings.names)
        admission = PageAdmission(settings.bind, settings.port, token, cookie_key(state), names)
        self._board = Board()
        actions = {"/mark": self._mark, "/group": self._recurring.name}
        self._server = PageServer(admission, self._board, actions, settings.frames)
        host = f"[{settings.bind}]" if bind.version == 6 else settings.bind
        address = f"http://{host}:{settings.port}/"
        whole = f"{address}?token={token}"
        try:
            file = keep_address(whole, state)
        except BridgeError:
            self._server.end()
            raise
        # Others may read the journal.
        if writes_to_journal():
            whole = f"{address}; its whole address, which opens it, is in {file.absolute()}"
        say(f"the page of the home: {whole}")
        if not bind.is_loopback:
            say(
                f"the page listens on {settings.bind}: it crosses the network in the clear, and "
                "who listens in on the network can read it and its token"
            )

    def update(self, news: News) -> None:
        """Show what is new."""
        self._board.keep_fresh()
        if time.monotonic() - self._made < _EVERY_SECONDS:
            return
        self._made = time.monotonic()
        if not self._is_read_back:
            self._is_read_back = True
            threading.Thread(target=self._read_back, daemon=True).start()
        last = last_events(news, self._said.of)
        self._events = last.events
        self._put("now", self._now.describe(news))
        self._put("scenarios", scenario_lines(news))
        self._put("home", {"home": room(self._node), "clock": clock(news.today.now, news.zone)})
        self._put("events", last.shown)
        self._put("recurring", self._recurring.describe(Moment(news.today.now, news.zone)))
        self._put("health", health_list(news, self._node, self._started, self._recurring.problem))
        key = _day_key(news)
        if key != self._day_key:
            self._day_key = key
            self._put("day", day_picture(news.state.microphones.values(), news.today, news.zone))

    def close(self) -> None:
        """End, and let browsers know."""
        self._server.end()
        self._recurring.close()

    def _put(self, name: str, content: Any) -> None:
        self._board.put(name, json.dumps(content, allow_nan=False).encode())

    def _mark(self, event: str, label: str) -> str:
        found = self._events.get(event)
        if found is None:
            raise BridgeError("This event is too long ago for the page: `hearthlog review` has it.")
        return self._said.say(found, label)

    def _read_back(self) -> None:
        try:
            self._said.read_back()
        except HearthlogError as error:
            self._say(f"page: earlier marks are not shown: {error}")


def _day_key(news: News) -> Any:
    """Return what changes whenever the picture of the day does."""
    microphones = news.state.microphones.values()
    return news.today.now // BIN, [
        (
            each.name,
            each.is_listening(),
            each.since,
            len(each.gaps),
            [(label, each.last_event(label)) for label in each.labels()],
            list(each.classes),
        )
        for each in microphones
    ]
