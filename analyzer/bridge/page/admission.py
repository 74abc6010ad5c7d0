"""Who may read the page, by the head of the request."""

import hmac
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from secrets import compare_digest

from hearthlog.analyzer.ports import is_asked_in_digits

_YEAR = 365 * 24 * 3600


@dataclass(frozen=True)
class PageAdmission:
    """What a request must say.

    A page in a browser can send requests to every server of this machine. The token keeps out who
    does not know the address, the origin other pages that came to know it, and the host those that
    let a name of theirs point here.

    Attributes
    ----------
    bind : str
        Address that is listened on.
    port : int
    token : str
    """

    bind: str
    port: int
    token: str

    @property
    def cookie(self) -> str:
        """The field that has a browser remember that it may read, for a year."""
        rules = f"Path=/; Max-Age={_YEAR}; HttpOnly; SameSite=Strict"
        return f"{self._cookie_name}={self._pass}; {rules}"

    def has_token(self, target: str) -> bool:
        """Tell whether the target of a request is the page with the token."""
        return compare_digest(target.encode(), f"/?token={self.token}".encode())

    def admits(self, target: str, fields: Mapping[str, Sequence[str]], *, changes: bool) -> bool:
        """Judge a request.

        Parameters
        ----------
        target : str
            Of the request.
        fields : mapping of str to sequence of str
            All values of `Host`, `Origin` and `Cookie`.
        changes : bool
            Whether the request changes something; it needs an origin then.
        """
        hosts, origins = fields["Host"], fields["Origin"]
        if len(hosts) != 1 or not is_asked_in_digits(self.bind, hosts[0]):
            return False
        if len(origins) > 1 or (changes and not origins):
            return False
        if origins and origins[0].lower() != f"http://{hosts[0].lower()}":
            return False
        return self.has_token(target) or self._has_pass(fields["Cookie"])

    @property
    def _cookie_name(self) -> str:
        return f"hearthlog-{self.port}"

    @property
    def _pass(self) -> str:
        """What the cookie has: who gets to see it does not know the token."""
        return hmac.digest(self.token.encode(), b"page of the home", "sha256").hex()

    def _has_pass(self, cookies: Sequence[str]) -> bool:
        given = [pair.strip().partition("=") for each in cookies for pair in each.split(";")]
        own = (value for name, _, value in given if name == self._cookie_name)
        return any(compare_digest(value.encode(), self._pass.encode()) for value in own)
