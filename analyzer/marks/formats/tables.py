"""Label files with one line per label: CSV, Raven, Audacity and RTTM."""

import csv
import io
import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
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
    scan,
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

    Columns are chosen by name, or by number from 1 if the first line has no names. The field
    separator is the most frequent of tab, semicolon and comma in the first line. Unless it is the
    comma, numbers may have decimal commas. Raise `DataError` if required columns are missing or
    ambiguous, or if the text has too many or too long lines.
    """
    first = _first_line(text)
    delimiter = max("\t;,", key=first.count)
    number_of = str if delimiter == "," else with_point
    rows = csv_rows(path, text, delimiter, quoted=delimiter != "\t")
    top = next(rows, None)
    if top is None:
        return
    where = place_text(path, top[0])
    if isinstance(top[1], csv.Error):
        raise DataError(f"{where}: is not CSV ({top[1]})")
    header = [value.strip() for value in top[1]]
    named = not any(is_seconds(number_of(value)) for value in header)
    names = header if named else [str(i) for i in range(1, len(header) + 1)]
    columns, width = _find(where, names, choice.columns, named=named), len(header)
    seen: set[tuple[str, ...]] = set()

    def label(where: str, record: list[str] | csv.Error) -> FileLabel | None:
        if isinstance(record, csv.Error):
            raise LineError(where, UNREADABLE, f"is not CSV ({record})")
        values = [value.strip() for value in record]
        if any(values[width:]):
            reason = f"has {len(values)} fields, the first line {width}"
            raise LineError(where, UNREADABLE, reason)
        row = {
            name: values[i] if i < len(values) else ""  # trailing empty fields may be missing
            for name, i in columns.items()
        }
        if _SELECTION in row:
            identity = tuple(row.values())
            if row[_SELECTION] and identity in seen:
                return None
            seen.add(identity)
        if delimiter != "\t":
            row |= {name: without_disarming(row[name]) for name in row.keys() & _TEXTS}
        start, end, duration = (number_of(row.get(name, "")) for name in _NUMBERS)
        end = end or add_seconds(where, start, duration)
        return FileLabel(start, end, *(row.get(name, "") for name in COLUMNS[3:]))

    yield from scan(path, rows if named else chain([top], rows), label)


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
    """Return a CSV table with all fields of the marks, with times in UTC.

    Spreadsheet formulas are disarmed with an apostrophe.
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


def read_audacity(path: Path, text: str, choice: Choice) -> Iterator[FileLabel | LineError]:  # noqa: ARG001
    """Yield the labels of an Audacity label track; times may have decimal commas.

    Raise `DataError` if the text has too many lines.
    """
    return scan(path, numbered_lines(path, text), _audacity_label)


def _audacity_label(where: str, line: str) -> FileLabel | None:
    if line.startswith("\\"):  # frequencies of a spectral selection
        return None
    start, end, label, *_ = [*(field.strip() for field in line.split("\t")), "", ""]
    if not end:
        raise LineError(where, UNREADABLE, "is not start, end and label with tabs between them")
    return FileLabel(with_point(start), with_point(end), label)


def read_rttm(path: Path, text: str, choice: Choice) -> Iterator[FileLabel | LineError]:  # noqa: ARG001
    """Yield the labels; lines of other types, and comments, are skipped.

    Raise `DataError` if the text has too many lines.
    """
    return scan(path, numbered_lines(path, text), _rttm_label)


def _rttm_label(where: str, line: str) -> FileLabel | None:
    fields = line.split()
    if fields[0].startswith(";;"):
        return None
    if len(fields) not in _RTTM_FIELDS:
        raise LineError(where, UNREADABLE, "is no line of RTTM, which has 9 or 10 fields")
    if fields[0] != "SPEAKER":
        return None
    _, microphone, _, onset, duration, _, _, label, *_ = fields
    return FileLabel(onset, add_seconds(where, onset, duration), label, microphone)


_RTTM_FIELDS = 9, 10  # the last field, lookahead of a system, was added later
_RTTM = "SPEAKER {microphone} 1 {start} {duration} <NA> <NA> {label} <NA> <NA>\n"
_AUDACITY = "{start}\t{end}\t{label}\n"
_RAVEN_COLUMNS = {
    "Selection": "{number}",
    "View": "Spectrogram 1",
    "Channel": "{channel}",
    "Begin Time (s)": "{start}",
    "End Time (s)": "{end}",
    "Low Freq (Hz)": "0.000",
    "High Freq (Hz)": "8000.000",  # for sound at 16 kHz
    "Annotation": "{label}",
    "Microphone": "{microphone}",
    "Reviewer": "{reviewer}",
    "Made": "{made}",
    "Corrects": "{corrects}",
}


def _lines(line: str, marks: Sequence[Mark], coverage: Mapping[str, Coverage]) -> str:
    """Format a line for each mark, with seconds since the first frame of its microphone."""
    names = sorted({mark.microphone for mark in marks})
    lines = []
    for number, mark in enumerate(marks, 1):
        zero = coverage[mark.microphone].starts[0]
        fields = mark._asdict() | {
            "number": number,
            "channel": names.index(mark.microphone) + 1,
            "start": seconds_text(mark.start - zero),
            "end": seconds_text(mark.end - zero),
            "duration": seconds_text(mark.end - mark.start),
            "made": made_text(mark),
        }
        lines.append(line.format_map(fields))
    return "".join(lines)


def write_raven(path: Path, marks: Sequence[Mark], coverage: Mapping[str, Coverage]) -> str:  # noqa: ARG001
    """Return a Raven table with all fields of the marks as columns, which Raven preserves."""
    line = "\t".join(_RAVEN_COLUMNS.values())
    return "\t".join(_RAVEN_COLUMNS) + "\n" + _lines(f"{line}\n", marks, coverage)


def write_audacity(path: Path, marks: Sequence[Mark], coverage: Mapping[str, Coverage]) -> str:
    """Return an Audacity label track, which has no fields for microphones and reviewers.

    Raise `DataError` if the marks are of several microphones.
    """
    microphones = sorted({mark.microphone for mark in marks})
    if len(microphones) > 1:
        names = ", ".join(microphones)
        raise DataError(f"{path}: is for one microphone: choose one with --microphone ({names})")
    return _lines(_AUDACITY, marks, coverage)


def write_rttm(path: Path, marks: Sequence[Mark], coverage: Mapping[str, Coverage]) -> str:  # noqa: ARG001
    """Return RTTM text with one line per mark."""
    return _lines(_RTTM, marks, coverage)


CODECS: Mapping[str, LabelCodec] = {
    "Audacity": LabelCodec(read_audacity, write_audacity),
    "CSV": LabelCodec(read_table, write_csv),
    "Raven": LabelCodec(read_table, write_raven),
    "RTTM": LabelCodec(read_rttm, write_rttm),
}
