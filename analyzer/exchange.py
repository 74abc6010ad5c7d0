"""Marks in files of others: label tracks of Audacity, and CSV."""

import re
from collections.abc import Iterator, Mapping, Sequence
from decimal import Decimal
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple

from analyzer.errors import DataError
from analyzer.heard import Heard
from analyzer.marks import Mark
from analyzer.textfile import csv_records, read_text
from models.modelfile import CLASS_NAME
from schemas.files import new_file
from schemas.messages import NANOSECONDS
from schemas.times import read_time, time_text

SUFFIXES = (".txt", ".csv")
_SIZE_LIMIT = 16 << 20  # four hundred thousand labels; what is larger is something else
_SECONDS = re.compile(r"[-+]?[0-9]{1,10}(\.[0-9]{0,18})?([eE][-+]?[0-9]{1,2})?")
_REQUIRED = ("start", "end", "label")
_COLUMNS = (*_REQUIRED, "microphone")


class _Line(NamedTuple):
    number: int
    start: str
    end: str
    label: str
    microphone: str


class LabelLine(NamedTuple):
    """A mark, and the number of the line that it is in."""

    number: int
    mark: Mark


def read_labels(
    path: Path, heard: Mapping[str, Heard], microphone: str | None = None
) -> dict[Path, list[Mark]]:
    """Read a label file.

    Parameters
    ----------
    path : Path
        A label track of Audacity, `*.txt`: start, end and label with tabs between them, times in
        seconds from the first frame of the microphone. Or `*.csv` with the columns start, end,
        label and, optionally, microphone; times likewise, or ISO 8601.
    heard : mapping of str to Heard
        By microphone: the logs, and when it was heard.
    microphone : str, optional
        Of the labels that do not name theirs; not needed if there is only one.

    Returns
    -------
    dict of Path to list of Mark
        By log; what crosses from one log to the next is split.

    Raises
    ------
    DataError
        With file and line, if the file is no label file, a time or label cannot be, labels
        overlap, or one lies where nothing was heard.
    """
    found = read_lines(path, heard, microphone)
    _check_overlaps(path, found)
    by_log: dict[Path, list[Mark]] = {}
    for number, mark in found:
        pieces = heard[mark.microphone].split(mark.start, mark.end)
        if not pieces:
            raise DataError(
                f"{path}:{number}: {mark.label} lies outside of what {mark.microphone} heard; "
                "`hearthlog info` shows when that was"
            )
        for log, start, end in pieces:
            by_log.setdefault(log, []).append(mark._replace(start=start, end=end))
    return by_log


def read_lines(
    path: Path, heard: Mapping[str, Heard], microphone: str | None = None
) -> list[LabelLine]:
    """Read a label file whose labels may overlap, and may lie where nothing was heard.

    Parameters and errors are otherwise those of `read_labels`.

    Returns
    -------
    list of (int, Mark)
        With the lines they are in.
    """
    text = read_text(path, "label file", _SIZE_LIMIT)
    lines = list(_csv_lines(path, text) if path.suffix == ".csv" else _track_lines(path, text))
    if not lines:
        raise DataError(f"{path}: holds no labels")
    return [_found(path, line, heard, microphone) for line in lines]


def write_labels(path: Path, marks: Sequence[Mark], heard: Mapping[str, Heard]) -> None:
    """Write marks as a label file that `read_labels` reads again.

    Parameters
    ----------
    path : Path
        `*.txt` or `*.csv`; must not exist.
    marks : sequence of Mark
        For a label track those of one microphone.
    heard : mapping of str to Heard

    Raises
    ------
    DataError
        If there are no marks, or those of several microphones have no place in the file.
    LogError
        If the file exists, or cannot be written.
    """
    if not marks:
        raise DataError("no marks to export: nothing was imported or marked in these logs yet")
    microphones = sorted({mark.microphone for mark in marks})
    if path.suffix == ".csv":
        rows = [f"{time_text(m.start)},{time_text(m.end)},{m.label},{m.microphone}" for m in marks]
        rows.insert(0, ",".join(_COLUMNS))
    elif len(microphones) > 1:
        names = ", ".join(microphones)
        raise DataError(f"{path}: is for one microphone: choose one with --microphone ({names})")
    else:
        zero = heard[microphones[0]].starts[0]
        rows = [f"{_seconds(m.start - zero)}\t{_seconds(m.end - zero)}\t{m.label}" for m in marks]
    with new_file(path) as temporary:
        temporary.write_text("".join(f"{row}\n" for row in rows), "utf-8", newline="\n")


