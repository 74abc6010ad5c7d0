"""The time zone of a home."""

import os
from datetime import UTC, tzinfo
from pathlib import Path
from zoneinfo import ZoneInfo

from hearthlog.schemas.errors import LogError

DEFAULT = "UTC"
_NAME_FILE = Path("/etc/timezone")
_LINK = Path("/etc/localtime")
_DATABASE = "zoneinfo/"


def time_zone(name: str) -> tzinfo:
    """Return a time zone by its name.

    Parameters
    ----------
    name : str
        As in the IANA database, such as "Europe/Berlin", or "UTC".

    Raises
    ------
    LogError
        If this machine has no such zone.
    """
    if name == DEFAULT:
        return UTC  # known where there is no database, too
    try:
        return ZoneInfo(name)
    except (KeyError, ValueError, OSError) as error:
        raise LogError(
            f"no time zone {name[:64]!r} on this machine; name one as Europe/Berlin, or UTC"
        ) from error


def check_time_zone(name: str) -> str:
    """Return the name of a time zone if this machine knows it.

    Raise `LogError` if this machine has no such zone.
    """
    time_zone(name)
    return name


def machine_zone() -> str:
    """Return the name of this machine's time zone; UTC where none is set or known."""
    for name in (os.environ.get("TZ", "").removeprefix(":"), _name_in_file(), _name_of_link()):
        if name and not name.startswith("/"):
            try:
                return check_time_zone(name)
            except LogError:  # TZ may also hold rules, such as CET-1CEST
                continue
    return DEFAULT


def _name_in_file() -> str:
    try:
        return _NAME_FILE.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError):
        return ""


def _name_of_link() -> str:
    try:
        return str(_LINK.readlink()).rpartition(_DATABASE)[2]
    except OSError:
        return ""
