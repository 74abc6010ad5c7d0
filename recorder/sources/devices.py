"""Microphones by names that survive a reboot."""

import re
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

from hearthlog.recorder.errors import DeviceError, SourceError
from hearthlog.recorder.sources.usb import UsbPlace, usb_place

_CARD_NUMBER = re.compile(r" ?\((?:hw|plughw):(\d+),\d+\)$")


@dataclass(frozen=True)
class Device:
    """A microphone that PortAudio can open.

    Attributes
    ----------
    name : str
        Name without the number of the sound card, which changes from one start to the next.
    default_rate : float
        In Hz.
    """

    index: int
    name: str
    channels: int
    default_rate: float
    is_default: bool
    port: str = ""
    serial: str = ""

    @property
    def identity(self) -> str:
        """What tells it from all others, now and when it is plugged in again."""
        return self.port if re.search(r" #\d+$", self.name) and self.port else self.name


def load_portaudio() -> ModuleType:
    """Import sounddevice, which looks for PortAudio and starts it.

    Raise `SourceError` if PortAudio is missing or cannot start.
    """
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
    """List the microphones.

    Returns
    -------
    list of Device
        In the order of PortAudio; several of one name are called `<name> #1`, `<name> #2`.
    """
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
    """Choose a microphone by its name.

    Parameters
    ----------
    name : str
        A name or a part of one, in which capitals make no difference; or a port or serial number,
        as `UsbPlace` has them; empty for the default microphone.

    Raises
    ------
    DeviceError
        If there is no microphone, or none or several match; then the message lists all of them.
    """
    if not devices:
        raise DeviceError("no microphone found: connect one and check `hearthlog devices`")
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
