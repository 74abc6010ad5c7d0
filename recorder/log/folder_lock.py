"""Folder lock: one recorder per node name in a log folder."""

import errno
import fcntl
import os
import re
import stat
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple, Self

from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.files import is_node_name
from hearthlog.schemas.new_files import make_folders, open_lock

# Temporary disk errors; the recorder waits for their end.
_PASSING = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO}
_NUMBER = re.compile(rb"([1-9]\d{0,9})\n?")
_NUMBER_SIZE = 20  # bytes


class FolderLock:
    """Lock of a node in a log folder, which is created if missing.

    The lock is the file `.<node>.lock`, which holds the process number. The file remains with the
    logs, but is released when the process ends. If the disk cannot take a file now, nothing is
    locked. Entering the context raises `LogError` if another recorder holds the lock, or the folder
    is not writable.
    """

    def __init__(self, folder: Path, node: str) -> None:
        self._folder = folder
        self._node = node
        self._path = folder / f".{node}.lock"
        self._descriptor: int | None = None
        self._is_new = False

    def __enter__(self) -> Self:
        self._is_new = not self._folder.exists()
        self._hold()
        return self

    def __exit__(self, *_: object) -> None:
        self._release()
        if self._is_new:
            with suppress(OSError):  # the folder or its disk is gone
                if list(self._folder.iterdir()) == [self._path]:  # nothing was recorded
                    self._path.unlink()
                    self._folder.rmdir()

    def renew(self) -> None:
        """Acquire the lock again if its folder was deleted, moved away or mounted since.

        Raise `LogError` if another recorder holds it now, or the folder is not writable.
        """
        if self._descriptor is None or not self._is_here(self._descriptor):
            self._release()
            self._hold()

    def _is_here(self, descriptor: int) -> bool:
        try:
            return os.path.samestat(self._path.stat(), os.fstat(descriptor))
        except OSError:
            return False

    def _hold(self) -> None:
        try:
            make_folders(self._folder)
            descriptor = open_lock(self._path)
        except OSError as error:
            if error.errno in _PASSING:
                return
            code = errno.ENOTDIR if error.errno == errno.EEXIST else error.errno
            what = os.strerror(code or 0)
            raise LogError(f"{self._folder}: cannot be written ({what})") from error
        try:
            _lock(descriptor, self._folder, self._node)
        except LogError:
            os.close(descriptor)
            raise
        self._descriptor = descriptor

    def _release(self) -> None:
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


def _lock(descriptor: int, folder: Path, node: str) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        process = os.pread(descriptor, _NUMBER_SIZE, 0).decode("ascii", "replace").strip()
        raise LogError(
            f"{folder}: is in use by the recorder {node!r} already (process "
            f"{process or 'unknown'}); stop it, or choose another --node or --output"
        ) from error
    try:
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)
    except OSError as error:
        if error.errno not in _PASSING:
            raise LogError(f"{folder}: cannot be written ({error.strerror})") from error


def check_writable(folder: Path) -> None:
    """Raise `LogError` if a folder is not writable and cannot be created; change nothing."""
    folder = folder.absolute()
    there = next(path for path in (folder, *folder.parents) if path.exists())
    if not there.is_dir() or not os.access(there, os.W_OK | os.X_OK):
        raise LogError(f"{folder}: cannot be written ({there} does not allow it)")


class NodeLock(NamedTuple):
    """Lock of a node found in a folder."""

    path: Path
    node: str
    process: int  # the last holder; 0 if the file has no number
    is_held: bool | None  # None if this account may not read the file


def node_locks(folder: Path) -> Iterator[NodeLock]:
    """Yield the locks of recorders in a folder, by name; ignore other `.lock` files.

    A lock is a regular file, not a link, with the name that `FolderLock` gives it, and holds a
    process number or nothing.
    """
    for path in sorted(folder.glob(".*.lock")):
        node = path.name.removeprefix(".").removesuffix(".lock")
        if not is_node_name(node):
            continue
        try:
            descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
        except PermissionError:
            if stat.S_ISREG(path.lstat().st_mode):
                yield NodeLock(path, node, 0, None)
            continue
        except OSError:  # a link, or gone
            continue
        try:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                continue
            content = os.pread(descriptor, _NUMBER_SIZE, 0)
            number = _NUMBER.fullmatch(content)
            if number or not content:
                process = int(number[1]) if number else 0
                yield NodeLock(path, node, process, _is_held(descriptor))
        finally:
            os.close(descriptor)


def _is_held(descriptor: int) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    return False
