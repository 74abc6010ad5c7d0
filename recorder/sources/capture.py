"""The capture process: reads one microphone and writes its sound to standard output.

PortAudio hangs inside the process when a device vanishes, so this process can be killed at any
moment. It imports no more than PortAudio needs and computes nothing.

It writes one line of JSON, a `CaptureFormat` or an error, and then blocks: a `BLOCK` header and
the samples that it announces (int16, interleaved if there are several channels).
"""

import json
import os
import queue
import signal
import struct
import sys
import time
from array import array
from dataclasses import asdict, dataclass
from types import ModuleType
from typing import Any

from hearthlog.recorder.errors import DeviceError, SourceError
from hearthlog.recorder.sources.devices import Device, find_device, list_devices, load_portaudio

# index of the first sample, samples of each channel, flags of PortAudio, time of the first sample
# by the ADC (s, on a clock of the driver's choice), now by CLOCK_MONOTONIC (s)
BLOCK = struct.Struct("<QIIdd")

_PREFERRED_RATE = 16_000
BLOCK_SECONDS = 0.6  # each wake-up costs more than the samples it brings
LATENCY_SECONDS = 1.0  # what PortAudio holds while this process does not run
LONG_LATENCY_SECONDS = 8.0  # for devices that give their sound in long pieces
_MOST_CHANNELS = 8  # to choose one of; a sound server offers any number, and mixes them itself
_QUEUE_BLOCKS = 300  # three minutes, beyond what the pipe holds
_LEAST_QUEUE_BLOCKS = 60  # where each has many channels


@dataclass(frozen=True)
class CaptureFormat:
    """Where the blocks come from, how many samples a second there are, and how steadily."""

    device: str
    identity: str  # of the device: what it is asked for by when it is plugged in again
    rate: int
    stale_seconds: float = 3.0  # without a block, after which none will come
    lost_reason: str = ""  # why samples are in no block; empty: the recorder was too slow
    channels: int | None = None  # of the blocks; None: one, and samples have no axis of channels


def main() -> None:
    """Capture from the device named by the first argument, until killed or without a parent.

    Without an argument, list the devices. The second one is the number of channels of an array, or
    0, the third one the channel to hear, or 0, the fourth one the latency in seconds. A fifth one:
    take no other device whose name contains this one.
    """
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # a logout is no reason to end
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the recorder decides when this ends
    output = os.fdopen(os.dup(1), "wb", buffering=0)
    os.dup2(2, 1)  # the sound libraries print as they like
    try:
        sounddevice = load_portaudio()
        devices = list_devices(sounddevice)
        if len(sys.argv) == 1:
            output.write(json.dumps([asdict(device) for device in devices]).encode())
        else:
            device = find_device(devices, sys.argv[1], exact=len(sys.argv) > 5)
            places, channel = (int(number) or None for number in sys.argv[2:4])
            _capture(sounddevice, device, places, channel, float(sys.argv[4]), output)
    except SourceError as error:
        answer = {"error": str(error), "device": isinstance(error, DeviceError)}
        output.write(json.dumps(answer).encode() + b"\n")
    except BrokenPipeError:
        pass
    # A stream of a device that is gone never closes.
    os._exit(0)


def _capture(  # noqa: PLR0913, PLR0917
    sounddevice: ModuleType,
    device: Device,
    places: int | None,
    channel: int | None,
    latency: float,
    output: Any,
) -> None:
    chooses = not channel and not places and 1 < device.channels <= _MOST_CHANNELS
    held = _QUEUE_BLOCKS // device.channels if chooses else _QUEUE_BLOCKS
    blocks: queue.Queue[tuple[bytes, bytes]] = queue.Queue(max(held, _LEAST_QUEUE_BLOCKS))
    index = 0

    def enqueue(samples: Any, count: int, times: Any, status: Any) -> None:
        nonlocal index
        head = BLOCK.pack(
            index,
            count,
            int(status._flags),  # noqa: SLF001  the only way to pass the flags on
            times.inputBufferAdcTime,
            time.monotonic(),
        )
        index += count
        if not blocks.full():  # what is dropped here shows in the next index
            blocks.put_nowait((head, bytes(samples)))

    _check_channels(device, places, channel)
    wanted = range(channel - 1, channel) if channel else range(places or 1)
    counts = [device.channels] if chooses else []
    stream, rate, channels = _open(
        sounddevice, device, [*counts, wanted.stop, device.channels], latency, enqueue
    )
    if chooses and channels > 1:
        wanted = range(channels)
    several = len(wanted) if places or len(wanted) > 1 else None
    stale = CaptureFormat.stale_seconds + latency - LATENCY_SECONDS
    answer = CaptureFormat(device.name, device.identity, rate, stale, channels=several)
    output.write(json.dumps(asdict(answer)).encode() + b"\n")
    stream.start()
    parent = os.getppid()
    while os.getppid() == parent:
        try:
            head, samples = blocks.get(timeout=1.0)
        except queue.Empty:
            continue
        output.write(head)
        output.write(_some_channels(samples, channels, wanted))


def _open(
    sounddevice: ModuleType, device: Device, counts: list[int], latency: float, callback: Any
) -> tuple[Any, int, int]:
    """Open the device at 16 kHz, or at its own rate, with the first number of channels it takes."""
    reason = ""
    for rate in (_PREFERRED_RATE, int(device.default_rate)):
        for channels in dict.fromkeys(counts):
            try:
                stream = sounddevice.RawInputStream(
                    samplerate=rate,
                    blocksize=int(rate * BLOCK_SECONDS),
                    device=device.index,
                    channels=channels,
                    dtype="int16",
                    latency=latency,
                    callback=callback,
                )
            except sounddevice.PortAudioError as error:
                reason = str(error)
            else:
                return stream, rate, channels
    raise DeviceError(f"microphone {device.name!r} cannot be opened ({reason})")


def _check_channels(device: Device, places: int | None, channel: int | None) -> None:
    """Raise SourceError if the device has too few channels."""
    there = device.channels
    has = f"microphone {device.name!r} has {there} channel{'s' if there > 1 else ''}"
    if places is not None and there < places:
        raise SourceError(
            f"{has}, and `array` names places for {places}: name one for each channel that it has"
        )
    if channel is not None and there < channel:
        raise SourceError(
            f"{has}, and `channel` asks for number {channel}: take one from 1 to {there}"
        )


def _some_channels(samples: bytes, channels: int, wanted: range) -> bytes:
    if wanted == range(channels):
        return samples
    every = array("h", samples)
    chosen = array("h", bytes(2 * len(wanted) * (len(every) // channels)))
    for place, channel in enumerate(wanted):
        chosen[place :: len(wanted)] = every[channel::channels]
    return chosen.tobytes()


if __name__ == "__main__":
    main()
