"""A sign of life to a watchdog on the network, which raises the alarm when it stays away."""

import urllib.request
from threading import Thread
from urllib.parse import urlsplit

_SECONDS = 15.0


def is_ping_address(url: str) -> bool:
    """Tell whether an address can be asked.

    Parameters
    ----------
    url : str
    """
    parts = urlsplit(url)
    return parts.scheme in {"http", "https"} and bool(parts.hostname)


def ping(url: str, *, is_well: bool) -> str:
    """Ask for an address, or for `/fail` below it if something is wrong; nothing is sent.

    Parameters
    ----------
    url : str
        As `is_ping_address` takes it.
    is_well : bool

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
        except (OSError, ValueError) as error:
            reason = getattr(error, "reason", None) or error
            problems[:] = [str(getattr(reason, "strerror", None) or reason)]

    thread = Thread(target=ask, daemon=True)
    thread.start()
    thread.join(_SECONDS)
    return "".join(problems)
