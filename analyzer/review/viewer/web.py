"""Browser viewer: a local page that relays protobuf requests to the viewer."""

import json
import secrets
import urllib.request
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from http import HTTPStatus
from importlib.resources import files
from itertools import count
from threading import Condition
from typing import Any, cast

from hearthlog.analyzer.http import HOST, HttpHandler, HttpServer, free_port
from hearthlog.analyzer.review.timeline import Key, Question
from hearthlog.analyzer.review.viewer.process import ViewerProcess
from hearthlog.analyzer.review.viewer.row_heights import TOP_BAR, Blueprint
from hearthlog.analyzer.review.viewer.viewer import (
    Viewer,
    ViewerSize,
    ViewerState,
)
from hearthlog.schemas.errors import HearthlogError

# Messages of Rerun's viewer control (0.41), accepted by the page in a browser; a viewer in a
# window has Rerun's own client. A field is a head, 8 * number + kind, and a value.
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_SIZES = {_FIXED64: 8, _FIXED32: 4}
_STATE, _SET_TIME, _BLUEPRINT, _SET_BLUEPRINT = 3, 6, 12, 14  # operations
_PAUSED, _PLAYING = 1, 2
_ON_RECORDING = 3  # in `set_blueprint`

Value = int | bytes


def _field(number: int, value: Value) -> bytes:
    if isinstance(value, int):
        return _varint(number << 3 | _VARINT) + _varint(value)
    return _varint(number << 3 | _BYTES) + _varint(len(value)) + value


def _varint(value: int) -> bytes:
    """Encode a number in groups of seven bits, the lowest first."""
    groups = bytearray()
    while value > 0x7F:
        groups.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*groups, value])


def _fields(content: bytes) -> Iterator[tuple[int, Value]]:
    """Yield number and value of each field.

    Raise `ValueError` if the content is no protobuf message.
    """
    place = 0
    while place < len(content):
        head, place = _read_varint(content, place)
        number, kind = head >> 3, head & 7
        if kind == _VARINT:
            value, place = _read_varint(content, place)
            yield number, value
            continue
        if kind == _BYTES:
            size, place = _read_varint(content, place)
        elif kind in _SIZES:
            size = _SIZES[kind]
        else:
            raise ValueError(f"a field of kind {kind}")
        if place + size > len(content):
            raise ValueError("a field is cut off")
        yield number, content[place : place + size]
        place += size


