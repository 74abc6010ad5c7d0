"""Publishers of growing and of recorded logs to Foxglove."""

import math
import time
from collections.abc import Callable, Collection, Generator, Sequence
from contextlib import closing, suppress
from pathlib import Path
from threading import Condition, Event

from foxglove import Channel, Context, Schema
from foxglove.websocket import (
    PlaybackCommand,
    PlaybackControlRequest,
    PlaybackState,
    PlaybackStatus,
    WebSocketServer,
)
from mcap import records

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.foxglove.layouts import ChannelType, channels_of
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.files import AUDIO_LAYER, log_name, time_span
from hearthlog.schemas.logs.follow import follow_messages
from hearthlog.schemas.logs.merged_reading import iterate_messages, time_spans
from hearthlog.schemas.mcap.raw_messages import RawMessages, in_order_of_time
from hearthlog.schemas.messages.message_types import STREAM_INFO


class Publisher:
    """Publishes messages, and repeats the last description of each stream on request."""

    def __init__(self) -> None:
        self.context = Context()
        self._channels: dict[str, Channel] = {}
        self._descriptions: dict[int, tuple[bytes, int]] = {}  # by channel number

    def advertise(self, channel: records.Channel, schema: records.Schema | None) -> bool:
        """Advertise a topic to viewers; again if its type grew."""
        advertised = self._channels.get(channel.topic)
        if advertised is not None:
            if _is_of(advertised, channel, schema):
                return False
            self._descriptions.pop(advertised.id(), None)
            advertised.close()
        of_sdk = None
        if schema is not None:
            of_sdk = Schema(name=schema.name, encoding=schema.encoding, data=schema.data)
        self._channels[channel.topic] = Channel(
            channel.topic,
            message_encoding=channel.message_encoding,
            schema=of_sdk,
            metadata=dict(channel.metadata),
            context=self.context,
        )
        return True

    def publish(self, messages: RawMessages, row: int) -> None:
        """Send a message to the subscribers of its topic."""
        self.advertise(messages.channel, messages.schema)
        channel = self._channels[messages.channel.topic]
        describes = messages.schema is not None and messages.schema.name == STREAM_INFO
        if describes or channel.has_sinks():
            payload, time = messages.payload(row), int(messages.log_times[row])
            if describes:  # first, so that a viewer that subscribes meanwhile gets it either way
                self._descriptions[channel.id()] = payload, time
            channel.log(payload, log_time=time)

    def repeat(self, number: int, topic: str) -> None:
        """Send the last description of a stream again, for a later subscriber."""
        last = self._descriptions.get(number)
        channel = self._channels.get(topic)
        if last is not None and channel is not None:
            channel.log(last[0], log_time=last[1])


def _is_of(advertised: Channel, channel: records.Channel, schema: records.Schema | None) -> bool:
    """Return whether an advertised channel has messages of this type."""
    theirs = advertised.schema()
    same = (theirs and (theirs.name, theirs.data)) == (schema and (schema.name, schema.data))
    return same and advertised.message_encoding == channel.message_encoding


_WINDOW = 3600 * NANOSECONDS  # logs of this span are read at once
_RECENT = NANOSECONDS  # messages this long before a moment are still shown at it

Damaged = Callable[[LogError], None]


class RecordedSpan:
    """Messages of logs between two times in ns of UTC, the end excluded; None for no limit.

    Raise `DataError` if there is no message between the two times.
    """

    def __init__(
        self, logs: Sequence[Path], start: int | None, end: int | None, damaged: Damaged
    ) -> None:
        self._damaged = damaged
        spans = [
            (first, last, path)
            for first, last, path in time_spans(logs, self._span)
            if (start is None or last >= start) and (end is None or first < end)
        ]
        if not spans:
            raise DataError("nothing was recorded in this time; `hearthlog info` lists what was")
        self.start = max(start or 0, spans[0][0])
        last_end = max(last for _, last, _ in spans) + 1
        self.end = last_end if end is None else min(end, last_end)
        self._spans = spans
        self._passed_over: set[Path] = set()
        self.channels: dict[str, ChannelType] = {}
        for _, _, path in spans:
            try:
                for channel, schema in channels_of(path):
                    self.channels.setdefault(channel.topic, (channel, schema))
            except LogError as error:
                damaged(error)

    def _span(self, log: Path) -> tuple[int, int] | None:
        try:
            return time_span(log)
        except LogError as error:
            self._damaged(error)
            return None

    def messages(self, start: int) -> Generator[list[RawMessages], None, None]:
        """Read the messages from a moment on; none is older than any yielded before."""
        while start < self.end:
            end = min(start + _WINDOW, self.end)
            yield from self._between(start, end)
            # Years may lie between two logs: a recorder without a clock begins in 1970.
            later = (max(first, end) for first, last, _ in self._spans if last >= end)
            start = min(later, default=self.end)

    def before(self, moment: int) -> list[tuple[RawMessages, int]]:
        """Read the state at a moment.

        It is the last description of each stream in the logs that contain the moment, and the last
        message of each topic in the second before, with their places.
        """
        latest: dict[str, tuple[RawMessages, int]] = {}
        topics = {
            topic
            for topic, (_, schema) in self.channels.items()
            if schema is not None and schema.name == STREAM_INFO
        }
        first = min((a for a, b, _ in self._spans if a < moment <= b), default=moment)
        descriptions = self._between(first, moment, topics)
        for batches in (descriptions, self._between(max(moment - _RECENT, 0), moment)):
            for batch in batches:
                latest |= {part.channel.topic: (part, len(part) - 1) for part in batch}
        return list(latest.values())

    def _between(
        self, start: int, end: int, topics: Collection[str] | None = None
    ) -> Generator[list[RawMessages], None, None]:
        """Read all logs together, except damaged ones."""
        spans = [path for a, b, path in self._spans if a < end and b >= start]
        logs = [path for path in spans if path not in self._passed_over]
        try:
            for batch in iterate_messages(logs, topics, start, end):
                start = 1 + max(int(part.log_times[-1]) for part in batch)
                yield batch
        except LogError as error:
            self._damaged(error)
            damaged = {path for path in logs if not _is_sound(path, start, end)}
            self._passed_over |= damaged
            if damaged:
                yield from self._between(start, end, topics)


