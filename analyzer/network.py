"""Ports and addresses of this machine, and pings to a remote watchdog."""

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
from hearthlog.schemas.files import read_limited

HOST = "127.0.0.1"


def listen(port: int | None = None, bind: str = HOST) -> socket.socket:
    """Open a listening socket, on any free port by default.

    Raise `DataError` if the address or port cannot be bound.
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
    """Return a port that is free to listen on.

    Raise `DataError` if the address or port cannot be bound.
    """
    with listen(port, bind) as probe:
        return int(probe.getsockname()[1])


def hidden_address() -> str:
    """Return a random loopback address that no web page can guess.

    Viewer servers answer every client. By DNS rebinding a web page can reach any loopback address,
    but it would have to try 16 million addresses times some ten thousand ports. Local programs can
    look the address up.

    Returns
    -------
    str
        In 127.0.0.0/8; 127.0.0.1 on systems that bind no other loopback address, such as macOS.
    """
    address = ".".join(["127", *(str(1 + secrets.randbelow(254)) for _ in range(3))])
    with socket.socket() as probe:
        try:
            probe.bind((address, 0))
        except OSError:
            return HOST
    return address


def is_asked_in_digits(bind: str, host: str) -> bool:
    """Whether the `Host` of a request is a numeric address of this machine or `localhost`.

    This blocks DNS rebinding: the owner of a host name can point the name at any address, so that
    a web page under that name could read this server. Numeric addresses and `localhost` are safe.
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
    """Return the host of a URL in lower case, without port and final dot; empty if absent."""
    try:
        return (urlsplit(url).hostname or "").removesuffix(".")
    except ValueError:
        return ""


def ip_of(text: str) -> IPv4Address | IPv6Address | None:
    """Parse a numeric IP address; None if the text is not an IP address."""
    try:
        return ip_address(text)
    except ValueError:
        return None


_SECONDS = 15.0
_LONGEST = 1 << 12  # bytes of a file


def is_ping_address(url: str) -> bool:
    """Whether a URL is a valid HTTP or HTTPS address to ping."""
    try:
        parts = urlsplit(url)
        is_whole = parts.scheme in {"http", "https"} and bool(parts.hostname)
        _ = parts.port
    except ValueError:
        return False
    return is_whole and url.isascii() and url.isprintable() and " " not in url


def has_password(url: str) -> bool:
    """Whether a URL accepted by `is_ping_address` contains a user or password."""
    return "@" in urlsplit(url).netloc


def read_ping_address(file: Path) -> str:
    """Read a one-line file with a ping URL, a secret: anyone with the URL could fake the pings.

    Raise `HearthlogError` if the file cannot be read or has no valid URL.
    """
    data = read_limited(file, "file of a ping address", _LONGEST, HearthlogError)
    url = data.decode("utf-8-sig", "replace").strip()
    if not is_ping_address(url):
        raise HearthlogError(
            f"{file}: has no address that can be asked for; write one such as "
            "https://hc-ping.com/your-uuid on one line"
        )
    return url


def ping(url: str, *, is_well: bool) -> str:
    """Send a GET request to a URL, or to its `/fail` path on a problem, without any data.

    Returns
    -------
    str
        Reason of the failure; empty on success.
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
            # Other error messages may contain the URL, which is a secret.
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
