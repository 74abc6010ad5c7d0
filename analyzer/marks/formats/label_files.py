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
        """Yield the labels of a file.

        Parameters
        ----------
        path : Path
            Of the file, for messages.
        text : str
            All of it.

        Yields
        ------
        FileLabel
            In the order of the file.

        Raises
        ------
        DataError
            With file and place, if the text is not of this format.
        """

    def write(self, path: Path, marks: Sequence[Mark], coverage: Mapping[str, Coverage]) -> str:
        """Return the text of a file that `read` reads again.

        Parameters
        ----------
        path : Path
            Of the file, for messages.
        marks : sequence of Mark
            At least one.
        coverage : mapping of str to Coverage
            By microphone; has all those of the marks.

        Raises
        ------
        DataError
            If the format has no place for several microphones.
        """


def read_labels(
    path: Path, coverage: Mapping[str, Coverage], microphone: str | None = None
) -> dict[Path, list[Mark]]:
    """Read a label file.

    Parameters
    ----------
    path : Path
        Of one of the formats in `formats.FORMATS`, by its suffix; a `*.txt` is a table of Raven or
        a label track of Audacity by its first line.
    coverage : mapping of str to Coverage
        By microphone.
    microphone : str, optional
        The microphone of labels that do not name theirs; not needed if there is only one.

    Returns
    -------
    dict of Path to list of Mark
        By log; what crosses from one log to the next is split.

    Raises
    ------
    DataError
        With file and place, if the file cannot be read, is too large, is no label file or holds no
        labels, if a label cannot be a mark, if labels of one microphone overlap, or if one lies
        where nothing was recorded.
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

    Parameters
    ----------
    path : Path
        As of `read_labels`.
    coverage : mapping of str to Coverage
        By microphone.
    microphone : str, optional
        The microphone of labels that do not name theirs; not needed if there is only one.

    Returns
    -------
    list of PlacedMark
        In the order of the file, with their lines, or their places in a file that has none.

    Raises
    ------
    DataError
        With file and place, if the file cannot be read, is too large, is no label file or holds no
        labels, or if a label cannot be a mark.
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
        With a suffix of `formats.FORMATS`. Must not exist.
    marks : sequence of Mark
    coverage : mapping of str to Coverage
        By microphone; has all those of the marks.

    Raises
    ------
    DataError
        If there are no marks, if the file would be too large, or if the marks are of several
        microphones and the format has no place for them.
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
