"""Regular files: what others put among them, as a pipe or a device, may never end."""

import errno
import os
import stat
from pathlib import Path


def open_regular(path: Path) -> int:
    """Open a file of this machine for reading, and return its descriptor.

    Raises
    ------
    OSError
        If it cannot be opened, or is no regular file.
    """
    mode = os.stat(path).st_mode  # noqa: PTH116  goes with what follows
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, "Is a directory", str(path))
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, "Not a regular file", str(path))
    return os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)


def may_be_regular(path: Path) -> bool:
    """Tell whether this is a regular file, or one that cannot be looked at: reading it says why."""
    try:
        return stat.S_ISREG(path.stat().st_mode)
    except OSError:
        return True
