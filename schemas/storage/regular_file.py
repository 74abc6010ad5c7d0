"""Regular files: what others put among them, as a pipe or a device, may never end."""

import errno
import os
import pwd
import stat
from contextlib import suppress
from pathlib import Path


def open_regular(path: Path) -> int:
    """Open a regular file of this machine for reading.

    Raise `OSError` if it cannot be opened, or is no regular file.
    """
    mode = os.stat(path).st_mode  # noqa: PTH116  goes with what follows
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, "Is a directory", str(path))
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, "Not a regular file", str(path))
    return os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)


def exposed_secret(path: Path) -> str:
    """Return a warning if everybody may read a file of secrets; empty otherwise."""
    try:
        mode = path.stat().st_mode
    except OSError:
        return ""
    if not (stat.S_ISREG(mode) and mode & (stat.S_IROTH | stat.S_IWOTH)):
        return ""
    what = "read" if mode & stat.S_IROTH else "change"
    return f"{path}: holds secrets, and everybody on this machine may {what} it: chmod 600 {path}"


def may_be_regular(path: Path) -> bool:
    """Tell whether a path is that of a regular file, or of one whose kind cannot be found out.

    Returns
    -------
    bool
        True, too, if there is no such file or its folder cannot be read: opening it says why.
    """
    try:
        return stat.S_ISREG(path.stat().st_mode)
    except OSError:
        return True


def is_denied(path: str | Path) -> bool:
    """Return whether there is a file or a folder that this user may not read."""
    if os.access(path, os.R_OK | os.X_OK if os.path.isdir(path) else os.R_OK):  # noqa: PTH112
        return False
    try:
        os.stat(path)  # noqa: PTH116  a name of one of many
    except PermissionError:
        return True
    except OSError:  # there is none
        return False
    return True


def denied_text(path: str | Path) -> str:
    """Say whose a file or a folder is that this user may not read, and what to do."""
    owner = ""
    for place in (Path(path), *Path(path).absolute().parents):
        with suppress(OSError, KeyError):
            owner = pwd.getpwuid(place.stat().st_uid).pw_name
            break
    run = "sudo" if owner in {"", "root"} else f"sudo -u {owner}"
    return (
        f"may not be read by you{f' (owner {owner})' if owner else ''}: run this as "
        f'`{run} …`, or let the recorder have readable_by = "group"'
    )
