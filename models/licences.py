"""Licences of recordings: which allow that a model learned from them is passed on."""

import re

_ALLOWED = re.compile(
    r"(cc0|public domain|cc[ -]by([ -]sa)?\b(?![ -](nc|nd))|odbl|apache[ -]2)", re.IGNORECASE
)
_FORBIDDEN = re.compile(
    r"\b(nc|nd|non-?commercial|commercial|no[ -]?deriv\w*|personal|unstated|unknown)\b",
    re.IGNORECASE,
)


def may_be_shipped(licence: str) -> bool:
    """Tell whether a model learned from a recording may be shipped, with attribution.

    Parameters
    ----------
    licence : str
        As a manifest states it: it must begin with CC0, public domain, CC BY, CC BY-SA, ODbL or
        Apache-2.0, and name nothing that forbids or doubts it.
    """
    return bool(_ALLOWED.match(licence.strip())) and not _FORBIDDEN.search(licence)
