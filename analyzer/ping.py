"""A sign of life to a watchdog on the network, which raises the alarm when it stays away."""

import urllib.error
import urllib.request
from http.client import HTTPException
from pathlib import Path
from threading import Thread
from urllib.parse import urlsplit

from hearthlog.schemas.errors import HearthlogError
from hearthlog.schemas.files import read_whole

_SECONDS = 15.0
_LONGEST = 1 << 12  # bytes of a file


def is_ping_address(url: str) -> bool:
    """Tell whether an address can be asked."""
    try:
        parts = urlsplit(url)
        is_whole = parts.scheme in {"http", "https"} and bool(parts.hostname)
        _ = parts.port
    except ValueError:
        return False
    return is_whole and url.isascii() and url.isprintable() and " " not in url


def has_password(url: str) -> bool:
    """Return whether an address, as `is_ping_address` takes it, has a user or a password in it."""
    return "@" in urlsplit(url).netloc


def read_ping_address(file: Path) -> str:
    """Read a file of one line with an address: who knows it could ping in the place of the box.

    Raise `HearthlogError` if it cannot be read, or has no such address.
    """
    data = read_whole(file, "file of a ping address", _LONGEST, HearthlogError)
    url = data.decode("utf-8-sig", "replace").strip()
    if not is_ping_address(url):
        raise HearthlogError(
            f"{file}: has no address that can be asked for; write one such as "
            "https://hc-ping.com/your-uuid on one line"
        )
    return url


def ping(url: str, *, is_well: bool) -> str:
    """Ask for an address, or for `/fail` below it if something is wrong; nothing is sent.

    Returns
    -------
    str
        Why nobody there has taken it; empty if somebody has.
    """
    problems = [f"no answer within {_SECONDS:.0f} s"]

    def ask() -> None:
        try:
            with urllib.request.urlopen(  # noqa: S310  the scheme was checked
                url if is_well else f"{url.rstrip('/')}/fail", timeout=_SECONDS
            ):
                problems.clear()
        except urllib.error.HTTPError as error:
            problems[:] = [f"status {error.code}"]
        except (OSError, ValueError, HTTPException) as error:
            reason = getattr(error, "reason", None) or error
            # What others say may have the address in it, which is a secret.
            is_late = isinstance(reason, TimeoutError)
            what = "timed out" if is_late else getattr(reason, "strerror", None)
            problems[:] = [what or type(reason).__name__]

    thread = Thread(target=ask, daemon=True)
    try:
        thread.start()
    except RuntimeError:
        return "no thread is free"
    thread.join(_SECONDS)
    return "".join(problems)
