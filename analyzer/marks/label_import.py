"""Label files of any format, read as marks."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.coverage import ROUNDING, Coverage
from hearthlog.analyzer.marks.formats.class_names import find_class_names
from hearthlog.analyzer.marks.formats.label_files import read_rows
from hearthlog.analyzer.marks.formats.labels import Choice, PlacedMark, make_mark
from hearthlog.analyzer.marks.formats.left_out import OTHER, OVERLAP, LeftOut, LineError, place_text
from hearthlog.analyzer.marks.marks import Mark
from hearthlog.models.classes import CLASS_NAME
from hearthlog.schemas.frames import FRAME_NANOSECONDS


class ImportOptions(NamedTuple):
    """How a label file is read."""

    microphone: str | None = None
    class_map: Mapping[str, str] | None = None
    choice: Choice = Choice()
    strict: bool = False


class Folded(NamedTuple):
    """A label that is no name of a class, the name that is spelt like it, and their number."""

    label: str
    name: str
    labels: int


class Imported(NamedTuple):
    """The marks of a label file."""

    by_log: dict[Path, list[Mark]]
    left_out: LeftOut
    moved: Mapping[str, int]


def import_labels(
    path: Path,
    coverage: Mapping[str, Coverage],
    options: ImportOptions,
    agree: Callable[[Sequence[Folded]], None],
) -> Imported:
    """Read a label file as marks that do not overlap, in the logs that cover them.

    Parameters
    ----------
    agree : callable
        Is called once if labels are taken as names of classes that are only spelt like them; raises
        if that is not wanted.

    Raises
    ------
    DataError
        With file and place, if the file cannot be read, is no label file or holds no labels; if
        `options.strict`, also if a label cannot be a mark.
    """
    left_out, moved = LeftOut(strict=options.strict), Counter[str]()
    placed = list(_placed(path, coverage, options, left_out, moved))
    if not placed and not any(left_out.kinds()):
        raise DataError(f"{path}: holds no labels")
    counts = Counter(each.mark.label for each in placed)
    certain, folded = find_class_names(counts, options.class_map)
    if folded:
        often = [label for label, _ in counts.most_common() if label in folded]
        agree([Folded(label, folded[label], counts[label]) for label in often])
    named = _named(path, placed, {**certain, **folded}, left_out)
    heard = _heard(path, named, coverage, left_out)
    by_log: dict[Path, list[Mark]] = {}
    for _, mark in _without_overlaps(path, heard, left_out):
        for log, start, end in coverage[mark.microphone].split(mark.start, mark.end):
            by_log.setdefault(log, []).append(mark._replace(start=start, end=end))
    return Imported(by_log, left_out, moved)


def read_lines(path: Path, coverage: Mapping[str, Coverage], microphone: str) -> list[PlacedMark]:
    """Read a label file whose labels may overlap, and may lie where nothing was recorded.

    Returns
    -------
    list of PlacedMark
        In the order of the file, with their lines, or their places in a file that has none.

    Raises
    ------
    DataError
        With file and place, if the file cannot be read, is no label file or holds no labels, or if
        a label cannot be a mark.
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
    left_out: LeftOut,
    moved: Counter[str],
) -> Iterator[PlacedMark]:
    """Yield the labels of a file as marks, whose labels are those of the file."""
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


def _named(
    path: Path, placed: Iterable[PlacedMark], names: Mapping[str, str], left_out: LeftOut
) -> Iterator[PlacedMark]:
    """Yield marks whose labels are classes."""
    for each in placed:
        name = names.get(each.mark.label)
        if name is None:
            left_out.add(_unnamed(path, each))
        else:
            yield each._replace(mark=each.mark._replace(label=name))


def _heard(
    path: Path,
    placed: Iterable[PlacedMark],
    coverage: Mapping[str, Coverage],
    left_out: LeftOut,
) -> Iterator[PlacedMark]:
    """Yield marks of what was recorded."""
    for each in placed:
        mark = each.mark
        if coverage[mark.microphone].split(mark.start, mark.end):
            yield each
        else:
            reason = (
                f"{mark.label} lies outside of what {mark.microphone} heard; `hearthlog info` "
                "shows when that was"
            )
            left_out.add(LineError(place_text(path, each.place), OTHER, reason))


def _unnamed(path: Path, placed: PlacedMark) -> LineError:
    label = placed.mark.label
    reason = (
        f"{label[:64]!r} is the name of no class; name one in a --map, as "
        f'{label[:64]!r} = "tap_water"'
    )
    return LineError(place_text(path, placed.place), OTHER, reason, label)


def _without_overlaps(
    path: Path, placed: Iterable[PlacedMark], left_out: LeftOut
) -> Iterator[PlacedMark]:
    """Yield marks by microphone and time, cut where one that starts earlier goes on.

    One of which another class takes more than a frame, or all, is a loss. Of those that start and
    end together the first in the file stays.
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
