"""New files: whole or not there at all, on this machine and in a store.

They are the account's alone, whatever its umask is: what comes from a home is private. Those that
belong to a log may be read by whoever may read that log. What root makes goes to the account that
the folder belongs to, and no link that this account may have put there is followed.
"""

import errno
import fcntl
import os
import shutil
import stat
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

from hearthlog.schemas.errors import LogError
from hearthlog.schemas.files import is_local, store_errors

_AT_ONCE = 8  # files that are synced: one after the other takes a disk milliseconds for each
_READERS = stat.S_IRGRP | stat.S_IROTH
_LOOKUP: int = getattr(os, "O_PATH", os.O_RDONLY)  # wants no right to read a folder


def sync_file(path: Path) -> None:
    """Make what was written to a file survive a power cut."""
    with path.open("rb") as stream:
        os.fsync(stream.fileno())


def sync_folder(folder: Path) -> None:
    """Make what was created or renamed in a folder survive a power cut."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def readers_of(path: Path) -> int:
    """Return the rights of others to read a file or a folder; none where it is not known."""
    try:
        return path.stat().st_mode & _READERS if is_local(path) else 0
    except OSError:
        return 0


def private_folder(path: Path, *, readers: int = 0) -> None:
    """Make a folder, and those around it, for this account alone; those that are there stay.

    Raise `OSError` if it cannot be made.
    """
    make_folders(path, 0o700 | readers | readers >> 2)


def make_folders(path: Path, mode: int | None = None) -> None:
    """Make a folder, and those around it; those that are there stay.

    Raise `OSError` if it cannot be made.
    """
    if path.is_dir():
        return
    make_folders(path.parent, mode)
    path.mkdir(mode=0o777 if mode is None else 0o700, exist_ok=True)
    hand_over(path, mode)


def create_file(path: Path, mode: int = 0o600) -> BinaryIO:
    """Create a file of this machine for writing, never one that a link leads to.

    Raise `FileExistsError` if something of this name exists, even a link that leads nowhere.
    Raise `OSError` if it cannot be created.
    """
    descriptor, folder = _open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
    _set_owner(descriptor, folder)
    return os.fdopen(descriptor, "wb")


def open_lock(path: Path) -> int:
    """Open a file to lock it, for reading and writing; make it if it is not there.

    Raise `OSError` if it cannot be opened, is a link or no regular file.
    """
    descriptor, folder = _open(path, os.O_RDWR | os.O_CREAT | os.O_NONBLOCK, 0o600)
    opened = os.fstat(descriptor)
    # Root writes to no file of others that was linked here.
    is_linked = opened.st_nlink > 1 and opened.st_uid != folder.st_uid and os.geteuid() == 0
    if not stat.S_ISREG(opened.st_mode) or is_linked:
        os.close(descriptor)
        raise OSError(errno.EINVAL, "Not a regular file", str(path))
    _set_owner(descriptor, folder)
    return descriptor


def hand_over(path: Path, mode: int | None = None) -> None:
    """Set the rights of what was made, which root gives to whom the folder around it belongs to.

    Parameters
    ----------
    path : Path
        A file or a folder of this machine; a link is not followed.

    Raises
    ------
    OSError
        If it is not there, or is a link.
    """
    descriptor, folder = _open(path, os.O_RDONLY | os.O_NONBLOCK)
    try:
        if mode is not None and _is_own(os.fstat(descriptor)):
            with suppress(OSError):  # a disk without rights
                os.fchmod(descriptor, mode)
        _set_owner(descriptor, folder)
    finally:
        os.close(descriptor)


def _open(path: Path, flags: int, mode: int = 0) -> tuple[int, os.stat_result]:
    """Open what has a name, no link, and return the status of its folder, too."""
    # The folder is opened once: another one may get its name while this runs.
    folder = os.open(path.parent, _LOOKUP | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        descriptor = os.open(path.name, flags | os.O_NOFOLLOW | os.O_CLOEXEC, mode, dir_fd=folder)
        return descriptor, os.fstat(folder)
    except OSError as error:
        error.filename = str(path)  # which names the file alone
        raise
    finally:
        os.close(folder)


def _set_owner(descriptor: int, folder: os.stat_result) -> None:
    made = os.fstat(descriptor)
    if os.geteuid() == 0 and folder.st_uid != 0 and made.st_uid == 0 and _is_own(made):
        with suppress(OSError):  # a disk without owners
            os.fchown(descriptor, folder.st_uid, folder.st_gid)


def _is_own(made: os.stat_result) -> bool:
    """Return whether it has one name; else somebody could have linked it here to be given it."""
    return stat.S_ISDIR(made.st_mode) or made.st_nlink == 1


@contextmanager
def locked_folder(folder: Path) -> Iterator[None]:
    """Hold a lock on a folder, which keeps out other processes that lock it.

    Parameters
    ----------
    folder : Path
        A folder of this machine. The lock is waited for without limit.

    Raises
    ------
    OSError
        If the folder cannot be opened.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def check_new(path: Path) -> None:
    """Check that a file or folder can be made under this name.

    Whether a store lets us write is known only when we do.

    Raise `LogError` if something of this name exists; on this machine, also if the folder
    around it does not exist or cannot be written to; in a store, also if it does not answer or
    refuses.
    """
    if not is_local(path):
        stored: Any = path
        with store_errors(path):
            exists = stored.fs.exists(stored.path)
        if exists:
            raise _exists(path)
        return
    if os.path.lexists(path):
        raise _exists(path)
    if not path.parent.is_dir():
        raise LogError(f"{path}: there is no folder {path.parent}; create it first")
    if not os.access(path.parent, os.W_OK):
        raise LogError(f"{path}: the folder cannot be written to")


