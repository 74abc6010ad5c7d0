"""Names of logs that may lie in a store, such as `s3://bucket/home`."""

import re
from pathlib import Path
from typing import Any, cast

from hearthlog.analyzer.extras import remedy
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.files import store_errors

_URL = re.compile(r"([A-Za-z][A-Za-z0-9+.-]*)://(.*)", re.DOTALL)
_FILES = {"file", "local"}
_OURS = {"fsspec", "s3fs", "upath", ""}  # what the extra `cluster` installs, or nobody knows
# A listing that is kept hides what others put there since.
_FRESH: dict[str, Any] = {"use_listings_cache": False}
# botocore waits longer each time where a store says that it is asked too often. s3fs tries five
# times whatever botocore tried: a silent server is given up after four minutes.
_S3 = _FRESH | {
    "config_kwargs": {"retries": {"mode": "standard", "total_max_attempts": 5}, "read_timeout": 10}
}
_OPTIONS: dict[str, dict[str, Any]] = {
    "s3": _S3,
    "s3a": _S3,
    **dict.fromkeys(("gs", "gcs", "az", "abfs", "adl"), _FRESH),
}


def location(text: str) -> Path:
    """Read the name of a log or a folder, on this machine or in a store that fsspec knows.

    Raise `LogError` if there is no such kind of store, or its package is not installed.
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
            path.fs.root_marker  # noqa: B018  makes it
    except ImportError as error:
        raise LogError(f"{text}: {error}; {_remedy(error)}") from error
    # It does all that is asked of a Path here, but is none for the type checker.
    return cast("Path", path)


def _remedy(error: ImportError) -> str:
    """Say how to install what could not be imported: our extra, or a package of fsspec's."""
    missing = error if error.__cause__ is None else error.__cause__
    name = getattr(missing, "name", None) or ""
    return f"try: pip install {name}" if name not in _OURS else remedy("fsspec")
