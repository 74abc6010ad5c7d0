"""One recorder of a name in a folder of logs: a second one is refused at its start."""

import errno
import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from hearthlog.schemas.errors import LogError

# With these a disk may be used again later; the recorder waits for that.
_PASSING = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO}


@contextmanager
def lock_folder(folder: Path, node: str) -> Iterator[None]:
    """Hold the lock of a node in a folder of logs, which is made if it is not there.

    The lock is the file `.<node>.lock`, in which the process writes its number. It stays there with
    the logs, but is nobody's once the process has ended.

    Parameters
    ----------
    folder : Path
    node : str
        Name of the recorder.

    Raises
    ------
    LogError
        If another recorder holds it, or the folder cannot be written to.
    """
    lock = folder / f".{node}.lock"
    is_new = not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
    except OSError as error:
        if error.errno not in _PASSING:
            code = errno.ENOTDIR if error.errno == errno.EEXIST else error.errno
            raise LogError(f"{folder}: cannot be written ({os.strerror(code or 0)})") from error
        yield
        return
    try:
        _lock(descriptor, folder, node)
        yield
    finally:
        os.close(descriptor)
        if is_new:
            _remove_unused(folder, lock)


def _remove_unused(folder: Path, lock: Path) -> None:
    with suppress(OSError):  # the folder is gone, or its disk
        if list(folder.iterdir()) == [lock]:  # nothing was recorded
            lock.unlink()
            folder.rmdir()


def _lock(descriptor: int, folder: Path, node: str) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        process = os.pread(descriptor, 20, 0).decode("ascii", "replace").strip()
        raise LogError(
            f"{folder}: is recorded by {node!r} already (process {process or 'unknown'}); stop "
            "that one, or give this one another --node or --output"
        ) from error
    try:
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)
    except OSError as error:
        if error.errno not in _PASSING:
            raise LogError(f"{folder}: cannot be written ({error.strerror})") from error
