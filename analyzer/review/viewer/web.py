"""The viewer in a browser: a page of this machine, which relays requests to the viewer in it."""

import json
import queue
import secrets
import sys
import threading
import urllib.request
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, field
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from typing import Any, cast

from hearthlog.analyzer.ports import HOST, free_port
from hearthlog.analyzer.review.viewer import messages
from hearthlog.analyzer.review.viewer.process import ViewerProcess
from hearthlog.analyzer.review.viewer.viewer import Blueprint, Viewer, ViewerState

_POLL_SECONDS = 20.0
_ANSWER_SECONDS = 15.0
_LIMIT = 16 << 20  # bytes of an answer
_VIEWER_FILES = ("re_viewer.js", "re_viewer_bg.wasm")


@dataclass
class Relay:
    """Requests to a page, and its answers."""

    keys: Sequence[tuple[str, str]] = ()
    press: Callable[[str], None] = lambda _: None
    texts: queue.SimpleQueue[str] = field(default_factory=queue.SimpleQueue)
    requests: queue.SimpleQueue[tuple[int, bytes]] = field(default_factory=queue.SimpleQueue)
    answers: dict[int, "Future[bytes]"] = field(default_factory=dict)
    _last: int = 0

    def ask(self, request: bytes) -> bytes:
        """Ask the page, and wait for its answer.

        Raise `TimeoutError` if there is no answer within 15 seconds. Raise `ConnectionError` if
        the viewer in the page refused.
        """
        self._last += 1
        number, answer = self._last, Future[bytes]()
        self.answers[number] = answer
        self.requests.put((number, request))
        try:
            return answer.result(_ANSWER_SECONDS)
        finally:
            del self.answers[number]

    def next(self) -> tuple[int, bytes]:
        """Wait up to 20 seconds for the next request.

        Returns
        -------
        number : int
            Of the request; 0 if there is none.
        """
        with suppress(queue.Empty):
            while True:
                number, request = self.requests.get(timeout=_POLL_SECONDS)
                if number in self.answers:  # somebody still waits for it
                    return number, request
        return 0, b""

    def answer(self, number: int, content: bytes | None) -> None:
        """Take the answer to a request.

        Parameters
        ----------
        content : bytes or None
            None if the viewer refused.
        """
        waiting = self.answers.get(number)
        if waiting is None or waiting.done():
            return
        if content is None:
            waiting.set_exception(ConnectionError("the viewer in the page refused"))
        else:
            waiting.set_result(content)


class _Server(ThreadingHTTPServer):
    """Serves the page, below a secret path."""

    daemon_threads = True

    def __init__(self, port: int, relay: Relay, viewer_files: str, data: str) -> None:
        super().__init__((HOST, port), _Handler)
        self.relay = relay
        self.secret = secrets.token_urlsafe(16)
        self.viewer_files = viewer_files
        self.data = data

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Pass over what a page that was closed took no more; print other errors."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)

    @property
    def url(self) -> str:
        return f"http://{HOST}:{self.server_port}/{self.secret}/"


