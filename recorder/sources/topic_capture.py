"""Capture process of a ROS 2 topic: the published sound goes to standard output.

Its output format is that of a local microphone; the last line of standard error is the reason for
its end. The address comes on standard input. It requires rclpy from a sourced ROS 2.
"""

import json
import math
import os
import signal
import sys
import time
from array import array
from collections.abc import Callable, Iterator
from dataclasses import asdict
from importlib import import_module
from typing import Any, NamedTuple

from hearthlog.recorder.addresses import TopicAddress, read_topic
from hearthlog.recorder.sources.capture import BLOCK, BLOCK_SECONDS, ArrivalPace, CaptureFormat
from hearthlog.schemas.errors import DeviceError, SourceError
from hearthlog.schemas.frames import SAMPLE_RATE

_FIND_SECONDS = 15.0  # timeout for a publisher and for sound
_LOOK_SECONDS = 0.2
_DEPTH = 100  # messages queued while this process does not run
_RATES = 8_000, 384_000
_MOST_CHANNELS = 64
_CLOCK_SECONDS = 2.0  # a stamp further from its arrival is on another clock
_LOSS_SECONDS = 0.1  # minimum distance of a stamp from the end of the previous sound
_STALE_SECONDS = 3.0
_SAMPLE_BYTES = 2


class _Sound(NamedTuple):
    """Samples of one message."""

    data: bytes  # int16, little-endian, interleaved
    rate: int
    channels: int
    stamp: float | None  # of the first one, in seconds of CLOCK_REALTIME


def main() -> None:
    """Capture from the address on standard input, until killed or without a parent."""
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # a logout is no reason to end
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the recorder decides when this ends
    output = os.fdopen(os.dup(1), "wb", buffering=0)
    os.dup2(2, 1)  # ROS prints to standard output
    try:
        _capture(sys.stdin.read(), int(sys.argv[1]) or 1, output)
    except SourceError as error:
        print(error, file=sys.stderr, flush=True)  # noqa: T201
    except BrokenPipeError:
        pass
    os._exit(0)  # rclpy may wait for others when it is shut down


def _capture(address: str, channel: int, output: Any) -> None:
    topic = read_topic(address)
    stream = _TopicStream(topic)
    sounds = stream.read()
    there = sounds[0].channels
    if there < channel:
        raise DeviceError(
            f"{topic.name} has {there} channels, and `channel` asks for number {channel}: take one "
            f"from 1 to {there}"
        )
    blocks = _Blocks(topic.name, channel, sounds[0], output)
    output.write(json.dumps(asdict(blocks.format(address))).encode() + b"\n")
    while True:
        arrival = time.monotonic()
        for run in blocks.split(sounds):
            blocks.write(run, arrival)
        sounds = stream.read()


class _Blocks:
    """Writes the sound of a topic as blocks of contiguous samples."""

    def __init__(self, name: str, channel: int, first: _Sound, output: Any) -> None:
        self._name = name
        self._channel = channel - 1
        self._output = output
        self._rate, self._channels = first.rate, first.channels
        self._stale = max(_STALE_SECONDS, 5 * self._seconds(first))
        self._index = 0
        self._last: _Sound | None = None
        self._pace = ArrivalPace(time.monotonic())

    def format(self, identity: str) -> CaptureFormat:
        """Return the format of the blocks."""
        lost = "messages with sound were lost on the way"
        return CaptureFormat(self._name, identity, self._rate, self._stale, lost)

    def split(self, sounds: list[_Sound]) -> Iterator[list[_Sound]]:
        """Yield runs of contiguous messages; count losses between them."""
        run: list[_Sound] = []
        for sound in sounds:
            lost = self._lost_before(sound)
            if lost and run:
                yield run
                run = []
            self._index += lost
            run.append(sound)
            self._last = sound
        yield run

    def write(self, run: list[_Sound], arrival: float) -> None:
        """Write contiguous messages as one block."""
        samples = b"".join(self._one_channel(sound) for sound in run)
        count = len(samples) // _SAMPLE_BYTES
        taken = _taken(run[0], arrival)
        self._output.write(BLOCK.pack(self._index, count, 0, taken, arrival))
        self._output.write(samples)
        self._index += count
        self._pace.add(round(count * SAMPLE_RATE / self._rate), arrival)
        if self._index == count:
            self._pace.settle()
        if math.isinf(taken) and (trouble := self._pace.trouble()):
            raise DeviceError(f"{self._name} {trouble}")

    def _seconds(self, sound: _Sound) -> float:
        return len(sound.data) / (_SAMPLE_BYTES * self._channels * self._rate)

    def _lost_before(self, sound: _Sound) -> int:
        """Return the number of samples missing before a message."""
        if self._last is None or self._last.stamp is None or sound.stamp is None:
            return 0
        seconds = sound.stamp - self._last.stamp - self._seconds(self._last)
        # A longer loss ends the capture; if this one goes on, a clock was set.
        return round(seconds * self._rate) if _LOSS_SECONDS < seconds < self._stale else 0

    def _one_channel(self, sound: _Sound) -> bytes:
        if (sound.rate, sound.channels) != (self._rate, self._channels):
            raise DeviceError(
                f"{self._name} changed from {self._rate} Hz and {self._channels} channels "
                f"to {sound.rate} Hz and {sound.channels}"
            )
        if self._channels == 1:
            return sound.data
        return array("h", sound.data)[self._channel :: self._channels].tobytes()


