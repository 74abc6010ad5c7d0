"""Installation of the recorder or the bridge as a service: check, write, enable and start."""

import json
import os
import pwd
import subprocess
import sys
from pathlib import Path
from typing import Any

from hearthlog.analyzer.bridge.settings import BridgeSettings, load_bridge_settings
from hearthlog.recorder.errors import ConfigurationError
from hearthlog.recorder.host import module_command
from hearthlog.tools.service.unit import (
    BRIDGE_NAME,
    NAME,
    STATE,
    SYSTEM_UNITS,
    Installed,
    Needs,
    ServiceError,
    bridge_unit,
    check_program_seen,
    check_root,
    check_seen,
    is_systemd_running,
    is_user_manager_running,
    place_of,
    start_unit,
    system_unit,
    user_unit,
    user_units,
    verb_command,
    write_unit,
)

_REHEARSAL_SECONDS = 120


def install_for_system(account: str, config: Path | None) -> Installed:
    """Install the recorder as a system service, and start or restart it.

    Raise `ConfigurationError` if the configuration is invalid. Raise `ServiceError` for other
    failures. Nothing is written on failure, unless only the start failed.
    """
    check_root()
    unit = place_of(SYSTEM_UNITS, NAME)
    person = _person(account)
    config = None if config is None else config.absolute()
    check_program_seen()
    check_seen("the configuration", config)
    needs = _rehearse(STATE, config, person)
    check_seen("the folder of logs", Path(needs.output))
    for model in needs.models:
        check_seen("a model", Path(model))
    write_unit(unit, system_unit(verb_command("record", config), account, needs))
    return Installed(unit, start_unit(NAME, is_running=is_systemd_running()))


def install_for_user(config: Path | None) -> Installed:
    """Install the recorder as a user service in the current folder, and start or restart it.

    Raise `ConfigurationError, ServiceError` as `install_for_system`.
    """
    unit = place_of(user_units(), NAME)
    config = None if config is None else config.absolute()
    needs = _rehearse(Path.cwd(), config, None)
    write_unit(unit, user_unit(verb_command("record", config), Path.cwd(), needs))
    return Installed(unit, start_unit(NAME, "--user", is_running=is_user_manager_running()))


def _person(account: str) -> pwd.struct_passwd:
    try:
        return pwd.getpwnam(account)
    except KeyError as error:
        raise ServiceError(
            f"there is no user {account[:64]!r}; make one: "
            f"useradd --system --user-group --home-dir {STATE} {account[:64]}"
        ) from error


def _rehearse(folder: Path, config: Path | None, person: pwd.struct_passwd | None) -> Needs:
    """Determine the recorder's needs as the user that will run it, without our variables."""
    command = [*module_command("hearthlog.tools.service.rehearsal"), str(folder)]
    env = {name: value for name, value in os.environ.items() if not name.startswith("HEARTHLOG_")}
    as_whom: dict[str, Any] = {}
    if person is not None:
        groups = os.getgrouplist(person.pw_name, person.pw_gid)
        as_whom = {"user": person.pw_uid, "group": person.pw_gid, "extra_groups": groups}
    try:
        result = subprocess.run(  # noqa: S603  our own module
            [*command, *([] if config is None else [str(config)])],
            env=env,
            cwd="/",
            capture_output=True,
            text=True,
            timeout=_REHEARSAL_SECONDS,
            check=False,
            **as_whom,
        )
    except PermissionError as error:
        raise ServiceError(_cannot_run(person, str(error.strerror))) from error
    except subprocess.TimeoutExpired as error:
        raise ServiceError(_cannot_run(person, f"no answer in {_REHEARSAL_SECONDS} s")) from error
    if result.returncode:
        raise ServiceError(_cannot_run(person, (result.stderr.splitlines() or [""])[-1]))
    answer = json.loads(result.stdout)
    if "error" in answer:
        raise (ConfigurationError if answer["is_wrong_use"] else ServiceError)(answer["error"])
    return Needs(**answer)


def _cannot_run(person: pwd.struct_passwd | None, reason: str) -> str:
    name = "you" if person is None else person.pw_name
    return (
        f"{sys.prefix}: {name} cannot run hearthlog from there ({reason}); "
        "install it where everyone may read, as `sudo python3 -m venv /opt/hearthlog` does"
    )


RECORDER = "hearthlog"  # user of the recorder


def install_bridge(config: Path, account: str | None) -> Installed:
    """Install the bridge as a system service, and start or restart it.

    Parameters
    ----------
    account : str or None
        User that runs the bridge; by default a user of its own, which may read logs readable by the
        recorder's group, and write none.

    Raises
    ------
    ConfigurationError
        If the configuration is invalid.
    ServiceError
        For other failures. Nothing is written on failure, unless only the start failed.
    """
    check_root()
    unit = place_of(SYSTEM_UNITS, BRIDGE_NAME)
    config = config.absolute()
    check_program_seen()
    check_seen("the configuration", config)
    for name in [name for name in os.environ if name.startswith("HEARTHLOG_")]:
        del os.environ[name]  # the service will not have these variables
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
    """Check that the service sees its further input files; a relative name is a credential's."""
    tables = bridge.mqtt, bridge.page, bridge.delivery, bridge.prometheus, bridge.ping
    for table in (each for each in tables if each is not None):
        for key, path in table:
            if isinstance(path, Path) and path.is_absolute() and key != "text_file":  # an output
                check_seen(key, path)


def _check_person(account: str) -> None:
    try:
        pwd.getpwnam(account)
    except KeyError as error:
        raise ServiceError(f"there is no user {account[:64]!r}") from error