def _read_varint(content: bytes, place: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        if place >= len(content):
            raise ValueError("a number is cut off")
        byte = content[place]
        place += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, place
    raise ValueError("a number is too long")


def _numbers(content: bytes, field: int) -> list[int]:
    return [v for number, v in _fields(content) if number == field and isinstance(v, int)]


def _messages(content: bytes, field: int) -> list[bytes]:
    return [v for number, v in _fields(content) if number == field and isinstance(v, bytes)]


def _message(content: bytes, field: int) -> bytes:
    """Return the last, effective value of a field; empty if there is none."""
    return (_messages(content, field) or [b""])[-1]


def _text(content: bytes, field: int) -> str:
    return _message(content, field).decode(errors="replace")


@contextmanager
def _decoding() -> Iterator[None]:
    """Raise `ConnectionError` if the answer of a page cannot be decoded."""
    try:
        yield
    except (ValueError, RecursionError):
        raise ConnectionError("the answer of the page cannot be decoded") from None


_POLL_SECONDS = 20.0
_SECONDS = 120.0  # for a request, with the time in which a browser takes the viewer
_ANSWER_SECONDS = 30.0  # a page without a graphics card takes some
_LARGEST = 20_000.0  # points of a viewer
_LIMIT = 16 << 20  # maximum bytes of an answer
_VIEWER_FILES = ("re_viewer.js", "re_viewer_bg.wasm")


@dataclass
class Relay:
    """Requests to the newest page and lines for it, with its answers.

    The page is loaded again, or opened in another window: then this one has the number of a page.
    """

    keys: Sequence[Key] = ()
    press: Callable[[str], None] = lambda _: None
    sound: Callable[[], bytes] | None = None
    size: ViewerSize | None = None  # of the viewer in the page
    page: int = 0  # number of the newest page
    _texts: deque[str | Question] = field(default_factory=deque)
    _shown: list[str | Question] = field(default_factory=list)  # the last question and two lines
    _requests: dict[int, bytes] = field(default_factory=dict)  # not answered yet
    _sent: set[int] = field(default_factory=set)
    _answers: dict[int, "Future[bytes]"] = field(default_factory=dict)
    _numbers: Iterator[int] = field(default_factory=lambda: count(1))
    _changed: Condition = field(default_factory=Condition)

    def open_page(self) -> int:
        """Return the number of a new page, which gets what the one before did not answer."""
        with self._changed:
            self.page += 1
            self._texts.extendleft(reversed(self._shown))
            self._shown = []
            self._sent.clear()
            self._changed.notify_all()
            return self.page

    def request(self, request: bytes) -> bytes:
        """Send a request to the page, and wait for its answer.

        Raise `TimeoutError` if there is no answer within 30 seconds. Raise `ConnectionError` if the
        viewer in the page refused.
        """
        number, answer = next(self._numbers), Future[bytes]()
        with self._changed:
            self._answers[number], self._requests[number] = answer, request
            self._changed.notify_all()
        try:
            return answer.result(_ANSWER_SECONDS)
        finally:
            with self._changed:
                del self._answers[number], self._requests[number]

    def announce(self, text: str | Question) -> None:
        """Send a line, or a question, to the page."""
        with self._changed:
            self._texts.append(text)
            self._changed.notify_all()

    def next(self, page: int) -> tuple[int, bytes]:
        """Wait up to 20 seconds for number and content of the next request; 0 if there is none."""
        with self._changed:
            self._wait(page, lambda: bool(self._requests.keys() - self._sent))
            for number, request in self._requests.items():
                if page == self.page and number not in self._sent:
                    self._sent.add(number)
                    return number, request
        return 0, b""

    def text(self, page: int) -> str | Question:
        """Wait up to 20 seconds for the next line or question; empty if there is none."""
        with self._changed:
            self._wait(page, lambda: bool(self._texts))
            if page != self.page or not self._texts:
                return ""
            text = self._texts.popleft()
            questions = [one for one in (*self._shown, text) if isinstance(one, Question)]
            lines = [one for one in (*self._shown, text) if not isinstance(one, Question)]
            self._shown = [*questions[-1:], *lines[-2:]]
            return text

    def _wait(self, page: int, is_there: Callable[[], bool]) -> None:
        self._changed.wait_for(lambda: page != self.page or is_there(), _POLL_SECONDS)

    def answer(self, number: int, content: bytes | None) -> None:
        """Deliver the answer to a request; None if the viewer refused."""
        waiting = self._answers.get(number)
        if waiting is None or waiting.done():
            return
        if content is None:
            waiting.set_exception(ConnectionError("the viewer in the page refused"))
        else:
            waiting.set_result(content)


class _Server(HttpServer):
    """Serves the page, below a secret path."""

    def __init__(self, port: int, relay: Relay, viewer_files: str, data: str) -> None:
        super().__init__(HOST, port, _Handler)
        self.relay = relay
        self.secret = secrets.token_urlsafe(16)
        self.viewer_files = viewer_files
        self.data = data

    @property
    def url(self) -> str:
        return f"http://{HOST}:{self.server_port}/{self.secret}/"


class _Handler(HttpHandler):
    timeout = _SECONDS
    body_limit = _LIMIT

    @property
    def _page(self) -> _Server:
        return cast(_Server, self.server)

    def do_GET(self) -> None:
        """Send the page, the files of the viewer, the next request or the next text."""
        name = self._name()
        if name == "":
            html = files("hearthlog.analyzer.review.viewer").joinpath("page.html").read_bytes()
            policy = {"Content-Security-Policy": self._policy()}
            self.send(HTTPStatus.OK, html, "text/html; charset=utf-8", policy)
        elif name == "description":
            relay = self._page.relay
            description = {
                "page": relay.open_page(),
                "data": self._page.data,
                "keys": list(relay.keys),
                "sound": relay.sound is not None,
            }
            self.send(HTTPStatus.OK, json.dumps(description).encode(), "application/json")
        elif (page := self._page_of(name, "next")) is not None:
            number, request = self._page.relay.next(page)
            kind = "application/octet-stream"
            self._send_to(page, request, kind, {"Number": str(number)})
        elif (page := self._page_of(name, "text")) is not None:
            self._send_text(page)
        elif name == "sound" and self._page.relay.sound is not None:
            self._send_sound(self._page.relay.sound)
        elif name in _VIEWER_FILES:
            kind = "text/javascript" if name.endswith(".js") else "application/wasm"
            with urllib.request.urlopen(f"{self._page.viewer_files}/{name}") as file:  # noqa: S310
                self.send(HTTPStatus.OK, file.read(), kind)
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    def do_POST(self) -> None:
        """Receive an answer, or a key."""
        name = self._name()
        content = self.body()
        relay = self._page.relay
        if name is None or isinstance(content, HTTPStatus):
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        verb, _, rest = name.partition("/")
        if verb in {"answer", "refused"} and rest.isdecimal():
            relay.answer(int(rest[:9]), content if verb == "answer" else None)
        elif verb == "size" and self._page_of(name, verb) == relay.page:
            with suppress(ValueError):
                width, height = (float(part) for part in content[:32].split())
                if 0 < width < _LARGEST and 0 < height < _LARGEST:
                    # The page hides the viewer's own top bar.
                    relay.size = ViewerSize(width, height + TOP_BAR)
        elif verb == "key":
            relay.press(content[:16].decode(errors="replace"))
        self.send(HTTPStatus.OK, b"", "text/plain")

    def _policy(self) -> str:
        """Limit the page to this machine; otherwise the viewer would send usage statistics."""
        allowed = self._page.data.removeprefix("rerun+").removesuffix("/proxy")
        return (
            "default-src 'none'; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval'; "
            "style-src 'unsafe-inline'; img-src data: blob:; media-src blob:; "
            f"connect-src 'self' {allowed}"
        )

    def _name(self) -> str | None:
        """Return the path after the secret; None for a wrong secret or host, or another page."""
        secret, _, name = self.path.removeprefix("/").partition("/")
        hosts = {f"{host}:{self._page.server_port}" for host in (HOST, "localhost")}
        is_ours = secrets.compare_digest(secret.encode(), self._page.secret.encode())
        origins = {f"http://{host}" for host in hosts}
        is_ours &= self.host in hosts and set(self.headers.get_all("Origin", [])) <= origins
        if not is_ours or not self._page.admit(self.connection):
            return None
        self._page.give_time(self.connection, _SECONDS)
        return name

    @staticmethod
    def _page_of(name: str | None, verb: str) -> int | None:
        """Return the number of the page in the name of its request; None for other names."""
        own, _, number = (name or "").partition("/")
        return int(number[:9]) if own == verb and number.isdecimal() else None

    def _send_to(
        self, page: int, content: bytes, kind: str, headers: dict[str, str] | None = None
    ) -> None:
        """Send to the newest page; tell an earlier one that there is another."""
        if page == self._page.relay.page:
            self.send(HTTPStatus.OK, content, kind, headers or {})
        else:
            self.send_text(HTTPStatus.GONE, "open in another window")

    def _send_sound(self, sound: Callable[[], bytes]) -> None:
        """Send the sound of the current span, or a line that says why there is none."""
        try:
            self.send(HTTPStatus.OK, sound(), "audio/wav")
        except HearthlogError as error:
            self.send_text(HTTPStatus.NOT_FOUND, str(error))
        except (ConnectionError, TimeoutError):
            self.send_text(HTTPStatus.SERVICE_UNAVAILABLE, "the viewer did not answer")

    def _send_text(self, page: int) -> None:
        """Send the next line, or the next question and the keys that answer it."""
        text = self._page.relay.text(page)
        if isinstance(text, Question):
            yes = text.keys[0]
            words = f"yes, {text.text.rstrip('?')}" if yes.text == "yes" else yes.text
            question = {
                "text": text.text,
                "keys": [one.key for one in text.keys],
                "yes": words.capitalize(),
            }
            self._send_to(page, json.dumps(question).encode(), "application/json")
        else:
            self._send_to(page, text.encode(), "text/plain; charset=utf-8")


class _PageViewer(Viewer):
    """A viewer in a page, whose process serves the data and the files of the viewer."""

    def __init__(self, process: ViewerProcess, server: _Server) -> None:
        super().__init__(process, server.url)
        self._relay = server.relay
        self._page = 0  # that shows what was shown
        self._server = server
        server.start()

    @_decoding()
    def state(self) -> ViewerState:
        state = self._request(_STATE)
        views, active = _messages(state, 5), _text(state, 2)
        reports = [(_text(view, 3), each) for view in views for each in _messages(view, 6)]
        errors = [f"{view}: {_text(report, 2)}" for view, report in reports]
        shown = [one for one in _messages(state, 3) if _text(one, 1) == active]
        cursors = _numbers(_message(_message(shown[0], 3), 3), 1) if shown else []
        return ViewerState(_text(state, 6), len(views), errors, cursors[-1] if cursors else None)

    def offer(
        self,
        keys: Sequence[Key],
        press: Callable[[str], None],
        sound: Callable[[], bytes] | None = None,
    ) -> None:
        self._relay.keys, self._relay.press, self._relay.sound = keys, press, sound

    def show_question(self, start: int, end: int, question: Question) -> None:
        super().show_question(start, end, question)
        self._relay.announce(question)

    def announce(self, text: str) -> None:
        self._relay.announce(text)

    def refresh(self) -> None:
        page = self._relay.page
        if page != self._page:
            if not self.state().views:
                return  # it has no data yet
            self._show_again()
            self._page = page
        super().refresh()

    def close(self) -> None:
        self._server.end()
        super().close()

    def _size(self) -> ViewerSize | None:
        return self._relay.size

    @_decoding()
    def _blueprint(self) -> Blueprint:
        blueprint: Any = json.loads(_text(self._request(_BLUEPRINT), 2))
        return {path: _dicts(entity) for path, entity in _dicts(blueprint).items()}

    def _set_blueprint(self, blueprint: Blueprint) -> None:
        text = json.dumps(blueprint).encode()
        self._request(_SET_BLUEPRINT, _field(2, text) + _field(_ON_RECORDING, b""))

    def _set_time(self, nanoseconds: int, *, play: bool) -> None:
        timeline = _field(2, _field(1, self._clock.name.encode()))
        time = _field(3, _field(1, nanoseconds))
        state = _field(5, _PLAYING if play else _PAUSED)
        self._request(_SET_TIME, timeline + time + state)

    @_decoding()
    def _request(self, operation: int, request: bytes = b"") -> bytes:
        """Let the viewer in the page do an operation; return its answer."""
        return _message(self._relay.request(_field(operation, request)), operation)


def _dicts(found: Any) -> dict[str, Any]:
    """Return the entries of a part of a blueprint that are dicts."""
    entries = found.items() if isinstance(found, dict) else ()
    return {name: entry for name, entry in entries if isinstance(entry, dict)}


def open_page(port: int | None = None, data: str | None = None) -> Viewer:
    """Serve the viewer as a local page.

    Raise `DataError` if the viewer is not installed, or the port is in use.
    """
    page, viewer_files = free_port(port), free_port()
    process = ViewerProcess(["--serve-web", "--web-viewer-port", str(viewer_files)])
    files_url = f"http://{process.address}:{viewer_files}"
    return _PageViewer(process, _Server(page, Relay(), files_url, data or process.url))
