"""Server of Foxglove's SDK behind a gate that checks address, origin and token."""

import asyncio
import logging
import re
import socket
from asyncio import StreamReader, StreamWriter, Task
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from threading import Thread
from typing import Self

import foxglove
from foxglove.websocket import (
    Capability,
    ChannelView,
    Client,
    PlaybackControlRequest,
    PlaybackState,
    ServerListener,
    WebSocketServer,
)

from hearthlog.analyzer.foxglove.publisher import Playback, Publisher
from hearthlog.analyzer.http import (
    busiest_address,
    has_token,
    hidden_address,
    host_name,
    ip_of,
    is_numeric_host,
)
from hearthlog.schemas.errors import HearthlogError

# Foxglove in a browser, and the desktop applications, whose pages are files.
_ORIGINS = frozenset({"https://app.foxglove.dev", "file://"})
_FIELD = re.compile(r"([!#$%&'*+.^_`|~0-9A-Za-z-]+):[ \t]*([\x20-\x7e]*?)[ \t]*")
_HANDED_ON = ("Sec-WebSocket-Key", "Sec-WebSocket-Version", "Sec-WebSocket-Protocol")
_LONGEST = 200  # maximum characters of a reported origin


class RefusedError(HearthlogError):
    """A refused connection; the message gives the reason to the operator of the server."""


@dataclass(frozen=True)
class Admission:
    """Requirements for a request.

    A page in a browser can connect to every server of this machine. The token blocks clients that
    do not know the address, the origin blocks other pages that learned it, and the host blocks
    pages with a domain name that resolves to this machine. `origins` are allowed pages, as
    `https://lichtblick.example`, in addition to Foxglove's own and to local pages. A client that is
    no page sends no origin, and needs only the token.
    """

    bind: str
    token: str
    origins: frozenset[str] = frozenset()

    def check(self, head: bytes) -> bytes:
        """Check a request up to and including the empty line.

        Return its head for the server behind the gate, without unneeded fields. Raise
        `RefusedError` if the client is not allowed.
        """
        target, fields = _parse(head)
        origin = fields.get("origin")
        if not is_numeric_host(self.bind, fields.get("host", "")):
            raise RefusedError("refused: the request used a host name; connect by IP address")
        if origin is not None and origin not in _ORIGINS | self.origins and not _is_local(origin):
            shown = origin[:_LONGEST]
            raise RefusedError(
                f"refused: a page of {shown}; if it is yours, allow it with --origin"
            )
        if not has_token(target, self.token):
            raise RefusedError("refused: the token is missing or wrong; copy the full address")
        handed_on = [
            f"{name}: {fields[name.lower()]}" for name in _HANDED_ON if name.lower() in fields
        ]
        lines = ["GET / HTTP/1.1", "Host: hearthlog", "Upgrade: websocket", "Connection: Upgrade"]
        return "\r\n".join([*lines, *handed_on, "", ""]).encode()


def _parse(head: bytes) -> tuple[str, Mapping[str, str]]:
    """Return the target, and the fields by lower-case name."""
    first, *lines = head.decode("latin-1").removesuffix("\r\n\r\n").split("\r\n")
    method, _, rest = first.partition(" ")
    target, _, version = rest.partition(" ")
    fields = [match.groups() for match in map(_FIELD.fullmatch, lines) if match]
    named = {name.lower(): value for name, value in fields}
    if method != "GET" or version != "HTTP/1.1" or len(named) != len(lines):
        raise RefusedError("refused: not a request of a viewer")
    return target, named


def _is_local(origin: str) -> bool:
    """Return whether a page is served by this machine."""
    address = ip_of(name := host_name(origin))
    is_here = name == "localhost" or (address is not None and address.is_loopback)
    return is_here and origin.startswith(("http://", "https://"))


_HEAD_SECONDS, _CLOSE_SECONDS = 5, 1
_LARGEST_HEAD = 16384  # bytes: includes the cookies of all servers of this machine
_MOST_PENDING, _MOST_VIEWERS = 32, 8  # maximum connections at once
_BLOCK = 1 << 16  # bytes
_BUFFER = 1 << 17  # maximum bytes buffered by the system: seconds of sound, not minutes
_REFUSAL = b"HTTP/1.1 403 Forbidden\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"
_GONE_SECONDS = 30  # timeout for a viewer that does not answer

Refused = Callable[[RefusedError], None]


