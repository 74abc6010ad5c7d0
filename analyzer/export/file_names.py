"""Names of the files that an export makes."""

import re

_LENGTH = 100  # characters


def file_stem(topic: str) -> str:
    """Make a part of a file name from a topic: `mic_features` from `/mic/features`.

    Returns
    -------
    str
        At most 100 letters, digits and `_`; `topic` if nothing is left.
    """
    return re.sub(r"[^A-Za-z0-9]+", "_", topic).strip("_")[:_LENGTH] or "topic"


def unused_name(name: str, taken: dict[str, int]) -> str:
    """Return a name that is not taken, with a number before its suffix if need be.

    Parameters
    ----------
    name : str
        The name that is wanted; becomes `name-2.suffix` and so on.
    """
    stem, dot, suffix = name.rpartition(".")
    before, behind = (stem, dot + suffix) if stem else (name, "")
    unused, number = name, taken.get(name, 2)
    while unused in taken:
        unused, number = f"{before}-{number}{behind}", number + 1
    taken[name] = number
    taken[unused] = 2
    return unused
