"""Files that people write or pass on: read whole within limits, or refused with one line."""

import os
import tomllib
from pathlib import Path
from typing import IO, Any

from hearthlog.schemas.errors import HearthlogError
from hearthlog.schemas.storage.byte_ranges import is_local
from hearthlog.schemas.storage.regular_file import open_regular

_TOML_LIMIT = 1 << 20
_DEEPEST = 100  # parts of a dotted key, for which the parser takes the cube of their number


def read_whole(path: Path, what: str, limit: int, error: type[HearthlogError]) -> bytes:
    """Read a regular file of this machine, or a file of a store.

    Parameters
    ----------
    path : Path
        On this machine, or a `upath.UPath` of a store.
    what : str
        What it should be, for the message: `scenario file`.
    limit : int
        Bytes, at most.
    error : type of HearthlogError
        Type of the error that is raised.

    Raises
    ------
    HearthlogError
        Of the type `error`, if there is no such file, it is larger than the limit, cannot be read,
        or is no regular file.
    """
    try:
        if not path.exists():
            raise error(f"{path}: no such {what}")
        with _opened(path) as stream:
            data = stream.read(limit + 1)
    except OSError as reason:
        raise error(f"{path}: cannot be read ({reason.strerror})") from reason
    if len(data) > limit:
        raise error(f"{path}: larger than {limit >> 20} MB; this is no {what}")
    return data


def _opened(path: Path) -> IO[bytes]:
    """Open a file, which in a store is a regular one."""
    return os.fdopen(open_regular(path), "rb") if is_local(path) else path.open("rb")


def read_toml(path: Path, what: str, error: type[HearthlogError]) -> dict[str, Any]:
    """Read a TOML file of at most 1 MB.

    Parameters
    ----------
    path : Path
        On this machine, or a `upath.UPath` of a store.
    what : str
        What it should be, for the message: `scenario file`.
    error : type of HearthlogError
        Type of the error that is raised.

    Returns
    -------
    dict of str to object
        The content, tables as dictionaries.

    Raises
    ------
    HearthlogError
        Of the type `error`, if there is no such file, it is larger than 1 MB, cannot be read, is
        nested too deeply, or is no TOML in UTF-8.
    """
    data = read_whole(path, what, _TOML_LIMIT, error)
    content: dict[str, Any] = {}
    try:
        text = data.decode("utf-8")
        keys = (line for line in text.split("\n") if not line.lstrip().startswith("#"))
        deep = any(line.count(".") > _DEEPEST for line in keys)
        if not deep:
            content = tomllib.loads(text)
    except ValueError as reason:
        raise error(f"{path}: cannot be read as TOML ({str(reason)[:200]})") from reason
    except RecursionError:
        deep = True
    if deep:
        raise error(f"{path}: cannot be read as TOML (it is nested too deeply)")
    return content
