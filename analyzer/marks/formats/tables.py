"""Label files with one line per label: CSV, Raven, Audacity and RTTM."""

import csv
import io
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.layers import Coverage
from hearthlog.analyzer.logs.text_files import csv_rows, disarmed, numbered_lines, without_disarming
from hearthlog.analyzer.marks.formats.labels import (
    UNREADABLE,
    Choice,
    FileLabel,
    LabelCodec,
    LineError,
    add_seconds,
    is_seconds,
    made_text,
    place_text,
    with_point,
)
from hearthlog.analyzer.marks.marks import Mark
from hearthlog.schemas.errors import listed
from hearthlog.schemas.frames import seconds_text, time_text

_NAMES: Mapping[str, Sequence[str]] = {
    "start": ("start", "start time", "begin", "begin time", "onset", "time"),
    "end": ("end", "end time", "stop", "offset"),
    "duration": ("duration",),
    "label": ("label", "annotation", "species", "common name", "class", "event label"),
    "microphone": ("microphone",),
    "reviewer": ("reviewer",),
    "made": ("made",),
    "corrects": ("corrects",),
}
COLUMNS = tuple(_NAMES)
_TEXTS = set(COLUMNS[3:])
_NUMBERS = ("start", "end", "duration")
_SELECTION = "selection"  # row number, in tables of Raven
_UNIT = re.compile(r"(\((s|sec)\)|\[(s|sec)\])$")


def is_table(text: str) -> bool:
    """Whether the first line of a text has the column names of a table."""
    names = {_plain(name) for name in _first_line(text).split("\t")}
    start, end, duration = (names.intersection(_NAMES[field]) for field in _NUMBERS)
    return bool(start and (end or duration))


def read_table(path: Path, text: str, choice: Choice) -> Iterator[FileLabel | LineError]:
    """Yield the rows of a table without duplicates, as Raven may repeat them per view and channel.

    The field separator is the most frequent of tab, semicolon and comma in the first line. Unless
    it is the comma, numbers may have decimal commas.

    Parameters
    ----------
    choice : Choice
        Columns by name, or by number from 1 if the first line has no names.

    Raises
    ------
    DataError
        If required columns are missing or ambiguous, or if the text has too many or too long
        lines.
    """
    first = _first_line(text)
    delimiter = max("\t;,", key=first.count)
    number_of = str if delimiter == "," else with_point
    columns: dict[str, int] | None = None
    width = 0
    seen: set[tuple[str, ...]] = set()
    for number, record in csv_rows(path, text, delimiter, quoted=delimiter != "\t"):
        where = place_text(path, number)
        if isinstance(record, csv.Error):
            if columns is None:
                raise DataError(f"{where}: is not CSV ({record})")
            yield LineError(where, UNREADABLE, f"is not CSV ({record})")
            continue
        values = [value.strip() for value in record]
        if columns is None:
            named = not any(is_seconds(number_of(value)) for value in values)
            names = values if named else [str(i) for i in range(1, len(values) + 1)]
            columns, width = _find(where, names, choice.columns, named=named), len(values)
            if named:
                continue
        if any(values[width:]):
            reason = f"has {len(values)} fields, the first line {width}"
            yield LineError(where, UNREADABLE, reason)
            continue
        row = {
            name: values[i] if i < len(values) else ""  # trailing empty fields may be missing
            for name, i in columns.items()
        }
        if _SELECTION in row:
            identity = tuple(row.values())
            if row[_SELECTION] and identity in seen:
                continue
            seen.add(identity)
        if delimiter != "\t":
            row |= {name: without_disarming(row[name]) for name in row.keys() & _TEXTS}
        yield _label(where, number, row, number_of)


def _label(
    where: str, number: int, row: Mapping[str, str], number_of: Callable[[str], str]
) -> FileLabel | LineError:
    start, end, duration = (number_of(row.get(name, "")) for name in _NUMBERS)
    try:
        end = end or add_seconds(where, start, duration)
    except LineError as error:
        return error
    others = (row.get(name, "") for name in COLUMNS[3:])
    return FileLabel(number, start, end, *others)


