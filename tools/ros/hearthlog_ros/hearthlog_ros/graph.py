"""What the nodes need of ROS: types by their names, qualities of service, and an end in order."""

import signal
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from importlib import import_module
from typing import Any

import rclpy
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.signals import SignalHandlerOptions

_FOREVER = 9_223_372_036  # seconds: how rosbag2 writes that there is no lifespan
_LOOK_SECONDS = 0.2
_CHECK_SECONDS = 2.0
_ARRIVAL_SECONDS = 0.5
_BUILD = "colcon build --base-paths tools/ros && source install/setup.bash"


class NodeError(Exception):
    """Something that the user of a node can mend; the message is one line that says how."""


def message_class(name: str) -> Any:
    """Return the class of messages of a type.

    Raise `NodeError` if no such messages are built here.
    """
    package, kind, message = name.split("/")
    try:
        return getattr(import_module(f"{package}.{kind}"), message)
    except (ImportError, AttributeError) as error:
        how = f"`{_BUILD}`" if package == "hearthlog_msgs" else f"install {package}"
        raise NodeError(f"no {name} here ({error}): {how}") from error


def offered_profile(offered: Mapping[str, Any]) -> QoSProfile:
    """Return the quality of service that a log says a topic was offered with."""
    lifespan = offered["lifespan"]
    latched = offered["durability"] == "transient_local"
    return QoSProfile(
        depth=offered["depth"],
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        lifespan=Duration(seconds=lifespan["sec"], nanoseconds=lifespan["nsec"])
        if lifespan["sec"] < _FOREVER
        else Duration(),
    )


class TypeChecks:
    """Compares, every two seconds, the types of all who use topics with those of hearthlog."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._hashes: dict[str, str] = {}
        self._reported: set[tuple[str, ...]] = set()
        node.create_timer(_CHECK_SECONDS, self._check)

    def expect(self, topic: str, type_hash: str) -> None:
        """Watch a topic.

        Parameters
        ----------
        type_hash : str
            Of the type that it has here, as REP-2016 writes it.
        """
        self._hashes[topic] = type_hash

    def _check(self) -> None:
        for topic, expected in list(self._hashes.items()):
            ends = [
                *self._node.get_publishers_info_by_topic(topic),
                *self._node.get_subscriptions_info_by_topic(topic),
            ]
            for end in ends:
                theirs = str(end.topic_type_hash)
                if theirs.startswith("RIHS01_") and theirs != expected:
                    self._report_mismatch(topic, end.node_name, end.topic_type, theirs, expected)

    def _report_mismatch(
        self, topic: str, node: str, name: str, theirs: str, expected: str
    ) -> None:
        if (topic, node, theirs) in self._reported:
            return
        self._reported.add((topic, node, theirs))
        self._node.get_logger().error(
            f"{topic}: node {node} has another {name} ({theirs[:15]}…, here {expected[:15]}…) and "
            f"understands nothing of it: build hearthlog_msgs there anew, from this hearthlog"
        )


def own_hash(node: Node, topic: str) -> str:
    """Return the hash of the type with which a node publishes to a topic; empty if unknown."""
    for end in node.get_publishers_info_by_topic(topic):
        if end.node_name == node.get_name() and end.node_namespace == node.get_namespace():
            return str(end.topic_type_hash)
    return ""


def wait_for_subscribers(publishers: Iterable[Any]) -> None:
    """Wait, half a second at most, until subscribers have all that was published."""
    until = time.monotonic() + _ARRIVAL_SECONDS
    for publisher in publishers:
        left = until - time.monotonic()
        if publisher is not None and left > 0:
            publisher.wait_for_all_acked(Duration(seconds=left))


def run(make_node: Callable[[], Any]) -> None:
    """Run a node until it is enough, Ctrl-C comes, or a request to end.

    Its method `look` does what there is to do, and returns whether to go on; `close` publishes what
    is left, and ends what was begun.

    The handlers of rclpy are not used: they end the context while others publish.
    """
    stopped = False

    def stop(*_: object) -> None:
        nonlocal stopped
        stopped = True

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    node = None
    try:
        _begin()
        node = make_node()
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        while not stopped and node.look():
            until = time.monotonic() + _LOOK_SECONDS
            while not stopped and (wait := until - time.monotonic()) > 0:
                executor.spin_once(timeout_sec=wait)
        node.close()
        executor.shutdown()
    except NodeError as error:
        sys.exit(f"hearthlog_ros: {error}")
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()


def _begin() -> None:
    try:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:  # such as of a ROS_DOMAIN_ID that is no number
        raise NodeError(str(error).partition(", at ")[0]) from error
