"""The capture process of a microphone in the network: what ffmpeg hears goes to standard output.

It writes what the one of a microphone at this machine writes, with arrival times only; why it ends
is the last line of standard error. The address comes on standard input, for arguments can be read
by all users of the machine.
"""

import fcntl
import json
import math
import os
import signal
import subprocess
import sys
import time
from array import array
from contextlib import suppress
from dataclasses import asdict
from typing import Any

from hearthlog.recorder.addresses import public_name
from hearthlog.recorder.errors import DeviceError
from hearthlog.recorder.sources.capture import BLOCK, BLOCK_SECONDS, CaptureFormat
from hearthlog.recorder.sources.ffmpeg import AU_HEADER, explain, start_ffmpeg
from hearthlog.recorder.sources.pace import Pace
from hearthlog.schemas.frames import SAMPLE_RATE

_STALE_SECONDS = 20.0  # of silence: this process ends by itself before
_PATIENCE_SECONDS = 15.0  # longer than ffmpeg's: a server may send something, but no sound
_SETTLE_SECONDS = 3.0  # in which a server has sent what it kept for its listeners
_PIPE_BYTES = 1 << 18  # 8 s of sound
_SAMPLE_BYTES = 2
_SAID_BYTES = 4000


def main() -> None:
    """Capture from the address on standard input, until killed or without a parent."""
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # a logout is no reason to end
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the recorder decides when this ends
    address = sys.stdin.read()
    try:
        sound = _Sound(address, int(sys.argv[1]) or None)
        _capture(sound, address, os.fdopen(1, "wb", buffering=0))
    except DeviceError as error:
        sys.exit(str(error))
    except BrokenPipeError:
        pass


class _Sound:
    """What ffmpeg gives, every 0.6 s: each wake-up costs more than the samples it brings."""

    def __init__(self, address: str, channel: int | None) -> None:
        self.began = self.arrival = time.monotonic()
        self._address = address
        self._channel = channel
        self._held = b""
        self._there = 0  # channels of the sound; 0 before its header
        self._process = start_ffmpeg(address)
        assert self._process.stdout is not None
        assert self._process.stderr is not None
        self._pipe, self._errors = self._process.stdout.fileno(), self._process.stderr.fileno()
        fcntl.fcntl(self._pipe, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
        for pipe in (self._pipe, self._errors):
            os.set_blocking(pipe, False)
        self._said = b""
        self._has_sounded = False
        self._parent = os.getppid()

    @property
    def channels(self) -> int:
        """How many the samples have, once some were read."""
        return self._there if self._channel is None else 1

    def read(self) -> bytes:
        """Wait for samples and return them; raise DeviceError if no more will come.

        Until the next call, `arrival` is when they came, in seconds of CLOCK_MONOTONIC.
        """
        while True:
            time.sleep(BLOCK_SECONDS)
            if os.getppid() != self._parent:
                sys.exit()
            self._listen()
            with suppress(BlockingIOError):
                data = os.read(self._pipe, _PIPE_BYTES)
                if not data:
                    raise DeviceError(self._reason())
                self._held += data
                if samples := self._take():
                    self.arrival, self._has_sounded = time.monotonic(), True
                    return samples
            if time.monotonic() - self.arrival > _PATIENCE_SECONDS:
                name = public_name(self._address)
                raise DeviceError(f"{name} has sent no sound for {_PATIENCE_SECONDS:.0f} s")

    def _take(self) -> bytes:
        """Return the samples that have come, as int16."""
        if not self._there:
            if len(self._held) < AU_HEADER.size:
                return b""
            _, place, _, _, _, channels = AU_HEADER.unpack_from(self._held)
            if len(self._held) < place:
                return b""
            self._held, self._there = self._held[place:], channels
            if self._channel is not None and self._channel > channels:
                from hearthlog.recorder.sources.channels import (  # noqa: PLC0415  no numpy else
                    missing_channel,
                )

                name = public_name(self._address)
                raise DeviceError(f"{name} {missing_channel(channels, self._channel)}")
        size = _SAMPLE_BYTES * self._there
        end = len(self._held) // size * size
        samples, self._held = array("h", self._held[:end]), self._held[end:]
        samples.byteswap()
        if self._channel is not None:
            samples = samples[self._channel - 1 :: self._there]
        return samples.tobytes()

    def _listen(self) -> None:
        with suppress(BlockingIOError):
            self._said = (self._said + os.read(self._errors, _PIPE_BYTES))[-_SAID_BYTES:]

    def _reason(self) -> str:
        if self._has_sounded:
            return f"{public_name(self._address)} has stopped sending"
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout=1.0)
        self._listen()
        return explain(self._address, self._said.decode(errors="replace"))


def _capture(sound: _Sound, address: str, output: Any) -> None:
    pace = Pace(sound.began)
    samples, arrival = _first_live(sound, pace)
    name = public_name(address)
    several = sound.channels if sound.channels > 1 else None
    answer = CaptureFormat(name, address, SAMPLE_RATE, _STALE_SECONDS, channels=several)
    output.write(json.dumps(asdict(answer)).encode() + b"\n")
    index, size = 0, _SAMPLE_BYTES * sound.channels
    while True:
        count = len(samples) // size
        output.write(BLOCK.pack(index, count, 0, math.inf, arrival))
        output.write(samples)
        index += count
        samples = sound.read()
        arrival = sound.arrival
        pace.add(len(samples) // size, arrival)
        trouble = pace.trouble()
        if trouble:
            raise DeviceError(f"{name} {trouble}")


def _first_live(sound: _Sound, pace: Pace) -> tuple[bytes, float]:
    """Return the first samples that are not older than the call, and when the last was taken."""
    held = b""
    settled = math.inf
    while sound.arrival < settled:
        samples = sound.read()
        settled = min(settled, sound.arrival + _SETTLE_SECONDS)
        size = _SAMPLE_BYTES * sound.channels
        pace.add(len(samples) // size, sound.arrival)
        most = math.ceil((sound.arrival - sound.began) * SAMPLE_RATE)
        held = (held + samples)[-most * size :]
    older, now = pace.settle()
    return held[len(held) - (pace.count - older) * size :], now


if __name__ == "__main__":
    main()
