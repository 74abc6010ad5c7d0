"""Web server of the page: admission of requests, and streams of the page's parts."""

import hmac
import html
import json
import re
import select
import socket
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from http import HTTPStatus
from importlib.resources import files
from secrets import compare_digest
from threading import Condition
from time import monotonic
from typing import Any, NamedTuple, Protocol, cast
from urllib.parse import unquote

from hearthlog.analyzer.bridge.page import ENGLISH, Translation
from hearthlog.analyzer.bridge.state import BridgeError
from hearthlog.analyzer.http import (
    SECONDS,
    HttpHandler,
    HttpServer,
    has_token,
    host_name,
    is_numeric_host,
)
from hearthlog.schemas.errors import HearthlogError

_YEAR = 365 * 24 * 3600
_PLAIN = re.compile(r"[a-z0-9.:-]{1,253}")  # a name or address that is safe in a message


@dataclass(frozen=True)
class PageAdmission:
    """Checks of requests: token or pass, `Origin`, and `Host`.

    Any web page in a browser can send requests to every server of this machine. The token excludes
    clients that do not know the address, the check of `Origin` excludes other pages that know it,
    and the check of `Host` excludes pages that use DNS rebinding.
    """

    bind: str
    port: int
    token: str
    key: bytes  # signs passes
    names: frozenset[str] = frozenset()  # host names of the page, with or without a port
    ingress: str = ""  # proxy that has checked its users: the only client, which needs no token

    def cookie(self) -> str:
        """Return the `Set-Cookie` value with a pass for a year.

        The cookie has no path, so the browser uses that of the request, which a proxy may change.
        """
        rules = f"Max-Age={_YEAR}; HttpOnly; SameSite=Strict"
        return f"{self._cookie_name}={self.new_pass()}; {rules}"

    def new_pass(self) -> str:
        """Return a pass valid for a year, which proves knowledge of the token without its value."""
        return self._pass(int(time.time()) + _YEAR)

    def is_pass(self, text: str) -> bool:
        """Whether a text is a currently valid pass."""
        until, _, _ = text.partition("-")
        if not (until.isascii() and until.isdecimal()) or len(until) > 12:
            return False
        is_ours = compare_digest(text.encode(), self._pass(int(until)).encode())
        return is_ours and time.time() < int(until)

    def refusal(  # noqa: PLR0913
        self,
        target: str,
        host: str,
        fields: Mapping[str, Sequence[str]],
        *,
        changes: bool,
        client: str = "",
        has_pass: bool = False,
        words: Translation = ENGLISH,
    ) -> str:
        """Check a request; return the reason of a refusal and its remedy, empty if it is admitted.

        `client` is the address of the other end of the connection, which no header field can
        change.
        """
        origins = fields["Origin"]
        if self.ingress and client != self.ingress:
            return words.text("refusal.ingress")
        # The ingress has a login under each of its names, so a name of another site gains nothing.
        if not host or not (self.ingress or self._is_named(host)):
            name = host_name(f"//{host}")
            key = "refusal.name" if _PLAIN.fullmatch(name) else "refusal.host"
            return words.text(key, name=name)
        if len(origins) > 1 or (changes and not origins):
            return words.text("refusal.no origin")
        if origins and not self._is_own(origins[0].lower(), host):
            return words.text("refusal.origin")
        cookies = self._cookies(fields["Cookie"])
        is_admitted = has_pass or has_token(target, self.token) or any(map(self.is_pass, cookies))
        if self.ingress or is_admitted:
            return ""
        reasons = ["refusal.address"]
        if target.startswith("/?token="):
            reasons.insert(0, "refusal.token")
        elif cookies:
            reasons.insert(0, "refusal.cookie")
        return " ".join(map(words.text, reasons))

    def _is_named(self, host: str) -> bool:
        """Whether the host of a request is allowed."""
        if host in self.names or host_name(f"//{host}") in self.names:
            return True
        return bool(host) and is_numeric_host(self.bind, host)

    def _is_own(self, origin: str, host: str) -> bool:
        """Whether an origin is that of the page itself."""
        scheme, _, place = origin.partition("://")
        return scheme in {"http", "https"} and (place == host or place in self.names)

    @property
    def _cookie_name(self) -> str:
        return f"hearthlog-{self.port}"

    def _pass(self, until: int) -> str:
        text = f"page of the home {self.port} {until} {self.token}"
        return f"{until}-{hmac.digest(self.key, text.encode(), 'sha256').hex()}"

    def _cookies(self, fields: Sequence[str]) -> list[str]:
        given = [pair.strip().partition("=") for each in fields for pair in each.split(";")]
        return [value for name, _, value in given if name == self._cookie_name]


