"""RTTM: lines of SPEAKER, with the microphone as the file, and the label as the speaker."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from hearthlog.analyzer.logs.coverage import Coverage
from hearthlog.analyzer.logs.text_files import numbered_lines
from hearthlog.analyzer.marks.formats.labels import Choice, FileLabel, add_seconds
from hearthlog.analyzer.marks.formats.left_out import UNREADABLE, LineError, place_text
from hearthlog.analyzer.marks.marks import Mark
from hearthlog.schemas.frames import seconds_text

_TYPE = "SPEAKER"
_FIELDS = 9, 10  # the last one, how far a system listened ahead, came later


def read(path: Path, text: str, choice: Choice) -> Iterator[FileLabel | LineError]:  # noqa: ARG001
    """Yield the labels; lines of other types, and comments, are left out.

    Raise `DataError` if the text has too many lines.
    """
    for number, line in numbered_lines(path, text):
        fields, where = line.split(), place_text(path, number)
        if fields[0].startswith(";;"):
            continue
        if len(fields) not in _FIELDS:
            yield LineError(where, UNREADABLE, "is no line of RTTM, which has 9 or 10 fields")
        elif fields[0] == _TYPE:
            _, microphone, _, onset, duration, _, _, label, *_ = fields
            try:
                end = add_seconds(where, onset, duration)
            except LineError as error:
                yield error
                continue
            yield FileLabel(number, onset, end, label, microphone)


def write(path: Path, marks: Sequence[Mark], coverage: Mapping[str, Coverage]) -> str:  # noqa: ARG001
    """Write a line for each mark.

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
            f"{_TYPE} {mark.microphone} 1 {onset} {duration} <NA> <NA> {mark.label} <NA> <NA>\n"
        )
    return "".join(lines)