def _taken(sound: _Sound, arrival: float) -> float:
    """Return the capture time of the first sample, in seconds of CLOCK_MONOTONIC; inf: unknown."""
    if sound.stamp is None:
        return math.inf
    taken = sound.stamp - (time.time() - time.monotonic())
    return taken if abs(taken - arrival) < _CLOCK_SECONDS else math.inf


class _TopicStream:
    """Sound of a topic, read in blocks: a wake-up costs more than the samples."""

    def __init__(self, address: TopicAddress) -> None:
        self._address = address
        self._sounds: list[_Sound] = []
        self._error = ""
        self._parent = os.getppid()
        self._rclpy = _import_rclpy()
        self._rclpy.init(
            args=[], signal_handler_options=self._rclpy.signals.SignalHandlerOptions.NO
        )
        self._node = self._rclpy.create_node(f"hearthlog_capture_{os.getpid()}")
        self._executor = self._rclpy.executors.SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._until = time.monotonic() + _FIND_SECONDS
        self._subscribe()

    def read(self) -> list[_Sound]:
        """Wait for sound and return it; raise DeviceError if it cannot be read."""
        ready = time.monotonic() + BLOCK_SECONDS
        while not self._sounds or time.monotonic() < ready:
            self._spin()
            if self._error:
                raise DeviceError(self._error)
            if time.monotonic() > self._until:
                raise DeviceError(f"{self._address.topic} has a publisher, but no sound comes")
        self._until = math.inf
        sounds, self._sounds = self._sounds, []
        return sounds

    def _spin(self) -> None:
        if os.getppid() != self._parent:
            os._exit(0)
        self._executor.spin_once(timeout_sec=_LOOK_SECONDS)

    def _subscribe(self) -> None:
        kinds: dict[str, Callable[[Any], _Sound]] = {
            "foxglove_msgs/msg/RawAudio": self._raw_audio,
            "audio_common_msgs/msg/AudioData": self._audio_data,
            "audio_common_msgs/msg/AudioDataStamped": self._audio_stamped,
        }
        publisher = self._find_publisher()
        kind = publisher.topic_type
        if kind not in kinds:
            raise DeviceError(
                f"{self._address.topic} is {kind}, which is not audio; audio types are "
                f"{', '.join(kinds)}"
            )
        package, _, name = kind.split("/")
        try:
            message = getattr(import_module(f"{package}.msg"), name)
        except ImportError as error:
            raise DeviceError(
                f"{self._address.topic} is {kind}, which is not installed here: "
                f"apt install ros-$ROS_DISTRO-{package.replace('_', '-')}"
            ) from error
        qos = self._rclpy.qos
        profile = qos.QoSProfile(
            depth=_DEPTH, reliability=publisher.qos_profile.reliability
        )  # as offered: a stricter profile would receive nothing
        read = kinds[kind]
        self._node.create_subscription(
            message, self._address.topic, lambda message: self._take(read, message), profile
        )

    def _find_publisher(self) -> Any:
        while time.monotonic() < self._until:
            found = self._node.get_publishers_info_by_topic(self._address.topic)
            if found:
                return found[0]
            self._spin()
        domain = os.environ.get("ROS_DOMAIN_ID", "0")
        raise DeviceError(
            f"nobody publishes {self._address.topic} in domain {domain}; is its node running?"
        )

    def _take(self, read: Callable[[Any], _Sound], message: Any) -> None:
        try:
            self._sounds.append(_checked(read(message)))
        except ValueError as error:
            self._error = f"{self._address.topic} {error}"

    def _raw_audio(self, message: Any) -> _Sound:
        if message.format != "pcm-s16":
            raise ValueError(f"has sound as {message.format[:16]!r}; only pcm-s16 is taken")
        return _Sound(
            bytes(message.data),
            message.sample_rate,
            message.number_of_channels,
            _seconds(message.timestamp),
        )

    def _audio_data(self, message: Any) -> _Sound:
        return _Sound(bytes(message.data), self._address.rate, self._address.channels, None)

    def _audio_stamped(self, message: Any) -> _Sound:
        return self._audio_data(message.audio)._replace(stamp=_seconds(message.header.stamp))


def _checked(sound: _Sound) -> _Sound:
    least, most = _RATES
    if not least <= sound.rate <= most or not 1 <= sound.channels <= _MOST_CHANNELS:
        raise ValueError(f"claims {sound.rate} Hz and {sound.channels} channels")
    if len(sound.data) % (_SAMPLE_BYTES * sound.channels):
        raise ValueError(
            f"has messages of {len(sound.data)} bytes: not int16 samples of {sound.channels} "
            "channels; an encoder such as mp3 must be switched off there"
        )
    return sound


def _seconds(stamp: Any) -> float:
    return stamp.sec + stamp.nanosec / 1e9


def _import_rclpy() -> Any:
    rclpy = import_module("rclpy")
    for part in ("executors", "qos", "signals"):
        import_module(f"rclpy.{part}")
    return rclpy


if __name__ == "__main__":
    main()
