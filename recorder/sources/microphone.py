"""A microphone that is heard for years: its capture process, watched and started again."""

import fcntl
import itertools
import json
import math
import os
import select
import subprocess
import sys
import time
from collections.abc import Generator, Iterator
from threading import Event as Flag

import numpy as np

from recorder.errors import SourceError
from recorder.sources.capture import BLOCK, Format
from recorder.sources.devices import Device
from recorder.sources.framing import Block, Framer
from recorder.stream import Event, Frames, Gap, Health
from schemas.messages import NANOSECONDS

_CAPTURE = [sys.executable, "-m", "recorder.sources.capture"]
_HANGS = "PortAudio does not answer: unplug the microphone and connect it again"
_CRASHES = "PortAudio crashed: check ALSA's configuration"
_PIPE_BYTES = 1 << 20  # 32 s of sound: what the recorder may be late by
_START_SECONDS = 10.0
_FIRST_BLOCK_SECONDS = 5.0  # PulseAudio wakes a sleeping source
_STALE_SECONDS = 3.0
_RETRY_SECONDS = (0.5, 1.0, 2.0, 5.0, 10.0)
_HEALTH_SECONDS = 10.0
_LOOK_SECONDS = 0.25

_SILENT_FRAMES = 200  # ten seconds
_STEP_SECONDS = 0.25
_INPUT_OVERFLOW = 2  # paInputOverflow

OK, WARNING, ERROR = 0, 1, 2  # of diagnostic_msgs


