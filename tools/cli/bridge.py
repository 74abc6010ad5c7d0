"""`hearthlog bridge`: what is heard, told to the systems of the home."""

import signal
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Annotated

import typer

from hearthlog.tools.cli.text import TellOnce, wrong_use

if TYPE_CHECKING:
    from collections.abc import Callable

    from hearthlog.analyzer.bridge.output import Output
    from hearthlog.analyzer.bridge.settings import BridgeSettings


def bridge(
    logs: Annotated[
        Path | None,
        typer.Argument(
            help="Folder that the recorder writes to.", show_default="that of the configuration"
        ),
    ] = None,
    *,
    config: Annotated[
        Path | None,
        typer.Option(help="Configuration of the recorder, a TOML file with a table `bridge`."),
    ] = None,
) -> None:
    """Follow the log of a recorder, and tell a broker, Home Assistant and others what is heard.

    The recorder takes no notice: only its logs are read. What cannot be told is tried again.
    """
    from hearthlog.analyzer.bridge.run import Bridge
    from hearthlog.analyzer.bridge.settings import load_bridge_settings
    from hearthlog.recorder.timezone import time_zone

    settings, own = load_bridge_settings(config)
    stop = Event()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: stop.set())
    say = TellOnce()
    outputs = _outputs(own, settings.node, say)
    if not outputs:
        wrong_use("nobody is to be told anything: see docs/bridge.md for the table [bridge.mqtt]")
    folder = logs or settings.output
    Bridge(folder, settings.node, time_zone(settings.timezone), outputs, say).run(stop)


def _outputs(
    settings: "BridgeSettings", node: str, say: "Callable[[str], None]"
) -> dict[str, "Output"]:
    outputs: dict[str, Output] = {}
    if settings.mqtt is not None:
        from hearthlog.analyzer.bridge.mqtt.publisher import MqttPublisher

        outputs["mqtt"] = MqttPublisher(settings.mqtt, node, say)
    return outputs
