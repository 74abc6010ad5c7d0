"""Manifests of labelled clips, and scenarios that map labels to the classes of a model."""

import math
import os
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.text_files import csv_records, read_text, without_disarming
from hearthlog.models import classes as sound
from hearthlog.models.classes import CLASS_NAME, meant_by
from hearthlog.models.classifiers.model import MOST_CLASSES, TEXT, Model
from hearthlog.schemas.files import read_toml

REQUIRED = ("path", "label", "source_group")
OPTIONAL = ("source", "licence", "start", "end")
_NAMED = 3  # skipped clips in a report
SIZE_LIMIT = 64 << 20  # half a million clips; a larger file is no manifest


@dataclass(frozen=True)
class LabelledClip:
    """One labelled recording."""

    path: Path
    label: str
    source_group: str
    source: str  # collection; empty if the manifest has none
    licence: str  # likewise
    start: float = 0.0  # in seconds of the file
    end: float = math.inf  # infinite for the end of the file


class SkippedClip(NamedTuple):
    """A clip that is excluded from training."""

    reason: str  # the same text for clips with the same problem
    clip: str  # identifies the clip, with details


def left_out_lines(left_out: Sequence[SkippedClip]) -> list[str]:
    """Format the number of skipped clips, with the first examples, one line per reason."""
    by_reason: dict[str, list[str]] = {}
    for reason, clip in left_out:
        by_reason.setdefault(reason, []).append(clip)
    lines = []
    for reason, clips in by_reason.items():
        first = "; ".join(clips[:_NAMED])
        more = f"; and {len(clips) - _NAMED:,} more" if len(clips) > _NAMED else ""
        lines.append(f"left out: {len(clips):,}, {reason}: {first}{more}")
    return lines


def why_skipped(skipped: Mapping[str, int]) -> str:
    """Format the reasons for skipped recordings, with their numbers."""
    return "; ".join(f"{count}: {reason}" for reason, count in skipped.items())[:300]


def example_of(left_out: Sequence[SkippedClip]) -> str:
    """Format the first skipped clip, to follow the reasons; empty if there is none."""
    return f", such as {left_out[0].clip}" if left_out else ""


class _RowError(DataError):
    """An invalid line of a manifest."""

    def __init__(self, where: str, reason: str, detail: str, shown: str = "") -> None:
        super().__init__(f"{where}: {detail}")
        self.left_out = SkippedClip(reason, f"{where}: {shown or detail}")


def read_manifest(
    path: Path, labels: Collection[str], left_out: list[SkippedClip] | None = None
) -> list[LabelledClip]:
    """Read a manifest with the columns path, label, source_group: at least one clip, in its order.

    The CSV is in UTF-8; its paths are relative to its folder. Optional columns are source, licence,
    start and end; others are ignored. Synonyms (`hearthlog.models.classes`) of allowed labels are
    allowed too. Invalid lines are collected in `left_out`, or raise an error without it.

    Raise `DataError`, with file and line, if a column, a value or an audio file is missing, a label
    is unknown, a start and an end are no part of a file, or the same clip, or part of it, is listed
    twice; if the file lists no clip, or is no CSV in UTF-8; if it cannot be read, or is larger than
    64 MiB.
    """
    lines = csv_records(path, read_text(path, "manifest", SIZE_LIMIT))
    first = next(lines, None)
    if first is None:
        raise DataError(f"{path}: is empty; it needs a first line that names the columns")
    number, header = first
    column = {name.strip(): position for position, name in enumerate(header)}
    missing = [name for name in REQUIRED if name not in column]
    if missing:
        raise DataError(f"{path}:{number}: no column {', '.join(missing)} in the first line")
    clips: list[LabelledClip] = []
    seen: dict[tuple[Path, float, float], int] = {}
    for number, record in lines:
        where = f"{path}:{number}"
        try:
            clip = _clip(where, path.parent, column, record, labels)
            _check_new(where, clip, seen, number)
        except _RowError as error:
            if left_out is None:
                raise
            left_out.append(error.left_out)
            continue
        clips.append(clip)
    if not clips and left_out:
        raise DataError(f"{path}: lists no clip that can be used; of its first, {left_out[0].clip}")
    if not clips:
        raise DataError(f"{path}: lists no clips")
    return clips


def _check_new(
    where: str, clip: LabelledClip, seen: dict[tuple[Path, float, float], int], number: int
) -> None:
    """Raise an error if another line lists the same part of a file."""
    first = seen.setdefault((clip.path, clip.start, clip.end), number)
    if first != number:
        raise _RowError(where, "listed twice", f"{clip.path.name!r} is listed in line {first} too")


