"""Capture processes of microphones, and detection of a device's return."""

import fcntl
import json
import os
import select
import subprocess
import sys
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from threading import Event as Flag
from threading import Lock, Thread

import numpy as np

from hearthlog.recorder.addresses import is_topic
from hearthlog.recorder.host import module_command
from hearthlog.recorder.sources.capture import BLOCK, LATENCY_SECONDS, CaptureFormat, Device
from hearthlog.recorder.sources.framing import SampleBlock
from hearthlog.schemas.errors import DeviceError, SourceError

_CAPTURE = module_command("hearthlog.recorder.sources.capture")
_NETWORK_CAPTURE = module_command("hearthlog.recorder.sources.ffmpeg")
_TOPIC_CAPTURE = module_command("hearthlog.recorder.sources.topic_capture")
_HANGS = "PortAudio does not answer: unplug the microphone and connect it again"
_CRASHES = "PortAudio crashed: check ALSA's configuration"
_NO_ANSWER = "the capture process does not answer"
_PIPE_BYTES = 1 << 20  # 32 s of sound: the recorder's maximum delay
_START_SECONDS = 10.0
_NETWORK_START_SECONDS = 30.0  # the process ends by itself earlier
_LOOK_SECONDS = 0.25
_INPUT_OVERFLOW = 2  # paInputOverflow


def query_devices() -> list[Device]:
    """List the microphones, as `list_devices` does, in a child process.

    Raise `SourceError` if PortAudio is missing, cannot start, hangs or crashes.
    """
    try:
        answer = subprocess.run(  # noqa: S603  our own module
            _CAPTURE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            timeout=_START_SECONDS,
            check=False,
        ).stdout
    except subprocess.TimeoutExpired as error:
        raise SourceError(_HANGS) from error
    if not answer:
        raise SourceError(_CRASHES)
    devices = json.loads(answer)
    if "error" in devices:
        raise SourceError(devices["error"])
    return [Device(**device) for device in devices]


def check_ros() -> None:
    """Raise `SourceError` with an installation hint if this Python has no ROS 2."""
    if find_spec("rclpy") is None:
        raise SourceError(
            f"there is no rclpy for {sys.executable}, which reads ROS 2 topics: source "
            "/opt/ros/jazzy/setup.bash before the start, or that of your ROS 2; a virtual "
            "environment must be made by the Python of ROS, with --system-site-packages"
        )


class Capture:
    """One run of a capture process, with a known format, started within some `seconds`.

    `hangs` and `crashes` are the errors of a process that does not answer, or ends without a
    reason. Raise `DeviceError` if the device is missing, cannot be opened or has too few channels,
    or there is no sound, with the message of the capture process; if it hangs, or was stopped.
    Raise `SourceError` if PortAudio is missing, cannot start, or crashes.
    """

    def __init__(
        self,
        process: "subprocess.Popen[bytes]",
        seconds: float,
        stop: Flag,
        hangs: str,
        crashes: str,
    ) -> None:
        self._process = process
        assert process.stdout is not None
        self._pipe = process.stdout.fileno()
        fcntl.fcntl(self._pipe, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
        os.set_blocking(self._pipe, False)
        self._held = b""
        try:
            self.format = self._read_format(time.monotonic() + seconds, stop, hangs, crashes)
        except SourceError:
            self.kill()
            raise

    def blocks(self, timeout: float) -> list[SampleBlock] | None:
        """Return the blocks that have arrived, in order; None if the process has ended.

        It waits `timeout` seconds for the first block; there may be none. Raise `DeviceError` if
        the process has ended with a reason.
        """
        if not self._wait(timeout):
            return []
        data = self._read()
        if not data:
            self._ended()
            return None
        self._held += data
        blocks = []
        while len(self._held) >= BLOCK.size:
            head = BLOCK.unpack_from(self._held)
            end = BLOCK.size + 2 * head[1] * (self.format.channels or 1)
            if len(self._held) < end:
                break
            blocks.append(_block(head, self._held[BLOCK.size : end], self.format.channels))
            self._held = self._held[end:]
        return blocks

    def kill(self) -> None:
        """Kill the process, even if it hangs."""
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdout, self._process.stderr):
            if pipe is not None:
                pipe.close()

    def _ended(self) -> None:
        """Raise DeviceError if the process gave a reason for its end."""
        if self._process.stderr is not None:
            lines = self._process.stderr.read().decode(errors="replace").splitlines()
            if lines:
                raise DeviceError(lines[-1])

    def _read_format(self, deadline: float, stop: Flag, hangs: str, crashes: str) -> CaptureFormat:
        while b"\n" not in self._held:
            if not self._wait(_LOOK_SECONDS):
                if stop.is_set():
                    raise DeviceError("the recorder was stopped")
                if time.monotonic() > deadline:
                    raise DeviceError(hangs)
                continue
            data = self._read()
            if not data:
                self._ended()
                raise SourceError(crashes)
            self._held += data
        line, self._held = self._held.split(b"\n", 1)
        answer = json.loads(line)
        if "error" in answer:
            raise (DeviceError if answer["device"] else SourceError)(answer["error"])
        return CaptureFormat(**answer)

    def _wait(self, timeout: float) -> bool:
        return bool(select.select([self._pipe], [], [], max(timeout, 0.0))[0])

    def _read(self) -> bytes:
        return os.read(self._pipe, _PIPE_BYTES)


