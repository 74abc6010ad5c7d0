"""Addresses of sound in the network, and the names under which the log has them."""

import re
from urllib.parse import urlsplit

from hearthlog.recorder.errors import SourceError

_SCHEMES = ("rtsp", "http", "https")
_MOST_CHARACTERS = 2000


def is_address(device: str) -> bool:
    """Return whether a device is one in the network, and not at this machine."""
    return "://" in device


def check_address(address: str) -> None:
    """Check what can be known of an address without the network.

    Parameters
    ----------
    address : str
        Such as "rtsp://user:password@camera/stream".

    Raises
    ------
    SourceError
        If it is of a kind that is not taken, has no host, or cannot be read. The message does not
        repeat it, for it may have a password.
    """
    if re.search(r"[\0-\x20\x7f]", address) or len(address) > _MOST_CHARACTERS:
        raise SourceError(
            "the address of a microphone has a space or a line break, or more than "
            f"{_MOST_CHARACTERS} characters; write a space as %20"
        )
    scheme = address.partition("://")[0]
    if scheme not in _SCHEMES:
        raise SourceError(
            f"{scheme[:16]!r} is no address of sound that is taken; "
            "such begin with rtsp://, http:// or https://"
        )
    if not _has_host(address):
        raise SourceError(
            f"the address {scheme}://… of a microphone has no host, or none that can be told from "
            "the rest; write it as rtsp://camera/stream, and in a password / as %2F, @ as %40, "
            "? as %3F and # as %23"
        )


def _has_host(address: str) -> bool:
    """Return whether it is clear which part is the host."""
    try:
        parts = urlsplit(address)
        host, _ = parts.hostname, parts.port
    except ValueError:
        return False
    return bool(host) and "@" not in address.partition("://")[2].removeprefix(parts.netloc)


def public_name(device: str) -> str:
    """Name a device for the log: an address without its user, password and parameters.

    Parameters
    ----------
    device : str
        An address, or the name of a device at this machine.

    Returns
    -------
    str
        Such as "rtsp://camera/stream"; any other device as it is.
    """
    if not is_address(device):
        return device
    scheme, _, rest = device.partition("://")
    place = re.split(r"[/?#]", rest, maxsplit=1)[0]
    path = rest.removeprefix(place)
    if "@" in path:  # where the password ends cannot be told
        return f"{scheme}://…"
    # Some cameras have `user=…&password=…` in their paths.
    return f"{scheme}://{place.rpartition('@')[2]}" + re.sub(r"[^/]*[=&?#].*", "…", path)
