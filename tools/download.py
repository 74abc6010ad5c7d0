"""File download: bounded, resumable, and verified before the file gets its name."""

import fcntl
import hashlib
import http.client
import os
import re
import ssl
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from http import HTTPStatus
from io import BufferedRandom
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.parse import urlsplit
from urllib.request import (
    HTTPDefaultErrorHandler,
    HTTPErrorProcessor,
    HTTPHandler,
    HTTPRedirectHandler,
    HTTPSHandler,
    OpenerDirector,
    ProxyHandler,
    Request,
)

from hearthlog import __version__
from hearthlog.schemas.errors import HearthlogError, Progress, ignore_progress, printable
from hearthlog.schemas.new_files import sync_folder

_TIMEOUT_SECONDS = 20.0  # without receiving a byte
_WAIT_SECONDS = (1.0, 2.0, 4.0)  # between attempts without progress
_MOST_TRIES = 50
_LEAST_SPEED = 256  # bytes a second
_BLOCK = 1 << 16
_READABLE = 0o644
_FOLDER = 0o755
_LOOPBACK = {"127.0.0.1", "::1", "localhost"}
_TRANSIENT = {408, 425, 429, 500, 502, 503, 504}
_RANGE = re.compile(r"bytes ([0-9]{1,18})-[0-9]+/([0-9]+|\*)")


class DownloadError(HearthlogError):
    """A file cannot be downloaded, or is not the expected file."""


class _TransientError(Exception):
    """A failure that may pass."""


class _StartOverError(Exception):
    """The partial file is unusable."""


def download(
    url: str, path: Path, size: int, sha256: str, progress: Progress = ignore_progress
) -> None:
    """Download a file of `size` bytes, at most, to a path readable by all, after verification.

    An existing file is replaced. The data of an interrupted download stays next to the path,
    readable by this account alone, and is resumed. Raise `DownloadError` if the file cannot be
    downloaded, is not the expected file, or cannot be written.
    """
    _check_address(url)
    with _writing(path), _part(path, sha256) as part:
        resumed = _length(part)
        _receive_all(url, part, size, progress)
        found = _digest(part)
        if found != sha256 and resumed:  # the earlier part may belong to another version
            _empty(part)
            _receive_all(url, part, size, progress)
            found = _digest(part)
        if found != sha256:
            _empty(part)
            raise DownloadError(
                f"{url}: differs from the expected file (its sha256 begins with {found[:12]}, "
                f"not {sha256[:12]}); nothing was kept"
            )
        _give_name(part, _part_path(path, sha256), path)


