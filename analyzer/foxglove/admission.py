"""Who may look, by the head of the request: judged before anything is sent."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from secrets import compare_digest

from hearthlog.analyzer.ports import host_name, ip_of, is_asked_in_digits
from hearthlog.schemas.errors import HearthlogError

# Foxglove in a browser, and the desktop applications, whose pages are files.
_ORIGINS = frozenset({"https://app.foxglove.dev", "file://"})
_FIELD = re.compile(r"([!#$%&'*+.^_`|~0-9A-Za-z-]+):[ \t]*([\x20-\x7e]*?)[ \t]*")
_HANDED_ON = ("Sec-WebSocket-Key", "Sec-WebSocket-Version", "Sec-WebSocket-Protocol")
_LONGEST = 200  # characters of an origin that is told


class RefusedError(HearthlogError):
    """Somebody may not look; the message says why, to whoever runs the server."""


@dataclass(frozen=True)
class Admission:
    """What a request must say.

    A page in a browser can connect to every server of this machine. The token keeps out who does
    not know the address, the origin other pages that came to know it, and the host those that let a
    name of theirs point here.

    Attributes
    ----------
    origins : frozenset of str
        Pages that may look, as `https://lichtblick.example`, beside Foxglove's own and those that
        this machine serves. What is no page names none, and needs the token only.
    """

    bind: str
    token: str
    origins: frozenset[str] = frozenset()

    def check(self, head: bytes) -> bytes:
        """Judge a request.

        Parameters
        ----------
        head : bytes
            Up to the empty line, with it.

        Returns
        -------
        bytes
            Head of the request for the server behind: what this one is not about is left out.

        Raises
        ------
        RefusedError
            If the one who asks may not look.
        """
        target, fields = _parse(head)
        origin = fields.get("origin")
        if not is_asked_in_digits(self.bind, fields.get("host", "")):
            raise RefusedError(
                "refused: it was asked for by a name; connect to an address in digits"
            )
        if origin is not None and origin not in _ORIGINS | self.origins and not _is_local(origin):
            shown = origin[:_LONGEST]
            raise RefusedError(
                f"refused: a page of {shown}; if it is yours, let it look by --origin"
            )
        if not compare_digest(target.encode(), f"/?token={self.token}".encode()):
            raise RefusedError("refused: the token is missing or wrong; copy the whole address")
        handed_on = [
            f"{name}: {fields[name.lower()]}" for name in _HANDED_ON if name.lower() in fields
        ]
        lines = ["GET / HTTP/1.1", "Host: hearthlog", "Upgrade: websocket", "Connection: Upgrade"]
        return "\r\n".join([*lines, *handed_on, "", ""]).encode()


def _parse(head: bytes) -> tuple[str, Mapping[str, str]]:
    """Return the target and the fields, by their names in lower case."""
    first, *lines = head.decode("latin-1").removesuffix("\r\n\r\n").split("\r\n")
    method, _, rest = first.partition(" ")
    target, _, version = rest.partition(" ")
    fields = [match.groups() for match in map(_FIELD.fullmatch, lines) if match]
    named = {name.lower(): value for name, value in fields}
    if method != "GET" or version != "HTTP/1.1" or len(named) != len(lines):
        raise RefusedError("refused: what came was no request of a viewer")
    return target, named


def _is_local(origin: str) -> bool:
    """Tell whether a page is one that this machine serves."""
    address = ip_of(name := host_name(origin))
    is_here = name == "localhost" or (address is not None and address.is_loopback)
    return is_here and origin.startswith(("http://", "https://"))