_STALE_SECONDS = 15.0


class PagePart(NamedTuple):
    """A part of the page: a number that grows with each change, and JSON content."""

    number: int
    content: bytes


class Board:
    """Newest version of each part of a page; slow readers miss versions in between."""

    def __init__(self) -> None:
        self._parts: dict[str, PagePart] = {}
        self._changed = Condition()
        self._seen = monotonic()
        self.is_closed = False

    def put(self, name: str, content: bytes) -> None:
        """Replace a part, if its content has changed."""
        with self._changed:
            part = self._parts.get(name)
            if part is None or part.content != content:
                self._parts[name] = PagePart(part.number + 1 if part else 1, content)
                self._changed.notify_all()

    def keep_fresh(self) -> None:
        """Record that the parts are up to date."""
        self._seen = monotonic()

    def is_fresh(self) -> bool:
        """Whether the parts were up to date within the last fifteen seconds."""
        return monotonic() - self._seen <= _STALE_SECONDS

    def wait(self, known: Mapping[str, int], seconds: float) -> dict[str, PagePart]:
        """Wait some seconds for parts that differ from a reader's, known by number.

        Empty on timeout or when closed.
        """

        def newer() -> dict[str, PagePart]:
            return {
                name: part for name, part in self._parts.items() if part.number != known.get(name)
            }

        with self._changed:
            self._changed.wait_for(lambda: newer() or self.is_closed, seconds)
            return newer()

    def close(self) -> None:
        """Wake all readers, which must stop."""
        with self._changed:
            self.is_closed = True
            self._changed.notify_all()