def _seconds(nanoseconds: int) -> str:
    """Write a time as seconds, none of whose digits is lost."""
    return f"{nanoseconds // NANOSECONDS}.{nanoseconds % NANOSECONDS:09}"


def _track_lines(path: Path, text: str) -> Iterator[_Line]:
    for number, line in enumerate(text.split("\n"), 1):
        if not line.strip() or line.startswith("\\"):  # the pitch of a spectral selection
            continue
        fields = line.rstrip("\r").split("\t")
        if len(fields) != len(_REQUIRED):
            raise DataError(f"{path}:{number}: is not start, end and label with tabs between them")
        start, end, label = (field.strip() for field in fields)
        yield _Line(number, start, end, label, microphone="")


def _csv_lines(path: Path, text: str) -> Iterator[_Line]:
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
        yield _Line(number, *(row.get(name, "") for name in _COLUMNS))


def _checked_header(path: Path, number: int, names: list[str]) -> list[str]:
    fitting = set(_REQUIRED) <= set(names) <= set(_COLUMNS) and len(set(names)) == len(names)
    if not fitting:
        raise DataError(
            f"{path}:{number}: the first line must name the columns: start,end,label or "
            "start,end,label,microphone"
        )
    return names


def _found(
    path: Path, line: _Line, heard: Mapping[str, Heard], microphone: str | None
) -> LabelLine:
    where = f"{path}:{line.number}"
    name = line.microphone or microphone or (next(iter(heard)) if len(heard) == 1 else "")
    if name not in heard:
        known = ", ".join(sorted(heard))
        if name:
            raise DataError(f"{where}: no microphone {name[:64]!r} in the logs; there is {known}")
        raise DataError(f"{where}: of which microphone? choose one with --microphone ({known})")
    zero = heard[name].starts[0]
    start, end = _time(where, line.start, zero), _time(where, line.end, zero)
    if not CLASS_NAME.fullmatch(line.label):
        raise DataError(
            f"{where}: {line.label[:64]!r} cannot be the name of a class: use lower-case letters, "
            "digits and '_'"
        )
    if start == end:
        raise DataError(f"{where}: {line.label} is a point; mark a span of time")
    if start > end:
        raise DataError(f"{where}: {line.label} ends before it starts")
    if start < zero and line.start.startswith("-"):
        raise DataError(f"{where}: {line.label} starts at {line.start} s, before the first frame")
    return LabelLine(line.number, Mark(name, start, end, line.label))


def _time(where: str, text: str, zero: int) -> int:
    """Read seconds from `zero` on, or a time of day and date."""
    if _SECONDS.fullmatch(text):
        return zero + round(Decimal(text) * NANOSECONDS)
    try:
        return read_time(text)
    except (ValueError, OverflowError) as error:
        raise DataError(
            f"{where}: {text[:64]!r} is neither seconds nor a time such as 2026-03-01T07:00:00"
        ) from error


def _check_overlaps(path: Path, found: Sequence[LabelLine]) -> None:
    for one, other in pairwise(sorted(found, key=attrgetter("mark"))):
        if one.mark.microphone == other.mark.microphone and other.mark.start < one.mark.end:
            first, last = sorted((one.number, other.number))
            raise DataError(f"{path}:{last}: overlaps the label in line {first}")
