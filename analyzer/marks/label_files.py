"""Import and export of label files in any supported format."""

import re
import unicodedata
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import NamedTuple, cast

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.layers import ROUNDING, Coverage
from hearthlog.analyzer.logs.text_files import read_text
from hearthlog.analyzer.marks.formats import AUDACITY, RAVEN, LabelFormat, find_format
from hearthlog.analyzer.marks.formats.labels import (
    OTHER,
    OVERLAP,
    Choice,
    FileLabel,
    LabelCodec,
    LineError,
    PlacedMark,
    SkippedLabels,
    make_mark,
    place_text,
)
from hearthlog.analyzer.marks.formats.tables import is_table
from hearthlog.analyzer.marks.marks import Mark
from hearthlog.models.classes import CLASS_NAME, find_class
from hearthlog.schemas.files import read_toml
from hearthlog.schemas.frames import FRAME_NANOSECONDS
from hearthlog.schemas.new_files import new_file

_CONTROLS = dict.fromkeys(range(0x80, 0xA0), "\ufffd")  # C1 control characters, allowed in names


def read_rows(path: Path, choice: Choice) -> Iterator[FileLabel | LineError]:
    """Yield the labels of a file in its order, unconverted; a `LineError` for a line without one.

    Raise `DataError` if the file cannot be read, is too large or no label file, or has no columns
    or tiers to choose.
    """
    format_ = find_format(path) or AUDACITY
    text = read_text(path, "label file", format_.size_limit)
    if format_ in {AUDACITY, RAVEN}:
        format_ = RAVEN if choice.columns or is_table(text) else AUDACITY
    if choice.columns and not format_.has_columns:
        raise DataError(f"{path}: has no columns to choose with --column; tables have")
    if choice.tiers and not format_.has_tiers:
        raise DataError(f"{path}: has no tiers to choose with --tier; documents of ELAN have")
    return _codec(format_).read(path, text, choice)


def write_labels(path: Path, marks: Sequence[Mark], coverage: Mapping[str, Coverage]) -> None:
    """Write marks as a label file that `read_rows` can read.

    Raise `DataError` if there are no marks, if the file would be too large, or if the marks are
    of several microphones and the format supports only one. Raise `LogError` if the file exists
    or cannot be written.
    """
    if not marks:
        raise DataError("no marks to export: nothing was imported or marked in these logs yet")
    format_ = find_format(path)
    assert format_ is not None
    harmless = [_without_controls(mark) for mark in marks]
    raw = _codec(format_).write(path, harmless, coverage).encode()
    if len(raw) > format_.size_limit:
        limit = format_.size_limit >> 20
        raise DataError(f"{path}: would be larger than {limit} MB; export fewer logs")
    with new_file(path) as temporary:
        temporary.write_bytes(raw)


def _codec(format_: LabelFormat) -> LabelCodec:
    module = import_module(f"hearthlog.analyzer.marks.formats.{format_.module}")
    return cast(LabelCodec, module.CODECS[format_.name])


def _without_controls(mark: Mark) -> Mark:
    """Replace terminal control characters in names."""
    return mark._replace(
        reviewer=mark.reviewer.translate(_CONTROLS), corrects=mark.corrects.translate(_CONTROLS)
    )


_LONGEST = 200  # characters of a label; normalising accents takes quadratic time
_UMLAUTS = str.maketrans({"ä": "ae", "ö": "oe", "ü": "ue"})
_SEPARATORS = re.compile(r"[\s_-]+")


class ClassNames(NamedTuple):
    """Classes of labels: exact, or by similar spelling."""

    certain: Mapping[str, str]
    folded: Mapping[str, str]


