"""Selection tables of Raven: columns separated by tabs, below their names."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.coverage import Coverage
from hearthlog.analyzer.marks.formats.labels import FileLabel, made_text
from hearthlog.analyzer.marks.marks import Mark
from hearthlog.schemas.times import seconds_text

_BAND = ("0.000", "8000.000")  # Hz, of sound at 16 kHz
_COLUMNS = (
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
_TIMES = [name.casefold() for name in _COLUMNS[3:5]]
_ANNOTATION = _COLUMNS[7].casefold()
_ORIGIN = [name.casefold() for name in _COLUMNS[8:]]


def is_table(text: str) -> bool:
    """Tell whether a text is a selection table, by its first line.

    Parameters
    ----------
    text : str
        All of the file.
    """
    return set(_TIMES) <= set(_names(text.lstrip().split("\n", 1)[0]))


def read(path: Path, text: str) -> Iterator[FileLabel]:
    """Yield the selections of a table, each once: Raven may list it for every view and channel.

    Parameters
    ----------
    path : Path
        Of the file, for the message.
    text : str
        All of it.

    Raises
    ------
    DataError
        If there is no column Annotation, if a column is named twice, or if a line has too many
        fields.
    """
    columns: list[str] = []
    seen: set[tuple[str, ...]] = set()
    for number, line in enumerate(text.split("\n"), 1):
        if not line.strip():
            continue
        if not columns:
            columns = _checked_header(path, number, line)
            continue
        values = [value.strip() for value in line.rstrip("\r").split("\t")]
        if len(values) > len(columns):
            raise DataError(
                f"{path}:{number}: has {len(values)} fields, the first line names {len(columns)}"
            )
        row = dict(zip(columns, values, strict=False))  # empty ones may be missing at the end
        fields = [row.get(name, "") for name in (*_TIMES, _ANNOTATION, *_ORIGIN)]
        selection = row.get("selection", "")
        identity = (selection, *fields)
        if not selection or identity not in seen:
            seen.add(identity)
            yield FileLabel(number, *fields)


def write(path: Path, marks: Sequence[Mark], coverage: Mapping[str, Coverage]) -> str:  # noqa: ARG001
    """Write a table with columns for all fields of the marks, which Raven keeps.

    Parameters
    ----------
    path : Path
        Not used.
    marks : sequence of Mark
    coverage : mapping of str to Coverage
        By microphone; times are written as seconds since its first frame.

    Returns
    -------
    str
        The text of the file.
    """
    channels = {name: i for i, name in enumerate(sorted({mark.microphone for mark in marks}), 1)}
    lines = ["\t".join(_COLUMNS)]
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


def _names(line: str) -> list[str]:
    return [name.strip().casefold() for name in line.split("\t")]


def _checked_header(path: Path, number: int, line: str) -> list[str]:
    names = _names(line)
    if _ANNOTATION not in names:
        raise DataError(
            f"{path}:{number}: this table of Raven has no column Annotation: name the column of "
            "the labels so"
        )
    if len(set(names)) < len(names):
        raise DataError(f"{path}:{number}: names a column twice")
    return names
