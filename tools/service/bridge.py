"""The bridge made a service of this machine."""

import os
import pwd
from pathlib import Path

from hearthlog.analyzer.bridge.settings import BridgeSettings, load_bridge_settings
from hearthlog.tools.service.errors import ServiceError
from hearthlog.tools.service.needs import STATE
from hearthlog.tools.service.unit import BRIDGE_NAME, bridge_unit
from hearthlog.tools.service.units import (
    SYSTEM_UNITS,
    Installed,
    check_program_seen,
    check_root,
    check_seen,
    is_systemd_running,
    place_of,
    start_unit,
    verb_command,
    write_unit,
)

RECORDER = "hearthlog"  # the user of the recorder


def install_bridge(config: Path, account: str | None) -> Installed:
    """Make the bridge a service of this machine, and start it, or start it anew.

    Parameters
    ----------
    account : str or None
        The user that it is run by; by default one of its own, who may read logs that the group of
        the recorder may read, and write none.

    Raises
    ------
    ConfigurationError
        If the configuration is wrong.
    ServiceError
        If it cannot be for another reason. Nothing was written then, unless it did not start.
    """
    check_root()
    unit = place_of(SYSTEM_UNITS, BRIDGE_NAME)
    config = config.absolute()
    check_program_seen()
    check_seen("the configuration", config)
    for name in [name for name in os.environ if name.startswith("HEARTHLOG_")]:
        del os.environ[name]  # the service will have none of them
    settings, bridge = load_bridge_settings(config)
    if not bridge.has_outputs():
        raise ServiceError(
            f"{config}: tells nobody anything; it has no table such as [bridge.mqtt]"
        )
    logs = STATE / settings.output
    check_seen("the folder of logs", logs)
    if account is None and settings.readable_by == "owner":
        raise ServiceError(
            f"{config}: the bridge has a user of its own, who may not read the logs; say there "
            f'readable_by = "group", or give it the user of the recorder: --account {RECORDER}'
        )
    _check_files(bridge)
    _check_person(account or RECORDER)
    figures = None if bridge.prometheus is None else bridge.prometheus.text_file
    written = [] if figures is None else [figures.absolute().parent]
    written += [] if bridge.state is None else [bridge.state.absolute()]
    text = bridge_unit(verb_command("bridge", config), account, RECORDER, logs, written)
    write_unit(unit, text)
    return Installed(unit, start_unit(BRIDGE_NAME, is_running=is_systemd_running()))


def _check_files(bridge: BridgeSettings) -> None:
    """Check that the service sees what it reads besides; a relative name is of a credential."""
    tables = bridge.mqtt, bridge.page, bridge.delivery, bridge.prometheus, bridge.ping
    for table in (each for each in tables if each is not None):
        for key, path in table:
            if isinstance(path, Path) and path.is_absolute() and key != "text_file":  # is written
                check_seen(key, path)


def _check_person(account: str) -> None:
    try:
        pwd.getpwnam(account)
    except KeyError as error:
        raise ServiceError(f"there is no user {account[:64]!r}") from error
