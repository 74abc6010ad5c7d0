"""The server of the page: a few readers at a time, who know the token."""

import json
import select
import socket
import threading
from collections.abc import Callable, Mapping, Sequence
from http import HTTPStatus
from importlib.resources import files
from time import monotonic
from typing import cast

from hearthlog.analyzer.bridge.errors import BridgeError
from hearthlog.analyzer.bridge.http_server import SECONDS, TEXT, HttpHandler, HttpServer
from hearthlog.analyzer.bridge.page.admission import PageAdmission
from hearthlog.analyzer.bridge.page.board import Board, Part
from hearthlog.schemas.errors import HearthlogError

_MOST_STREAMS = 16
_MARK_SECONDS = 120.0  # for the logs of the event to be read, from a slow disk
_BEAT_SECONDS, _LOOK_SECONDS = 5.0, 1.0
_BODY_LIMIT = 4 << 10  # bytes
_FILES = {
    "/": ("page.html", "text/html; charset=utf-8"),
    "/page.css": ("page.css", "text/css; charset=utf-8"),
    "/page.js": ("page.js", "text/javascript; charset=utf-8"),
}
_ASKED = {"/mark": "event", "/group": "group"}  # what a label is given to
_JSON = "application/json"
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src data:; "
    "base-uri 'none'; form-action 'none'; require-trusted-types-for 'script'; trusted-types 'none'"
)
_PROTECTION = {
    **HttpHandler.fields,
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
# A page and no redirection: to that, a browser that comes from a link sends no strict cookie.
_ENTRANCE = (
    '<!doctype html><html lang="en"><meta charset="utf-8"><title>The home</title>'
    '<meta http-equiv="refresh" content="0; url=TO"><p><a href="TO">Open the page</a></p></html>\n'
)


def _protection(frames: Sequence[str]) -> dict[str, str]:
    """Return the fields of each answer, by the pages that may show this one in a frame."""
    ancestors = " ".join(frames) or "'none'"
    fields = {**_PROTECTION, "Content-Security-Policy": f"{_POLICY}; frame-ancestors {ancestors}"}
    return fields if frames else fields | {"X-Frame-Options": "DENY"}


class PageServer(HttpServer):
    """Serves the page from a thread of its own.

    Parameters
    ----------
    frames : sequence of str, optional
        Pages, by their origins, that may show this one in a frame.

    Raises
    ------
    BridgeError
        If nothing can listen there.
    """

    def __init__(
        self,
        admission: PageAdmission,
        board: Board,
        actions: Mapping[str, Callable[[str, str], str]],
        frames: Sequence[str] = (),
    ) -> None:
        bind, port = admission.bind, admission.port
        try:
            super().__init__(bind, port, _Handler)
        except OSError as error:
            raise BridgeError(
                f"the page cannot listen on {bind}, port {port} ({error.strerror or error}); "
                "choose another `bind` or `port` in [bridge.page]"
            ) from error
        self.admission, self.board, self.actions = admission, board, actions
        self.has_frames = bool(frames)
        self.fields = _protection(frames)
        self.streams = threading.BoundedSemaphore(_MOST_STREAMS)
        self.start()

    def end(self) -> None:
        """Send nobody anything any more."""
        self.board.close()
        super().end()


class _Handler(HttpHandler):
    """Answers one request."""

    body_limit = _BODY_LIMIT

    @property
    def _server(self) -> PageServer:
        return cast(PageServer, self.server)

    def setup(self) -> None:
        """Send with each answer what protects the page."""
        self.fields = self._server.fields
        super().setup()

    def get(self) -> None:
        """Send the page, one of its files, or what is new from now on."""
        if not self._is_admitted(changes=False):
            return
        if self._server.admission.has_token(self.path):
            self._send_entrance()
        elif self._path == "/events":
            self._stream()
        elif self._path in _FILES:
            name, kind = _FILES[self._path]
            content = files("hearthlog.analyzer.bridge.page").joinpath(name).read_bytes()
            self.send(HTTPStatus.OK, content, kind)
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    def post(self) -> None:
        """Take what somebody says that an event was, or the sounds of a group."""
        if not self._is_admitted(changes=True):
            return
        if self._path not in _ASKED:
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        asked = self._body(_ASKED[self._path])
        if isinstance(asked, HTTPStatus):
            self.send_error(asked)
            return
        self._server.give_time(self.connection, _MARK_SECONDS)
        try:
            answer, code = {"said": self._server.actions[self._path](*asked)}, HTTPStatus.OK
        except HearthlogError as error:
            answer, code = {"error": str(error)}, HTTPStatus.UNPROCESSABLE_ENTITY
        self._server.give_time(self.connection, SECONDS)
        self.send(code, json.dumps(answer).encode(), _JSON)

    def _is_admitted(self, *, changes: bool) -> bool:
        fields = {name: self.headers.get_all(name, []) for name in ("Host", "Origin", "Cookie")}
        self._path, has_pass = self._without_pass()
        admission = self._server.admission
        refusal = admission.refusal(self.path, fields, changes=changes, has_pass=has_pass)
        if refusal:
            self.send(HTTPStatus.FORBIDDEN, f"{refusal}\n".encode(), TEXT)
        elif not self._server.admit(self.connection):
            self.send_error(HTTPStatus.SERVICE_UNAVAILABLE)
        else:
            return True
        return False

    def _without_pass(self) -> tuple[str, bool]:
        """Return the path without the pass that begins it in frames, and whether one did."""
        first, slash, rest = self.path.removeprefix("/").partition("/")
        if self._server.has_frames and slash and self._server.admission.is_pass(first):
            return f"/{rest}", True
        return self.path, False

    def _send_entrance(self) -> None:
        """Send what leads from the address with the token to the page.

        In a frame of another site a browser keeps no cookie of the page: the path has the pass.
        """
        admission = self._server.admission
        to = f"./{admission.new_pass()}/" if self._server.has_frames else "./"
        cookie = {"Set-Cookie": admission.cookie()}
        self.send(HTTPStatus.OK, _ENTRANCE.replace("TO", to).encode(), _FILES["/"][1], cookie)

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
            self.send_head(
                HTTPStatus.OK, {"Content-Type": "text/event-stream", "X-Accel-Buffering": "no"}
            )
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
                server.give_time(self.connection, SECONDS + _BEAT_SECONDS)
                self.wfile.write(_as_events(parts, is_fresh=server.board.is_fresh()))
        finally:
            server.streams.release()

    def _is_gone(self) -> bool:
        """Tell whether the browser has closed the connection."""
        readable, _, _ = select.select([self.connection], [], [], 0)
        return bool(readable) and not self.connection.recv(1, socket.MSG_PEEK)


def _as_events(parts: Mapping[str, Part], *, is_fresh: bool) -> bytes:
    """Write parts as server-sent events, and a beat: without it what the page shows may be old."""
    news = [b"event: %s\ndata: %s\n\n" % (n.encode(), part.content) for n, part in parts.items()]
    return b"".join([*news, b"event: beat\ndata:\n\n" if is_fresh else b":\n\n"])
