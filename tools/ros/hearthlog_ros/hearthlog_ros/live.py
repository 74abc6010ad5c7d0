"""`ros2 run hearthlog_ros live`: what a recorder writes, on the graph, as the bytes of its log."""

import json
import time
from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path
from threading import Event, Thread
from typing import Any

from mcap.records import Channel
from rclpy.node import Node

from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.files import AUDIO_LAYER, log_name
from hearthlog.schemas.logs.follow import follow_messages
from hearthlog.schemas.mcap.raw_messages import RawMessages, in_order_of_time
from hearthlog_ros.graph import (
    NodeError,
    TypeChecks,
    message_class,
    offered_profile,
    own_hash,
    run,
    wait_for_subscribers,
)
from hearthlog_ros.pace import PublicationDelay

_DELAY_SECONDS = 1.5  # a block of sound, a new file, writing and reading, and a little more
_LOOK_SECONDS = 0.5  # for a folder that is not there yet
_FIND_SECONDS = 3.0  # of patience with subscribers that want another quality of service
_FIND_LOOK_SECONDS = 0.02
_SOUND_LAYERS = ("", AUDIO_LAYER)  # the others are about earlier sound
_EVERY_FRAME = ("/features", "/label")  # others are less frequent, and about earlier sound
_BEFORE = 10_000_000_000  # ns that a recorder's clock may be behind
_NANOSECONDS = 1_000_000_000


class Live(Node):
    """Publishes what a recorder writes to its logs, each message a little later than it speaks of.

    Parameters of the node: `folder`, of the logs; `topics`, patterns such as `/*/label`; `delay`,
    in seconds, at least, from the log time of a message to its publication, 0 for at once, in
    bursts.
    """

    def __init__(self) -> None:
        super().__init__("hearthlog_live")
        self._folder = Path(self.declare_parameter("folder", "logs").value)
        self._patterns = self.declare_parameter("topics", ["*"]).value
        delay = self.declare_parameter("delay", _DELAY_SECONDS).value
        if not 0 <= delay <= 60:
            raise NodeError(f"delay: from 0 to 60 seconds, not {delay:g}")
        self._pace = PublicationDelay(int(delay * _NANOSECONDS))
        self._stop = Event()
        self._error = ""
        self._publishers_of: dict[str, Any] = {}
        self._last_info: dict[str, bytes] = {}
        self._checks = TypeChecks(self)
        message_class("hearthlog_msgs/msg/AudioLabel")  # without it nothing makes sense
        self._thread = Thread(target=self._publish_all, name="publisher", daemon=True)
        self._thread.start()

    def look(self) -> bool:
        """Return whether to go on."""
        if self._error:
            raise NodeError(self._error)
        return not self._stop.is_set()

    def close(self) -> None:
        """End the publishing, once subscribers have what was published."""
        self._stop.set()
        self._thread.join()
        wait_for_subscribers(self._publishers_of.values())

    def _publish_all(self) -> None:
        try:
            for parts in self._batches():
                self._announce(parts)
                frames = [part for part in parts if part.channel.topic.endswith(_EVERY_FRAME)]
                if frames:
                    first = min(int(part.log_times[0]) for part in frames)
                    self._pace.add_block(first, time.time_ns())
                for part, row in in_order_of_time(parts):
                    wait = self._pace.wait(int(part.log_times[row]), time.time_ns())
                    if self._stop.wait(wait / _NANOSECONDS) if wait else self._stop.is_set():
                        return
                    self._publish(part, row)
        except LogError as error:
            self._error = str(error)
        except Exception as error:  # noqa: BLE001  whatever it is, the node ends and says so
            self._error = repr(error)

    def _announce(self, parts: list[RawMessages]) -> None:
        """Make publishers for topics that are new, and let those who want them find them."""
        new = []
        for part in parts:
            if part.channel.topic not in self._publishers_of:
                schema = "" if part.schema is None else part.schema.name
                publisher = self._publisher(part.channel, schema)
                self._publishers_of[part.channel.topic] = publisher
                new += [] if publisher is None else [publisher]
        deadline = time.monotonic() + _FIND_SECONDS
        while any(map(self._is_unfound, new)) and time.monotonic() < deadline:
            self._stop.wait(_FIND_LOOK_SECONDS)

    def _is_unfound(self, publisher: Any) -> bool:
        """Return whether a subscriber is not connected yet: what is published now it never gets."""
        found = publisher.get_subscription_count()
        return bool(found < self.count_subscribers(publisher.topic_name))

    def _batches(self) -> Iterator[list[RawMessages]]:
        """Follow the folder, once it is there."""
        # What is written before the folder is seen is news too; years of logs on a disk are not.
        start = None if self._folder.is_dir() else time.time_ns() - _BEFORE
        if start is not None:
            self.get_logger().warning(f"{self._folder} is not there yet; waiting for a recorder")
        while not self._folder.is_dir():
            if self._stop.wait(_LOOK_SECONDS):
                return
        report = self.get_logger().error
        followed = follow_messages(
            self._folder,
            start=start,
            stop=self._stop,
            damaged=lambda error: report(str(error)),
            infos=True,
        )
        for path, parts in followed:
            if log_name(path).layer in _SOUND_LAYERS:
                yield parts

    def _publish(self, part: RawMessages, row: int) -> None:
        topic = part.channel.topic
        publisher = self._publishers_of[topic]
        if publisher is None:
            return
        payload = part.payload(row)
        if topic.endswith("/info"):
            if self._last_info.get(topic) == payload:
                return
            self._last_info[topic] = payload
        publisher.publish(payload)

    def _publisher(self, channel: Channel, schema: str) -> Any:
        """Return a publisher for a channel of the log; None if it is not to be published."""
        topic = channel.topic
        if not any(fnmatch(topic, pattern) for pattern in self._patterns):
            return None
        try:
            offered = json.loads(channel.metadata["offered_qos_profiles"])[0]
            type_hash = channel.metadata["topic_type_hash"]
            publisher = self.create_publisher(
                message_class(schema), topic, offered_profile(offered)
            )
        except (KeyError, ValueError, TypeError) as error:
            self.get_logger().error(f"{topic}: no channel of a recorder ({error!r}); left out")
            return None
        except NodeError as error:
            self.get_logger().error(f"{topic}: left out: {error}")
            return None
        ours = own_hash(self, topic)
        if ours and ours != type_hash:
            self.get_logger().error(
                f"{topic}: left out: the log has {schema} {type_hash[:15]}…, here is {ours[:15]}…; "
                "build hearthlog_msgs from the hearthlog that records"
            )
            self.destroy_publisher(publisher)
            return None
        self._checks.expect(topic, type_hash)
        return publisher


def main() -> None:
    """Run the node."""
    run(Live)
