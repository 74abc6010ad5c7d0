"""Microphones by names that survive a reboot."""

import re
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

from hearthlog.recorder.errors import DeviceError, SourceError

_CARD_NUMBER = re.compile(r" ?\((hw|plughw):\d+,\d+\)$")


@dataclass(frozen=True)
class Device:
    """A microphone that PortAudio can open.

    Attributes
    ----------
    index : int
        Number in PortAudio, valid only in this process.
    name : str
        Name without the number of the sound card, which changes from one start to the next.
    channels : int
    default_rate : float
        In Hz.
    is_default : bool
    """

    index: int
    name: str
    channels: int
    default_rate: float
    is_default: bool


def load_portaudio() -> ModuleType:
    """Import sounddevice, which looks for PortAudio and starts it.

    Raises
    ------
    SourceError
        If PortAudio is missing or cannot start.
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

    Parameters
    ----------
    sounddevice : module
        As `load_portaudio` returns it.

    Returns
    -------
    list of Device
        In the order of PortAudio; the second one of a name is called `<name> #2`, and so on.
    """
    default = sounddevice.default.device[0]
    devices = [
        _device(info, is_default=info["index"] == default)
        for info in sounddevice.query_devices()
        if info["max_input_channels"] > 0
    ]
    seen: dict[str, int] = {}
    numbered = []
    for device in devices:
        count = seen[device.name] = seen.get(device.name, 0) + 1
        name = device.name if count == 1 else f"{device.name} #{count}"
        numbered.append(replace(device, name=name))
    return numbered


def find_device(devices: list[Device], name: str, *, exact: bool = False) -> Device:
    """Choose a microphone by its name.

    Parameters
    ----------
    devices : list of Device
        All microphones, as `list_devices` gives them.
    name : str
        A name or a part of one, in which capitals make no difference; empty for the default
        microphone.
    exact : bool, optional
        Whether only a whole name will do.

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
    matching = [device for device in devices if device.name == name]
    if not matching and not exact:
        matching = [device for device in devices if name.lower() in device.name.lower()]
    if len(matching) == 1:
        return matching[0]
    listed = ", ".join(repr(device.name) for device in devices)
    what = "no microphone" if not matching else "more than one microphone"
    raise DeviceError(f"{what} is called {name!r}; there are {listed}")


def _device(info: dict[str, Any], *, is_default: bool) -> Device:
    return Device(
        index=info["index"],
        name=_CARD_NUMBER.sub("", info["name"]),
        channels=info["max_input_channels"],
        default_rate=info["default_samplerate"],
        is_default=is_default,
    )
