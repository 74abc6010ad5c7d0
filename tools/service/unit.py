"""Units of systemd: their text, where they are, written, enabled and started."""

import grp
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import hearthlog.recorder
from hearthlog.recorder.host import module_command
from hearthlog.schemas.errors import HearthlogError


class ServiceError(HearthlogError):
    """The recorder cannot be made a service, as it is asked for."""


STATE = Path("/var/lib/hearthlog")  # what systemd calls the state directory of the unit


@dataclass(frozen=True)
class Needs:
    """What a recorder needs by its configuration."""

    output: str
    models: list[str]
    has_network: bool
    readable_by: str


NAME, BRIDGE_NAME = "hearthlog.service", "hearthlog-bridge.service"
_STATE_MODES = {"owner": "0700", "group": "0750", "all": "0755"}
_NO_NETWORK = "RestrictAddressFamilies=AF_UNIX"
_NETWORK = "RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6"
_PLAIN = re.compile(r"[\w./-]+")
_SOUND_GROUP = "audio"  # whose members may open sound cards


def system_unit(command: Sequence[str], account: str, needs: Needs) -> str:
    """Return the unit of a service of the machine.

    Raise `ServiceError` if a name cannot stand in a unit.
    """
    has_state = Path(needs.output).is_relative_to(STATE)
    isolated = f"PrivateNetwork=yes\n{_NO_NETWORK}\nIPAddressDeny=any"
    return _filled(
        "system.service",
        command=_command(command),
        account=account,
        groups=f"SupplementaryGroups={_SOUND_GROUP}" if _has_sound_group() else "",
        folder=STATE,
        mode=_STATE_MODES[needs.readable_by],
        writable="" if has_state else f"ReadWritePaths={_word(needs.output)}",
        network=_NETWORK if needs.has_network else isolated,
    )


def user_unit(command: Sequence[str], folder: Path, needs: Needs) -> str:
    """Return the unit of a service of a user.

    Raise `ServiceError` if a name cannot stand in a unit.
    """
    return _filled(
        "user.service",
        command=_command(command),
        folder=_printable(folder).replace("%", "%%"),
        network=_NETWORK if needs.has_network else _NO_NETWORK,
    )


def bridge_unit(
    command: Sequence[str], account: str | None, recorder: str, logs: Path, written: Sequence[Path]
) -> str:
    """Return the unit of the bridge as a service of the machine.

    Parameters
    ----------
    account : str or None
        The user that it is run by; None for one that systemd makes for it.

    Raises
    ------
    ServiceError
        If a name cannot stand in a unit.
    """
    own = f"DynamicUser=yes\nSupplementaryGroups={recorder}"
    # A folder that is not there yet is waited for.
    access = [f"{'ReadOnlyPaths' if account is None else 'ReadWritePaths'}={_word(f'-{logs}')}"]
    access += [f"ReadWritePaths={_word(f'-{folder}')}" for folder in written]
    return _filled(
        "bridge.service",
        command=_command(command),
        who=own if account is None else f"User={account}",
        folder=STATE,
        access="\n".join(access),
    )


def is_ours(unit: str) -> bool:
    """Tell whether the text of a unit is one that was made here."""
    return unit.startswith(_template("system.service").partition("\n")[0])


def _filled(template: str, **values: object) -> str:
    text = _template(template)
    for name, value in values.items():
        text = text.replace(f"{{{name}}}\n", f"{value}\n" if value else "")
    return text


def _template(name: str) -> str:
    return files(__package__).joinpath(name).read_text("utf-8")


def _has_sound_group() -> bool:
    try:
        grp.getgrnam(_SOUND_GROUP)
    except KeyError:
        return False
    return True


def _command(words: Sequence[str]) -> str:
    """Return the command of a unit; systemd puts no variable into the path of its program."""
    literal = [_word(word).replace("$", "$$") for word in words]
    program = [_word(f"@{words[0]}")] if "$" in words[0] else []  # the next one is its argv[0]
    return " ".join([*program, *literal])


def _word(text: str | Path) -> str:
    """Return a word of a unit's line, in which no character has a meaning of its own."""
    escaped = _printable(text).replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%")
    return escaped if _PLAIN.fullmatch(escaped) else f'"{escaped}"'


def _printable(text: str | Path) -> str:
    text = str(text)
    if not text.isprintable():
        raise ServiceError(f"{text!r}: a unit of systemd cannot name it")
    return text


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
