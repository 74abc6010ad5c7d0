"""CSV: a line for each label, below the names of the columns."""

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

from hearthlog.analyzer.logs.coverage import Coverage
from hearthlog.analyzer.logs.text_files import disarmed
from hearthlog.analyzer.marks.formats.labels import made_text
from hearthlog.analyzer.marks.formats.tables import read
from hearthlog.analyzer.marks.marks import Mark
from hearthlog.schemas.frames import time_text

__all__ = ["read", "write"]
_COLUMNS = ("start", "end", "label", "microphone", "reviewer", "made", "corrects")


def write(path: Path, marks: Sequence[Mark], coverage: Mapping[str, Coverage]) -> str:  # noqa: ARG001
    """Write a table with all fields of the marks.

    Parameters
    ----------
    coverage : mapping of str to Coverage
        Not used: times are written in UTC.

    Returns
    -------
    str
        The text of the file; an apostrophe stands before what a spreadsheet would run.
    """
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(_COLUMNS)
    for mark in marks:
        start, end = time_text(mark.start), time_text(mark.end)
        origin = mark.reviewer, made_text(mark), mark.corrects
        texts = mark.label, mark.microphone, *origin
        table.writerow([start, end, *map(disarmed, texts)])
    return text.getvalue()
