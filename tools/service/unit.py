"""The text of the unit by which systemd starts the recorder."""

import grp
import re
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path

from hearthlog.tools.service.errors import ServiceError
from hearthlog.tools.service.needs import STATE, Needs

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
