"""Sound devices, and the capture process: one microphone's sound on standard output.

PortAudio hangs inside the process when a device vanishes, so this process can be killed at any
moment. It imports only what PortAudio needs and computes nothing.
"""

import json
import os
import queue
import re
import signal
import struct
import sys
import time
from array import array
from collections import deque
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from math import ceil, inf
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from hearthlog.schemas.errors import DeviceError, SourceError
from hearthlog.schemas.frames import SAMPLE_RATE

_WINDOW_SAMPLES = 30 * SAMPLE_RATE  # longer than a recoverable stall of the network
_WINDOWS = 10  # five minutes, too short for a clock drift above the tolerance
_TOLERANCE_SECONDS = 1.0


class ArrivalPace:
    """Estimates the capture time of the first sample from the arrivals of sound.

    It is the earliest time that any arrival allows: sound can be late, but not early. `began` is
    the time of the connection, in seconds of CLOCK_MONOTONIC.
    """

    def __init__(self, began: float) -> None:
        self.count = 0
        self._began = began
        self._window = inf
        self._window_end = _WINDOW_SAMPLES
        self._windows: deque[float] = deque(maxlen=_WINDOWS)

    def add(self, count: int, arrival: float) -> None:
        """Add the arrival of `count` samples, in seconds of CLOCK_MONOTONIC."""
        self.count += count
        self._window = min(self._window, arrival - self.count / SAMPLE_RATE)

    def settle(self) -> tuple[int, float]:
        """Separate live sound from the buffered sound that a server sends first.

        Return the number of samples from before the connection, and the capture time of the last
        sample, in seconds of CLOCK_MONOTONIC.
        """
        start = self._window
        self._windows.append(start)
        older = ceil((self._began - start) * SAMPLE_RATE)
        return min(max(older, 0), self.count), start + self.count / SAMPLE_RATE

    def trouble(self) -> str:
        """Return the fault of a settled source; empty if there is none."""
        if self._window < min(self._windows) - _TOLERANCE_SECONDS:
            return "sends sound faster than real time; use the address of a live source"
        if self.count < self._window_end:
            return ""
        late = self._window - min(self._windows)
        self._windows.append(self._window)
        self._window = inf
        self._window_end = self.count + _WINDOW_SAMPLES
        return f"lost {late:.1f} s of sound on the way" if late > _TOLERANCE_SECONDS else ""


_CARDS = Path("/sys/class/sound")


class UsbPlace(NamedTuple):
    """USB location of a sound card."""

    # `usb:` with bus and ports, such as "usb:1-1.2"; stable over reboots for the same socket. Empty
    # for a card that is not on USB
    port: str = ""
    serial: str = ""  # `serial:` with the serial number; empty without one


def usb_place(card: int, cards: Path = _CARDS) -> UsbPlace:
    """Return the USB location of a sound card."""
    interface = (cards / f"card{card}" / "device").resolve()
    device = interface.parent  # parent of the sound card's interface
    try:
        (device / "idVendor").read_text()
    except OSError:
        return UsbPlace()
    try:
        serial = (device / "serial").read_text(errors="replace").strip()
    except OSError:
        serial = ""
    return UsbPlace(f"usb:{device.name}", f"serial:{serial}" if serial else "")


_NODES = Path("/dev/snd")
_NO_MICROPHONE = "no microphone found: connect one and check `hearthlog devices`"
_CARD_NUMBER = re.compile(r" ?\((?:hw|plughw):(\d+),\d+\)$")


@dataclass(frozen=True)
class Device:
    """A microphone that PortAudio can open."""

    index: int
    name: str  # name without the number of the sound card, which changes between starts
    channels: int
    default_rate: float  # in Hz
    is_default: bool
    port: str = ""
    serial: str = ""

    @property
    def identity(self) -> str:
        """Unique identity, stable over a reconnection."""
        return self.port if re.search(r" #\d+$", self.name) and self.port else self.name


def load_portaudio() -> ModuleType:
    """Import sounddevice; raise `SourceError` if PortAudio is missing or cannot start."""
    try:
        import sounddevice  # noqa: PLC0415  starting PortAudio may fail, and takes time
    except OSError as error:
        raise SourceError(
            "PortAudio is missing: install it (Debian: apt install libportaudio2)"
        ) from error
    except Exception as error:  # its own error class is not importable when its import fails
        raise SourceError(f"PortAudio cannot start ({error}): check ALSA's settings") from error
    return sounddevice