def open_device(
    device: str,
    *,
    exact: bool = False,
    channels: int | None = None,
    channel: int | None = None,
    latency: float = LATENCY_SECONDS,
) -> Capture:
    """Start to capture from a microphone of `hearthlog devices`, or the default one if empty.

    `channels` is that of an array; `channel`, from 1, selects one; by default the blocks have all
    of up to eight. `latency` is the length of PortAudio's buffer in seconds.
    """
    arguments = [device, str(channels or 0), str(channel or 0), str(latency)]
    arguments += ["exact"] if exact else []
    process = subprocess.Popen(  # noqa: S603  our own module
        [*_CAPTURE, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,  # PortAudio fills a disk when a device vanishes
        bufsize=0,
    )
    return Capture(process, _START_SECONDS, Flag(), _HANGS, _CRASHES)


def open_address(address: str, stop: Flag, channel: int | None = None) -> Capture:
    """Start to capture from a network microphone; `channel`, from 1, selects one.

    By default the blocks have all channels, for a topic the first one.
    """
    pipe = subprocess.PIPE
    process = subprocess.Popen(  # noqa: S603  our own modules
        [*(_TOPIC_CAPTURE if is_topic(address) else _NETWORK_CAPTURE), str(channel or 0)],
        stdin=pipe,
        stdout=pipe,
        stderr=pipe,
        bufsize=0,
    )
    assert process.stdin is not None
    process.stdin.write(address.encode())
    process.stdin.close()
    return Capture(process, _NETWORK_START_SECONDS, stop, _NO_ANSWER, _NO_ANSWER)


def _block(
    head: tuple[int, int, int, float, float], data: bytes, channels: int | None
) -> SampleBlock:
    index, _, flags, adc_time, arrival = head
    overflowed = bool(flags & _INPUT_OVERFLOW)
    samples = np.frombuffer(data, "<i2")
    if channels is not None:
        samples = samples.reshape(-1, channels)
    return SampleBlock(index, samples, overflowed, adc_time, arrival)


_CARDS = Path("/dev/snd")
_CARDS_SECONDS = 0.25


def cards_change(stop: Flag, seconds: float) -> bool:
    """Wait until a sound card comes or goes, or for a timeout; return whether one did."""
    cards, end = _sound_cards(), time.monotonic() + seconds
    while time.monotonic() < end and not stop.wait(min(_CARDS_SECONDS, seconds)):
        if _sound_cards() != cards:
            return True
    return False


def _sound_cards() -> int:
    """Return a value that changes with Linux's sound cards; 0 on other systems."""
    try:
        return _CARDS.stat().st_mtime_ns
    except OSError:
        return 0


_RETRY_SECONDS = 10.0


class ReturnWatch:
    """Opens a device as soon as it returns, in a thread, as opening may block."""

    def __init__(self, open_device: Callable[[Flag], Capture]) -> None:
        self._open = open_device
        self._stop = Flag()
        self._lock = Lock()
        self._capture: Capture | None = None
        Thread(target=self._run, name="return of a microphone", daemon=True).start()

    @property
    def is_there(self) -> bool:
        """Whether a capture is available."""
        return self._capture is not None

    def take(self) -> Capture | None:
        """Return the available capture, or None, and release it to the caller."""
        with self._lock:
            capture, self._capture = self._capture, None
        return capture

    def close(self) -> None:
        """Stop, and kill a capture that was not taken."""
        with self._lock:
            self._stop.set()
            if self._capture is not None:
                self._capture.kill()

    def _run(self) -> None:
        while not self._stop.is_set():
            cards_change(self._stop, _RETRY_SECONDS)
            try:
                capture = self._open(self._stop)
            except SourceError:
                continue
            with self._lock:
                if self._stop.is_set():
                    capture.kill()
                self._capture = capture
            return
