"""CSV: a line for each label, below the names of the columns."""

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.coverage import Coverage
from hearthlog.analyzer.logs.text_files import csv_records
from hearthlog.analyzer.marks.formats.labels import FileLabel, made_text
from hearthlog.analyzer.marks.marks import Mark
from hearthlog.schemas.times import time_text

_REQUIRED = ("start", "end", "label")
_COLUMNS = (*_REQUIRED, "microphone", "reviewer", "made", "corrects")


def read(path: Path, text: str) -> Iterator[FileLabel]:
    """Yield the labels of a table.

    Parameters
    ----------
    path : Path
        Of the file, for the message.
    text : str
        All of it.

    Raises
    ------
    DataError
        If the text is not CSV, if the first line does not name the columns, or if a line has more
        or fewer fields.
    """
    columns: list[str] = []
    for number, record in csv_records(path, text):
        values = [value.strip() for value in record]
        if not columns:
            columns = _checked_header(path, number, values)
            continue
        if len(values) != len(columns):
            raise DataError(
                f"{path}:{number}: has {len(values)} fields, the first line names {len(columns)}"
            )
        row = dict(zip(columns, values, strict=True))
        yield FileLabel(number, *(row.get(name, "") for name in _COLUMNS))


def write(path: Path, marks: Sequence[Mark], coverage: Mapping[str, Coverage]) -> str:  # noqa: ARG001
    """Write a table with all fields of the marks.

    Parameters
    ----------
    path : Path
        Not used.
    marks : sequence of Mark
    coverage : mapping of str to Coverage
        Not used: times are written in UTC.

    Returns
    -------
    str
        The text of the file.
    """
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(_COLUMNS)
    for mark in marks:
        start, end = time_text(mark.start), time_text(mark.end)
        origin = mark.reviewer, made_text(mark), mark.corrects
        table.writerow([start, end, mark.label, mark.microphone, *origin])
    return text.getvalue()


def _checked_header(path: Path, number: int, names: list[str]) -> list[str]:
    fitting = set(_REQUIRED) <= set(names) <= set(_COLUMNS) and len(set(names)) == len(names)
    if not fitting:
        raise DataError(
            f"{path}:{number}: the first line must name the columns: start,end,label and, where "
            "known, microphone,reviewer,made,corrects"
        )
    return names
