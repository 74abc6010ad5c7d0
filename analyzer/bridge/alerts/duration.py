"""Durations as people write them: `90s`, `20m`, `1h30m`, `7d`."""

import re

from hearthlog.schemas.frames import NANOSECONDS

SECOND = NANOSECONDS
MINUTE, HOUR, DAY = 60 * SECOND, 3600 * SECOND, 86_400 * SECOND
_UNITS = {"d": DAY, "h": HOUR, "m": MINUTE, "s": SECOND}
_WORDS = {"d": "d", "h": "h", "m": "min", "s": "s"}
_FORM = re.compile(r"(?:(\d{1,3})d)?(?:(\d{1,4})h)?(?:(\d{1,5})m)?(?:(\d{1,6})s)?")


def read_duration(text: object) -> int:
    """Read a duration, in nanoseconds.

    Raise `ValueError` if it is written otherwise.
    """
    found = _FORM.fullmatch(text) if isinstance(text, str) else None
    if found is None or not any(found.groups()):
        raise ValueError(f"{str(text)[:64]!r} is no duration; write it as 90s, 20m, 1h30m or 7d")
    counts = zip(_UNITS.values(), found.groups(), strict=True)
    return sum(unit * int(count) for unit, count in counts if count)


def duration_words(nanoseconds: int) -> str:
    """Write a duration: `1 h 30 min`.

    Parameters
    ----------
    nanoseconds : int
        Whole seconds.
    """
    parts = []
    rest = nanoseconds
    for key, unit in _UNITS.items():
        count, rest = divmod(rest, unit)
        if count:
            parts.append(f"{count} {_WORDS[key]}")
    return " ".join(parts) or "0 s"
