"""Releases of hearthlog, as files name the one that wrote them."""

import re

from hearthlog._version import __version__

_RELEASE = re.compile(r"(\d{1,4})\.(\d{1,4})\.(\d{1,4})")


def update_advice(written_by: object) -> str:
    """Return the advice for a file that only a later release reads in full.

    `written_by` is the release that wrote the file, such as `0.4.0`; anything else, as a file may
    contain, gives the advice without a release.
    """
    release, own = _numbers(written_by), _numbers(__version__)
    if release is None or own is None or release <= own:
        return "update hearthlog"
    return f"update hearthlog to {written_by} or later"


def _numbers(text: object) -> tuple[int, ...] | None:
    found = _RELEASE.fullmatch(text) if isinstance(text, str) else None
    return None if found is None else tuple(int(number) for number in found.groups())
