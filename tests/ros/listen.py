"""Runs where ROS is: writes what arrives on topics to a file until it is asked to end.

Arguments: the file, the depth of the subscriptions (sensor for that of sensors), and pairs of
topics and types. One line of JSON a message: topic, monotonic arrival, wall arrival, type's hash,
and the message as it came, in hex.
"""

import json
import signal
import sys
import time
from importlib import import_module
from pathlib import Path

import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rclpy.signals import SignalHandlerOptions

LATCHED = ("/info", "/rosout", "_info")


def main():
    output, depth, *names = sys.argv[1:]
    stopped = []
    signal.signal(signal.SIGTERM, lambda *_: stopped.append(True))
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("listener")
    out = Path(output).open("w", buffering=1)  # noqa: SIM115
    for topic, name in zip(names[::2], names[1::2], strict=True):

        def take(raw, topic=topic):
            row = [topic, time.monotonic(), time.time(), bytes(raw).hex()]
            out.write(json.dumps(row) + "\n")

        package, kind, message = name.split("/")
        latched = topic.endswith(LATCHED)
        profile = QoSProfile(
            depth=1000,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        )
        if depth == "sensor" and not latched:
            profile = qos_profile_sensor_data
        node.create_subscription(
            getattr(import_module(f"{package}.{kind}"), message), topic, take, profile, raw=True
        )
    is_labelled = any(topic.endswith("label_info") for topic in names[::2])
    awaited = "hearthlog_label" if is_labelled else "hearthlog"  # else the first frames pass it by
    while not [name for name in node.get_node_names() if name.startswith(awaited)]:
        time.sleep(0.1)
    time.sleep(1.0)  # ten announcements of discovery.xml: all participants know each other
    print("listening", flush=True)
    while not stopped:
        rclpy.spin_once(node, timeout_sec=0.1)
    hashes = {
        topic: [
            [str(end.topic_type_hash), str(end.qos_profile.durability), end.qos_profile.depth]
            for end in node.get_publishers_info_by_topic(topic)
        ]
        for topic in names[::2]
    }
    print(json.dumps(hashes), flush=True)
    out.close()
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
