"""Labels as people write them, and the names of classes that they mean."""

import re
import unicodedata
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

from hearthlog.analyzer.errors import DataError
from hearthlog.models.classes import CLASS_NAME, find_class
from hearthlog.schemas.files import read_toml

_LONGEST = 200  # characters of a label; to normalise many accents takes the square of their number
_UMLAUTS = str.maketrans({"ä": "ae", "ö": "oe", "ü": "ue"})
_SEPARATORS = re.compile(r"[\s_-]+")


class ClassNames(NamedTuple):
    """What labels mean."""

    certain: Mapping[str, str]
    folded: Mapping[str, str]


def read_class_map(path: Path) -> dict[str, str]:
    """Read a table of labels and their classes.

    Raise `DataError` if the file cannot be read, has something else than names of classes, or
    names two for one label.
    """
    classes: dict[str, str] = {}
    for label, name in read_toml(path, "map", DataError).items():
        if not isinstance(name, str) or not CLASS_NAME.fullmatch(name):
            raise DataError(
                f"{path}: {label[:64]!r} needs the name of a class in quotes (lower-case letters, "
                'digits and \'_\'), as "Tap Water" = "tap_water"'
            )
        other = classes.setdefault(_spelt(label), name)
        if other != name:
            raise DataError(f"{path}: {label[:64]!r} has two classes: {other} and {name}")
    return classes


def find_class_names(labels: Iterable[str], class_map: Mapping[str, str] | None) -> ClassNames:
    """Find the classes that labels mean; without a map, any name may be that of a new one.

    Parameters
    ----------
    class_map : mapping of str to str or None
        As `read_class_map` returns it. With a map, only classes that it or hearthlog knows are
        found for labels that are no names.
    """
    given = class_map or {}
    classes = set(given.values())
    certain: dict[str, str] = {}
    folded: dict[str, str] = {}
    for label in set(labels):
        mapped = given.get(_spelt(label))
        name = _folded(label)
        if mapped or CLASS_NAME.fullmatch(label):
            certain[label] = mapped or label
        elif name and (class_map is None or name in classes or find_class(name)):
            folded[label] = name
    return ClassNames(certain, folded)


def _spelt(label: str) -> str:
    """Return a label as it is compared: capitals and the width of blanks make no difference."""
    if len(label) > _LONGEST:
        return label
    return " ".join(unicodedata.normalize("NFC", label).casefold().split())


def _folded(label: str) -> str:
    """Return the name of a class that is spelt like a label; empty if there is none."""
    if len(label) > _LONGEST:
        return ""
    letters = unicodedata.normalize("NFD", _spelt(label).translate(_UMLAUTS))
    plain = "".join(c for c in letters if not unicodedata.combining(c))
    row = find_class(plain)
    if row is not None:
        return row.name
    name = _SEPARATORS.sub("_", plain).strip("_")
    return name if CLASS_NAME.fullmatch(name) else ""
