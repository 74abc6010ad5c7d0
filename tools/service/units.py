"""Units of systemd: where they are, written, enabled and started."""

import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import hearthlog.recorder
from hearthlog.recorder.modules import module_command
from hearthlog.tools.service.errors import ServiceError
from hearthlog.tools.service.unit import is_ours

SYSTEM_UNITS = Path("/etc/systemd/system")
_UNSEEN = tuple(map(Path, ("/home", "/root", "/run/user", "/tmp", "/var/tmp")))  # noqa: S108
_SYSTEMD = Path("/run/systemd/system")  # is there as long as it runs


@dataclass(frozen=True)
class Installed:
    """A service that was installed."""

    unit: Path
    started: bool


def is_systemd_running() -> bool:
    """Tell whether this machine was started by systemd."""
    return _SYSTEMD.is_dir()


def user_units() -> Path:
    """Return the folder of the units of this user."""
    home = Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config")
    return home / "systemd" / "user"


def is_user_manager_running() -> bool:
    """Tell whether systemd runs for this user."""
    runtime = os.environ.get("XDG_RUNTIME_DIR", "")
    return bool(runtime) and Path(runtime, "systemd").is_dir()


def place_of(folder: Path, name: str) -> Path:
    """Return where a unit is to be, if it may be there.

    Raise `ServiceError` if there is another one, or no systemd.
    """
    if shutil.which("systemctl") is None:
        raise ServiceError(
            "systemd is not here; start `hearthlog record` by the supervisor that this machine has"
        )
    unit = folder / name
    if os.path.lexists(unit) and (unit.is_symlink() or not is_ours(unit.read_text("utf-8"))):
        raise ServiceError(f"{unit}: was not written by hearthlog; move it away")
    return unit


def check_seen(what: str, path: Path | None) -> None:
    """Check that a service of the machine sees a file.

    Raise `ServiceError` if it is where the service sees nothing.
    """
    if path is not None and any(path.is_relative_to(folder) for folder in _UNSEEN):
        raise ServiceError(
            f"{path}: {what} is in a folder that the service does not see, as no home and no /tmp; "
            "move it, to /opt, /etc or /srv, or install a service of your own with --user"
        )


def write_unit(unit: Path, text: str) -> None:
    """Write a unit, in place of the one that is there."""
    unit.parent.mkdir(parents=True, exist_ok=True)
    fresh = unit.with_name(f".{unit.name}.new")
    fresh.write_text(text, "utf-8")
    fresh.chmod(0o644)
    fresh.replace(unit)


def start_unit(name: str, *options: str, is_running: bool) -> bool:
    """Enable a service, and start it anew if systemd runs; return whether it does.

    Raise `ServiceError` if it does not start.
    """
    if not is_running:
        _systemctl(*options, "enable", name, env={"SYSTEMD_OFFLINE": "1"})
        return False
    _systemctl(*options, "daemon-reload")
    _systemctl(*options, "enable", name)
    try:
        _systemctl(*options, "restart", name)
    except ServiceError as error:
        raise ServiceError(
            f"{name} did not start; `journalctl {' '.join([*options, '-u'])} {name}` says why"
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


def check_root() -> None:
    """Check that a service of the machine may be installed.

    Raise `ServiceError` if somebody else than root asks for it.
    """
    if os.geteuid():
        raise ServiceError(
            "a service of the machine is installed by root: use sudo, or --user for one of your own"
        )


def check_program_seen() -> None:
    """Check that a service of the machine sees hearthlog and its Python.

    Raise `ServiceError` if one of them is where the service sees nothing.
    """
    check_seen("hearthlog", Path(hearthlog.recorder.__file__).resolve())
    check_seen("its Python", Path(sys.executable).absolute())
    check_seen("the Python of its environment", Path(sys.executable).resolve())


def verb_command(verb: str, config: Path | None) -> list[str]:
    """Return the command of a verb."""
    program = Path(sys.executable).with_name("hearthlog")
    command = [str(program)] if program.exists() else module_command("hearthlog.tools.cli.main")
    return [*command, verb, *([] if config is None else ["--config", str(config)])]