class _Handler(BaseHTTPRequestHandler):
    """Answers requests of the page."""

    protocol_version = "HTTP/1.1"

    @property
    def _page(self) -> _Server:
        return cast(_Server, self.server)

    def log_message(self, *_: object) -> None:
        """Keep quiet."""

    def do_GET(self) -> None:
        """Send the page, the files of the viewer, the next request or the next text."""
        name = self._name()
        if name == "":
            page = files("hearthlog.analyzer.review.viewer").joinpath("page.html").read_bytes()
            self._send(
                page, "text/html; charset=utf-8", {"Content-Security-Policy": self._policy()}
            )
        elif name == "description":
            description = {"data": self._page.data, "keys": list(self._page.relay.keys)}
            self._send(json.dumps(description).encode(), "application/json")
        elif name == "next":
            self._send_next()
        elif name == "text":
            self._send_text()
        elif name in _VIEWER_FILES:
            self._send_viewer_file(name)
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    def do_POST(self) -> None:
        """Take an answer, or a key."""
        name = self._name()
        content = self._content()
        relay = self._page.relay
        if name is None or content is None:
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        verb, _, rest = name.partition("/")
        if verb in {"answer", "refused"} and rest.isdecimal():
            relay.answer(int(rest[:9]), content if verb == "answer" else None)
        elif verb == "key":
            relay.press(content[:16].decode(errors="replace"))
        self._send(b"", "text/plain")

    def _policy(self) -> str:
        """Allow the page to reach this machine only: the viewer would send usage statistics."""
        allowed = self._page.data.removeprefix("rerun+").removesuffix("/proxy")
        return (
            "default-src 'none'; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval'; "
            f"style-src 'unsafe-inline'; img-src data: blob:; connect-src 'self' {allowed}"
        )

    def _name(self) -> str | None:
        """Return the path behind the secret; None if the secret or the host is another one."""
        secret, _, name = self.path.removeprefix("/").partition("/")
        hosts = {f"{host}:{self._page.server_port}" for host in (HOST, "localhost")}
        is_ours = secrets.compare_digest(secret.encode(), self._page.secret.encode())
        return name if is_ours and self.headers.get("Host") in hosts else None

    def _content(self) -> bytes | None:
        length = self.headers.get("Content-Length", "")
        if not length.isdecimal() or len(length) > 9 or int(length) > _LIMIT:
            self.close_connection = True
            return None
        return self.rfile.read(int(length))

    def _send_next(self) -> None:
        number, request = self._page.relay.next()
        self._send(request, "application/octet-stream", {"Number": str(number)})

    def _send_text(self) -> None:
        try:
            text = self._page.relay.texts.get(timeout=_POLL_SECONDS)
        except queue.Empty:
            self._send(b"", "text/plain; charset=utf-8")
        else:
            self._send(text.encode(), "text/plain; charset=utf-8")

    def _send_viewer_file(self, name: str) -> None:
        kind = "text/javascript" if name.endswith(".js") else "application/wasm"
        with urllib.request.urlopen(f"{self._page.viewer_files}/{name}") as file:  # noqa: S310
            self._send(file.read(), kind)

    def _send(self, content: bytes, kind: str, more: dict[str, str] | None = None) -> None:
        self.send_response(HTTPStatus.OK)
        headers = {
            "Content-Type": kind,
            "Content-Length": str(len(content)),
            "Cache-Control": "no-store",
            **(more or {}),
        }
        for key, value in headers.items():
            self.send_header(key, value)
        self.end_headers()
        self.wfile.write(content)


class _WebControl:
    """Controls a viewer through the page that it is in."""

    def __init__(self, process: ViewerProcess, server: _Server) -> None:
        self.process = process  # it hands out the data and the files of the viewer
        self._relay = server.relay
        self._server = server
        threading.Thread(target=server.serve_forever, daemon=True).start()

    def state(self) -> ViewerState:
        version, reports, cursor = messages.read_state(self._relay.ask(messages.get_state()))
        return ViewerState(version, len(reports), [text for one in reports for text in one], cursor)

    def blueprint(self) -> Blueprint:
        text = messages.read_blueprint(self._relay.ask(messages.get_blueprint()))
        blueprint: Any = json.loads(text)
        return blueprint if isinstance(blueprint, dict) else {}

    def set_blueprint(self, blueprint: Blueprint) -> None:
        self._relay.ask(messages.set_blueprint(json.dumps(blueprint)))

    def set_time(self, axis: str, nanoseconds: int, *, play: bool) -> None:
        self._relay.ask(messages.set_time(axis, nanoseconds, play=play))

    def offer(self, keys: Sequence[tuple[str, str]], press: Callable[[str], None]) -> None:
        self._relay.keys, self._relay.press = keys, press

    def say(self, text: str) -> None:
        self._relay.texts.put(text)

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()
        self.process.close()


def open_page(port: int | None = None, data: str | None = None) -> Viewer:
    """Serve the viewer as a page of this machine.

    Raise `DataError` if the viewer is not installed, or the port is in use.
    """
    page, viewer_files = free_port(port), free_port()
    process = ViewerProcess(["--serve-web", "--web-viewer-port", str(viewer_files)])
    files_url = f"http://{process.address}:{viewer_files}"
    server = _Server(page, Relay(), files_url, data or process.url)
    return Viewer(_WebControl(process, server), server.url)
