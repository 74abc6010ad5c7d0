"""From the categories of a collection to the labels of a manifest: a table that can be edited."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

from hearthlog.analyzer.errors import DataError
from hearthlog.models.classes import OTHER, OTHER_NEGATIVE, UNKNOWN, find_class
from hearthlog.models.classifiers.model import TEXT
from hearthlog.schemas.errors import listed
from hearthlog.schemas.files import read_toml

_KEYS = {"labels", "broad", "skip", "keep"}
BROAD = "only broad categories"
SKIPPED = "may be one of ours"
SEVERAL = "several sounds at once"


class Decision(NamedTuple):
    """What categories that are heard together are in a manifest.

    Attributes
    ----------
    label : str
        Empty if they are left out.
    reason : str
        Why they are left out; empty if they are not.
    """

    label: str
    detail: str
    reason: str = ""


@dataclass(frozen=True)
class LabelMap:
    """A map from categories to labels."""

    label_of: Mapping[str, str]
    broad: frozenset[str]
    skip: frozenset[str]
    keep: bool = False

    def decide(self, categories: Iterable[str]) -> Decision:
        """Return the label of categories that are heard together.

        Broad ones are passed over. The others must all have one label; without one in the map it
        is `other_negative`, or the category itself.
        """
        told = [name for name in categories if name not in self.broad]
        detail = " + ".join(sorted(set(told)))
        labels = {self.label_of.get(name, name if self.keep else OTHER_NEGATIVE) for name in told}
        skipped = [name for name in told if name in self.skip]
        if not told:
            return Decision("", "", BROAD)
        if skipped:
            return Decision("", skipped[0], SKIPPED)
        if len(labels) > 1:
            return Decision("", detail, SEVERAL)
        return Decision(labels.pop(), detail)

    def with_classes(self, folder: Path, names: Iterable[str]) -> "LabelMap":
        """Return this map, with names of categories that are names of classes, too.

        Raise `DataError` if one of them is in this map nowhere, and is no name of a class.
        """
        known = self.label_of.keys() | self.broad | self.skip
        classes = {name: find_class(name) for name in sorted(set(names) - known)}
        unknown = [
            repr(name[:64])
            for name, row in classes.items()
            if row is None or row.name in {OTHER, UNKNOWN}
        ]
        if unknown:
            raise DataError(
                f"{folder}: {listed(unknown[:10])}: no label is called so; rename the folder, or "
                "give a --map"
            )
        named = {name: row.name for name, row in classes.items() if row is not None}
        return replace(self, label_of={**self.label_of, **named})


def shipped_map(name: str) -> str:
    """Return the map of a collection that comes with hearthlog, as TOML."""
    return _shipped(name).read_text("utf-8")


def read_map(name: str, path: Path | None = None) -> LabelMap:
    """Read a map.

    Raise `DataError` if the file cannot be read, or is no map.
    """
    path = path or _shipped(name)
    content = read_toml(path, "map", DataError)
    unknown = content.keys() - _KEYS
    if unknown:
        raise DataError(
            f"{path}: unknown key {min(unknown)[:64]!r}; known are {', '.join(sorted(_KEYS))}"
        )
    labels = content.get("labels")
    if not isinstance(labels, dict):
        raise DataError(f"{path}: needs a table [labels]")
    keep = content.get("keep", False)
    if not isinstance(keep, bool):
        raise DataError(f"{path}: 'keep' must be true or false")
    rows = [(label, _categories(path, label, names)) for label, names in labels.items()]
    broad, skip = (_categories(path, key, content.get(key, [])) for key in ("broad", "skip"))
    every = [name for names in (broad, skip, *(names for _, names in rows)) for name in names]
    if len(set(every)) < len(every):
        twice = next(name for name in every if every.count(name) > 1)
        raise DataError(f"{path}: {twice[:64]!r} is in two places")
    label_of = {name: label for label, names in rows for name in names}
    return LabelMap(label_of, frozenset(broad), frozenset(skip), keep)


def _shipped(name: str) -> Path:
    return Path(str(files(__package__))) / "maps" / f"{name}.toml"


def _categories(path: Path, key: str, value: object) -> list[str]:
    texts = isinstance(value, list) and all(isinstance(name, str) for name in value)
    if not texts or not key.strip() or not TEXT.fullmatch(key):
        raise DataError(f'{path}: {key[:64]!r} must be a label with categories, such as ["Cough"]')
    assert isinstance(value, list)
    return value
