"""Names of the files that an export makes."""

import re

_LENGTH = 100  # characters


def file_stem(topic: str) -> str:
    """Make a part of a file name of a topic: `mic_features` of `/mic/features`."""
    return re.sub(r"[^A-Za-z0-9]+", "_", topic).strip("_")[:_LENGTH] or "topic"


def unused_name(name: str, taken: set[str]) -> str:
    """Return the name, or with `-2` and so on before its suffix if it is taken; it is taken now."""
    stem, dot, suffix = name.rpartition(".")
    before, behind = (stem, dot + suffix) if stem else (name, "")
    unused, number = name, 2
    while unused in taken:
        unused, number = f"{before}-{number}{behind}", number + 1
    taken.add(unused)
    return unused
