"""Label tracks of Audacity: start, end and label separated by tabs, of one microphone.

Times are seconds, or ISO 8601 in files that people correct without Audacity.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.coverage import Coverage
from hearthlog.analyzer.logs.text_files import numbered_lines
from hearthlog.analyzer.marks.formats.labels import Choice, FileLabel, with_point
from hearthlog.analyzer.marks.formats.left_out import UNREADABLE, LineError, place_text
from hearthlog.analyzer.marks.marks import Mark
from hearthlog.schemas.frames import seconds_text


def read(path: Path, text: str, choice: Choice) -> Iterator[FileLabel | LineError]:  # noqa: ARG001
    """Yield the labels of a track, whose times may have decimal commas.

    Raise `DataError` if the text has too many lines.
    """
    for number, line in numbered_lines(path, text):
        if line.startswith("\\"):  # the pitch of a spectral selection
            continue
        start, end, label, *_ = [*(field.strip() for field in line.split("\t")), "", ""]
        if not end:
            reason = "is not start, end and label with tabs between them"
            yield LineError(place_text(path, number), UNREADABLE, reason)
            continue
        yield FileLabel(number, with_point(start), with_point(end), label)


def write(path: Path, marks: Sequence[Mark], coverage: Mapping[str, Coverage]) -> str:
    """Write a track, which has no place for microphones and reviewers.

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
