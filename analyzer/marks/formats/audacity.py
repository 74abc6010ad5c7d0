"""Label tracks of Audacity: start, end and label separated by tabs, of one microphone."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.coverage import Coverage
from hearthlog.analyzer.marks.formats.labels import FileLabel
from hearthlog.analyzer.marks.marks import Mark
from hearthlog.schemas.times import seconds_text


def read(path: Path, text: str) -> Iterator[FileLabel]:
    """Yield the labels of a track.

    Parameters
    ----------
    path : Path
        Of the file, for the message.
    text : str
        All of it.

    Raises
    ------
    DataError
        If a line is not start, end and label with tabs between them.
    """
    for number, line in enumerate(text.split("\n"), 1):
        if not line.strip() or line.startswith("\\"):  # the pitch of a spectral selection
            continue
        fields = [field.strip() for field in line.rstrip("\r").split("\t")]
        if len(fields) != 3:
            raise DataError(f"{path}:{number}: is not start, end and label with tabs between them")
        yield FileLabel(number, *fields)


def write(path: Path, marks: Sequence[Mark], coverage: Mapping[str, Coverage]) -> str:
    """Write a track, which has no place for microphones and reviewers.

    Parameters
    ----------
    path : Path
        Of the file, for the message.
    marks : sequence of Mark
        At least one; all of one microphone.
    coverage : mapping of str to Coverage
        By microphone; times are written as seconds since its first frame.

    Returns
    -------
    str
        The text of the file.

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
