"""Bounded reading of files, local or in a store of fsspec, by ranges or completely."""

import errno
import io
import os
import pwd
import re
import stat
import tomllib
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import IO, Any, TypeVar

from hearthlog.schemas.errors import HearthlogError, LogError


def open_regular(path: Path) -> int:
    """Open a regular local file for reading.

    Raise `OSError` if the file cannot be opened, or is no regular file.
    """
    mode = os.stat(path).st_mode  # noqa: PTH116  `os.open` below takes the same text
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, "Is a directory", str(path))
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, "Not a regular file", str(path))
    return os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)


def exposed_secret(path: Path) -> str:
    """Return a warning if a file of secrets is readable by everyone; otherwise empty."""
    try:
        mode = path.stat().st_mode
    except OSError:
        return ""
    if not (stat.S_ISREG(mode) and mode & (stat.S_IROTH | stat.S_IWOTH)):
        return ""
    what = "read" if mode & stat.S_IROTH else "change"
    return f"{path}: holds secrets, and everybody on this machine may {what} it: chmod 600 {path}"


def may_be_regular(path: Path) -> bool:
    """Return whether a path is a regular file, or its kind cannot be determined.

    Also True for a missing file or an unreadable folder: opening it raises the exact error.
    """
    try:
        return stat.S_ISREG(path.stat().st_mode)
    except OSError:
        return True


def is_denied(path: str | Path) -> bool:
    """Return whether a file or a folder exists that this user may not read."""
    if os.access(path, os.R_OK | os.X_OK if os.path.isdir(path) else os.R_OK):  # noqa: PTH112
        return False
    try:
        os.stat(path)  # noqa: PTH116  a name of one of many
    except PermissionError:
        return True
    except OSError:  # it does not exist
        return False
    return True


def denied_text(path: str | Path) -> str:
    """Return the owner of an unreadable file or folder, and advice."""
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


_TOML_LIMIT = 1 << 20
_LINE = re.compile(r"at line (\d+)")
_HINTS = (  # by the parser's message, and the line of the error
    (
        re.compile(r"overwrite|twice|redefine|mutate|duplicate", re.IGNORECASE),
        "; a key or table is given twice",
    ),
    (
        re.compile(r"\n.*\"[^\"]*\\"),
        "; a text with a backslash stands in single quotes: 'C:\\logs'",
    ),
    (
        re.compile(r"Invalid value"),
        '; a text stands in quotes, as node = "home"; else true, false, a number',
    ),
    (
        re.compile(
            r"Expected '='|Invalid (initial )?(character|statement)|after (a )?(key|statement)"
        ),
        "; each line is KEY = VALUE, [TABLE] or # COMMENT",
    ),
    (
        re.compile(r"Unclosed|Unterminated|newline|Illegal character '\\n'", re.IGNORECASE),
        "; a quote or a bracket is not closed, or a comma is missing",
    ),
)
_UTF_16 = {b"\xff\xfe", b"\xfe\xff"}
_IS_UTF_16 = "no UTF-8: it is UTF-16"
_DEEPEST = 100  # parts of a dotted key: the parser's time grows with the cube of their number


def read_limited(path: Path, what: str, limit: int, error: type[HearthlogError]) -> bytes:
    """Read a regular local file, or a file of a store, of at most `limit` bytes.

    Raise `error` if the file does not exist, is larger, cannot be read, or is no regular file.
    """
    try:
        if not path.exists():
            raise error(f"{path}: no such {what}")
        with _opened(path) as stream:
            data = stream.read(limit + 1)
    except OSError as reason:
        raise error(f"{path}: cannot be read ({reason.strerror})") from reason
    if len(data) > limit:
        most = f"{limit >> 20} MB" if limit >= 1 << 20 else f"{limit / 1000:.3g} kB"
        raise error(f"{path}: larger than {most}; this is no {what}")
    return data


def _opened(path: Path) -> IO[bytes]:
    """Open a file; files of a store are regular."""
    return os.fdopen(open_regular(path), "rb") if is_local(path) else path.open("rb")


def read_toml(path: Path, what: str, error: type[HearthlogError]) -> dict[str, Any]:
    """Read a TOML file of at most 1 MB.

    Raise `error` if the file does not exist, is larger than 1 MB, cannot be read, is nested too
    deeply, or is not TOML in UTF-8.
    """
    data = read_limited(path, what, _TOML_LIMIT, error)
    content: dict[str, Any] = {}
    try:
        text = data.decode("utf-8-sig")  # editors of Windows write a byte order mark
        keys = (line for line in text.split("\n") if not line.lstrip().startswith("#"))
        if "\0" in text:
            raise error(f"{path}: cannot be read as TOML ({_IS_UTF_16}); save it as UTF-8")
        deep = any(line.count(".") > _DEEPEST for line in keys)
        if not deep:
            content = tomllib.loads(text)
    except UnicodeDecodeError as reason:
        line = data.count(b"\n", 0, reason.start) + 1
        problem = _IS_UTF_16 if data[:2] in _UTF_16 else f"no UTF-8: at line {line}"
        raise error(f"{path}: cannot be read as TOML ({problem}); save it as UTF-8") from reason
    except ValueError as reason:
        raise error(f"{path}: cannot be read as TOML ({_toml_problem(text, reason)})") from reason
    except RecursionError:
        deep = True
    if deep:
        raise error(f"{path}: cannot be read as TOML (it is nested too deeply)")
    return content


def _toml_problem(text: str, reason: ValueError) -> str:
    """Return the parser's complaint, its position, and the correct syntax."""
    last = f"at line {text.rstrip().count(chr(10)) + 1}, the last one"
    problem = str(reason).replace("at end of document", last)[:200]
    found = _LINE.search(problem)
    lines = text.split("\n")
    line = lines[int(found[1]) - 1] if found and int(found[1]) <= len(lines) else ""
    return problem + next(
        (hint for words, hint in _HINTS if words.search(f"{problem}\n{line}")), ""
    )