def _find(
    where: str, names: Sequence[str], chosen: Mapping[str, str], *, named: bool
) -> dict[str, int]:
    """Return the column number of each label field in the table."""
    plain = [_plain(name) for name in names]
    unknown = [name for name in chosen.values() if _plain(name) not in plain]
    if unknown:
        raise DataError(f"{where}: no column {unknown[0][:64]!r}; there is {_listed(names)}")
    found = {field: plain.index(_plain(name)) for field, name in chosen.items()}
    taken = set(found.values())
    for field in (field for field in _NAMES if field not in chosen):
        fitting = [i for i, name in enumerate(plain) if name in _NAMES[field] and i not in taken]
        if len(fitting) > 1:
            two = _listed([names[i] for i in fitting])
            raise DataError(
                f"{where}: the {field} may be the column {two}: choose it with "
                f"--column {field}=NAME"
            )
        if fitting:
            found[field] = fitting[0]
    end = "duration" if "duration" in found else "end"
    missing = [field for field in ("start", end, "label") if field not in found]
    if missing and not named:
        raise DataError(
            f"{where}: does not name the columns: say which is what, as --column start=1 "
            "--column end=2 --column label=3"
        )
    if missing:
        raise DataError(
            f"{where}: no column is called {missing[0]}: choose it with --column "
            f"{missing[0]}=NAME; there is {_listed(names)}"
        )
    if _SELECTION in plain:
        found[_SELECTION] = plain.index(_SELECTION)
    return found


def _listed(names: Sequence[str]) -> str:
    return listed([repr(name[:64]) for name in names[:20]])


def _plain(name: str) -> str:
    """Return a column name in lower case, without underscores and unit."""
    return _UNIT.sub("", name.strip().casefold().replace("_", " ")).rstrip()


def _first_line(text: str) -> str:
    return text.lstrip().split("\n", 1)[0]


_CSV_COLUMNS = ("start", "end", "label", "microphone", "reviewer", "made", "corrects")


def write_csv(path: Path, marks: Sequence[Mark], coverage: Mapping[str, Coverage]) -> str:  # noqa: ARG001
    """Return a CSV table with all fields of the marks.

    Parameters
    ----------
    coverage : mapping of str to Coverage
        Not used: times are written in UTC.

    Returns
    -------
    str
        The text of the file; spreadsheet formulas are disarmed with an apostrophe.
    """
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(_CSV_COLUMNS)
    for mark in marks:
        start, end = time_text(mark.start), time_text(mark.end)
        origin = mark.reviewer, made_text(mark), mark.corrects
        texts = mark.label, mark.microphone, *origin
        table.writerow([start, end, *map(disarmed, texts)])
    return text.getvalue()


_BAND = ("0.000", "8000.000")  # Hz, for sound at 16 kHz
_RAVEN_COLUMNS = (
    "Selection",
    "View",
    "Channel",
    "Begin Time (s)",
    "End Time (s)",
    "Low Freq (Hz)",
    "High Freq (Hz)",
    "Annotation",
    "Microphone",
    "Reviewer",
    "Made",
    "Corrects",
)


def write_raven(path: Path, marks: Sequence[Mark], coverage: Mapping[str, Coverage]) -> str:  # noqa: ARG001
    """Return a Raven table with all fields of the marks as columns, which Raven preserves.

    Parameters
    ----------
    coverage : mapping of str to Coverage
        By microphone; times are written as seconds since its first frame.
    """
    channels = {name: i for i, name in enumerate(sorted({mark.microphone for mark in marks}), 1)}
    lines = ["\t".join(_RAVEN_COLUMNS)]
    for number, mark in enumerate(marks, 1):
        zero = coverage[mark.microphone].starts[0]
        fields = [
            str(number),
            "Spectrogram 1",
            str(channels[mark.microphone]),
            seconds_text(mark.start - zero),
            seconds_text(mark.end - zero),
            *_BAND,
            mark.label,
            mark.microphone,
            mark.reviewer,
            made_text(mark),
            mark.corrects,
        ]
        lines.append("\t".join(fields))
    return "".join(f"{line}\n" for line in lines)


