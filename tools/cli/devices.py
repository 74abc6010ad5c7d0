"""`hearthlog devices`: the microphones."""

import json
from dataclasses import asdict

import typer

from hearthlog.tools.cli.options import Json
from hearthlog.tools.cli.text import tell


def devices(*, as_json: Json = False) -> None:
    """List the microphones by the names that `hearthlog record --device` takes."""
    from hearthlog.recorder.sources.process import query_devices

    microphones = query_devices()
    if as_json:
        print(json.dumps([asdict(device) for device in microphones], indent=2))
        return
    for device in microphones:
        default = "  (default)" if device.is_default else ""
        place = "".join(f", {each}" for each in (device.port, device.serial) if each)
        rate = f"{device.default_rate:.0f} Hz"
        print(f"{device.name}  {device.channels} channels, {rate}{place}{default}")
    if not microphones:
        tell("no microphone found")
        raise typer.Exit(1)
