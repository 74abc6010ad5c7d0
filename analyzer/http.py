"""Servers of this machine: addresses, limits and deadlines of HTTP; pings to a remote watchdog."""

import errno
import secrets
import select
import socket
import threading
import urllib.error
import urllib.request
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from http import HTTPStatus
from http.client import HTTPException, LineTooLong
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from ipaddress import IPv4Address, IPv6Address, ip_address
from pathlib import Path
from time import monotonic
from typing import Any, BinaryIO, TypeVar, cast
from urllib.parse import urlsplit

from hearthlog.analyzer.errors import DataError
from hearthlog.schemas.errors import HearthlogError
from hearthlog.schemas.files import read_limited

HOST = "127.0.0.1"
_Connected = TypeVar("_Connected")


def listen(port: int | None = None, bind: str = HOST) -> socket.socket:
    """Open a listening socket, on any free port by default.

    Raise `DataError` if the address or port cannot be bound.
    """
    family = socket.AF_INET6 if ":" in bind else socket.AF_INET
    try:
        return socket.create_server((bind, port or 0), family=family)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise DataError(
                f"port {port} is in use, perhaps by another viewer or watcher; choose another "
                "one with --port"
            ) from error
        reason = error.strerror or error
        place = bind if port is None else f"{bind}, port {port}"
        raise DataError(f"cannot listen on {place}: {reason}") from error


def free_port(port: int | None = None, bind: str = HOST) -> int:
    """Return a port that is free to listen on.

    Raise `DataError` if the address or port cannot be bound.
    """
    with listen(port, bind) as probe:
        return int(probe.getsockname()[1])


def hidden_address() -> str:
    """Return a random loopback address that no web page can guess.

    Viewer servers answer every client. By DNS rebinding a web page can reach any loopback address,
    but it would have to try 16 million addresses times some ten thousand ports. Local programs can
    look the address up.

    Returns
    -------
    str
        In 127.0.0.0/8; 127.0.0.1 on systems that bind no other loopback address, such as macOS.
    """
    address = ".".join(["127", *(str(1 + secrets.randbelow(254)) for _ in range(3))])
    with socket.socket() as probe:
        try:
            probe.bind((address, 0))
        except OSError:
            return HOST
    return address


def is_numeric_host(bind: str, host: str) -> bool:
    """Whether the `Host` of a request is a numeric address of this machine or `localhost`.

    This blocks DNS rebinding: the owner of a host name can point the name at any address, so that
    a web page under that name could read this server. Numeric addresses and `localhost` are safe.
    """
    listening, named = ip_address(bind), host_name(f"//{host}")
    if named == "localhost":
        return listening.is_loopback or listening.is_unspecified
    address = ip_of(named)
    if address is None:
        return False
    same = address == listening or listening.is_unspecified
    return same or (listening.is_loopback and address.is_loopback)


def has_token(target: str, token: str) -> bool:
    """Whether the target of a request is `/` with a token."""
    return secrets.compare_digest(target.encode(), f"/?token={token}".encode())


def busiest_address(pending: Mapping[_Connected, str]) -> list[_Connected]:
    """Return the connections of the address with the most of them, in the given order."""
    ((most, _),) = Counter(pending.values()).most_common(1)
    return [each for each, host in pending.items() if host == most]


def host_name(url: str) -> str:
    """Return the host of a URL in lower case, without port and final dot; empty if absent."""
    try:
        return (urlsplit(url).hostname or "").removesuffix(".")
    except ValueError:
        return ""


def ip_of(text: str) -> IPv4Address | IPv6Address | None:
    """Parse a numeric IP address; None if the text is not an IP address."""
    try:
        return ip_address(text)
    except ValueError:
        return None


MOST_ASKING = 64  # connections that are not admitted yet
MOST_ADMITTED = 32
_MOST_THREADS = 4 * MOST_ASKING
SECONDS = 10.0  # for a request, and for each part of a response
_HEAD_LIMIT = 16 << 10  # bytes


@dataclass
class _Connection:
    host: str
    end: float  # deadline, by CLOCK_MONOTONIC
    is_admitted: bool = False


