"""Creation of files that are complete or absent, locally and in a store.

Files are private to the account regardless of its umask; those of a log are readable by its
readers. Files of root are handed to the owner of the folder. Links placed there are not followed.
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

_AT_ONCE = 8  # files synced in parallel: one after the other takes milliseconds each
_READERS = stat.S_IRGRP | stat.S_IROTH
_LOOKUP: int = getattr(os, "O_PATH", os.O_RDONLY)  # needs no read permission for the folder


def sync_file(path: Path) -> None:
    """Flush the content of a file to disk, to survive a power cut."""
    with path.open("rb") as stream:
        os.fsync(stream.fileno())


def sync_folder(folder: Path) -> None:
    """Flush the entries of a folder to disk, to survive a power cut."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def readers_of(path: Path) -> int:
    """Return the group and other read permissions of a file or a folder; 0 if unknown."""
    try:
        return path.stat().st_mode & _READERS if is_local(path) else 0
    except OSError:
        return 0


def private_folder(path: Path, *, readers: int = 0) -> None:
    """Create a folder and its parents, private to this account; existing ones are unchanged.

    Raise `OSError` if the folder cannot be created.
    """
    make_folders(path, 0o700 | readers | readers >> 2)


def make_folders(path: Path, mode: int | None = None) -> None:
    """Create a folder and its parents; existing ones are unchanged.

    Raise `OSError` if the folder cannot be created.
    """
    if path.is_dir():
        return
    make_folders(path.parent, mode)
    path.mkdir(mode=0o777 if mode is None else 0o700, exist_ok=True)
    hand_over(path, mode)


def create_file(path: Path, mode: int = 0o600) -> BinaryIO:
    """Create a local file for writing, without following links.

    Raise `FileExistsError` if the name exists, even as a dangling link, else `OSError`.
    """
    descriptor, folder = _open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
    _set_owner(descriptor, folder)
    return os.fdopen(descriptor, "wb")


def open_lock(path: Path) -> int:
    """Open a lock file for reading and writing; create a missing one.

    Raise `OSError` if the file cannot be opened, is a link or no regular file.
    """
    descriptor, folder = _open(path, os.O_RDWR | os.O_CREAT | os.O_NONBLOCK, 0o600)
    opened = os.fstat(descriptor)
    # Root writes to no file of others that is linked here.
    is_linked = opened.st_nlink > 1 and opened.st_uid != folder.st_uid and os.geteuid() == 0
    if not stat.S_ISREG(opened.st_mode) or is_linked:
        os.close(descriptor)
        raise OSError(errno.EINVAL, "Not a regular file", str(path))
    _set_owner(descriptor, folder)
    return descriptor


def hand_over(path: Path, mode: int | None = None) -> None:
    """Set the permissions of a new file or folder; root also gives it to the owner of its parent.

    Raise `OSError` if the path, which is local, does not exist, or is a link.
    """
    descriptor, folder = _open(path, os.O_RDONLY | os.O_NONBLOCK)
    try:
        if mode is not None and _is_own(os.fstat(descriptor)):
            with suppress(OSError):  # file system without permissions
                os.fchmod(descriptor, mode)
        _set_owner(descriptor, folder)
    finally:
        os.close(descriptor)


def _open(path: Path, flags: int, mode: int = 0) -> tuple[int, os.stat_result]:
    """Open a path that is no link; also return the status of its folder."""
    # The folder is opened once: another folder may take its name meanwhile.
    folder = os.open(path.parent, _LOOKUP | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        descriptor = os.open(path.name, flags | os.O_NOFOLLOW | os.O_CLOEXEC, mode, dir_fd=folder)
        return descriptor, os.fstat(folder)
    except OSError as error:
        error.filename = str(path)  # instead of the file name only
        raise
    finally:
        os.close(folder)


def _set_owner(descriptor: int, folder: os.stat_result) -> None:
    made = os.fstat(descriptor)
    if os.geteuid() == 0 and folder.st_uid != 0 and made.st_uid == 0 and _is_own(made):
        with suppress(OSError):  # file system without owners
            os.fchown(descriptor, folder.st_uid, folder.st_gid)


def _is_own(made: os.stat_result) -> bool:
    """Return whether a file has one name; otherwise, it may be a foreign file linked here."""
    return stat.S_ISDIR(made.st_mode) or made.st_nlink == 1


@contextmanager
def locked_folder(folder: Path) -> Iterator[None]:
    """Hold a lock on a local folder against other processes, after an unlimited wait.

    Raise `OSError` if the folder cannot be opened.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def check_new(path: Path) -> None:
    """Check that a file or folder can be created at a path.

    Write permission in a store is only known after a write.

    Raise `LogError` if the path exists; locally, also if its parent does not exist or is not
    writable; in a store, also if it does not answer or refuses.
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
    """Create a file under a temporary name, and rename it if the block raises no error.

    For a path in a store the temporary file is local, and is uploaded at the end. S3 shows the
    file complete or not at all, and refuses to overwrite. Other stores may not: a file created
    between the last check and the end of the upload may be overwritten, and a store with real
    folders may keep a part of an interrupted upload.

    Raise `LogError` if the file exists, or cannot be written.
    """
    check_new(path)
    put = (
        _put_in_place(path, readers, new=True) if is_local(path) else _put_in_store(path, new=True)
    )
    with put as temporary:
        yield temporary


@contextmanager
def replaced_file(path: Path, *, readers: int | None = None) -> Iterator[Path]:
    """Create a file as `new_file` does, but atomically replace an existing one.

    Raise `LogError` if the file cannot be written.
    """
    rights = readers_of(path) if readers is None else readers
    put = (
        _put_in_place(path, rights, new=False) if is_local(path) else _put_in_store(path, new=False)
    )
    with put as temporary:
        yield temporary


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Create a folder under a temporary name, and rename it if the block raises no error.

    Raise `LogError` if the name exists, or the folder cannot be written.
    """
    check_new(path)
    with _temporary(path) as temporary:
        temporary.mkdir(mode=0o700)
        yield temporary
        hand_over(temporary, 0o700)  # before its files, which inherit the owner
        for file in temporary.iterdir():
            hand_over(file, 0o600)
        with ThreadPoolExecutor(_AT_ONCE) as pool:
            list(pool.map(sync_file, temporary.iterdir()))
        sync_folder(temporary)
        path.mkdir()  # reserves the name; a rename replaces only an empty folder
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
    """Yield a temporary path next to a path, and remove its remains at the end."""
    temporary = path.with_name(f".{path.name}.{os.urandom(8).hex()}.tmp")
    try:
        yield temporary
    except FileExistsError as error:
        raise _exists(path) from error
    except OSError as error:
        raise LogError(_not_written(path, error)) from error
    finally:
        if temporary.is_dir():
            shutil.rmtree(temporary, ignore_errors=True)
        else:
            temporary.unlink(missing_ok=True)


def _name(temporary: Path, path: Path) -> None:
    """Rename a temporary file without ever replacing another file."""
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
        raise LogError(_not_written(path, error)) from error


def _not_written(path: Any, error: OSError) -> str:
    remedy = "; make room" if error.errno in {errno.ENOSPC, errno.EDQUOT} else ""
    return f"{path}: cannot be written ({error.strerror or error}){remedy}"


def _put(file: Path, path: Any, *, new: bool) -> None:
    if new:
        check_new(path)  # again: some stores ignore `create`
    try:
        path.fs.put_file(str(file), path.path, mode="create" if new else "overwrite")
    except FileExistsError as error:
        raise _exists(path) from error
