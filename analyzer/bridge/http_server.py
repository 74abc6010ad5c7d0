"""HTTP server with limits on connections, and a deadline for each."""

import select
import socket
import threading
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from http import HTTPStatus
from http.client import LineTooLong
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from time import monotonic
from typing import Any, BinaryIO, cast

MOST_ASKING = 64  # connections that are not admitted yet
MOST_ADMITTED = 32
_MOST_THREADS = 4 * MOST_ASKING
SECONDS = 10.0  # for a request, and for each part of a response
_HEAD_LIMIT = 16 << 10  # bytes
TEXT = "text/plain; charset=utf-8"


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
        asking = {each: a.host for each, a in self._connections.items() if not a.is_admitted}
        if len(asking) < MOST_ASKING:
            return
        ((most, _),) = Counter(asking.values()).most_common(1)
        those = [each for each, host in asking.items() if host == most]
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

    def get(self) -> None:
        """Answer a GET request."""
        raise NotImplementedError

    def post(self) -> None:
        """Answer a POST request; not found by default."""
        self.send_error(HTTPStatus.NOT_FOUND)

    def do_GET(self) -> None:
        """Answer a GET request."""
        self.get()

    def do_POST(self) -> None:
        """Answer a POST request."""
        self.post()

    def setup(self) -> None:
        """Limit the bytes read to a head and a body."""
        super().setup()
        self.rfile = cast(Any, _Limited(cast(BinaryIO, self.rfile), _HEAD_LIMIT + self.body_limit))

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
        self.send(code, f"{HTTPStatus(code).phrase}\n".encode(), TEXT)

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
