"""Scenarios: which labels of a manifest make up which class of a model."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from hearthlog.analyzer.errors import DataError
from hearthlog.models.modelfile import CLASS_NAME, MOST_CLASSES, TEXT
from hearthlog.schemas.smallfile import read_toml

# What is audible in a home, by the names the built-in scenarios use. `other_negative` (rain, a
# dog, sirens …) is no class of either: an honest recogniser calls it unknown.
_GENERAL = (
    "silence",
    "speech",
    "music",
    "phone_ring",
    "coughing",
    "crying",
    "yelling",
    "laughing",
    "objects_activity",
)
_WATER = ("flushing_water", "shower", "tap_water")
_BATHROOM_OTHER = ("bathroom_other", *_GENERAL[1:])
LABELS = frozenset({*_GENERAL, *_WATER, "bathroom_other", "other_negative"})


@dataclass(frozen=True)
class Scenario:
    """What a model is to tell apart.

    Attributes
    ----------
    name : str
    classes : mapping of str to tuple of str
        Each class and the labels that belong to it, in the order of the model's classes.
    ignored : frozenset of str
        Labels that may stand in a manifest and are left out.
    """

    name: str
    classes: Mapping[str, tuple[str, ...]]
    ignored: frozenset[str] = frozenset()

    @property
    def class_of(self) -> dict[str, str]:
        """Class of each label that has one."""
        return {label: name for name, labels in self.classes.items() for label in labels}

    @property
    def labels(self) -> frozenset[str]:
        """Labels a manifest may use: built in, in a class, or ignored."""
        return LABELS | self.class_of.keys() | self.ignored


BUILTIN = {
    "bathroom": Scenario(
        "bathroom",
        {"silence": ("silence",)} | {w: (w,) for w in _WATER} | {"other": _BATHROOM_OTHER},
    ),
    "general": Scenario("general", {label: (label,) for label in _GENERAL}),
}


def load_scenario(name: str) -> Scenario:
    """Return a built-in scenario, or read one from a TOML file.

    The file has a table `[classes]`, `name = ["label", ...]`, and may have `ignore = ["label",
    ...]` above it.

    Raises
    ------
    DataError
        If there is no such scenario, or the file does not say what it must.
    """
    if name in BUILTIN:
        return BUILTIN[name]
    path = Path(name)
    if path.suffix != ".toml":
        raise DataError(f"unknown scenario {name!r}: use {', '.join(BUILTIN)} or a .toml file")
    if not path.stem.isprintable():
        raise DataError(f"{name!a}: give the scenario a name that can be printed")
    content = read_toml(path, "scenario file", DataError)
    unknown = content.keys() - {"classes", "ignore"}
    if unknown:
        raise DataError(f"{path}: unknown key {min(unknown)[:64]!r}; known are classes, ignore")
    classes = content.get("classes")
    if not isinstance(classes, dict) or not 2 <= len(classes) <= MOST_CLASSES:
        raise DataError(f"{path}: needs a table [classes] with 2 to {MOST_CLASSES} classes")
    table = {_class_name(path, key): _labels(path, key, value) for key, value in classes.items()}
    ignored = frozenset(_labels(path, "ignore", content["ignore"])) if "ignore" in content else ()
    every = [label for labels in (*table.values(), ignored) for label in labels]
    twice = sorted({label for label in every if every.count(label) > 1})
    if twice:
        raise DataError(f"{path}: label {twice[0][:64]!r} is in two places")
    return Scenario(path.stem, table, frozenset(ignored))


def _class_name(path: Path, name: str) -> str:
    if not CLASS_NAME.fullmatch(name):
        raise DataError(
            f"{path}: class name {name[:64]!r} must be at most 64 lower-case letters, digits and "
            "'_', starting with a letter"
        )
    return name


def _labels(path: Path, key: str, value: object) -> tuple[str, ...]:
    if not isinstance(value, list) or not value or not all(map(_is_label, value)):
        raise DataError(f'{path}: {key} must be a list of labels, such as ["speech"]')
    return tuple(value)


def _is_label(value: object) -> bool:
    return isinstance(value, str) and bool(value.strip()) and bool(TEXT.fullmatch(value))