def read_audacity(path: Path, text: str, choice: Choice) -> Iterator[FileLabel | LineError]:  # noqa: ARG001
    """Yield the labels of an Audacity label track; times may have decimal commas.

    Raise `DataError` if the text has too many lines.
    """
    for number, line in numbered_lines(path, text):
        if line.startswith("\\"):  # frequencies of a spectral selection
            continue
        start, end, label, *_ = [*(field.strip() for field in line.split("\t")), "", ""]
        if not end:
            reason = "is not start, end and label with tabs between them"
            yield LineError(place_text(path, number), UNREADABLE, reason)
            continue
        yield FileLabel(number, with_point(start), with_point(end), label)


def write_audacity(path: Path, marks: Sequence[Mark], coverage: Mapping[str, Coverage]) -> str:
    """Return an Audacity label track, which has no fields for microphones and reviewers.

    Parameters
    ----------
    marks : sequence of Mark
        At least one; all of one microphone.
    coverage : mapping of str to Coverage
        By microphone; times are written as seconds since its first frame.

    Raises
    ------
    DataError
        If the marks are of several microphones.
    """
    microphones = sorted({mark.microphone for mark in marks})
    if len(microphones) > 1:
        names = ", ".join(microphones)
        raise DataError(f"{path}: is for one microphone: choose one with --microphone ({names})")
    zero = coverage[microphones[0]].starts[0]
    return "".join(
        f"{seconds_text(mark.start - zero)}\t{seconds_text(mark.end - zero)}\t{mark.label}\n"
        for mark in marks
    )


_SPEAKER = "SPEAKER"
_FIELDS = 9, 10  # the last field, lookahead of a system, was added later


def read_rttm(path: Path, text: str, choice: Choice) -> Iterator[FileLabel | LineError]:  # noqa: ARG001
    """Yield the labels; lines of other types, and comments, are skipped.

    Raise `DataError` if the text has too many lines.
    """
    for number, line in numbered_lines(path, text):
        fields, where = line.split(), place_text(path, number)
        if fields[0].startswith(";;"):
            continue
        if len(fields) not in _FIELDS:
            yield LineError(where, UNREADABLE, "is no line of RTTM, which has 9 or 10 fields")
        elif fields[0] == _SPEAKER:
            _, microphone, _, onset, duration, _, _, label, *_ = fields
            try:
                end = add_seconds(where, onset, duration)
            except LineError as error:
                yield error
                continue
            yield FileLabel(number, onset, end, label, microphone)


def write_rttm(path: Path, marks: Sequence[Mark], coverage: Mapping[str, Coverage]) -> str:  # noqa: ARG001
    """Return RTTM text with one line per mark.

    Parameters
    ----------
    coverage : mapping of str to Coverage
        By microphone; times are written as seconds since its first frame.
    """
    lines = []
    for mark in marks:
        onset = seconds_text(mark.start - coverage[mark.microphone].starts[0])
        duration = seconds_text(mark.end - mark.start)
        lines.append(
            f"{_SPEAKER} {mark.microphone} 1 {onset} {duration} <NA> <NA> {mark.label} <NA> <NA>\n"
        )
    return "".join(lines)


CODECS: Mapping[str, LabelCodec] = {
    "Audacity": LabelCodec(read_audacity, write_audacity),
    "CSV": LabelCodec(read_table, write_csv),
    "Raven": LabelCodec(read_table, write_raven),
    "RTTM": LabelCodec(read_rttm, write_rttm),
}
