"""Who may read the page, by the head of the request."""

import hmac
import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from secrets import compare_digest

from hearthlog.analyzer.ports import host_name, is_asked_in_digits

_YEAR = 365 * 24 * 3600
_PLAIN = re.compile(r"[a-z0-9.:-]{1,253}")  # a name, or an address, that can be said
_WHOLE = (
    "This page opens with its whole address only: copy all of it, with what is behind `?token=`. "
    "`hearthlog bridge` says at its start in which file the address is."
)


@dataclass(frozen=True)
class PageAdmission:
    """What a request must say.

    A page in a browser can send requests to every server of this machine. The token keeps out who
    does not know the address, the origin other pages that came to know it, and the host those that
    let a name of theirs point here.

    Attributes
    ----------
    names : frozenset of str
        Names by which the page may be asked for, with or without a port.
    """

    bind: str
    port: int
    token: str
    key: bytes
    names: frozenset[str] = frozenset()

    def cookie(self) -> str:
        """Return the field that has a browser remember for a year that it may read.

        It has no path: a browser takes that of the request, which a proxy may have changed.
        """
        rules = f"Max-Age={_YEAR}; HttpOnly; SameSite=Strict"
        return f"{self._cookie_name}={self.new_pass()}; {rules}"

    def new_pass(self) -> str:
        """Return what shows for a year that somebody had the token; it does not give it away."""
        return self._pass(int(time.time()) + _YEAR)

    def is_pass(self, text: str) -> bool:
        """Return whether a text is a pass that is valid now."""
        until, _, _ = text.partition("-")
        if not (until.isascii() and until.isdecimal()) or len(until) > 12:
            return False
        is_ours = compare_digest(text.encode(), self._pass(int(until)).encode())
        return is_ours and time.time() < int(until)

    def has_token(self, target: str) -> bool:
        """Tell whether the target of a request is the page with the token."""
        return compare_digest(target.encode(), f"/?token={self.token}".encode())

    def refusal(
        self,
        target: str,
        fields: Mapping[str, Sequence[str]],
        *,
        changes: bool,
        has_pass: bool = False,
    ) -> str:
        """Judge a request.

        Returns
        -------
        str
            Why it is refused, and what to do; empty if it is not.
        """
        hosts, origins = fields["Host"], fields["Origin"]
        host = hosts[0].lower() if len(hosts) == 1 else ""
        if not self._is_named(host):
            return _by_name(host_name(f"//{host}"))
        if len(origins) > 1 or (changes and not origins):
            return "A request that changes something has to say of which page it is."
        if origins and not self._is_own(origins[0].lower(), host):
            return (
                "Another page asked. If it is this one behind a proxy, write its name into the "
                "configuration as it is in the address, with a port if there is one: "
                'names = ["home.example"] in [bridge.page].'
            )
        cookies = self._cookies(fields["Cookie"])
        if has_pass or self.has_token(target) or any(map(self.is_pass, cookies)):
            return ""
        reason = ""
        if target.startswith("/?token="):
            reason = "The token in this address is not the one of the page. "
        elif cookies:
            reason = "What this browser remembers of the page is valid no more. "
        return f"{reason}{_WHOLE}"

    def _is_named(self, host: str) -> bool:
        """Return whether the page opens under the host of a request."""
        if host in self.names or host_name(f"//{host}") in self.names:
            return True
        return bool(host) and is_asked_in_digits(self.bind, host)

    def _is_own(self, origin: str, host: str) -> bool:
        """Return whether an origin is that of the page itself."""
        scheme, _, place = origin.partition("://")
        return scheme in {"http", "https"} and (place == host or place in self.names)

    @property
    def _cookie_name(self) -> str:
        return f"hearthlog-{self.port}"

    def _pass(self, until: int) -> str:
        text = f"page of the home {self.port} {until} {self.token}"
        return f"{until}-{hmac.digest(self.key, text.encode(), 'sha256').hex()}"

    def _cookies(self, fields: Sequence[str]) -> list[str]:
        given = [pair.strip().partition("=") for each in fields for pair in each.split(";")]
        return [value for name, _, value in given if name == self._cookie_name]


def _by_name(name: str) -> str:
    if not _PLAIN.fullmatch(name):
        return "This page is asked for by an address in digits, or by a name that is allowed."
    return (
        f"This page does not open by the name {name}, which a foreign page could let point here. "
        "Open it by the address of the box in digits, or allow the name in the configuration: "
        f'names = ["{name}"] in [bridge.page].'
    )
