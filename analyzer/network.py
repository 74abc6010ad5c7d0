"""Ports and addresses of this machine, and pings to a watchdog."""

import errno
import secrets
import socket
import urllib.error
import urllib.request
from http.client import HTTPException
from ipaddress import IPv4Address, IPv6Address, ip_address
from pathlib import Path
from threading import Thread
from urllib.parse import urlsplit

from hearthlog.analyzer.errors import DataError
from hearthlog.schemas.errors import HearthlogError
from hearthlog.schemas.files import read_whole

HOST = "127.0.0.1"


def listen(port: int | None = None, bind: str = HOST) -> socket.socket:
    """Open a socket that waits for connections.

    Raise `DataError` if nothing can listen there.
    """
    family = socket.AF_INET6 if ":" in bind else socket.AF_INET
    try:
        return socket.create_server((bind, port or 0), family=family)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise DataError(
                f"port {port} is in use, perhaps by another viewer or watcher; choose another "
                "one with --port"
            ) from error
        reason = error.strerror or error
        place = bind if port is None else f"{bind}, port {port}"
        raise DataError(f"cannot listen on {place}: {reason}") from error


def free_port(port: int | None = None, bind: str = HOST) -> int:
    """Return a port on which this machine can listen.

    Raise `DataError` if nothing can listen there.
    """
    with listen(port, bind) as probe:
        return int(probe.getsockname()[1])


def hidden_address() -> str:
    """Return an address of this machine that no web page can guess.

    Servers of viewers answer whoever reaches them. A page in a browser reaches all of this machine,
    by a name that it lets point there, but it would have to try 16 million addresses times some ten
    thousand ports. Programs of this machine can look the address up.

    Returns
    -------
    str
        In 127.0.0.0/8; 127.0.0.1 on a system that has no other one, such as macOS.
    """
    address = ".".join(["127", *(str(1 + secrets.randbelow(254)) for _ in range(3))])
    with socket.socket() as probe:
        try:
            probe.bind((address, 0))
        except OSError:
            return HOST
    return address


def is_asked_in_digits(bind: str, host: str) -> bool:
    """Tell whether a request came for an address of this machine, and not for a name.

    Whoever owns a name can let it point to any address, so that a page of that name may read what
    is there. Nobody can do so with an address in digits, or with `localhost`.
    """
    listening, named = ip_address(bind), host_name(f"//{host}")
    if named == "localhost":
        return listening.is_loopback or listening.is_unspecified
    address = ip_of(named)
    if address is None:
        return False
    same = address == listening or listening.is_unspecified
    return same or (listening.is_loopback and address.is_loopback)


def host_name(url: str) -> str:
    """Return the host of a URL in lower case, without port and final dot; empty if it has none."""
    try:
        return (urlsplit(url).hostname or "").removesuffix(".")
    except ValueError:
        return ""


def ip_of(text: str) -> IPv4Address | IPv6Address | None:
    """Return the address that a text is in digits; None if it is none."""
    try:
        return ip_address(text)
    except ValueError:
        return None


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
