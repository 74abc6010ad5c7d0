"""RTTM: lines of SPEAKER, with the microphone as the file, and the label as the speaker."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.coverage import Coverage
from hearthlog.analyzer.marks.formats.labels import FileLabel, read_seconds
from hearthlog.analyzer.marks.marks import Mark
from hearthlog.schemas.times import seconds_text

_TYPE = "SPEAKER"
_FIELDS = 9, 10  # the last one, how far a system listened ahead, came later


def read(path: Path, text: str) -> Iterator[FileLabel]:
    """Yield the labels; lines of other types, and comments, are left out.

    Parameters
    ----------
    path : Path
        Of the file, for the message.
    text : str
        All of it.

    Raises
    ------
    DataError
        If a line has fewer than 9 fields or more than 10, or its onset or duration is no number.
    """
    for number, line in enumerate(text.split("\n"), 1):
        fields = line.split()
        if not fields or fields[0].startswith(";;"):
            continue
        if len(fields) not in _FIELDS:
            raise DataError(f"{path}:{number}: is no line of RTTM, which has 9 or 10 fields")
        if fields[0] != _TYPE:
            continue
        _, microphone, _, onset, duration, _, _, label, *_ = fields
        where = f"{path}:{number}"
        end = read_seconds(where, onset) + read_seconds(where, duration)
        yield FileLabel(number, onset, f"{end:f}", label, microphone)


def write(path: Path, marks: Sequence[Mark], coverage: Mapping[str, Coverage]) -> str:  # noqa: ARG001
    """Write a line for each mark.

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
        The text of the file, which has no place for reviewers.
    """
    lines = []
    for mark in marks:
        onset = seconds_text(mark.start - coverage[mark.microphone].starts[0])
        duration = seconds_text(mark.end - mark.start)
        lines.append(
            f"{_TYPE} {mark.microphone} 1 {onset} {duration} <NA> <NA> {mark.label} <NA> <NA>\n"
        )
    return "".join(lines)
