"""State folder, secrets, and server tokens of the bridge."""

import os
import re
import secrets
from collections.abc import Callable
from pathlib import Path
from typing import Generic, TypeVar

from pydantic import TypeAdapter, ValidationError

from hearthlog.schemas.errors import HearthlogError, LogError
from hearthlog.schemas.files import read_limited
from hearthlog.schemas.new_files import create_file, private_folder, replaced_file


class BridgeError(HearthlogError):
    """Error in the configuration or operation of the bridge."""


_OF_SYSTEMD = "STATE_DIRECTORY"  # one folder, or several with colons between them


def state_folder(configured: Path | None, logs: Path) -> Path:
    """Return the state folder, created if missing.

    Returns
    -------
    Path
        The configured folder; else the state directory of systemd; else `bridge` next to the logs.

    Raises
    ------
    BridgeError
        If the folder cannot be created.
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


Content = TypeVar("Content")
_LARGEST = 4 << 20  # bytes of a file


class StateFile(Generic[Content]):
    """A JSON file of the state folder, checked when it is read and replaced atomically.

    Parameters
    ----------
    kind : type
        Type of the content, for pydantic.
    damaged, unsaved : str
        Consequence of a file that cannot be read, or written, for `say`.
    """

    def __init__(
        self,
        path: Path,
        kind: type[Content],
        say: Callable[[str], None],
        damaged: str,
        unsaved: str = "",
    ) -> None:
        self.path = path
        self._kind = TypeAdapter(kind)
        self._say = say
        self._damaged, self._unsaved = damaged, unsaved

    def read(self) -> Content | None:
        """Return the content; None if there is no file.

        Raise `BridgeError` if the file is damaged.
        """
        if not self.path.exists():
            return None
        try:
            return self._kind.validate_json(
                read_limited(self.path, "file of the bridge", _LARGEST, BridgeError)
            )
        except ValidationError as error:
            raise BridgeError(f"{self.path}: {self._damaged}") from error

    def load(self) -> Content | None:
        """Return the content; None if there is no file, or it is reported to be damaged."""
        try:
            return self.read()
        except HearthlogError:
            self.report_damage()
            return None

    def report_damage(self) -> None:
        """Report that the file is damaged."""
        self._say(f"{self.path}: {self._damaged}")

    def save(self, content: Content) -> bool:
        """Write the content, on disk on return; return False if the failure is reported."""
        try:
            self.write(content)
        except LogError as error:
            self._say(f"{error}; {self._unsaved}")
            return False
        return True

    def write(self, content: Content) -> None:
        """Write the content, on disk on return; raise `LogError` on a failure."""
        with replaced_file(self.path) as temporary, create_file(temporary) as stream:
            stream.write(self._kind.dump_json(content))


_CREDENTIALS = "CREDENTIALS_DIRECTORY"  # of systemd


def secret_path(path: Path) -> Path:
    """Return the path of a secret, relative to the systemd credentials folder if there is one."""
    return Path(os.environ.get(_CREDENTIALS, "")) / path


_TOKEN, _COOKIES, _ADDRESS = "page-token", "page-cookies", "page-address"
_FORM = re.compile(r"[A-Za-z0-9._~-]{16,200}")  # characters that URLs need not escape


def page_token(file: Path | None, state: Path) -> str:
    """Return the token of the page.

    Parameters
    ----------
    file : Path or None
        One-line token file, resolved by `secret_path`; None to create a token in the state folder
        and keep it.

    Raises
    ------
    BridgeError
        If the file cannot be used or created.
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
