"""Scenarios: which labels of a manifest make up which class of a model."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from hearthlog.analyzer.errors import DataError
from hearthlog.models import classes as sound
from hearthlog.models.classes import CLASS_NAME
from hearthlog.models.classifiers.model import MOST_CLASSES, TEXT, Model
from hearthlog.schemas.files import read_toml

_GENERAL = (
    *(sound.SILENCE, sound.SPEECH, sound.MUSIC, sound.PHONE_RING, sound.COUGHING, sound.CRYING),
    *(sound.YELLING, sound.LAUGHING, sound.OBJECTS_ACTIVITY),
)
_WATER = (sound.FLUSHING_WATER, sound.SHOWER, sound.TAP_WATER)
_BATHROOM_OTHER = (sound.BATHROOM_OTHER, *_GENERAL[1:])
_FEWEST_UNKNOWN = 5  # sources
LABELS = frozenset(row.name for row in sound.CLASSES) - {sound.OTHER, sound.UNKNOWN}


@dataclass(frozen=True)
class Scenario:
    """The classes of a model, and the labels of each."""

    name: str
    classes: Mapping[str, tuple[str, ...]]
    ignored: frozenset[str] = frozenset()

    @property
    def class_of(self) -> dict[str, str]:
        """Class of each label that has one."""
        return {label: name for name, labels in self.classes.items() for label in labels}

    def find(self, label: str, *, marked: bool = False) -> str | None:
        """Find the class that a label belongs to.

        It is the class that lists this very label. If none does, it is the one that lists another
        name of the same sound (see `hearthlog.models.classes`), unless two classes do.

        Returns
        -------
        str or None
            Name of the class; None if the label is ignored, or in no class.
        """
        if marked and label == sound.UNKNOWN:  # a reviewer cannot tell
            return None
        classes: dict[str, str | None] = dict.fromkeys(self.ignored)
        classes |= {name: name for name in self.classes} if marked else {}
        classes |= self.class_of
        meant = {classes[name] for name in sound.meant_by(label, classes)}
        return meant.pop() if len(meant) == 1 else None

    def with_unknown(self, sources: Iterable[tuple[str, str]]) -> "Scenario":
        """Return this scenario with a class `unknown` of all that is in none of its classes.

        Returns
        -------
        Scenario
            This one, if it has such a class or as many as a model may have, or if fewer than five
            sources have such labels.
        """
        listed = self.class_of.keys() | self.ignored
        others = {(label, group) for label, group in sources if not sound.meant_by(label, listed)}
        full = sound.UNKNOWN in self.classes or len(self.classes) == MOST_CLASSES
        if full or len({group for _, group in others}) < _FEWEST_UNKNOWN:
            return self
        labels = tuple(sorted({label for label, _ in others}))
        return Scenario(self.name, {**self.classes, sound.UNKNOWN: labels}, self.ignored)

    def with_classes(self, names: Iterable[str]) -> "Scenario":
        """Return this scenario with some of its classes; labels of the others are unknown again."""
        classes = {name: self.classes[name] for name in names}
        if sound.UNKNOWN in classes:
            others = [labels for name, labels in self.classes.items() if name not in classes]
            classes[sound.UNKNOWN] += tuple(label for labels in others for label in labels)
        return Scenario(self.name, classes, self.ignored)

    def with_taught(self, learned: Mapping[str, tuple[str, ...]]) -> "Scenario":
        """Return this scenario with the classes that a home teaches, which then are not unknown."""
        classes = {**self.classes, **learned}
        if sound.UNKNOWN in self.classes:
            taken = learned.keys() | {one for labels in learned.values() for one in labels}
            unknown = self.classes[sound.UNKNOWN]
            rest = [one for one in unknown if not {one, sound.class_name(one)} & taken]
            classes[sound.UNKNOWN] = tuple(rest) or (sound.OTHER_NEGATIVE,)
        return Scenario(self.name, classes, self.ignored)

    @property
    def labels(self) -> frozenset[str]:
        """Labels that a manifest may use: built-in labels, those in a class, and ignored ones."""
        return LABELS | self.class_of.keys() | self.ignored


BUILTIN = {
    "bathroom": Scenario(
        "bathroom",
        {name: (name,) for name in (sound.SILENCE, *_WATER)} | {sound.OTHER: _BATHROOM_OTHER},
    ),
    "general": Scenario("general", {label: (label,) for label in _GENERAL}),
}


def scenario_of(model: Model) -> Scenario:
    """Return the scenario that a model was trained for."""
    classes = {name: tuple(labels) for name, labels in model.description.scenario.items()}
    return Scenario(model.description.scenario_name, classes)


def load_scenario(name: str) -> Scenario:
    """Return a built-in scenario, or read one from a TOML file.

    The file has a table `[classes]`, `name = ["label", ...]`, and may have `ignore = ["label",
    ...]` above it.

    Parameters
    ----------
    name : str
        `bathroom`, `general`, or the path of a `.toml` file, whose stem becomes the name.

    Raises
    ------
    DataError
        If there is no such scenario, or if the file cannot be read, is no TOML, has an unknown
        key, fewer than 2 classes or more than `MOST_CLASSES`, an invalid name of a class, or one
        label in two places, or if the labels of a class are no list of texts.
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
