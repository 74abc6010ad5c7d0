"""Label files of any format, read as marks and written from marks."""

from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Protocol, cast

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.coverage import Coverage
from hearthlog.analyzer.logs.text_files import read_text
from hearthlog.analyzer.marks.formats import raven
from hearthlog.analyzer.marks.formats.formats import AUDACITY, RAVEN, LabelFormat, find_format
from hearthlog.analyzer.marks.formats.labels import (
    FileLabel,
    PlacedMark,
    check_overlaps,
    make_mark,
    place_text,
)
from hearthlog.analyzer.marks.marks import Mark
from hearthlog.schemas.storage.new_files import new_file

_CONTROLS = dict.fromkeys(range(0x80, 0xA0), "\ufffd")  # that a name may have


class LabelCodec(Protocol):
    """The functions of the module of a format."""

    def read(self, path: Path, text: str) -> Iterator[FileLabel]:
        """Yield the labels of a file; raise DataError with file and place if it is none."""

    def write(self, path: Path, marks: Sequence[Mark], coverage: Mapping[str, Coverage]) -> str:
        """Return the text of a file that `read` reads again."""


def read_labels(
    path: Path, coverage: Mapping[str, Coverage], microphone: str | None = None
) -> dict[Path, list[Mark]]:
    """Read a label file.

    Parameters
    ----------
    path : Path
        Of one of the formats in `table.FORMATS`, by its suffix; a `*.txt` is a table of Raven or
        a label track of Audacity by its first line.
    coverage : mapping of str to Coverage
        Of each microphone.
    microphone : str, optional
        Of labels that do not name theirs; not needed if there is only one.

    Returns
    -------
    dict of Path to list of Mark
        By log; what crosses from one log to the next is split.

    Raises
    ------
    DataError
        With file and place, if the file is no label file, a time or a label is invalid, labels
        overlap, or one lies where nothing was recorded.
    """
    placed = read_lines(path, coverage, microphone)
    check_overlaps(path, placed)
    by_log: dict[Path, list[Mark]] = {}
    for place, mark in placed:
        pieces = coverage[mark.microphone].split(mark.start, mark.end)
        if not pieces:
            raise DataError(
                f"{place_text(path, place)}: {mark.label} lies outside of what {mark.microphone} "
                "heard; `hearthlog info` shows when that was"
            )
        for log, start, end in pieces:
            by_log.setdefault(log, []).append(mark._replace(start=start, end=end))
    return by_log


def read_lines(
    path: Path, coverage: Mapping[str, Coverage], microphone: str | None = None
) -> list[PlacedMark]:
    """Read a label file whose labels may overlap, and may lie where nothing was recorded.

    Parameters and errors are otherwise those of `read_labels`.

    Returns
    -------
    list of PlacedMark
        With their lines, or their places in a file that has none.
    """
    format_ = find_format(path) or AUDACITY
    text = read_text(path, "label file", format_.size_limit)
    if format_ in {AUDACITY, RAVEN}:
        format_ = RAVEN if raven.is_table(text) else AUDACITY
    labels = _codec(format_).read(path, text)
    placed = [make_mark(path, label, coverage, microphone) for label in labels]
    if not placed:
        raise DataError(f"{path}: holds no labels")
    return placed


def write_labels(path: Path, marks: Sequence[Mark], coverage: Mapping[str, Coverage]) -> None:
    """Write marks as a label file that `read_labels` reads again.

    Parameters
    ----------
    path : Path
        With a suffix of `table.FORMATS`. Must not exist.
    marks : sequence of Mark
    coverage : mapping of str to Coverage
        Of each microphone.

    Raises
    ------
    DataError
        If there are no marks, too many, or those of several microphones have no place in the file.
    LogError
        If the file exists, or cannot be written.
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
    return cast(LabelCodec, import_module(f"{__package__}.{format_.module}"))


def _without_controls(mark: Mark) -> Mark:
    """Replace the characters of names that would steer a terminal."""
    return mark._replace(
        reviewer=mark.reviewer.translate(_CONTROLS), corrects=mark.corrects.translate(_CONTROLS)
    )
