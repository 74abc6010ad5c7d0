"""The recorder made a service: checked as the user that runs it, written, enabled and started."""

import json
import os
import pwd
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hearthlog.recorder
from hearthlog.recorder.errors import ConfigurationError
from hearthlog.recorder.modules import module_command
from hearthlog.tools.service.errors import ServiceError
from hearthlog.tools.service.needs import STATE, Needs
from hearthlog.tools.service.unit import NAME, is_ours, system_unit, user_unit

_UNSEEN = tuple(map(Path, ("/home", "/root", "/run/user", "/tmp", "/var/tmp")))  # noqa: S108
_SYSTEMD = Path("/run/systemd/system")  # is there as long as it runs
_REHEARSAL_SECONDS = 120


@dataclass(frozen=True)
class Installed:
    """A service that was installed.

    Attributes
    ----------
    unit : Path
        Its unit.
    started : bool
        Whether it runs, or will only when systemd does.
    """

    unit: Path
    started: bool


def install_for_system(account: str, config: Path | None) -> Installed:
    """Make the recorder a service of this machine, and start it, or start it anew.

    Parameters
    ----------
    account : str
        The user that it is run by.
    config : Path or None
        Its configuration.

    Raises
    ------
    ConfigurationError
        If the configuration is wrong.
    ServiceError
        If it cannot be for another reason. Nothing was written then, unless it did not start.
    """
    if os.geteuid():
        raise ServiceError(
            "a service of the machine is installed by root: use sudo, or --user for one of your own"
        )
    unit = _place_of(Path("/etc/systemd/system"))
    person = _person(account)
    config = None if config is None else config.absolute()
    _check_seen("hearthlog", Path(hearthlog.recorder.__file__).resolve())
    _check_seen("its Python", Path(sys.executable).absolute())
    _check_seen("the Python of its environment", Path(sys.executable).resolve())
    _check_seen("the configuration", config)
    needs = _rehearse(STATE, config, person)
    _check_seen("the folder of logs", Path(needs.output))
    for model in needs.models:
        _check_seen("a model", Path(model))
    _write(unit, system_unit(_command(config), account, needs))
    return Installed(unit, _start(is_running=_SYSTEMD.is_dir()))


def install_for_user(config: Path | None) -> Installed:
    """Make the recorder a service of the user, in the current folder, and start it or again.

    Parameters
    ----------
    config : Path or None
        Its configuration.

    Raises
    ------
    ConfigurationError, ServiceError
        As `install_for_system`.
    """
    home = Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config")
    unit = _place_of(home / "systemd" / "user")
    config = None if config is None else config.absolute()
    needs = _rehearse(Path.cwd(), config, None)
    _write(unit, user_unit(_command(config), Path.cwd(), needs))
    runtime = os.environ.get("XDG_RUNTIME_DIR", "")
    is_running = bool(runtime) and Path(runtime, "systemd").is_dir()
    return Installed(unit, _start("--user", is_running=is_running))


def _place_of(folder: Path) -> Path:
    """Return where the unit is to be, if it may be there."""
    if shutil.which("systemctl") is None:
        raise ServiceError(
            "systemd is not here; start `hearthlog record` by the supervisor that this machine has"
        )
    unit = folder / NAME
    if os.path.lexists(unit) and (unit.is_symlink() or not is_ours(unit.read_text("utf-8"))):
        raise ServiceError(f"{unit}: was not written by hearthlog; move it away")
    return unit


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


def _check_seen(what: str, path: Path | None) -> None:
    if path is not None and any(path.is_relative_to(folder) for folder in _UNSEEN):
        raise ServiceError(
            f"{path}: {what} is in a folder that the service does not see, as no home and no /tmp; "
            "move it, to /opt, /etc or /srv, or install a service of your own with --user"
        )


def _command(config: Path | None) -> list[str]:
    program = Path(sys.executable).with_name("hearthlog")
    command = [str(program)] if program.exists() else module_command("hearthlog.tools.cli.main")
    return [*command, "record", *([] if config is None else ["--config", str(config)])]


def _write(unit: Path, text: str) -> None:
    unit.parent.mkdir(parents=True, exist_ok=True)
    fresh = unit.with_name(f".{unit.name}.new")
    fresh.write_text(text, "utf-8")
    fresh.chmod(0o644)
    fresh.replace(unit)


def _start(*options: str, is_running: bool) -> bool:
    """Enable the service, and start it anew if systemd runs; return whether it does."""
    if not is_running:
        _systemctl(*options, "enable", NAME, env={"SYSTEMD_OFFLINE": "1"})
        return False
    _systemctl(*options, "daemon-reload")
    _systemctl(*options, "enable", NAME)
    try:
        _systemctl(*options, "restart", NAME)
    except ServiceError as error:
        raise ServiceError(
            f"{NAME} did not start; `journalctl {' '.join([*options, '-u'])} {NAME}` says why"
        ) from error
    return True


def _systemctl(*arguments: str, env: dict[str, str] | None = None) -> None:
    result = subprocess.run(  # noqa: S603
        ["systemctl", *arguments],  # noqa: S607  of the system
        env=os.environ | (env or {}),
        capture_output=True,
        text=True,
        check=False,
    )
    if result.returncode:
        said = " ".join(result.stderr.split()) or f"status {result.returncode}"
        raise ServiceError(f"systemctl {' '.join(arguments)}: {said}")
