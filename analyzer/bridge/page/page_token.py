"""The token in the address of the page: given in a file, or made once."""

import os
import re
import secrets
from pathlib import Path

from hearthlog.analyzer.bridge.errors import BridgeError
from hearthlog.analyzer.bridge.secret_files import secret_path
from hearthlog.schemas.storage.small_file import read_whole

_NAME = "page-token"
_FORM = re.compile(r"[A-Za-z0-9._~-]{16,200}")  # what an address can have as it is


def page_token(file: Path | None, state: Path) -> str:
    """Return the token of the page.

    Parameters
    ----------
    file : Path or None
        That has it in one line, as `secret_path` finds it; by default one is made in the folder of
        the state, and kept.
    state : Path
        That folder.

    Raises
    ------
    BridgeError
        If the file cannot be used, or none can be made.
    """
    if file is not None:
        return _read(secret_path(file))
    path = state / _NAME
    if not path.exists():
        _make(path)
    return _read(path)


def _read(file: Path) -> str:
    data = read_whole(file, "file of a token", 1 << 12, BridgeError)
    token = data.decode("utf-8", errors="replace").strip()
    if not _FORM.fullmatch(token):
        raise BridgeError(
            f"{file}: is no token of the page: one line of 16 to 200 letters, digits, '.', '_', "
            "'~' and '-'"
        )
    return token


def _make(path: Path) -> None:
    temporary = path.with_name(f".{path.name}-{os.getpid()}")
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        temporary.unlink(missing_ok=True)
        descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(descriptor, "w") as stream:
            stream.write(f"{secrets.token_urlsafe(16)}\n")
        temporary.replace(path)
    except OSError as error:
        raise BridgeError(
            f"{path}: the token of the page cannot be kept ({error.strerror}); name a folder with "
            "`state` in [bridge], or a file with `token_file` in [bridge.page]"
        ) from error
