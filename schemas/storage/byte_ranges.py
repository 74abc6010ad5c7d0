"""Read files by ranges: those of this machine, and those of a store that fsspec knows."""

import io
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

from hearthlog.schemas.errors import HearthlogError, LogError
from hearthlog.schemas.storage.prefetch import prefetch
from hearthlog.schemas.storage.regular_file import open_regular

_BLOCK = 1 << 17  # bytes: a store hands them out in hardly more time than a few
_KEPT = 4  # blocks
_ASKED = 8  # files of a store at once

Result = TypeVar("Result")


def is_local(path: object) -> bool:
    """Tell whether a path is one of this machine."""
    return isinstance(path, Path)


def map_logs(function: Callable[[Path], Result], logs: Sequence[Path]) -> Iterable[Result]:
    """Apply a function to logs, in their order."""
    if all(map(is_local, logs)):
        return map(function, logs)
    return prefetch(function, logs, _ASKED)


@contextmanager
def store_errors(path: object) -> Iterator[None]:
    """Turn errors of a store into LogError while its file or folder is used.

    Raise `LogError` if the block raises any error but HearthlogError and ImportError, which
    pass unchanged.
    """
    try:
        yield
    except (HearthlogError, ImportError):
        raise
    except FileNotFoundError as error:
        raise LogError(f"{path}: no such log, folder or bucket") from error
    except PermissionError as error:
        raise LogError(f"{path}: not allowed ({_line(error)}); check the credentials") from error
    except Exception as error:  # each store has errors of its own, and fsspec passes them on
        raise LogError(f"{path}: the store cannot be used ({_line(error)})") from error


def _line(error: Exception) -> str:
    return next(iter(str(error).splitlines()), "") or type(error).__name__


class LocalFile:
    """A file of this machine, open for reading.

    Raise `LogError` if it cannot be opened, or is no regular file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._descriptor = open_regular(path)
        except OSError as error:
            raise self._unreadable(error) from error

    @property
    def size(self) -> int:
        """Bytes of the file as it is now."""
        return os.fstat(self._descriptor).st_size

    def close(self) -> None:
        """Close the file."""
        os.close(self._descriptor)

    def is_at(self, path: Path) -> bool:
        """Tell whether a path leads to this open file, and not to another one or none."""
        try:
            return os.path.samestat(os.fstat(self._descriptor), path.stat())
        except FileNotFoundError:
            return False

    def read(self, offset: int, length: int) -> bytes:
        """Read bytes from an offset on.

        Parameters
        ----------
        offset : int
            Byte of the file.
        length : int
            Bytes to read.

        Raises
        ------
        LogError
            If the file cannot be read.
        """
        try:
            return os.pread(self._descriptor, length, offset)
        except OSError as error:
            raise self._unreadable(error) from error

    def read_into(self, out: memoryview, offset: int) -> int:
        """Read bytes from an offset on into a buffer.

        Parameters
        ----------
        out : memoryview
            Filled from its beginning; its length in bytes says how many to read.
        offset : int
            Byte of the file.

        Returns
        -------
        int
            Bytes that were read: fewer than there is room for at the end of the file.

        Raises
        ------
        LogError
            If the file cannot be read.
        """
        try:
            return os.preadv(self._descriptor, [out], offset)
        except OSError as error:
            raise self._unreadable(error) from error

    def _unreadable(self, error: OSError) -> LogError:
        return LogError(f"{self._path}: cannot be read ({error.strerror})")


class StoredFile:
    """A file of a store, as it is when this is made; may be read from several threads.

    Raise `LogError` if the store does not answer, refuses, or has no file of this name.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._identity = _identity(path)
        self.size = int(self._identity["size"])
        self._block: Callable[[int], bytes] = lru_cache(_KEPT)(self._read_block)

    def close(self) -> None:
        """Forget what was read; nothing else stays open between two reads."""
        self._block = self._read_block

    def is_at(self, path: Path) -> bool:
        """Tell whether a path leads to this file, unchanged since it was opened."""
        try:
            return path == self._path and _identity(path) == self._identity
        except LogError:
            return False

    def read(self, offset: int, length: int) -> bytes:
        """Read bytes from an offset on, and keep short pieces with their neighbours for later.

        Parameters
        ----------
        offset : int
            Byte of the file.
        length : int
            Bytes to read.

        Raises
        ------
        LogError
            If the store does not answer, refuses, or returns another number of bytes, as it may do
            after the file has changed.
        """
        end = min(offset + length, self.size)
        if end - offset >= _BLOCK:
            return self._fetch(offset, end)
        blocks = range(offset // _BLOCK, -(-end // _BLOCK))
        read = b"".join(self._block(number) for number in blocks)
        return read[offset % _BLOCK :][: max(end - offset, 0)]

    def read_into(self, out: memoryview, offset: int) -> int:
        """Read bytes from an offset on into a buffer.

        Parameters
        ----------
        out : memoryview
            Filled from its beginning; its length in bytes says how many to read.
        offset : int
            Byte of the file.

        Returns
        -------
        int
            Bytes that were read: fewer than there is room for at the end of the file.

        Raises
        ------
        LogError
            If the store does not answer, refuses, or returns another number of bytes, as it may do
            after the file has changed.
        """
        read = self.read(offset, len(out))
        out[: len(read)] = read
        return len(read)

    def _read_block(self, number: int) -> bytes:
        return self._fetch(number * _BLOCK, min((number + 1) * _BLOCK, self.size))

    def _fetch(self, start: int, end: int) -> bytes:
        store: Any = self._path
        with store_errors(self._path):
            read: bytes = store.fs.cat_file(store.path, start=start, end=end)
        if len(read) != end - start:
            raise LogError(
                f"{self._path}: {len(read)} bytes came where {end - start} were asked for; it "
                "changed while it was read, or this store does not read by ranges"
            )
        return read


def _identity(path: Any) -> dict[str, Any]:
    """Ask a store what it says of a file: its size, and what tells it from another one."""
    with store_errors(path):
        info = path.fs.info(path.path)
        if info["type"] != "file" or info["size"] is None:
            raise LogError(f"{path}: is no file")
        return {name: info.get(name) for name in ("size", "ETag", "etag", "mtime", "created")}


def open_file(path: Path) -> LocalFile | StoredFile:
    """Open a file for reading by ranges.

    Raise `LogError` if the file cannot be opened.
    """
    return LocalFile(path) if is_local(path) else StoredFile(path)


class Section(io.RawIOBase):
    """A file from some byte on, as a stream.

    Parameters
    ----------
    start : int
        Byte of the file at which the stream begins.
    """

    def __init__(self, file: LocalFile | StoredFile, start: int) -> None:
        super().__init__()
        self._file = file
        self._position = start

    def readable(self) -> bool:
        """Return True: a section can be read."""
        return True

    def readinto(self, out: Any) -> int:
        """Read the next bytes into a buffer.

        Parameters
        ----------
        out : buffer
            Filled from its beginning; its length in bytes says how many to read.

        Returns
        -------
        int
            Bytes that were read; 0 at the end of the file.

        Raises
        ------
        LogError
            If the file cannot be read.
        """
        count = self._file.read_into(memoryview(out), self._position)
        self._position += count
        return count
