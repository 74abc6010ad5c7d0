"""Files of the bridge: the folder of its state, secrets, and tokens of its servers."""

import os
import re
import secrets
from pathlib import Path

from hearthlog.schemas.errors import HearthlogError, LogError
from hearthlog.schemas.files import read_whole
from hearthlog.schemas.new_files import create_file, private_folder, replaced_file


class BridgeError(HearthlogError):
    """The bridge cannot do what it is configured for."""


_OF_SYSTEMD = "STATE_DIRECTORY"  # one folder, or several with colons between them


def state_folder(configured: Path | None, logs: Path) -> Path:
    """Return the folder of the state, which is made where it is missing.

    Returns
    -------
    Path
        The configured one; else that of systemd; else `bridge` beside the logs.

    Raises
    ------
    BridgeError
        If it cannot be made.
    """
    given = os.environ.get(_OF_SYSTEMD, "").partition(":")[0]
    folder = configured or (Path(given) if given else logs.absolute().parent / "bridge")
    try:
        private_folder(folder)
    except OSError as error:
        raise BridgeError(
            f"{folder}: cannot be made ({error.strerror}); name another one: bridge.state"
        ) from error
    return folder


_CREDENTIALS = "CREDENTIALS_DIRECTORY"  # of systemd


def secret_path(path: Path) -> Path:
    """Return where a file of a secret is."""
    return Path(os.environ.get(_CREDENTIALS, "")) / path


_TOKEN, _COOKIES, _ADDRESS = "page-token", "page-cookies", "page-address"
_FORM = re.compile(r"[A-Za-z0-9._~-]{16,200}")  # what an address can have as it is


def page_token(file: Path | None, state: Path) -> str:
    """Return the token of the page.

    Parameters
    ----------
    file : Path or None
        That has it in one line, as `secret_path` finds it; by default one is made in the folder of
        the state, and kept.

    Raises
    ------
    BridgeError
        If the file cannot be used, or none can be made.
    """
    return read_token(file) if file is not None else _kept(state / _TOKEN)


def cookie_key(state: Path) -> bytes:
    """Return what the cookies of the page are made with; without its file there will be another.

    Raise `BridgeError` if it cannot be read or made.
    """
    return _kept(state / _COOKIES).encode()


def page_secrets(state: Path) -> list[Path]:
    """Name the files of secrets that the page keeps in a folder."""
    return [state / name for name in (_TOKEN, _COOKIES, _ADDRESS)]


def keep_address(address: str, state: Path) -> Path:
    """Write the whole address of the page into a file that only its owner may read.

    Raise `BridgeError` if it cannot be written.
    """
    path = state / _ADDRESS
    _write(path, address)
    return path


def read_token(file: Path) -> str:
    """Read a file of a token, as `secret_path` finds it.

    Raise `BridgeError` if it cannot be used.
    """
    file = secret_path(file)
    data = read_whole(file, "file of a token", 1 << 12, BridgeError)
    token = data.decode("utf-8", errors="replace").strip()
    if not _FORM.fullmatch(token):
        raise BridgeError(
            f"{file}: has no token: one line of 16 to 200 letters, digits, '.', '_', '~' and '-'"
        )
    return token


def figures_token(port: int, file: Path | None) -> str:
    """Return the token of the port for Prometheus.

    Raise `BridgeError` if there is none: every account of the machine can reach a port of
    loopback.
    """
    if file is None:
        raise BridgeError(
            f"bridge.prometheus: port {port} stays closed, as every account of this machine could "
            "read it: name a `token_file`, and the same file as `credentials_file` in Prometheus"
        )
    return read_token(file)


def _kept(path: Path) -> str:
    if not path.exists():
        _write(path, secrets.token_urlsafe(16))
    return read_token(path.absolute())


def _write(path: Path, line: str) -> None:
    try:
        private_folder(path.parent)
        with replaced_file(path, readers=0) as temporary, create_file(temporary) as stream:
            stream.write(f"{line}\n".encode())
    except (LogError, OSError) as error:
        text = (
            f"{path}: cannot be written ({error.strerror})" if isinstance(error, OSError) else error
        )
        raise BridgeError(f"{text}; name another folder with `state` in [bridge]") from error
