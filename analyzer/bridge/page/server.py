"""The server of the page: a few readers at a time, who know the token."""

import json
import select
import socket
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from http import HTTPStatus
from http.client import LineTooLong
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from time import monotonic
from typing import Any, BinaryIO, cast

from hearthlog.analyzer.bridge.errors import BridgeError
from hearthlog.analyzer.bridge.page.admission import PageAdmission
from hearthlog.analyzer.bridge.page.board import Board, Part
from hearthlog.schemas.errors import HearthlogError

_MOST_CONNECTIONS, _MOST_STREAMS = 32, 16
_SECONDS = 10.0  # for a request, and for each part of an answer
_MARK_SECONDS = 120.0  # for the logs of the event to be read, from a slow disk
_BEAT_SECONDS, _LOOK_SECONDS = 5.0, 1.0
_HEAD_LIMIT, _BODY_LIMIT = 16 << 10, 4 << 10  # bytes
_FILES = {
    "/": ("page.html", "text/html; charset=utf-8"),
    "/page.css": ("page.css", "text/css; charset=utf-8"),
    "/page.js": ("page.js", "text/javascript; charset=utf-8"),
}
_ASKED = {"/mark": "event", "/group": "group"}  # what a label is given to
_TEXT, _JSON = "text/plain; charset=utf-8", "application/json"
_REFUSED = (
    "This page opens with its whole address only. `hearthlog bridge` says the address when it "
    "starts: copy all of it, with what is behind `?token=`.\n"
)
_PROTECTION = {
    "Cache-Control": "no-store",
    "Connection": "close",
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
        "img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'; "
        "require-trusted-types-for 'script'; trusted-types 'none'"
    ),
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}
# A page and no redirection: to that, a browser that comes from a link sends no strict cookie.
_ENTRANCE = (
    '<!doctype html><html lang="en"><meta charset="utf-8"><title>The home</title>'
    '<meta http-equiv="refresh" content="0; url=/"><p><a href="/">Open the page</a></p></html>\n'
)


class PageServer(ThreadingHTTPServer):
    """Serves the page from a thread of its own.

    Parameters
    ----------
    bind, port : str, int
        Where it listens.
    token : str
    board : Board
        What the page shows.
    actions : mapping of str to callable
        Of `/mark` and `/group`: told the id of an event, or of a group of sounds, and what somebody
        says that it was; returns what was marked, in words, and raises HearthlogError.

    Raises
    ------
    BridgeError
        If nothing can listen there.
    """

    daemon_threads = True
    request_queue_size = 16

    def __init__(
        self,
        bind: str,
        port: int,
        token: str,
        board: Board,
        actions: Mapping[str, Callable[[str, str], str]],
    ) -> None:
        self.address_family = socket.AF_INET6 if ":" in bind else socket.AF_INET
        try:
            super().__init__((bind, port), _Handler)
        except OSError as error:
            raise BridgeError(
                f"the page cannot listen on {bind}, port {port} ({error.strerror or error}); "
                "choose another `bind` or `port` in [bridge.page]"
            ) from error
        self.board, self.actions = board, actions
        self.admission = PageAdmission(bind, self.server_address[1], token)
        self.streams = threading.BoundedSemaphore(_MOST_STREAMS)
        self._free = threading.BoundedSemaphore(_MOST_CONNECTIONS)
        self._ends: dict[socket.socket, float] = {}  # when each has to be done, CLOCK_MONOTONIC
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self.serve_forever, daemon=True)
        self._thread.start()

    def end(self) -> None:
        """Send nobody anything any more."""
        self.board.close()
        self.shutdown()
        self.server_close()

    def server_bind(self) -> None:
        """Bind without asking the network for the name of this machine."""
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self.socket.bind(self.server_address)
        self.server_address = self.socket.getsockname()
        self.server_name, self.server_port = str(self.server_address[0]), self.server_address[1]

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer in a thread, if there are not too many."""
        if not self._free.acquire(blocking=False):
            with suppress(OSError):
                request.setblocking(False)
                request.send(b"HTTP/1.1 503 Service Unavailable\r\nConnection: close\r\n\r\n")
            self.shutdown_request(request)
            return
        self.give_time(request, _SECONDS)
        try:
            super().process_request(request, client_address)
        except BaseException:
            self._free.release()
            raise

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer, and make room for the next one."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            with self._lock:
                self._ends.pop(request, None)
            self._free.release()

    def give_time(self, connection: socket.socket, seconds: float) -> None:
        """Let a connection be for so many seconds from now on."""
        with self._lock:
            self._ends[connection] = monotonic() + seconds

    def service_actions(self) -> None:
        """End connections that take too long, however busy they are."""
        now = monotonic()
        with self._lock:
            late = [connection for connection, end in self._ends.items() if end < now]
        for connection in late:
            with suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Pass over those who go away, or send what is no request."""