_MOST_STREAMS = 16
_READ_SECONDS = 120.0  # to read the logs from a slow disk
_BEAT_SECONDS, _LOOK_SECONDS = 5.0, 1.0
_FILES = {
    "/": ("page.html", "text/html; charset=utf-8"),
    "/page.css": ("page.css", "text/css; charset=utf-8"),
    "/page.js": ("page.js", "text/javascript; charset=utf-8"),
    "/picture.js": ("picture.js", "text/javascript; charset=utf-8"),
    "/sounds.js": ("sounds.js", "text/javascript; charset=utf-8"),
    "/elements.js": ("elements.js", "text/javascript; charset=utf-8"),
    "/icon.svg": ("icon.svg", "image/svg+xml"),
    "/icon-180.png": ("icon-180.png", "image/png"),
    "/icon-512.png": ("icon-512.png", "image/png"),
}
_QUERIES = {"/days", "/day", "/kept"}  # answered as JSON
_TEXT = re.compile(r"\{\{(page\.[a-z ]+)\}\}")  # in page.html
_GROUND = "#f4f6f8"  # as in page.css
_JSON = "application/json"
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self'; "
    "manifest-src 'self'; base-uri 'none'; form-action 'none'; "
    "require-trusted-types-for 'script'; trusted-types 'none'"
)
_FIELDS = {
    **HttpHandler.fields,
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
# Not a redirect: a browser that follows a link sends no strict cookie to the redirect's target.
_ENTRANCE = (
    '<!doctype html><html lang="en"><meta charset="utf-8"><title>The home</title>'
    '<meta http-equiv="refresh" content="0; url=TO"><p><a href="TO">Open the page</a></p></html>\n'
)


class PageContent(Protocol):
    """Content and actions of the page; called from many threads."""

    actions: Mapping[str, str]  # by path of a POST request, the JSON field of its subject

    def words(self, accepted: str) -> Translation:
        """Return the words for an `Accept-Language`."""

    def board(self, words: Translation) -> Board:
        """Return the parts of the page in a language."""

    def boards(self) -> Sequence[Board]:
        """Return the parts of the page in all languages."""

    def home_name(self) -> str:
        """Return the name of the home."""

    def act(self, path: str, subject: str, label: str, words: Translation) -> str:
        """Carry out a POST request; return what was done, or raise `HearthlogError`."""

    def answer(self, path: str, text: str, words: Translation) -> Any:
        """Return the answer to a GET request for JSON, or raise `HearthlogError`."""

    def sound(self, identifier: str) -> bytes:
        """Return the sound of an event as a WAV file, or raise `HearthlogError`."""


class PageServer(HttpServer):
    """Serves the page from a separate thread.

    `frames` are origins of pages that may show this page in a frame. Raise `BridgeError` if the
    address or port cannot be bound.
    """

    def __init__(
        self,
        admission: PageAdmission,
        content: PageContent,
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
        self.admission, self.content = admission, content
        self.is_ended = False
        self.has_frames = bool(frames)
        # The panel of the proxy frames the page, from the same origin.
        ancestors = " ".join(frames) or ("'self'" if admission.ingress else "'none'")
        policy = f"{_POLICY}; frame-ancestors {ancestors}"
        self.fields = {**_FIELDS, "Content-Security-Policy": policy}
        if not frames:
            self.fields["X-Frame-Options"] = "SAMEORIGIN" if admission.ingress else "DENY"
        self.streams = threading.BoundedSemaphore(_MOST_STREAMS)
        self.start()

    def end(self) -> None:
        """Stop all streams and the server."""
        self.is_ended = True
        for board in self.content.boards():
            board.close()
        super().end()


class _Handler(HttpHandler):
    body_limit = 4 << 10

    @property
    def _server(self) -> PageServer:
        return cast(PageServer, self.server)

    def setup(self) -> None:
        """Set the security headers of each response."""
        self.fields = self._server.fields
        super().setup()

    @property
    def _words(self) -> Translation:
        return self._server.content.words(self.headers.get("Accept-Language", ""))

    def do_GET(self) -> None:
        """Send the page, one of its files, the stream of changes, or what the page asks for."""
        if not self._is_admitted(changes=False):
            return
        path, _, query = self._path.partition("?")
        admission = self._server.admission
        if not admission.ingress and has_token(self.path, admission.token):
            self._send_entrance()
        elif self._path == "/events":
            self._stream()
        elif path in _QUERIES or path == "/sound":
            self._send_result(path, unquote(query, errors="replace"))
        elif self._path in {"/words.js", "/page.webmanifest"}:
            self._send_generated()
        elif self._path in _FILES:
            name, kind = _FILES[self._path]
            content = files("hearthlog.analyzer.bridge.page").joinpath(name).read_bytes()
            self.send(HTTPStatus.OK, content if self._path != "/" else self._page(content), kind)
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    def _page(self, content: bytes) -> bytes:
        """Return the page with its texts in the language of the browser."""
        words = self._words

        def text(found: re.Match[str]) -> str:
            return html.escape(words.texts[found[1]])

        page = content.decode().replace('lang="en"', f'lang="{words.language}"')
        return _TEXT.sub(text, page).encode()

    def _send_generated(self) -> None:
        words = self._words
        if self._path == "/words.js":
            texts = {key: text for key, text in words.texts.items() if key.startswith("page.")}
            script = f"export default {json.dumps(texts)};\n"
            self.send(HTTPStatus.OK, script.encode(), _FILES["/page.js"][1])
            return
        name = self._server.content.home_name()
        icon = {"src": "icon-512.png", "sizes": "512x512", "type": "image/png"}
        manifest = {
            "name": name,
            "short_name": name,
            "lang": words.language,
            "start_url": "./",
            "scope": "./",
            "display": "standalone",
            "background_color": _GROUND,
            "theme_color": _GROUND,
            "icons": [icon, {"src": "icon.svg", "sizes": "any", "type": "image/svg+xml"}],
        }
        self.send(HTTPStatus.OK, json.dumps(manifest).encode(), "application/manifest+json")

    def _send_result(self, path: str, text: str) -> None:
        """Send JSON, or the sound of an event, that is read from the logs."""
        words, content = self._words, self._server.content
        self._server.give_time(self.connection, _READ_SECONDS)
        kind, code = _JSON, HTTPStatus.OK
        try:
            if path == "/sound":
                body, kind = content.sound(text), "audio/wav"
            else:
                body = json.dumps(content.answer(path, text, words), allow_nan=False).encode()
        except HearthlogError as error:
            body = json.dumps({"error": words.translated(str(error))}).encode()
            kind, code = _JSON, HTTPStatus.UNPROCESSABLE_ENTITY
        self._server.give_time(self.connection, _READ_SECONDS)
        self.send(code, body, kind)

    def do_POST(self) -> None:
        """Carry out an action of the page."""
        if not self._is_admitted(changes=True):
            return
        subject = self._server.content.actions.get(self._path)
        if subject is None:
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        mark = self._label(subject)
        if isinstance(mark, HTTPStatus):
            self.send_error(mark)
            return
        self._server.give_time(self.connection, _READ_SECONDS)
        words = self._words
        try:
            answer = {"said": self._server.content.act(self._path, *mark, words)}
            code = HTTPStatus.OK
        except HearthlogError as error:
            answer = {"error": words.translated(str(error))}
            code = HTTPStatus.UNPROCESSABLE_ENTITY
        self._server.give_time(self.connection, SECONDS)
        self.send(code, json.dumps(answer).encode(), _JSON)

    def _is_admitted(self, *, changes: bool) -> bool:
        fields = {name: self.headers.get_all(name, []) for name in ("Origin", "Cookie")}
        self._path, has_pass = self._without_pass()
        refusal = self._server.admission.refusal(
            self.path,
            self.host,
            fields,
            changes=changes,
            client=str(self.client_address[0]),
            has_pass=has_pass,
            words=self._words,
        )
        if refusal:
            self.send_text(HTTPStatus.FORBIDDEN, refusal)
        return not refusal and self.has_place()

    def _without_pass(self) -> tuple[str, bool]:
        """Return the path without its leading pass (used in frames), and whether there was one."""
        first, slash, rest = self.path.removeprefix("/").partition("/")
        if self._server.has_frames and slash and self._server.admission.is_pass(first):
            return f"/{rest}", True
        return self.path, False

    def _send_entrance(self) -> None:
        """Send a page that leads from the address with the token to the page itself.

        In a frame of another site the browser stores no cookie, so the pass goes into the path.
        """
        admission = self._server.admission
        to = f"./{admission.new_pass()}/" if self._server.has_frames else "./"
        cookie = {"Set-Cookie": admission.cookie()}
        self.send(HTTPStatus.OK, _ENTRANCE.replace("TO", to).encode(), _FILES["/"][1], cookie)

    def _label(self, what: str) -> tuple[str, str] | HTTPStatus:
        """Read the id and label from the body; return a status code on an invalid body."""
        if self.headers.get_content_type() != _JSON:
            return HTTPStatus.UNSUPPORTED_MEDIA_TYPE
        content = self.body()
        if isinstance(content, HTTPStatus):
            return content
        try:
            mark = json.loads(content)
            labelled, label = mark[what], mark["label"]
        except (ValueError, KeyError, TypeError, RecursionError):
            return HTTPStatus.BAD_REQUEST
        if not (isinstance(labelled, str) and isinstance(label, str)):
            return HTTPStatus.BAD_REQUEST
        return labelled, label

    def _stream(self) -> None:
        """Send the parts of the board, and then their changes."""
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
            board = server.content.board(self._words)
            while not (board.is_closed or server.is_ended):
                parts = board.wait(known, _LOOK_SECONDS)
                if not parts and monotonic() - sent < _BEAT_SECONDS:
                    if self._is_gone():
                        return
                    continue
                known |= {name: part.number for name, part in parts.items()}
                sent = monotonic()
                server.give_time(self.connection, SECONDS + _BEAT_SECONDS)
                self.wfile.write(_as_events(parts, is_fresh=board.is_fresh()))
        finally:
            server.streams.release()

    def _is_gone(self) -> bool:
        """Whether the browser has closed the connection."""
        readable, _, _ = select.select([self.connection], [], [], 0)
        return bool(readable) and not self.connection.recv(1, socket.MSG_PEEK)


def _as_events(parts: Mapping[str, PagePart], *, is_fresh: bool) -> bytes:
    """Format parts as server-sent events with a beat; without beats the page may be stale."""
    news = [b"event: %s\ndata: %s\n\n" % (n.encode(), part.content) for n, part in parts.items()]
    return b"".join([*news, b"event: beat\ndata:\n\n" if is_fresh else b":\n\n"])
