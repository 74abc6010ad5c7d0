"""Label files: their forms by suffix and content, read and written."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.coverage import Coverage
from hearthlog.analyzer.logs.text_files import read_text
from hearthlog.analyzer.marks.formats import audacity, csvfile, elan, labelstudio, raven, rttm
from hearthlog.analyzer.marks.formats.labels import (
    FileLabel,
    PlacedMark,
    check_overlaps,
    make_mark,
    place_text,
)
from hearthlog.analyzer.marks.marks import Mark
from hearthlog.schemas.storage.new_files import new_file

_SIZE_LIMIT = 16 << 20  # a hundred thousand labels, or more; what is larger is something else
_XML_LIMIT = 64 << 20  # as many
_OBEYED = dict.fromkeys(range(0x80, 0xA0), "\ufffd")  # by terminals; names have no others


class _Form(NamedTuple):
    read: Callable[[Path, str], Iterator[FileLabel]]
    write: Callable[[Path, Sequence[Mark], Mapping[str, Coverage]], str]
    size_limit: int = _SIZE_LIMIT


_AUDACITY = _Form(audacity.read, audacity.write)
_RAVEN = _Form(raven.read, raven.write)
_FORMS = {
    ".txt": _AUDACITY,
    ".csv": _Form(csvfile.read, csvfile.write),
    ".eaf": _Form(elan.read, elan.write, _XML_LIMIT),
    ".json": _Form(labelstudio.read, labelstudio.write),
    ".rttm": _Form(rttm.read, rttm.write),
}
SUFFIXES = tuple(_FORMS)


def read_labels(
    path: Path, heard: Mapping[str, Coverage], microphone: str | None = None
) -> dict[Path, list[Mark]]:
    """Read a label file.

    Parameters
    ----------
    path : Path
        `*.txt` (a label track of Audacity, or a selection table of Raven), `*.csv`, `*.eaf`
        (ELAN), `*.json` (Label Studio) or `*.rttm`.
    heard : mapping of str to Coverage
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
        With file and place, if the file is no label file, a time or label cannot be, labels
        overlap, or one lies where nothing was heard.
    """
    found = read_lines(path, heard, microphone)
    check_overlaps(path, found)
    by_log: dict[Path, list[Mark]] = {}
    for place, mark in found:
        pieces = heard[mark.microphone].split(mark.start, mark.end)
        if not pieces:
            raise DataError(
                f"{place_text(path, place)}: {mark.label} lies outside of what {mark.microphone} "
                "heard; `hearthlog info` shows when that was"
            )
        for log, start, end in pieces:
            by_log.setdefault(log, []).append(mark._replace(start=start, end=end))
    return by_log


def read_lines(
    path: Path, heard: Mapping[str, Coverage], microphone: str | None = None
) -> list[PlacedMark]:
    """Read a label file whose labels may overlap, and may lie where nothing was heard.

    Parameters and errors are otherwise those of `read_labels`.

    Returns
    -------
    list of (int or str, Mark)
        With their lines, or their places in a file that has none.
    """
    form = _FORMS.get(path.suffix, _AUDACITY)
    text = read_text(path, "label file", form.size_limit)
    if form is _AUDACITY and raven.is_table(text):
        form = _RAVEN
    found = [make_mark(path, label, heard, microphone) for label in form.read(path, text)]
    if not found:
        raise DataError(f"{path}: holds no labels")
    return found


def write_labels(path: Path, marks: Sequence[Mark], heard: Mapping[str, Coverage]) -> None:
    """Write marks as a label file that `read_labels` reads again.

    Parameters
    ----------
    path : Path
        Named as for `read_labels`; `*.selections.txt` is a table of Raven. Must not exist.
    marks : sequence of Mark
        For a label track of Audacity those of one microphone.
    heard : mapping of str to Coverage

    Raises
    ------
    DataError
        If there are no marks, too many, or those of several microphones have no place in the file.
    LogError
        If the file exists, or cannot be written.
    """
    if not marks:
        raise DataError("no marks to export: nothing was imported or marked in these logs yet")
    form = _RAVEN if path.name.endswith(raven.SUFFIX) else _FORMS[path.suffix]
    raw = form.write(path, [_harmless(mark) for mark in marks], heard).encode()
    if len(raw) > form.size_limit:
        limit = form.size_limit >> 20
        raise DataError(f"{path}: would be larger than {limit} MB; export fewer logs")
    with new_file(path) as temporary:
        temporary.write_bytes(raw)


def _harmless(mark: Mark) -> Mark:
    """Leave out of a mark what would steer a terminal."""
    return mark._replace(
        reviewer=mark.reviewer.translate(_OBEYED), corrects=mark.corrects.translate(_OBEYED)
    )