class HttpServer(ThreadingHTTPServer):
    """HTTP server that listens in a separate thread.

    Admitted connections have places of their own. All others share a limited number of places: if
    these are full, the oldest connection of the address with the most connections is closed.

    Raise `OSError` if the address or port cannot be bound.
    """

    daemon_threads = True
    block_on_close = False
    request_queue_size = 128

    def __init__(self, bind: str, port: int, handler: "type[HttpHandler]") -> None:
        self.address_family = socket.AF_INET6 if ":" in bind else socket.AF_INET
        super().__init__((bind, port), handler)
        self._connections: dict[socket.socket, _Connection] = {}  # the oldest first
        self._threads_free = threading.BoundedSemaphore(_MOST_THREADS)
        self._lock = threading.Lock()

    def start(self) -> None:
        """Start serving."""
        threading.Thread(target=self.serve_forever, daemon=True).start()

    def end(self) -> None:
        """Stop serving, and close all connections at once."""
        self.shutdown()
        self.server_close()
        with self._lock:
            connections = [*self._connections]
        for connection in connections:
            _shut(connection)

    def server_bind(self) -> None:
        """Bind without a name lookup of this machine on the network."""
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self.socket.bind(self.server_address)
        self.server_address = self.socket.getsockname()
        self.server_name, self.server_port = str(self.server_address[0]), self.server_address[1]

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer in a new thread, closing another connection if there is no room."""
        if not self._threads_free.acquire(blocking=False):
            self.shutdown_request(request)
            return
        with self._lock:
            self._make_room()
            self._connections[request] = _Connection(client_address[0], monotonic() + SECONDS)
        try:
            super().process_request(request, client_address)
        except BaseException:
            self._forget(request)
            raise

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer, and free the place of the connection."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._forget(request)

    def admit(self, connection: socket.socket) -> bool:
        """Give an authorized connection a place of its own; return False if none is free."""
        with self._lock:
            if sum(each.is_admitted for each in self._connections.values()) >= MOST_ADMITTED:
                return False
            if connection in self._connections:
                self._connections[connection].is_admitted = True
            return True

    def give_time(self, connection: socket.socket, seconds: float) -> None:
        """Set the deadline of a connection, in seconds from now."""
        with self._lock:
            if connection in self._connections:
                self._connections[connection].end = monotonic() + seconds

    def service_actions(self) -> None:
        """Close connections past their deadline, even active ones."""
        now = monotonic()
        with self._lock:
            late = [each for each, about in self._connections.items() if about.end < now]
        for connection in late:
            _shut(connection)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore clients that disconnect or send invalid requests."""

    def _make_room(self) -> None:
        pending = {each: a.host for each, a in self._connections.items() if not a.is_admitted}
        if len(pending) < MOST_ASKING:
            return
        those = busiest_address(pending)
        with suppress(OSError, ValueError):  # a connection was closed meanwhile
            waiting = select.select(those, [], [], 0)[0]  # their data is about to be read
            those = [each for each in those if each not in waiting] or those
        self._connections.pop(those[0])
        _shut(those[0])

    def _forget(self, connection: socket.socket) -> None:
        with self._lock:
            self._connections.pop(connection, None)
        self._threads_free.release()