def list_devices(sounddevice: ModuleType) -> list[Device]:
    """List microphones in PortAudio's order; equal names become `<name> #1`, `<name> #2`."""
    default = sounddevice.default.device[0]
    devices = [
        _device(info, is_default=info["index"] == default)
        for info in sounddevice.query_devices()
        if info["max_input_channels"] > 0
    ]
    names = [device.name for device in devices]
    seen: dict[str, int] = {}
    numbered = []
    for device in devices:
        count = seen[device.name] = seen.get(device.name, 0) + 1
        name = device.name if names.count(device.name) == 1 else f"{device.name} #{count}"
        numbered.append(replace(device, name=name))
    return numbered


def find_device(devices: list[Device], name: str, *, exact: bool = False) -> Device:
    """Find a microphone by its name or part of it, in any case; empty for the default one.

    `name` may also be a port or serial number in the form of `UsbPlace`. Raise `DeviceError` with
    all names if there is no microphone, or none or several match.
    """
    if not devices:
        raise DeviceError(closed_card() or _NO_MICROPHONE)
    if not name:
        defaults = [device for device in devices if device.is_default]
        return (defaults or devices)[0]
    matching = [each for each in devices if name in {each.name, each.port, each.serial}]
    if not matching and not exact:
        matching = [device for device in devices if name.lower() in device.name.lower()]
    if len(matching) == 1:
        return matching[0]
    listed = ", ".join(repr(device.name) for device in devices)
    what = "no microphone" if not matching else "more than one microphone"
    raise DeviceError(f"{what} is called {name!r}; there are {listed}")


def closed_card(folder: Path = _NODES) -> str:
    """Return why sound cards cannot be opened by this account; empty if they can.

    ALSA leaves such cards out of its list, as if there were none.
    """
    for node in sorted(folder.glob("pcmC*D*c")):
        with suppress(OSError):
            if not os.access(node, os.R_OK | os.W_OK, effective_ids=True):
                group = node.stat().st_gid
                return (
                    f"this account may not open {node}: add it to the group {group}; in a "
                    f"container, set AUDIO_GROUP={group}"
                )
    return ""


def _device(info: dict[str, Any], *, is_default: bool) -> Device:
    card = _CARD_NUMBER.search(info["name"])
    place = usb_place(int(card[1])) if card else UsbPlace()
    return Device(
        index=info["index"],
        name=_CARD_NUMBER.sub("", info["name"]),
        channels=info["max_input_channels"],
        default_rate=info["default_samplerate"],
        is_default=is_default,
        port=place.port,
        serial=place.serial,
    )


# index of the first sample, samples per channel, PortAudio flags, ADC time of the first sample
# (s, on a clock of the driver's choice), current CLOCK_MONOTONIC (s)
BLOCK = struct.Struct("<QIIdd")

_PREFERRED_RATE = 16_000
BLOCK_SECONDS = 0.6  # each wake-up costs more than the samples it brings
LATENCY_SECONDS = 1.0  # PortAudio's buffer while this process does not run
LONG_LATENCY_SECONDS = 8.0  # for devices that deliver sound in long pieces
_MOST_CHANNELS = 8  # for selection; a sound server offers any number, and mixes them itself
_QUEUE_BLOCKS = 300  # three minutes, in addition to the pipe
_LEAST_QUEUE_BLOCKS = 60  # for blocks with many channels


@dataclass(frozen=True)
class CaptureFormat:
    """Origin, sample rate and timing of the blocks."""

    device: str
    identity: str  # of the device, to find it after a reconnection
    rate: int
    stale_seconds: float = 3.0  # without a block until the device counts as lost
    lost_reason: str = ""  # why samples are missing; empty: the recorder was too slow
    channels: int | None = None  # of the blocks; None: one, without a channel axis


def main() -> None:
    """Capture from the device named by the first argument, until killed or without a parent.

    Write one line of JSON, a `CaptureFormat` or an error, and then blocks: a `BLOCK` header and its
    samples (int16, interleaved if there are several channels). Without arguments, list the devices.
    Further arguments: the number of channels of an array, or 0; the selected channel, or 0; the
    latency in seconds; a fifth argument of any value requires an exact name.
    """
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # a logout is no reason to end
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the recorder decides when this ends
    output = os.fdopen(os.dup(1), "wb", buffering=0)
    os.dup2(2, 1)  # the sound libraries print to standard output
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
    # A stream of a disconnected device never closes.
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
        if not blocks.full():  # dropped blocks show in the next index
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
        output.write(head + _some_channels(samples, channels, wanted))  # one wake-up of the reader


def _open(
    sounddevice: ModuleType, device: Device, counts: list[int], latency: float, callback: Any
) -> tuple[Any, int, int]:
    """Open the device at 16 kHz, or at its own rate, with the first supported channel count."""
    reason = ""
    for rate in (_PREFERRED_RATE, int(device.default_rate)):
        for channels in dict.fromkeys(counts):
            try:
                stream = sounddevice.RawInputStream(
                    samplerate=rate,
                    blocksize=int(rate * min(BLOCK_SECONDS, latency)),
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