class _Handler(BaseHTTPRequestHandler):
    """Answers one request."""

    protocol_version = "HTTP/1.1"
    timeout = _SECONDS

    @property
    def _server(self) -> PageServer:
        return cast(PageServer, self.server)

    def setup(self) -> None:
        """Read no more than a head may have, and a body."""
        super().setup()
        self.rfile = cast(Any, _Limited(cast(BinaryIO, self.rfile), _HEAD_LIMIT + _BODY_LIMIT))

    def version_string(self) -> str:
        """Return what names the server, without a version."""
        return "hearthlog"

    def log_message(self, *_: object) -> None:
        """Keep quiet."""

    def send_error(
        self,
        code: int,
        message: str | None = None,  # noqa: ARG002
        explain: str | None = None,  # noqa: ARG002
    ) -> None:
        """Send what is wrong with a request, and nothing of the page."""
        self._send(code, f"{HTTPStatus(code).phrase}\n".encode(), _TEXT)

    def do_GET(self) -> None:
        """Send the page, one of its files, or what is new from now on."""
        if not self._is_admitted(changes=False):
            return
        if self._server.admission.has_token(self.path):
            cookie = {"Set-Cookie": self._server.admission.cookie}
            self._send(HTTPStatus.OK, _ENTRANCE.encode(), _FILES["/"][1], cookie)
        elif self.path == "/events":
            self._stream()
        elif self.path in _FILES:
            name, kind = _FILES[self.path]
            content = files("hearthlog.analyzer.bridge.page").joinpath(name).read_bytes()
            self._send(HTTPStatus.OK, content, kind)
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    def do_POST(self) -> None:
        """Take what somebody says that an event was, or the sounds of a group."""
        if not self._is_admitted(changes=True):
            return
        if self.path not in _ASKED:
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        asked = self._body(_ASKED[self.path])
        if isinstance(asked, HTTPStatus):
            self.send_error(asked)
            return
        self._server.give_time(self.connection, _MARK_SECONDS)
        try:
            answer, code = {"said": self._server.actions[self.path](*asked)}, HTTPStatus.OK
        except HearthlogError as error:
            answer, code = {"error": str(error)}, HTTPStatus.UNPROCESSABLE_ENTITY
        self._server.give_time(self.connection, _SECONDS)
        self._send(code, json.dumps(answer).encode(), _JSON)

    def _is_admitted(self, *, changes: bool) -> bool:
        fields = {name: self.headers.get_all(name, []) for name in ("Host", "Origin", "Cookie")}
        if self._server.admission.admits(self.path, fields, changes=changes):
            return True
        self._send(HTTPStatus.FORBIDDEN, _REFUSED.encode(), _TEXT)
        return False

    def _body(self, what: str) -> tuple[str, str] | HTTPStatus:
        """Read what is labelled and its label, or return what is wrong."""
        length = self.headers.get("Content-Length", "")
        if self.headers.get_content_type() != _JSON:
            return HTTPStatus.UNSUPPORTED_MEDIA_TYPE
        if not (length.isascii() and length.isdecimal()):
            return HTTPStatus.LENGTH_REQUIRED
        if len(length) > 9 or int(length) > _BODY_LIMIT:
            return HTTPStatus.REQUEST_ENTITY_TOO_LARGE
        try:
            asked = json.loads(self.rfile.read(int(length)))
            labelled, label = asked[what], asked["label"]
        except (ValueError, KeyError, TypeError, RecursionError):
            return HTTPStatus.BAD_REQUEST
        if not (isinstance(labelled, str) and isinstance(label, str)):
            return HTTPStatus.BAD_REQUEST
        return labelled, label

    def _stream(self) -> None:
        """Send what the board has, and then what changes."""
        server = self._server
        if not server.streams.acquire(blocking=False):
            self.send_error(HTTPStatus.SERVICE_UNAVAILABLE)
            return
        try:
            self._send_head(HTTPStatus.OK, {"Content-Type": "text/event-stream"})
            known: dict[str, int] = {}
            sent = 0.0
            while not server.board.is_closed:
                parts = server.board.wait(known, _LOOK_SECONDS)
                if not parts and monotonic() - sent < _BEAT_SECONDS:
                    if self._is_gone():
                        return
                    continue
                known |= {name: part.number for name, part in parts.items()}
                sent = monotonic()
                server.give_time(self.connection, _SECONDS + _BEAT_SECONDS)
                self.wfile.write(_as_events(parts, is_fresh=server.board.is_fresh()))
        finally:
            server.streams.release()

    def _is_gone(self) -> bool:
        """Tell whether the browser has closed the connection."""
        readable, _, _ = select.select([self.connection], [], [], 0)
        return bool(readable) and not self.connection.recv(1, socket.MSG_PEEK)

    def _send(
        self, code: int, content: bytes, kind: str, more: Mapping[str, str] | None = None
    ) -> None:
        head = {"Content-Type": kind, "Content-Length": str(len(content)), **(more or {})}
        self._send_head(code, head)
        self.wfile.write(content)

    def _send_head(self, code: int, fields: Mapping[str, str]) -> None:
        self.send_response(code)
        for name, value in {**fields, **_PROTECTION}.items():
            self.send_header(name, value)
        self.end_headers()


def _as_events(parts: Mapping[str, Part], *, is_fresh: bool) -> bytes:
    """Write parts as server-sent events, and a beat: without it what the page shows may be old."""
    news = [b"event: %s\ndata: %s\n\n" % (n.encode(), part.content) for n, part in parts.items()]
    return b"".join([*news, b"event: beat\ndata:\n\n" if is_fresh else b":\n\n"])


class _Limited:
    """A stream of which only so many bytes can be read."""

    def __init__(self, stream: BinaryIO, limit: int) -> None:
        self._stream = stream
        self._left = limit

    def readline(self, limit: int) -> bytes:
        return self._counted(self._stream.readline(min(limit, self._left + 1)))

    def read(self, size: int) -> bytes:
        return self._counted(self._stream.read(min(size, self._left + 1)))

    def close(self) -> None:
        self._stream.close()

    @property
    def closed(self) -> bool:
        return self._stream.closed

    def _counted(self, data: bytes) -> bytes:
        self._left -= len(data)
        if self._left < 0:
            raise LineTooLong("head")
        return data
