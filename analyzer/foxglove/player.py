"""Plays a recording as viewers ask: at their speed, from any moment on."""

import math
import time
from collections.abc import Sequence
from contextlib import closing
from threading import Condition, Event

from foxglove.websocket import (
    PlaybackCommand,
    PlaybackControlRequest,
    PlaybackState,
    PlaybackStatus,
    WebSocketServer,
)

from hearthlog.analyzer.foxglove.publisher import Publisher
from hearthlog.analyzer.foxglove.recording import Recording
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.mcap.raw_messages import RawMessages, in_order_of_time

_SLOWEST, _FASTEST = 0.01, 100.0
_TICK_SECONDS = 0.05  # so often viewers are told the time
_IDLE_SECONDS = 0.2
# The answer to a seek empties the views: what is to be seen then must come after it. Many seeks
# follow each other while somebody drags the time, and only the last one is worth reading for.
_SETTLE_SECONDS = 0.1


class Player:
    """Publishes a recording; all viewers share one state of it."""

    def __init__(self, recording: Recording, publisher: Publisher, stop: Event) -> None:
        self._recording = recording
        self._publisher = publisher
        self._stop = stop
        self._changed = Condition()
        self._status = PlaybackStatus.Paused
        self._speed = 1.0
        self._position = recording.start  # at the moment `_since`
        self._since = time.monotonic()
        self._seeks = 0
        self._told = self._since  # when the viewers were told the time

    @property
    def span(self) -> tuple[int, int]:
        """Start and end of the recording, in nanoseconds of UTC."""
        return self._recording.start, self._recording.end

    def obey(self, request: PlaybackControlRequest) -> PlaybackState:
        """Do what a viewer asks for."""
        with self._changed:
            self._position, self._since = self._now(), time.monotonic()
            if math.isfinite(request.playback_speed):
                self._speed = min(max(request.playback_speed, _SLOWEST), _FASTEST)
            if request.seek_time is not None:
                wanted = max(request.seek_time, self._recording.start)
                self._position = min(wanted, self._recording.end)
                self._seeks += 1
                self._status = PlaybackStatus.Paused
            if self._status != PlaybackStatus.Ended:  # from there only a seek leads back
                plays = request.playback_command == PlaybackCommand.Play
                self._status = PlaybackStatus.Playing if plays else PlaybackStatus.Paused
            self._changed.notify()
            return self._state(did_seek=request.seek_time is not None)

    def play(self, server: WebSocketServer) -> None:
        """Publish what is to be seen, until `stop` is set."""
        while not self._stop.is_set():
            with self._changed:
                seeks, start = self._seeks, self._position
            if seeks:
                self._stop.wait(_SETTLE_SECONDS)
                if seeks != self._seeks:
                    continue
            for messages, row in self._recording.before(start):
                self._publisher.publish(messages, row)
            with closing(self._recording.messages(start)) as batches:
                played = all(self._publish(parts, server, seeks) for parts in batches)
            if played and self._wait_until(self._recording.end, server, seeks):
                self._end(server, seeks)

    def _publish(self, parts: Sequence[RawMessages], server: WebSocketServer, seeks: int) -> bool:
        """Publish messages at their times; tell whether nothing came in between."""
        for part, row in in_order_of_time(parts):
            if not self._wait_until(int(part.log_times[row]), server, seeks):
                return False
            self._publisher.publish(part, row)
        return True

    def _wait_until(self, moment: int, server: WebSocketServer, seeks: int) -> bool:
        """Wait until a moment is played; tell whether nothing came in between."""
        while True:
            with self._changed:
                if self._stop.is_set() or self._seeks != seeks:
                    return False
                now, is_playing = self._now(), self._status == PlaybackStatus.Playing
                is_there = now > moment or (is_playing and now == moment)
                if not is_there:
                    ahead = (moment - now) / NANOSECONDS / self._speed
                    self._changed.wait(min(ahead, _TICK_SECONDS) if is_playing else _IDLE_SECONDS)
            if is_playing and time.monotonic() - self._told >= _TICK_SECONDS:
                self._told = time.monotonic()
                server.broadcast_time(min(now, moment))
            if is_there:
                return True

    def _end(self, server: WebSocketServer, seeks: int) -> None:
        """Tell that all was played, and wait until a viewer goes back."""
        with self._changed:
            if self._seeks != seeks:
                return
            self._position, self._status = self._recording.end, PlaybackStatus.Ended
            state = self._state(did_seek=False)
        server.broadcast_playback_state(state)
        with self._changed:
            while self._seeks == seeks and not self._stop.is_set():
                self._changed.wait(_IDLE_SECONDS)

    def _now(self) -> int:
        """Return the log time that is played now."""
        if self._status != PlaybackStatus.Playing:
            return self._position
        elapsed = (time.monotonic() - self._since) * self._speed
        return min(self._position + round(elapsed * NANOSECONDS), self._recording.end)

    def _state(self, *, did_seek: bool) -> PlaybackState:
        return PlaybackState(self._status, self._position, self._speed, did_seek, None)
