"""The recorder made a service: checked as the user that runs it, written, enabled and started."""

import json
import os
import pwd
import subprocess
import sys
from pathlib import Path
from typing import Any

from hearthlog.recorder.errors import ConfigurationError
from hearthlog.recorder.modules import module_command
from hearthlog.tools.service.errors import ServiceError
from hearthlog.tools.service.needs import STATE, Needs
from hearthlog.tools.service.unit import NAME, system_unit, user_unit
from hearthlog.tools.service.units import (
    SYSTEM_UNITS,
    Installed,
    check_program_seen,
    check_root,
    check_seen,
    is_systemd_running,
    is_user_manager_running,
    place_of,
    start_unit,
    user_units,
    verb_command,
    write_unit,
)

_REHEARSAL_SECONDS = 120


def install_for_system(account: str, config: Path | None) -> Installed:
    """Make the recorder a service of this machine, and start it, or start it anew.

    Raise `ConfigurationError` if the configuration is wrong. Raise `ServiceError` if it cannot
    be for another reason. Nothing was written then, unless it did not start.
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
    """Make the recorder a service of the user, in the current folder, and start it or again.

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
    """Ask what the recorder needs, as the user that will run it, without our variables."""
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