def _clip(
    where: str, folder: Path, column: dict[str, int], record: list[str], labels: Collection[str]
) -> LabelledClip:
    if len(record) <= max(column[name] for name in REQUIRED):
        detail = f"has {len(record)} fields, the first line names {len(column)}"
        raise _RowError(where, "a line that is not complete", detail)
    value = {
        name: without_disarming(record[column[name]].strip())
        if column.get(name, len(record)) < len(record)
        else ""
        for name in (*REQUIRED, *OPTIONAL)
    }
    for name in REQUIRED:
        if not value[name]:
            raise _RowError(where, f"no {name}", f"{name} is empty")
    for name in ("source", "licence"):
        if not TEXT.fullmatch(value[name]):
            detail = f"{name} must be one line of at most 300 characters"
            raise _RowError(where, f"no {name} that can be kept", detail)
    if not meant_by(value["label"], labels):
        names = ", ".join(sorted(labels))
        shown = repr(value["label"][:64])
        detail = f"unknown label {shown}; known are {names}"
        raise _RowError(where, "a label that the scenario does not know", detail, shown)
    audio = folder / value["path"]
    if not os.path.isfile(audio):  # noqa: PTH113  False for a name too long for any file
        shown = repr(value["path"][:256])
        raise _RowError(where, "no such file", f"no such file: {shown}", shown)
    return LabelledClip(
        audio,
        value["label"],
        value["source_group"],
        value["source"],
        value["licence"],
        *_span(where, value["start"], value["end"]),
    )


def _span(where: str, start: str, end: str) -> tuple[float, float]:
    try:
        span = float(start or 0), float(end or math.inf)
    except ValueError:
        span = math.nan, math.nan
    if not 0 <= span[0] < span[1]:
        detail = (
            f"start {start[:32]!r} and end {end[:32]!r} are no part of a file; give seconds, the "
            "start before the end"
        )
        raise _RowError(where, "no part of a file", detail)
    return span


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
        """Class of each label that belongs to one."""
        return {label: name for name, labels in self.classes.items() for label in labels}

    def find(self, label: str, *, marked: bool = False) -> str | None:
        """Return the class of a label; None if the label is ignored, or in no class.

        A class that lists the label itself takes precedence. Otherwise a class that lists a synonym
        (see `hearthlog.models.classes`) is used, unless two classes do.
        """
        if marked and label == sound.UNKNOWN:  # a reviewer could not decide
            return None
        classes: dict[str, str | None] = dict.fromkeys(self.ignored)
        classes |= {name: name for name in self.classes} if marked else {}
        classes |= self.class_of
        meant = {classes[name] for name in sound.meant_by(label, classes)}
        return meant.pop() if len(meant) == 1 else None

    def with_unknown(self, sources: Iterable[tuple[str, str]]) -> "Scenario":
        """Return this scenario with a class `unknown` for all labels outside its classes.

        Unchanged if it has class `unknown` or the maximum number of classes, or if fewer than five
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
        """Return this scenario with some of its classes; labels of the others become unknown."""
        classes = {name: self.classes[name] for name in names}
        if sound.UNKNOWN in classes:
            others = [labels for name, labels in self.classes.items() if name not in classes]
            classes[sound.UNKNOWN] += tuple(label for labels in others for label in labels)
        return Scenario(self.name, classes, self.ignored)

    def with_trained(self, learned: Mapping[str, tuple[str, ...]]) -> "Scenario":
        """Return this scenario with the new classes of a home, which are then no longer unknown."""
        classes = {**self.classes, **learned}
        if sound.UNKNOWN in self.classes:
            taken = learned.keys() | {one for labels in learned.values() for one in labels}
            unknown = self.classes[sound.UNKNOWN]
            rest = [one for one in unknown if not {one, sound.class_name(one)} & taken]
            classes[sound.UNKNOWN] = tuple(rest) or (sound.OTHER_NEGATIVE,)
        return Scenario(self.name, classes, self.ignored)

    @property
    def labels(self) -> frozenset[str]:
        """Labels allowed in a manifest: built-in labels, labels of a class, and ignored ones."""
        return LABELS | self.class_of.keys() | self.ignored


BUILTIN = {
    "bathroom": Scenario(
        "bathroom",
        {name: (name,) for name in (sound.SILENCE, *_WATER)} | {sound.OTHER: _BATHROOM_OTHER},
    ),
    "general": Scenario("general", {label: (label,) for label in _GENERAL}),
}


def scenario_of(model: Model) -> Scenario:
    """Return the scenario of a model."""
    classes = {name: tuple(labels) for name, labels in model.description.scenario.items()}
    return Scenario(model.description.scenario_name, classes)


def load_scenario(name: str) -> Scenario:
    """Return a built-in scenario, `bathroom` or `general`, or read one from the path of a file.

    The `.toml` file has a table `[classes]`, `name = ["label", ...]`, and may have `ignore =
    ["label", ...]` above it; its stem becomes the name.

    Raise `DataError` if there is no such scenario, or if the file cannot be read, is no TOML, has
    an unknown key, fewer than 2 classes or more than `MOST_CLASSES`, an invalid name of a class, or
    one label in two places, or if the labels of a class are no list of texts.
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
