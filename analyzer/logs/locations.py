"""Locations of logs in folders and stores: listings, sizes and times."""

import os
import re
from collections.abc import Mapping
from datetime import datetime
from operator import attrgetter
from pathlib import Path
from time import time_ns
from types import MappingProxyType
from typing import Any, NamedTuple, cast

from hearthlog.analyzer.errors import remedy
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.files import is_local, store_errors
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.files import ENROLLED, SUFFIX, look_into
from hearthlog.schemas.mcap.logfile import ACTIVE_SUFFIX

_URL = re.compile(r"([A-Za-z][A-Za-z0-9+.-]*)://(.*)", re.DOTALL)
_FILES = {"file", "local"}
_OURS = {"fsspec", "s3fs", "upath", ""}  # packages of the extra `cluster`; empty if unknown
# A cached listing hides files that other programs added since.
_FRESH: dict[str, Any] = {"use_listings_cache": False}
# botocore backs off where a store throttles requests. s3fs tries five times on top of
# botocore's retries: a silent server fails after four minutes.
_S3 = _FRESH | {
    "config_kwargs": {"retries": {"mode": "standard", "total_max_attempts": 5}, "read_timeout": 10}
}
_OPTIONS: dict[str, dict[str, Any]] = {
    "s3": _S3,
    "s3a": _S3,
    **dict.fromkeys(("gs", "gcs", "az", "abfs", "adl"), _FRESH),
}


def location(text: str) -> Path:
    """Parse the path of a log or a folder, local or in a store supported by fsspec.

    Raise `LogError` if the kind of store is unknown or its package is not installed.
    """
    url = _URL.fullmatch(text)
    if url is None:
        return Path(text)
    scheme, rest = url[1].lower(), url[2]
    return Path(rest) if scheme in _FILES else _stored(scheme, rest)


def _stored(scheme: str, rest: str) -> Path:
    text = f"{scheme}://{rest}"
    try:
        with store_errors(text):
            import fsspec  # noqa: PLC0415  part of the extra `cluster`
            from upath import UPath  # noqa: PLC0415  part of the extra `cluster`

            options = _OPTIONS.get(scheme, {}) | fsspec.config.conf.get(scheme, {})
            path = UPath(text, **options)
            path.fs.root_marker  # noqa: B018  creates the file system
    except ImportError as error:
        raise LogError(f"{text}: {error}; {_remedy(error)}") from error
    # UPath behaves like a Path here, but is none for the type checker.
    return cast("Path", path)


def _remedy(error: ImportError) -> str:
    """Return how to install the missing package: our extra, or a package that fsspec needs."""
    missing = error if error.__cause__ is None else error.__cause__
    name = getattr(missing, "name", None) or ""
    return f"try: pip install {name}" if name not in _OURS else remedy("fsspec")


_TIMES = ("mtime", "LastModified", "last_modified", "updated", "created")  # keys vary by store
_NAME = attrgetter("name")
UNSURE = -1
_YOUNG = 5 * NANOSECONDS  # since a folder changed: a disk's clock may be this coarse


class ListedLog(NamedTuple):
    """A log file as listed by its folder."""

    name: str  # path within the folder, with `/`
    size: int  # bytes
    mtime: int  # nanoseconds of UTC


class Listing(NamedTuple):
    """Logs and folders found in a folder."""

    logs: list[ListedLog]  # sorted by name
    # change times of the listed folders; `UNSURE` if this time cannot reveal a later change
    folders: dict[str, int]
    unchanged: list[str]  # known folders that were not listed again


def list_logs(folder: Path, earlier: Mapping[str, int] = MappingProxyType({})) -> Listing:
    """List the logs in a folder with size and modification time, without opening them.

    `earlier` has change times of folders by name, as in `Listing`; local folders only. Logs of
    unchanged folders are not listed.
    """
    found = _list_local(folder, earlier) if is_local(folder) else _list_stored(folder)
    found.logs.sort(key=_NAME)
    return found


def _list_local(folder: Path, earlier: Mapping[str, int]) -> Listing:
    found = Listing([], {}, [])
    inner: dict[str, list[str]] = {name: [] for name in earlier}
    for name in filter(None, earlier):
        inner.get(name.rpartition("/")[0], []).append(name)
    sure = time_ns() - _YOUNG
    waiting = [""]
    while waiting:
        name = waiting.pop()
        path, prefix = (f"{folder}/{name}", f"{name}/") if name else (str(folder), "")
        try:
            changed = os.stat(path).st_ctime_ns  # noqa: PTH116  no Path for each folder
        except OSError:  # deleted, or no permission
            continue
        if earlier.get(name) == changed and os.access(path, os.R_OK):
            found.unchanged.append(name)
            waiting += inner[name]
            continue
        inside = look_into(path)
        # The catalogue itself changes the outermost folder.
        is_sure = name and inside.is_all and changed < sure
        found.folders[name] = changed if is_sure else UNSURE
        found.logs.extend(_listed(prefix + entry.name, entry) for entry in inside.logs)
        waiting += [prefix + entry.name for entry in inside.folders if entry.name != ENROLLED]
    return found


def _listed(name: str, entry: "os.DirEntry[str]") -> ListedLog:
    try:
        about = entry.stat()
    except OSError:  # deleted, or reading it will report the error
        return ListedLog(name, -1, -1)
    return ListedLog(name, about.st_size, about.st_mtime_ns)


def _list_stored(folder: Any) -> Listing:
    with store_errors(folder):
        files: Mapping[str, Mapping[str, Any]] = folder.fs.find(folder.path, detail=True)
    start = len(folder.path.rstrip("/")) + 1
    logs = [
        ListedLog(path[start:], *_stored_size_and_time(about))
        for path, about in files.items()
        if path.endswith((SUFFIX, ACTIVE_SUFFIX))
    ]
    # Folders of a store are only name prefixes, without a change time.
    return Listing([log for log in logs if ENROLLED not in log.name.split("/")[:-1]], {}, [])


def size_and_time(path: Path) -> tuple[int, int]:
    """Return size (bytes) and modification time (ns) of a file, to detect changes.

    Raise `LogError` if there is no such file, or its store cannot be used.
    """
    with store_errors(path):
        if is_local(path):
            status = path.stat()
            return status.st_size, status.st_mtime_ns
        stored: Any = path
        return _stored_size_and_time(stored.fs.info(stored.path))


def _stored_size_and_time(about: Mapping[str, Any]) -> tuple[int, int]:
    """Return size and time from a store's metadata; objects are replaced, never modified."""
    time = next((about[name] for name in _TIMES if about.get(name) is not None), 0)
    if isinstance(time, str):
        time = datetime.fromisoformat(time)
    if isinstance(time, datetime):
        time = time.timestamp()
    return int(about["size"] or 0), int(time * NANOSECONDS)