Item = TypeVar("Item")
Result = TypeVar("Result")


def prefetch(
    function: Callable[[Item], Result], items: Iterable[Item], workers: int
) -> Generator[Result, None, None]:
    """Apply a function to items in threads, a few items ahead of the consumer.

    It should mostly release the interpreter lock: reading, decompression, numpy. At most `workers +
    1` items, `workers` >= 1, are in progress or unread.
    """
    with ThreadPoolExecutor(workers) as pool:
        waiting: deque[Future[Result]] = deque()
        for item in items:
            waiting.append(pool.submit(function, item))
            if len(waiting) > workers:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


_BLOCK = 1 << 17  # bytes: a store needs little more time for them than for a few
_KEPT = 4  # blocks
_REQUESTS = 8  # concurrent files of a store


def is_local(path: object) -> bool:
    """Return whether a path is local."""
    return isinstance(path, Path)


def map_logs(function: Callable[[Path], Result], logs: Sequence[Path]) -> Iterable[Result]:
    """Apply a function to logs, in order."""
    if all(map(is_local, logs)):
        return map(function, logs)
    return prefetch(function, logs, _REQUESTS)


@contextmanager
def store_errors(path: object) -> Iterator[None]:
    """Turn errors of a store into `LogError`, except HearthlogError and ImportError."""
    try:
        yield
    except (HearthlogError, ImportError):
        raise
    except FileNotFoundError as error:
        raise LogError(f"{path}: no such log, folder or bucket") from error
    except PermissionError as error:
        raise LogError(f"{path}: not allowed ({_line(error)}); check the credentials") from error
    except Exception as error:  # fsspec passes on the error types of each store
        raise LogError(f"{path}: the store cannot be used ({_line(error)})") from error


def _line(error: Exception) -> str:
    return next(iter(str(error).splitlines()), "") or type(error).__name__


class LocalFile:
    """Local file, open for reading; raise `LogError` if it cannot be opened, or is not regular."""

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._descriptor = open_regular(path)
        except OSError as error:
            raise self._unreadable(error) from error

    @property
    def size(self) -> int:
        """Current size of the file in bytes."""
        return os.fstat(self._descriptor).st_size

    def close(self) -> None:
        """Close the file."""
        os.close(self._descriptor)

    def is_at(self, path: Path) -> bool:
        """Return whether a path refers to this open file."""
        try:
            return os.path.samestat(os.fstat(self._descriptor), path.stat())
        except FileNotFoundError:
            return False

    def read(self, offset: int, length: int) -> bytes:
        """Read bytes at an offset; raise `LogError` if the file cannot be read."""
        try:
            return os.pread(self._descriptor, length, offset)
        except OSError as error:
            raise self._unreadable(error) from error

    def read_into(self, out: memoryview, offset: int) -> int:
        """Read bytes at an offset into a buffer; return their number, less at the end of the file.

        Raise `LogError` if the file cannot be read.
        """
        try:
            return os.preadv(self._descriptor, [out], offset)
        except OSError as error:
            raise self._unreadable(error) from error

    def _unreadable(self, error: OSError) -> LogError:
        return LogError(f"{self._path}: cannot be read ({error.strerror})")


class StoredFile:
    """Snapshot of a file in a store; may be read from several threads.

    Raise `LogError` if the store does not answer, refuses, or has no such file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._identity = _identity(path)
        self.size = int(self._identity["size"])
        self._block: Callable[[int], bytes] = lru_cache(_KEPT)(self._read_block)

    def close(self) -> None:
        """Drop the cached blocks; no connection stays open between reads."""
        self._block = self._read_block

    def is_at(self, path: Path) -> bool:
        """Return whether a path refers to this file, unchanged since it was opened."""
        try:
            return path == self._path and _identity(path) == self._identity
        except LogError:
            return False

    def read(self, offset: int, length: int) -> bytes:
        """Read bytes at an offset; cache short reads in blocks.

        Raise `LogError` if the store does not answer, refuses, or returns another number of bytes,
        for example because the file has changed.
        """
        end = min(offset + length, self.size)
        if end - offset >= _BLOCK:
            return self._fetch(offset, end)
        blocks = range(offset // _BLOCK, -(-end // _BLOCK))
        read = b"".join(self._block(number) for number in blocks)
        return read[offset % _BLOCK :][: max(end - offset, 0)]

    def read_into(self, out: memoryview, offset: int) -> int:
        """Read bytes at an offset into a buffer, as `LocalFile.read_into`."""
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
    """Return size and version identifiers of a file in a store."""
    with store_errors(path):
        info = path.fs.info(path.path)
        if info["type"] != "file" or info["size"] is None:
            raise LogError(f"{path}: is no file")
        return {name: info.get(name) for name in ("size", "ETag", "etag", "mtime", "created")}


def open_file(path: Path) -> LocalFile | StoredFile:
    """Open a file for reading by ranges; raise `LogError` if that fails."""
    return LocalFile(path) if is_local(path) else StoredFile(path)


class Section(io.RawIOBase):
    """Stream over a file from byte `start` to its end."""

    def __init__(self, file: LocalFile | StoredFile, start: int) -> None:
        super().__init__()
        self._file = file
        self._position = start

    def readable(self) -> bool:
        """Return True: a section is readable."""
        return True

    def readinto(self, out: Any) -> int:
        """Read the next bytes into a buffer; return their number, 0 at the end of the file.

        Raise `LogError` if the file cannot be read.
        """
        count = self._file.read_into(memoryview(out), self._position)
        self._position += count
        return count
