"""Ports and addresses of this machine on which something listens for viewers."""

import errno
import secrets
import socket

from hearthlog.analyzer.errors import DataError

HOST = "127.0.0.1"


def listen(port: int | None = None, bind: str = HOST) -> socket.socket:
    """Open a socket that waits for connections.

    Parameters
    ----------
    port : int, optional
        The only one that will do; by default any.
    bind : str, optional
        Address to listen on, of IPv4 or IPv6.

    Raises
    ------
    DataError
        If nothing can listen there.
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
        raise DataError(f"cannot listen on {bind}, port {port}: {reason}") from error


def free_port(port: int | None = None, bind: str = HOST) -> int:
    """Return a port on which this machine can listen.

    Parameters
    ----------
    port : int, optional
        The only one that will do; by default any.
    bind : str, optional
        Address to listen on, of IPv4 or IPv6.

    Raises
    ------
    DataError
        If nothing can listen there.
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