class HttpHandler(BaseHTTPRequestHandler):
    """Handler of one request."""

    protocol_version = "HTTP/1.1"
    timeout = SECONDS
    body_limit = 0  # bytes
    fields: Mapping[str, str] = {"Cache-Control": "no-store", "Connection": "close"}

    def do_POST(self) -> None:
        """Answer a POST request; not found by default."""
        self.send_error(HTTPStatus.NOT_FOUND)

    def setup(self) -> None:
        """Limit the bytes read to a head and a body."""
        super().setup()
        self.rfile = cast(Any, _Limited(cast(BinaryIO, self.rfile), _HEAD_LIMIT + self.body_limit))

    @property
    def host(self) -> str:
        """The `Host` of the request in lower case; empty if it has none or several."""
        hosts = self.headers.get_all("Host", [])
        return hosts[0].lower() if len(hosts) == 1 else ""

    def body(self) -> bytes | HTTPStatus:
        """Read the body of the request; return a status code if its length is invalid."""
        length = self.headers.get("Content-Length", "")
        if not (length.isascii() and length.isdecimal()):
            return HTTPStatus.LENGTH_REQUIRED
        if len(length) > 9 or int(length) > self.body_limit:
            return HTTPStatus.REQUEST_ENTITY_TOO_LARGE
        return self.rfile.read(int(length))

    def has_place(self) -> bool:
        """Give the authorized connection a place of its own, or answer that none is free."""
        if cast(HttpServer, self.server).admit(self.connection):
            return True
        self.send_error(HTTPStatus.SERVICE_UNAVAILABLE)
        return False

    def version_string(self) -> str:
        """Return the name of the server, without a version."""
        return "hearthlog"

    def log_message(self, *_: object) -> None:
        """Log nothing."""

    def send_error(
        self,
        code: int,
        message: str | None = None,  # noqa: ARG002
        explain: str | None = None,  # noqa: ARG002
    ) -> None:
        """Send the phrase of a status code as plain text."""
        self.send_text(code, HTTPStatus(code).phrase)

    def send_text(self, code: int, text: str, more: Mapping[str, str] | None = None) -> None:
        """Send a line of plain text."""
        self.send(code, f"{text}\n".encode(), "text/plain; charset=utf-8", more)

    def send(
        self, code: int, content: bytes, kind: str, more: Mapping[str, str] | None = None
    ) -> None:
        """Send a response."""
        head = {"Content-Type": kind, "Content-Length": str(len(content)), **(more or {})}
        self.send_head(code, head)
        self.wfile.write(content)

    def send_head(self, code: int, fields: Mapping[str, str]) -> None:
        """Send the head of a response; the connection closes after the body."""
        self.send_response(code)
        for name, value in {**fields, **self.fields}.items():
            self.send_header(name, value)
        self.end_headers()


def _shut(connection: socket.socket) -> None:
    with suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)


class _Limited:
    """Input stream with a limit on the bytes read."""

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


_PING_SECONDS = 15.0
_LONGEST_ADDRESS = 1 << 12  # bytes of a file


def is_ping_address(url: str) -> bool:
    """Whether a URL is a valid HTTP or HTTPS address to ping."""
    try:
        parts = urlsplit(url)
        is_complete = parts.scheme in {"http", "https"} and bool(parts.hostname)
        _ = parts.port
    except ValueError:
        return False
    return is_complete and url.isascii() and url.isprintable() and " " not in url


def has_password(url: str) -> bool:
    """Whether a URL accepted by `is_ping_address` contains a user or password."""
    return "@" in urlsplit(url).netloc


def read_ping_address(file: Path) -> str:
    """Read a one-line file with a ping URL, a secret: anyone with the URL could fake the pings.

    Raise `HearthlogError` if the file cannot be read or has no valid URL.
    """
    data = read_limited(file, "file of a ping address", _LONGEST_ADDRESS, HearthlogError)
    url = data.decode("utf-8-sig", "replace").strip()
    if not is_ping_address(url):
        raise HearthlogError(
            f"{file}: has no web address; write one such as https://hc-ping.com/your-uuid on one "
            "line"
        )
    return url


def ping(url: str, *, is_well: bool) -> str:
    """Send a GET request to a URL, or to its `/fail` path on a problem, without any data.

    Returns
    -------
    str
        Reason of the failure; empty on success.
    """
    problems = [f"no answer within {_PING_SECONDS:.0f} s"]

    def send() -> None:
        try:
            with urllib.request.urlopen(  # noqa: S310  the scheme was checked
                url if is_well else f"{url.rstrip('/')}/fail", timeout=_PING_SECONDS
            ):
                problems.clear()
        except urllib.error.HTTPError as error:
            problems[:] = [f"status {error.code}"]
        except (OSError, ValueError, HTTPException) as error:
            reason = getattr(error, "reason", None) or error
            # Other error messages may contain the URL, which is a secret.
            is_late = isinstance(reason, TimeoutError)
            what = "timed out" if is_late else getattr(reason, "strerror", None)
            problems[:] = [what or type(reason).__name__]

    thread = threading.Thread(target=send, daemon=True)
    try:
        thread.start()
    except RuntimeError:
        return "no thread is free"
    thread.join(_PING_SECONDS)
    return "".join(problems)
