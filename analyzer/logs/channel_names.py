"""Names: of the elements of arrays, and of files."""

import json
import re
from collections.abc import Mapping

_LENGTH = 100  # characters of a file name


def names_of(metadata: Mapping[str, str], path: str) -> list[str]:
    """Return the names that a channel has for the elements of an array; none if one is unfit."""
    try:
        names = json.loads(metadata.get(f"{path}_names", ""))
    except (ValueError, RecursionError):
        return []
    fit = isinstance(names, list) and all(
        isinstance(name, str) and name.isprintable() for name in names
    )
    return names if fit and len(set(names)) == len(names) else []


def file_stem(topic: str) -> str:
    """Make a part of a file name of a topic: `mic_features` of `/mic/features`."""
    return re.sub(r"[^A-Za-z0-9]+", "_", topic).strip("_")[:_LENGTH] or "topic"


def unused(name: str, names: set[str]) -> str:
    """Return the name, or with `-2` and so on before its suffix if it is taken; it is taken now."""
    stem, dot, suffix = name.rpartition(".")
    before, behind = (stem, dot + suffix) if stem else (name, "")
    own, number = name, 2
    while own in names:
        own, number = f"{before}-{number}{behind}", number + 1
    names.add(own)
    return own