def read_class_map(path: Path) -> dict[str, str]:
    """Read a table of labels and their classes.

    Raise `DataError` if the file cannot be read, has values other than class names, or two
    classes for one label.
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
    """Find the classes of labels; without a map, any valid name may be a new class.

    With a map, as from `read_class_map`, labels that are no valid names match only classes of the
    map or of hearthlog.
    """
    given = class_map or {}
    classes = set(given.values())
    certain: dict[str, str] = {}
    folded: dict[str, str] = {}
    for label in dict.fromkeys(labels):
        mapped = given.get(_spelt(label))
        name = _folded(label)
        if mapped or CLASS_NAME.fullmatch(label):
            certain[label] = mapped or label
        elif name and (class_map is None or name in classes or find_class(name)):
            folded[label] = name
    return ClassNames(certain, folded)


def _spelt(label: str) -> str:
    """Return a label normalised for comparison: case-folded, with single blanks."""
    if len(label) > _LONGEST:
        return label
    return " ".join(unicodedata.normalize("NFC", label).casefold().split())


def _folded(label: str) -> str:
    """Return the class name with the spelling of a label; empty if there is none."""
    if len(label) > _LONGEST:
        return ""
    letters = unicodedata.normalize("NFD", _spelt(label).translate(_UMLAUTS))
    plain = "".join(c for c in letters if not unicodedata.combining(c))
    row = find_class(plain)
    if row is not None:
        return row.name
    name = _SEPARATORS.sub("_", plain).strip("_")
    return name if CLASS_NAME.fullmatch(name) else ""


class ImportOptions(NamedTuple):
    """Options for reading a label file."""

    microphone: str | None = None
    class_map: Mapping[str, str] | None = None
    choice: Choice = Choice()
    strict: bool = False


class Folded(NamedTuple):
    """A label that is no class name, the class name with its spelling, and the label count."""

    label: str
    name: str
    labels: int


class Imported(NamedTuple):
    """The marks of a label file."""

    by_log: dict[Path, list[Mark]]
    left_out: SkippedLabels
    moved: Mapping[str, int]


def import_labels(
    path: Path,
    coverage: Mapping[str, Coverage],
    options: ImportOptions,
    agree: Callable[[Sequence[Folded]], None],
) -> Imported:
    """Read a label file as non-overlapping marks, by covering log.

    `agree` is called once if labels match class names only by spelling; it raises to reject them.
    Raise `DataError`, with file and place, if the file cannot be read, is no label file or holds no
    labels; if `options.strict`, also if a label cannot be a mark.
    """
    left_out, moved = SkippedLabels(strict=options.strict), Counter[str]()
    placed = list(_placed(path, coverage, options, left_out, moved))
    if not placed and not any(left_out.kinds()):
        raise DataError(f"{path}: holds no labels")
    counts = Counter(each.mark.label for each in placed)
    certain, folded = find_class_names(counts, options.class_map)
    if folded:
        often = [label for label, _ in counts.most_common() if label in folded]
        agree([Folded(label, folded[label], counts[label]) for label in often])
    usable = _usable(path, placed, {**certain, **folded}, coverage, left_out)
    by_log: dict[Path, list[Mark]] = {}
    for _, mark in _without_overlaps(path, usable, left_out):
        for log, start, end in coverage[mark.microphone].split(mark.start, mark.end):
            by_log.setdefault(log, []).append(mark._replace(start=start, end=end))
    return Imported(by_log, left_out, moved)


def read_lines(path: Path, coverage: Mapping[str, Coverage], microphone: str) -> list[PlacedMark]:
    """Read a label file with labels that may overlap and may lie outside of recorded time.

    They are in the order of the file, with line numbers, or places in formats without lines. Raise
    `DataError`, with file and place, if the file cannot be read, is no label file or holds no
    labels, or if a label cannot be a mark.
    """
    placed = []
    for row in read_rows(path, Choice()):
        if isinstance(row, LineError):
            raise row
        placed.append(make_mark(path, row, coverage, microphone))
        if not CLASS_NAME.fullmatch(row.label):
            raise _unnamed(path, placed[-1])
    if not placed:
        raise DataError(f"{path}: holds no labels")
    return placed


def _placed(
    path: Path,
    coverage: Mapping[str, Coverage],
    options: ImportOptions,
    left_out: SkippedLabels,
    moved: Counter[str],
) -> Iterator[PlacedMark]:
    """Yield the labels of a file as marks, with unconverted labels."""
    for row in read_rows(path, options.choice):
        try:
            if isinstance(row, LineError):
                raise row
            chosen = options.microphone or row.microphone
            if chosen != row.microphone:
                moved.update({row.microphone} & coverage.keys())
            mark = make_mark(path, row._replace(microphone=chosen), coverage, None)
        except LineError as error:
            left_out.add(error)
        else:
            yield mark


def _usable(
    path: Path,
    placed: Iterable[PlacedMark],
    names: Mapping[str, str],
    coverage: Mapping[str, Coverage],
    left_out: SkippedLabels,
) -> Iterator[PlacedMark]:
    """Yield the marks within recorded time, with class names as labels."""
    for each in placed:
        name = names.get(each.mark.label)
        if name is None:
            left_out.add(_unnamed(path, each))
            continue
        mark = each.mark._replace(label=name)
        if coverage[mark.microphone].split(mark.start, mark.end):
            yield each._replace(mark=mark)
        else:
            reason = (
                f"{mark.label} lies outside of what {mark.microphone} heard; `hearthlog info` "
                "shows when that was"
            )
            left_out.add(LineError(place_text(path, each.place), OTHER, reason))


def _unnamed(path: Path, placed: PlacedMark) -> LineError:
    label = placed.mark.label
    reason = (
        f'{label[:64]!r} is not a class name; name one in a --map, as {label[:64]!r} = "tap_water"'
    )
    return LineError(place_text(path, placed.place), OTHER, reason, label)


def _without_overlaps(
    path: Path, placed: Iterable[PlacedMark], left_out: SkippedLabels
) -> Iterator[PlacedMark]:
    """Yield marks by microphone and time, cut where an earlier mark still lasts.

    A mark that loses more than a frame, or all, to another class is skipped and reported. Of marks
    with equal start and end, the first in the file is kept.
    """
    last: PlacedMark | None = None
    for each in sorted(placed, key=lambda each: each.mark[:3]):
        mark = each.mark
        if last is not None and last.mark.microphone == mark.microphone:
            taken = min(mark.end, last.mark.end) - mark.start
            much = min(FRAME_NANOSECONDS, mark.end - mark.start - 1)
            if mark.label != last.mark.label and taken > much:
                line = f"line {last.place}" if isinstance(last.place, int) else last.place
                reason = f"{mark.label} overlaps {last.mark.label} in {line}, which stays"
                left_out.add(LineError(place_text(path, each.place), OVERLAP, reason))
            mark = mark._replace(start=max(mark.start, last.mark.end))
        if mark == each.mark or mark.end - mark.start > ROUNDING:
            last = each._replace(mark=mark)
            yield last
