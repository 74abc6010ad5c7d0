"""Label files of any format, read as labels and written from marks."""

from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Protocol, cast

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.coverage import Coverage
from hearthlog.analyzer.logs.text_files import read_text
from hearthlog.analyzer.marks.formats.formats import AUDACITY, RAVEN, LabelFormat, find_format
from hearthlog.analyzer.marks.formats.labels import Choice, FileLabel
from hearthlog.analyzer.marks.formats.left_out import LineError
from hearthlog.analyzer.marks.formats.tables import is_table
from hearthlog.analyzer.marks.marks import Mark
from hearthlog.schemas.new_files import new_file

_CONTROLS = dict.fromkeys(range(0x80, 0xA0), "\ufffd")  # that a name may have


class LabelCodec(Protocol):
    """The functions of the module of a format."""

    def read(self, path: Path, text: str, choice: Choice) -> Iterator[FileLabel | LineError]:
        """Yield the labels of a file.

        Parameters
        ----------
        path : Path
            Of the file, for messages.
        text : str
            All of it.
        choice : Choice

        Yields
        ------
        FileLabel or LineError
            In the order of the file; an error for a line that is no label.

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


def read_rows(path: Path, choice: Choice) -> Iterator[FileLabel | LineError]:
    """Yield the labels of a file as they are there.

    Yields
    ------
    FileLabel or LineError
        In the order of the file; an error for a line that is no label.

    Raises
    ------
    DataError
        If the file cannot be read, is too large or no label file, or has nothing to choose from.
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
    """Write marks as a label file that `read_rows` reads again.

    Raise `DataError` if there are no marks, if the file would be too large, or if the marks are
    of several microphones and the format has no place for them. Raise `LogError` if the file
    exists, or cannot be written.
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