def _is_sound(log: Path, start: int, end: int) -> bool:
    try:
        for _ in iterate_messages([log], None, start, end):
            pass
    except LogError:
        return False
    return True


_SUBSCRIBE_SECONDS = 0.5  # time for viewers to subscribe to a new topic before its first message
_CURRENT = ("", AUDIO_LAYER)  # layers of current sound; the others are about earlier sound


def publish_live(folder: Path, publisher: Publisher, stop: Event, damaged: Damaged) -> None:
    """Publish new messages of the logs in a folder; `damaged` gets errors of unreadable logs."""
    advertised: set[Path] = set()
    for path, parts in follow_messages(folder, stop=stop, damaged=damaged, infos=True):
        if log_name(path).layer in _CURRENT:
            if path not in advertised:
                advertised.add(path)
                if _advertise(path, publisher):
                    stop.wait(_SUBSCRIBE_SECONDS)
            for part, row in in_order_of_time(parts):
                publisher.publish(part, row)
        if stop.is_set():
            break


def _advertise(log: Path, publisher: Publisher) -> bool:
    """Advertise all topics of a log, also rarely used ones; return whether one is new."""
    with suppress(LogError):  # it is being renamed at this moment
        return sum(publisher.advertise(*channel) for channel in channels_of(log)) > 0
    return False


_SLOWEST, _FASTEST = 0.01, 100.0
_TICK_SECONDS = 0.05  # interval of time messages to viewers
_IDLE_SECONDS = 0.2
# The answer to a seek empties the views, so the current messages must come after it. Dragging
# the time causes many seeks, and only the last one is worth reading for.
_SETTLE_SECONDS = 0.1


class Playback:
    """Publishes a recording; all viewers share one playback state."""

    def __init__(self, recording: RecordedSpan, publisher: Publisher, stop: Event) -> None:
        self._recording = recording
        self._publisher = publisher
        self._stop = stop
        self._changed = Condition()
        self._status = PlaybackStatus.Paused
        self._speed = 1.0
        self._position = recording.start  # at the moment `_since`
        self._since = time.monotonic()
        self._seeks = 0
        self._last_sent = self._since  # last time message to viewers

    @property
    def span(self) -> tuple[int, int]:
        """Start and end of the recording, in nanoseconds of UTC."""
        return self._recording.start, self._recording.end

    def obey(self, request: PlaybackControlRequest) -> PlaybackState:
        """Apply a viewer's request."""
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
        """Publish the recording until `stop` is set."""
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
        """Publish messages at their times; return False after a seek or stop."""
        for part, row in in_order_of_time(parts):
            if not self._wait_until(int(part.log_times[row]), server, seeks):
                return False
            self._publisher.publish(part, row)
        return True

    def _wait_until(self, moment: int, server: WebSocketServer, seeks: int) -> bool:
        """Wait until a moment is played; return False after a seek or stop."""
        while True:
            with self._changed:
                if self._stop.is_set() or self._seeks != seeks:
                    return False
                now, is_playing = self._now(), self._status == PlaybackStatus.Playing
                is_there = now > moment or (is_playing and now == moment)
                if not is_there:
                    ahead = (moment - now) / NANOSECONDS / self._speed
                    self._changed.wait(min(ahead, _TICK_SECONDS) if is_playing else _IDLE_SECONDS)
            if is_playing and time.monotonic() - self._last_sent >= _TICK_SECONDS:
                self._last_sent = time.monotonic()
                server.broadcast_time(min(now, moment))
            if is_there:
                return True

    def _end(self, server: WebSocketServer, seeks: int) -> None:
        """Announce the end of the recording, and wait until a viewer seeks back."""
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
        """Return the current log time of the playback."""
        if self._status != PlaybackStatus.Playing:
            return self._position
        elapsed = (time.monotonic() - self._since) * self._speed
        return min(self._position + round(elapsed * NANOSECONDS), self._recording.end)

    def _state(self, *, did_seek: bool) -> PlaybackState:
        return PlaybackState(self._status, self._position, self._speed, did_seek, None)
