"""`hearthlog install-service`: the recorder as a service of systemd."""

import getpass
from pathlib import Path
from typing import Annotated

import typer

from hearthlog.tools.cli.text import tell, wrong_use

_LINGER = Path("/var/lib/systemd/linger")


def install_service(
    *,
    user: Annotated[
        bool,
        typer.Option("--user", help="A service of your own, which records in the current folder."),
    ] = False,
    config: Annotated[
        Path | None, typer.Option(help="Configuration of the recorder, a TOML file.")
    ] = None,
    account: Annotated[
        str | None,
        typer.Option(
            help="User that runs the service of the machine.",
            show_default="hearthlog; for the bridge one of its own",
        ),
    ] = None,
    bridge: Annotated[
        bool,
        typer.Option("--bridge", help="Instead of the recorder, the bridge that follows its log."),
    ] = False,
) -> None:
    """Make the recorder, or the bridge, a service of systemd: now, at every boot, after upgrades.

    It is checked first what the service will find. Given again it writes the unit anew, and starts
    the recorder again: the log is completed, and the next one says in a gap what was not heard.
    """
    from hearthlog.tools.service.install import install_for_system, install_for_user

    if user and (bridge or account is not None):
        wrong_use("--account and --bridge are of the service of the machine; --user runs as you")
    if bridge:
        _install_bridge(config, account)
        return
    if user:
        installed = install_for_user(config)
    else:
        installed = install_for_system(account or "hearthlog", config)
    print(installed.unit)
    manager = "systemctl --user" if user else "systemctl"
    if installed.started:
        tell(f"it records: `{manager} status hearthlog` says how it is")
    else:
        tell("it is enabled, and starts when systemd does")
    if user and not (_LINGER / getpass.getuser()).exists():
        tell("it ends when you log out; to let it run on: loginctl enable-linger")


def _install_bridge(config: Path | None, account: str | None) -> None:
    from hearthlog.tools.service.install import install_bridge

    if config is None:
        wrong_use("--bridge wants --config, with a table such as [bridge.mqtt]")
    installed = install_bridge(config, account)
    print(installed.unit)
    if installed.started:
        tell("it runs: `systemctl status hearthlog-bridge` says how it is")
    else:
        tell("it is enabled, and starts when systemd does")