def put(data: bytes, path: Path) -> None:
    """Write a file readable by all, atomically; an existing file is replaced.

    Raise `DownloadError` if it cannot be written.
    """
    sha256 = hashlib.sha256(data).hexdigest()
    with _writing(path), _part(path, sha256) as part:
        _empty(part)
        part.write(data)
        _give_name(part, _part_path(path, sha256), path)


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Create the folder of a file, accessible to all; convert write errors to one line."""
    try:
        for folder in reversed([path.parent, *path.parent.parents]):
            if not folder.exists():
                folder.mkdir(exist_ok=True)
                folder.chmod(_FOLDER)  # regardless of the umask of a private verb
        yield
    except OSError as error:
        raise DownloadError(f"{path}: cannot be written ({error.strerror or error})") from error


@contextmanager
def _part(path: Path, sha256: str) -> Iterator[BufferedRandom]:
    """Open the partial file next to a path, with a lock against other commands."""
    place = _part_path(path, sha256)
    flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
    with os.fdopen(os.open(place, flags, 0o600), "r+b") as part:
        try:
            fcntl.flock(part, fcntl.LOCK_EX | fcntl.LOCK_NB)
            is_ours = os.path.samestat(os.fstat(part.fileno()), place.lstat())
        except (BlockingIOError, FileNotFoundError):
            is_ours = False
        if not is_ours:  # or another command wrote it until just now
            raise DownloadError(f"{path}: another command is fetching it; wait for it")
        try:
            yield part
        finally:
            with suppress(OSError):
                part.flush()
                if not os.fstat(part.fileno()).st_size:
                    place.unlink()


def _part_path(path: Path, sha256: str) -> Path:
    return path.with_name(f".{path.name}.{sha256[:12]}.part")


def _give_name(part: BufferedRandom, place: Path, path: Path) -> None:
    part.flush()
    os.fchmod(part.fileno(), _READABLE)
    os.fsync(part.fileno())
    place.replace(path)
    sync_folder(path.parent)


def _digest(part: BufferedRandom) -> str:
    part.seek(0)
    return hashlib.file_digest(part, "sha256").hexdigest()


def _length(part: BufferedRandom) -> int:
    return part.seek(0, os.SEEK_END)


def _empty(part: BufferedRandom) -> None:
    part.seek(0)
    part.truncate()


def _receive_all(url: str, part: BufferedRandom, size: int, progress: Progress) -> None:
    """Receive the missing data; retry while attempts make progress, and a few times without."""
    idle, problem = 0, ""
    for _ in range(_MOST_TRIES):
        have = _length(part)
        if have > size:
            _empty(part)
            have = 0
        if have == size:
            return
        try:
            _receive(url, part, size, progress)
        except _StartOverError:
            _empty(part)
        except _TransientError as error:
            problem = str(error)
        idle = 0 if _length(part) > have else idle + 1
        if idle > len(_WAIT_SECONDS):
            break
        if _length(part) < size:
            time.sleep(_WAIT_SECONDS[max(idle - 1, 0)])
    else:
        if _length(part) == size:
            return
    kept = "; the same command resumes the download" if _length(part) else ""
    raise DownloadError(f"{url}: cannot be downloaded ({printable(problem)[:200]}){kept}")


def _receive(url: str, part: BufferedRandom, size: int, progress: Progress) -> None:
    """Receive the rest of a file, or as much as arrives."""
    have = _length(part)
    with _opened(url, have) as response:
        have = _start(response, have, url)
        if not have:
            _empty(part)
        announced = response.headers.get("Content-Length", "")
        if announced.isascii() and announced.isdigit() and have + int(announced) != size:
            raise DownloadError(
                f"{url}: differs from the expected file ({have + int(announced):,} "
                f"bytes, not {size:,}); nothing was kept"
            )
        begin, first = time.monotonic(), have
        while block := _next_block(response):
            have += len(block)
            if have > size:
                _empty(part)
                raise DownloadError(
                    f"{url}: is larger than the expected file ({size:,} bytes); nothing was kept"
                )
            part.write(block)
            progress(have / size)
            seconds = time.monotonic() - begin
            if seconds > _TIMEOUT_SECONDS and have - first < seconds * _LEAST_SPEED:
                raise _TransientError("it comes too slowly")
    if have < size:
        raise _TransientError("it ended early")


def _opened(url: str, have: int) -> Any:
    headers = {"Accept-Encoding": "identity", "User-Agent": f"hearthlog/{__version__}"}
    if have:
        headers["Range"] = f"bytes={have}-"
    try:
        response = _opener().open(Request(url, headers=headers), timeout=_TIMEOUT_SECONDS)  # noqa: S310  its scheme was checked
    except HTTPError as error:
        error.close()
        answer = f"{error.code} {error.reason}"[:100]
        if error.code == HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE and have:
            raise _StartOverError from error
        if error.code in _TRANSIENT:
            raise _TransientError(f"the server says {answer}") from error
        raise DownloadError(f"{url}: is not there (the server says {printable(answer)})") from error
    except (OSError, http.client.HTTPException) as error:
        reason = getattr(error, "reason", error)
        if isinstance(reason, ssl.SSLCertVerificationError):
            raise DownloadError(
                f"{url}: the server has no certificate that this machine trusts "
                f"({reason.verify_message}); is its clock right?"
            ) from error
        raise _TransientError(_words(reason)) from error
    if response is None:
        raise DownloadError(f"{url}: leads to an address that is not https")
    return response


def _start(response: Any, have: int, url: str) -> int:
    """Return the byte position at which a response begins, if it can continue the partial file."""
    if response.status == HTTPStatus.OK:
        return 0
    found = _RANGE.fullmatch(response.headers.get("Content-Range", ""))
    if response.status != HTTPStatus.PARTIAL_CONTENT:
        raise DownloadError(f"{url}: is not there (the server says {response.status})")
    if found is None or int(found[1]) != have:
        raise _StartOverError
    return have


def _next_block(response: Any) -> bytes:
    try:
        return bytes(response.read1(_BLOCK))
    except (OSError, http.client.HTTPException) as error:
        raise _TransientError(_words(error)) from error


def _words(error: object) -> str:
    if isinstance(error, TimeoutError):
        return f"nothing came for {_TIMEOUT_SECONDS:g} s"
    return getattr(error, "strerror", None) or str(error) or type(error).__name__


def _check_address(url: str, *, of_here: bool = True) -> None:
    """Refuse addresses other than https, or http of this machine where expected."""
    parts = urlsplit(url)
    is_here = of_here and parts.scheme == "http" and parts.hostname in _LOOPBACK
    if parts.scheme != "https" and not is_here:
        raise DownloadError(f"{url}: is not an https:// address")


class _Redirects(HTTPRedirectHandler):
    """Follows redirects to equally safe addresses."""

    def redirect_request(self, *arguments: Any) -> Request | None:
        """Make the request for the redirect's address."""
        request, answer, address = arguments[0], arguments[1], arguments[-1]
        try:
            _check_address(address, of_here=request.type == "http")
        except DownloadError:
            answer.close()
            raise
        return super().redirect_request(*arguments)


def _opener() -> OpenerDirector:
    """Make the opener: HTTP only, through the proxies of the environment."""
    opener = OpenerDirector()
    kinds = (ProxyHandler, HTTPHandler, HTTPSHandler, HTTPDefaultErrorHandler, HTTPErrorProcessor)
    for kind in (*kinds, _Redirects):
        opener.add_handler(kind())
    return opener