def query_devices() -> list[Device]:
    """List the microphones.

    Raises
    ------
    SourceError
        If PortAudio is missing, cannot start, hangs or crashes.
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
    found = json.loads(answer)
    if "error" in found:
        raise SourceError(found["error"])
    return [Device(**device) for device in found]


class CaptureProcess:
    """One life of the capture process.

    Parameters
    ----------
    device : str
        As `hearthlog devices` lists it, or empty for the default one.

    Raises
    ------
    SourceError
        If the device cannot be opened, in the words of the capture process.
    """

    def __init__(self, device: str) -> None:
        self._process = subprocess.Popen(  # noqa: S603  our own module
            [*_CAPTURE, device],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,  # PortAudio fills a disk when a device vanishes
            bufsize=0,
        )
        assert self._process.stdout is not None
        self._pipe = self._process.stdout.fileno()
        fcntl.fcntl(self._pipe, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
        os.set_blocking(self._pipe, False)
        self._held = b""
        try:
            self.format = self._read_format()
        except SourceError:
            self.kill()
            raise

    def blocks(self, timeout: float) -> list[Block] | None:
        """Return the blocks that have come, after waiting for one; None if the process ended."""
        if not self._wait(timeout):
            return []
        data = self._read()
        if not data:
            return None
        self._held += data
        found = []
        while len(self._held) >= BLOCK.size:
            head = BLOCK.unpack_from(self._held)
            end = BLOCK.size + 2 * head[1]
            if len(self._held) < end:
                break
            found.append(_block(head, self._held[BLOCK.size : end]))
            self._held = self._held[end:]
        return found

    def kill(self) -> None:
        """End the process, however sick it is."""
        self._process.kill()
        self._process.wait()
        assert self._process.stdout is not None
        self._process.stdout.close()

    def _read_format(self) -> Format:
        deadline = time.monotonic() + _START_SECONDS
        while b"\n" not in self._held:
            if not self._wait(deadline - time.monotonic()):
                raise SourceError(_HANGS)
            data = self._read()
            if not data:
                raise SourceError(_CRASHES)
            self._held += data
        line, self._held = self._held.split(b"\n", 1)
        answer = json.loads(line)
        if "error" in answer:
            raise SourceError(answer["error"])
        return Format(**answer)

    def _wait(self, timeout: float) -> bool:
        return bool(select.select([self._pipe], [], [], max(timeout, 0.0))[0])

    def _read(self) -> bytes:
        return os.read(self._pipe, _PIPE_BYTES)


def _block(head: tuple[int, int, int, float, float], data: bytes) -> Block:
    index, _, flags, adc_time, arrival = head
    overflowed = bool(flags & _INPUT_OVERFLOW)
    return Block(index, np.frombuffer(data, "<i2"), overflowed, adc_time, arrival)


class MicrophoneSource:
    """One microphone, as one stream of frames.

    Raises
    ------
    SourceError
        If the microphone cannot be heard at the start; later it is waited for.
    """

    def __init__(self, device: str) -> None:
        self._wanted = device
        self._capture: CaptureProcess | None = CaptureProcess(device)
        self.device = self._capture.format.device
        self._framer = Framer()
        self._silent_frames = 0
        self._health = (OK, "starting")
        self._last_health = self._health
        self._reported = -math.inf
        self._wall_offset = _wall_offset()

    def events(self, stop: Flag) -> Iterator[Event]:
        """Hand on what is heard until `stop` is set, however often the microphone is lost."""
        reason = "the microphone was started"
        while not stop.is_set():
            if self._capture is None:
                yield from self._wait_for_device(stop)
            if self._capture is not None:
                reason = yield from self._one_life(self._capture, reason, stop)
                self.close()
                if stop.is_set():
                    return
                self._health = (ERROR, reason)
                yield from self._report(self._now())

    def close(self) -> None:
        """End the capture process."""
        if self._capture is not None:
            self._capture.kill()
            self._capture = None

    def _one_life(
        self, capture: CaptureProcess, reason: str, stop: Flag
    ) -> Generator[Event, None, str]:
        """Hand on what one capture process hears; return why it ended."""
        self._framer.begin(capture.format.rate, self._wall_offset, reason)
        heard = time.monotonic() + _FIRST_BLOCK_SECONDS - _STALE_SECONDS
        while not stop.is_set():
            blocks = capture.blocks(_LOOK_SECONDS)
            if blocks is None:
                return "the capture process ended"
            for block in blocks:
                heard = block.arrival
                for event in self._framer.add(block):
                    self._watch_silence(event)
                    yield event
            if time.monotonic() - heard > _STALE_SECONDS and not blocks:
                return "the microphone went silent"
            self._watch_clock()
            if blocks:  # its frames' time: now would be ahead of them
                yield from self._report(self._framer.last_stamp)
        return "the recorder was stopped"

    def _wait_for_device(self, stop: Flag) -> Iterator[Event]:
        for pause in itertools.chain(_RETRY_SECONDS, itertools.repeat(_RETRY_SECONDS[-1])):
            try:
                self._capture = CaptureProcess(self._wanted)
            except SourceError as error:
                self._health = (ERROR, str(error))
            else:
                return
            yield from self._report(self._now())
            if stop.wait(pause):
                return

    def _watch_silence(self, event: Frames | Gap) -> None:
        if isinstance(event, Gap):
            self._health = (WARNING, event.reason)
            return
        heard = np.flatnonzero(event.samples.any(axis=1))
        zeros = len(event.samples) - 1 - heard[-1] if len(heard) else len(event.samples)
        self._silent_frames = int(zeros) if len(heard) else self._silent_frames + int(zeros)
        if self._silent_frames >= _SILENT_FRAMES:
            self._health = (ERROR, "the microphone gives digital silence: is it muted or dead?")
        else:
            self._health = (OK, "listening")

    def _watch_clock(self) -> None:
        offset = _wall_offset()
        step = (offset - self._wall_offset) / NANOSECONDS
        if abs(step) > _STEP_SECONDS:
            self._wall_offset = offset
            self._framer.step_clock(offset, f"the clock was set by {step:+.3f} s")

    def _now(self) -> int:
        return time.monotonic_ns() + self._wall_offset

    def _report(self, stamp: int) -> Iterator[Health]:
        """Yield the state every ten seconds, and when it has changed."""
        now = time.monotonic()
        if self._health != self._last_health or now - self._reported >= _HEALTH_SECONDS:
            level, summary = self._last_health = self._health
            self._reported = now
            values = {"device": self.device, "clock_ppm": f"{self._framer.ppm:.1f}"}
            yield Health(stamp, level, summary, values)


def _wall_offset() -> int:
    """Return CLOCK_REALTIME less CLOCK_MONOTONIC in nanoseconds."""
    before = time.monotonic_ns()
    return time.time_ns() - (before + time.monotonic_ns()) // 2