def _exists(path: Path) -> LogError:
    return LogError(f"{path}: exists already; choose another name, or delete it first")


@contextmanager
def new_file(path: Path, *, readers: int = 0) -> Iterator[Path]:
    """Make a file under a temporary name, and give it its own if the block raises no error.

    For a path in a store the temporary file is one of this machine, and is put there at the end.
    S3 shows it whole or not at all, and refuses to put it over another one. That is not sure of
    every store: between a last look and the end of putting, another file of this name may be
    replaced, and a store that has real folders may keep a part of a file when it is cut off.

    Raise `LogError` if there is such a file already, or if it cannot be written.
    """
    check_new(path)
    put = (
        _put_in_place(path, readers, new=True) if is_local(path) else _put_in_store(path, new=True)
    )
    with put as temporary:
        yield temporary


@contextmanager
def replaced_file(path: Path, *, readers: int | None = None) -> Iterator[Path]:
    """Make a file as `new_file` does, or put it in one step in the place of the one that is there.

    Raise `LogError` if it cannot be written.
    """
    rights = readers_of(path) if readers is None else readers
    put = (
        _put_in_place(path, rights, new=False) if is_local(path) else _put_in_store(path, new=False)
    )
    with put as temporary:
        yield temporary


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Make a folder under a temporary name, and give it its own if the block raises no error.

    Raise `LogError` if something of this name exists, or the folder cannot be written.
    """
    check_new(path)
    with _temporary(path) as temporary:
        temporary.mkdir(mode=0o700)
        yield temporary
        hand_over(temporary, 0o700)  # before the files, which go to whom it belongs to
        for file in temporary.iterdir():
            hand_over(file, 0o600)
        with ThreadPoolExecutor(_AT_ONCE) as pool:
            list(pool.map(sync_file, temporary.iterdir()))
        sync_folder(temporary)
        path.mkdir()  # the name is ours now; only an empty folder is replaced
        temporary.replace(path)
        sync_folder(path.parent)


@contextmanager
def _put_in_place(path: Path, readers: int, *, new: bool) -> Iterator[Path]:
    with _temporary(path) as temporary:
        yield temporary
        hand_over(temporary, 0o600 | readers)
        sync_file(temporary)
        if new:
            _name(temporary, path)
        else:
            temporary.replace(path)
        sync_folder(path.parent)


@contextmanager
def _temporary(path: Path) -> Iterator[Path]:
    """Name a temporary file or folder beside a path, and remove what is left of it."""
    temporary = path.with_name(f".{path.name}.{os.urandom(8).hex()}.tmp")
    try:
        yield temporary
    except FileExistsError as error:
        raise _exists(path) from error
    except OSError as error:
        raise LogError(f"{path}: cannot be written ({error.strerror or error})") from error
    finally:
        if temporary.is_dir():
            shutil.rmtree(temporary, ignore_errors=True)
        else:
            temporary.unlink(missing_ok=True)


def _name(temporary: Path, path: Path) -> None:
    """Give a file its name, which unlike a rename never takes it from another file."""
    try:
        path.hardlink_to(temporary)
    except FileExistsError:
        raise
    except OSError:  # an SD card without links
        path.open("xb").close()
        temporary.replace(path)


@contextmanager
def _put_in_store(path: Any, *, new: bool) -> Iterator[Path]:
    try:
        with tempfile.TemporaryDirectory(prefix="hearthlog-") as folder:
            temporary = Path(folder) / path.name
            yield temporary
            with store_errors(path):
                _put(temporary, path, new=new)
    except OSError as error:
        raise LogError(f"{path}: cannot be written ({error.strerror or error})") from error


def _put(file: Path, path: Any, *, new: bool) -> None:
    if new:
        check_new(path)  # again: not every store minds `create`
    try:
        path.fs.put_file(str(file), path.path, mode="create" if new else "overwrite")
    except FileExistsError as error:
        raise _exists(path) from error
