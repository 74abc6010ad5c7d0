"""`hearthlog devices`: the microphones."""

import json
from dataclasses import asdict
from typing import Annotated

import typer


def devices(
    *, as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False
) -> None:
    """List the microphones by the names that `hearthlog record --device` takes."""
    from hearthlog.recorder.sources.process import query_devices

    found = query_devices()
    if as_json:
        print(json.dumps([asdict(device) for device in found], indent=2))
        return
    for device in found:
        default = "  (default)" if device.is_default else ""
        print(f"{device.name}  {device.channels} channels, {device.default_rate:.0f} Hz{default}")
    if not found:
        typer.echo("hearthlog: no microphone found", err=True)
        raise typer.Exit(1)
