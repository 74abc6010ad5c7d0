"""A server of Foxglove's SDK behind a gate."""

import logging
import socket
from collections.abc import Iterator
from contextlib import contextmanager

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

from hearthlog.analyzer.foxglove.admission import Admission
from hearthlog.analyzer.foxglove.gate import Gate, Refused
from hearthlog.analyzer.foxglove.player import Player
from hearthlog.analyzer.foxglove.publisher import Publisher
from hearthlog.analyzer.ports import hidden_address

PORT = 8765  # where Foxglove looks for a server if it is not told
_BACKLOG = 8192  # messages that wait for a slow viewer, some megabytes; then the oldest are dropped


class _Listener(ServerListener):
    """Takes what viewers ask for: descriptions that they missed, and the time to play."""

    def __init__(self, publisher: Publisher, player: Player | None) -> None:
        self._publisher = publisher
        self._player = player

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        del client  # only its number is known, and messages go to all: the others get it twice
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
    player: Player | None = None,
) -> Iterator[WebSocketServer]:
    """Let viewers connect that may look."""
    logging.getLogger("foxglove").addHandler(logging.NullHandler())  # it tells who hung up
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