class Gate:
    """Accepts connections in its own thread, and pipes the admitted ones.

    The number of pending requests is limited: a new one replaces the oldest of the address with the
    most of them, so that idle connections cannot block a client with the token.
    """

    def __init__(
        self,
        listener: socket.socket,
        behind: tuple[str, int],
        admission: Admission,
        refused: Refused,
    ) -> None:
        self._listener = listener
        self._behind = behind
        self._admission = admission
        self._refused = refused
        self._pending: dict[Task[None], str] = {}  # requests: address, the oldest first
        self._viewing: set[Task[None]] = set()
        self._loop = asyncio.new_event_loop()
        self._thread = Thread(target=self._run, name="gate", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        with self._listener:
            self._listener.setblocking(False)
            accepting = self._loop.create_task(self._accept())
            self._loop.run_forever()
            tasks = {accepting, *self._pending, *self._viewing}
            for task in tasks:
                task.cancel()
            self._loop.run_until_complete(asyncio.gather(*tasks, return_exceptions=True))
        self._loop.close()

    async def _accept(self) -> None:
        while True:
            try:
                connection, address = await self._loop.sock_accept(self._listener)
            except OSError:  # too many files are open, or the client was gone already
                await asyncio.sleep(1)
                continue
            if len(self._pending) >= _MOST_PENDING:
                oldest = busiest_address(self._pending)[0]
                del self._pending[oldest]
                oldest.cancel()
            task = self._loop.create_task(self._take(connection))
            self._pending[task] = address[0]
            task.add_done_callback(lambda task: self._pending.pop(task, None))
            task.add_done_callback(self._viewing.discard)

    async def _take(self, connection: socket.socket) -> None:
        """Serve a connection, from the request to the end."""
        _configure(connection)
        reader, writer = await asyncio.open_connection(sock=connection, limit=_LARGEST_HEAD)
        with suppress(OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            try:
                async with asyncio.timeout(_HEAD_SECONDS):
                    head = await reader.readuntil(b"\r\n\r\n")
                await self._lead_on(self._admitted(head), reader, writer)
            except RefusedError as error:
                self._refused(error)
                writer.write(_REFUSAL)
                await _close(writer)
            finally:
                writer.transport.abort()

    def _admitted(self, head: bytes) -> bytes:
        head = self._admission.check(head)
        if len(self._viewing) >= _MOST_VIEWERS:
            raise RefusedError(f"refused: {_MOST_VIEWERS} viewers are looking; close one")
        task = asyncio.current_task()
        assert task is not None
        self._viewing.add(task)
        self._pending.pop(task, None)
        return head

    async def _lead_on(self, head: bytes, reader: StreamReader, writer: StreamWriter) -> None:
        """Pipe between a viewer and the server, until one of them ends."""
        inner_reader, inner_writer = await asyncio.open_connection(*self._behind)
        _configure(inner_writer.get_extra_info("socket"))
        inner_writer.write(head)
        ways = (_pipe(reader, inner_writer), _pipe(inner_reader, writer))
        tasks = [self._loop.create_task(way) for way in ways]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in tasks:
                task.cancel()
            inner_writer.transport.abort()
            await asyncio.gather(*tasks, return_exceptions=True)
        await _close(writer)


async def _close(writer: StreamWriter) -> None:
    """End a connection after the last data is sent."""
    writer.close()
    async with asyncio.timeout(_CLOSE_SECONDS):
        await writer.wait_closed()


async def _pipe(reader: StreamReader, writer: StreamWriter) -> None:
    """Copy until one side ends; a slow reader blocks the writer, so nothing accumulates."""
    while block := await reader.read(_BLOCK):
        writer.write(block)
        await writer.drain()


def _configure(connection: socket.socket) -> None:
    """Buffer little for a slow viewer, and drop one that vanished, as a laptop that sleeps."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in (
        ("TCP_KEEPIDLE", _GONE_SECONDS),
        ("TCP_USER_TIMEOUT", _GONE_SECONDS * 1000),
    ):
        if hasattr(socket, option):  # not on all platforms
            connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)


PORT = 8765  # default port in Foxglove
_BACKLOG = 8192  # messages queued for a slow viewer, some megabytes; then the oldest are dropped


class _Listener(ServerListener):
    """Handles requests of viewers: missed descriptions, and playback control."""

    def __init__(self, publisher: Publisher, player: Playback | None) -> None:
        self._publisher = publisher
        self._player = player

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        del client  # only its number is available; messages go to all, so the others get it twice
        self._publisher.repeat(channel.id, channel.topic)

    def on_playback_control_request(
        self, playback_control_request: PlaybackControlRequest
    ) -> PlaybackState | None:
        return None if self._player is None else self._player.obey(playback_control_request)


@contextmanager
def serve(
    listener: socket.socket,
    admission: Admission,
    refused: Refused,
    publisher: Publisher,
    player: Playback | None = None,
) -> Iterator[WebSocketServer]:
    """Serve allowed viewers."""
    logging.getLogger("foxglove").addHandler(logging.NullHandler())  # it logs disconnects
    address = hidden_address()
    server = foxglove.start_server(
        name="hearthlog",
        host=address,
        port=0,
        capabilities=[] if player is None else [Capability.Time, Capability.PlaybackControl],
        playback_time_range=None if player is None else player.span,
        server_listener=_Listener(publisher, player),
        context=publisher.context,
        message_backlog_size=_BACKLOG,
    )
    try:
        with Gate(listener, (address, server.port), admission, refused):
            yield server
    finally:
        server.stop()
