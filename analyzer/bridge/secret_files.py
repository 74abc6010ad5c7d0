"""Files of the bridge's secrets: tokens, the key of cookies, and the page's address."""

import os
import re
import secrets
from pathlib import Path

from hearthlog.analyzer.bridge.state import BridgeError
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.files import read_limited
from hearthlog.schemas.new_files import create_file, private_folder, replaced_file

_CREDENTIALS = "CREDENTIALS_DIRECTORY"  # of systemd


def secret_path(path: Path) -> Path:
    """Return the path of a secret, relative to the systemd credentials folder if there is one."""
    return Path(os.environ.get(_CREDENTIALS, "")) / path


_TOKEN, _COOKIES, _ADDRESS = "page-token", "page-cookies", "page-address"
_FORM = re.compile(r"[A-Za-z0-9._~-]{16,200}")  # characters that URLs need not escape


def page_token(file: Path | None, state: Path) -> str:
    """Return the token of the page from a one-line file, resolved by `secret_path`.

    Without a file a token is created in the state folder and kept. Raise `BridgeError` if the file
    cannot be used or created.
    """
    return read_token(file) if file is not None else _kept(state / _TOKEN)


def cookie_key(state: Path) -> bytes:
    """Return the key that signs the page's cookies; a new key is created if its file is missing.

    Raise `BridgeError` if the key cannot be read or created.
    """
    return _kept(state / _COOKIES).encode()


def page_secrets(state: Path) -> list[Path]:
    """Return the paths of the page's secrets in the state folder."""
    return [state / name for name in (_TOKEN, _COOKIES, _ADDRESS)]


def keep_address(address: str, state: Path) -> Path:
    """Write the page's address with its token to a file that only the owner may read.

    Raise `BridgeError` if the file cannot be written.
    """
    path = state / _ADDRESS
    _write(path, address)
    return path


def read_token(file: Path) -> str:
    """Read a token file, resolved by `secret_path`.

    Raise `BridgeError` if the file cannot be used.
    """
    file = secret_path(file)
    data = read_limited(file, "file of a token", 1 << 12, BridgeError)
    token = data.decode("utf-8", errors="replace").strip()
    if not _FORM.fullmatch(token):
        raise BridgeError(
            f"{file}: has no token: one line of 16 to 200 letters, digits, '.', '_', '~' and '-'"
        )
    return token


def figures_token(port: int, file: Path | None) -> str:
    """Return the token of the port for Prometheus.

    Raise `BridgeError` if no token is configured: every account of the machine can reach a loopback
    port.
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
