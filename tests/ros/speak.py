"""Runs where ROS is: publishes a sound file as a topic, in real time, once someone listens.

Arguments: the topic, its type, the file, milliseconds a message, and messages that are left out.
"""

import signal
import sys
import time
from importlib import import_module

import rclpy
import soundfile
from rclpy.signals import SignalHandlerOptions


def main():
    topic, name, path, milliseconds, *left_out = sys.argv[1:]
    stopped = []
    signal.signal(signal.SIGTERM, lambda *_: stopped.append(True))
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("robot")
    package, _, kind = name.split("/")
    module = import_module(f"{package}.msg")
    publisher = node.create_publisher(getattr(module, kind), topic, 10)
    while not publisher.get_subscription_count() and not stopped:
        rclpy.spin_once(node, timeout_sec=0.05)
    samples, rate = soundfile.read(path, dtype="int16", always_2d=True)
    count = rate * int(milliseconds) // 1000
    began = time.time()
    for number, first in enumerate(range(0, len(samples), count)):
        part = samples[first : first + count]
        time.sleep(max(began + (first + len(part)) / rate - time.time(), 0))
        if stopped:
            break
        if str(number) not in left_out:
            taken = began + first / rate
            publisher.publish(message(module, kind, part, rate, taken))
    while not stopped:
        rclpy.spin_once(node, timeout_sec=0.05)
    node.destroy_node()
    rclpy.shutdown()


def message(module, kind, part, rate, taken):
    filled = getattr(module, kind)()
    if kind == "String":
        return filled
    if kind == "RawAudio":
        filled.data, filled.format = part.tobytes(), "pcm-s16"
        filled.sample_rate, filled.number_of_channels = rate, part.shape[1]
        stamp = filled.timestamp
    elif kind == "AudioData":
        filled.data = part.tobytes()
        return filled
    else:
        filled.audio.data = part.tobytes()
        stamp = filled.header.stamp
    stamp.sec, stamp.nanosec = int(taken), int(taken % 1 * 1e9)
    return filled


if __name__ == "__main__":
    main()
