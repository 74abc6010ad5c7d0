"""`hearthlog bridge`: what is heard, told to the systems of the home."""

import signal
from pathlib import Path
from threading import Event
from typing import Annotated

import typer

from hearthlog.tools.cli.text import tell, wrong_use


def bridge(
    logs: Annotated[
        Path | None,
        typer.Argument(
            help="Folder that the recorder writes to.",
            readable=False,
            show_default="that of the configuration",
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
    from hearthlog.analyzer.bridge.alerts.rule_doubts import rule_doubts
    from hearthlog.analyzer.bridge.home import Home
    from hearthlog.analyzer.bridge.outputs import exposed_files, needed_modules, open_outputs
    from hearthlog.analyzer.bridge.run import Bridge
    from hearthlog.analyzer.bridge.saying import Saying
    from hearthlog.analyzer.bridge.settings import configured_microphones, load_bridge_settings
    from hearthlog.analyzer.bridge.state_folder import state_folder
    from hearthlog.analyzer.extras import require
    from hearthlog.recorder.config import exposed_passwords
    from hearthlog.recorder.pause_schedule import time_zone

    settings, own = load_bridge_settings(config)
    if not own.has_outputs():
        where = "no --config is given" if config is None else f"{config} has no table of the bridge"
        wrong_use(
            f"{where}: `[bridge.page]` in one shows a page of the home; docs/bridge.md says how to "
            "tell others"
        )
    modules = needed_modules(own)
    if not (own.page or own.ping or any(modules.values())):
        lacking = [name for name, is_there in modules.items() if not is_there]
        require(*lacking)  # what else there is goes on without them
    stop = Event()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: stop.set())
    home = Home(logs or settings.output, settings.node, time_zone(settings.timezone))
    say = Saying(tell)
    state = state_folder(own.state, home.folder)
    for line in [*exposed_files(own, config, state), *exposed_passwords(settings, config)]:
        say(line)
    microphones = [] if logs else configured_microphones(settings)
    for line in rule_doubts(own.alert, settings, microphones):
        say(f"alerts: {line}")
    outputs, since = open_outputs(own, home, state, say)
    Bridge(home, since, outputs, say).run(stop)
