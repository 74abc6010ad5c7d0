"""Labels as they are in a file, and the marks that they become."""

import re
from collections.abc import Mapping, Sequence
from decimal import Decimal
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.coverage import Coverage
from hearthlog.analyzer.marks.marks import LATEST, PERSON_NAME, Mark
from hearthlog.models.classifiers.description import CLASS_NAME
from hearthlog.schemas.times import NANOSECONDS, read_time, time_text

_SECONDS = re.compile(r"[-+]?[0-9]{1,10}(\.[0-9]{0,18})?([eE][-+]?[0-9]{1,2})?")
_LENGTH_TOLERANCE = NANOSECONDS  # between a labelled recording and the logs of it


class FileLabel(NamedTuple):
    """A label as it is in a file: text, empty where the file has none.

    Attributes
    ----------
    place : int or str
        The line, or the place in a file without lines.
    start, end : str
        Seconds since `zero`, or ISO 8601.
    label, microphone, reviewer : str
    made : str
        When the label was made, ISO 8601.
    corrects : str
        The labelling that it corrects.
    zero : str
        ISO 8601; by default the first frame of the microphone.
    length : str
        Length of the labelled recording, in seconds.
    """

    place: int | str
    start: str
    end: str
    label: str
    microphone: str = ""
    reviewer: str = ""
    made: str = ""
    corrects: str = ""
    zero: str = ""
    length: str = ""


class PlacedMark(NamedTuple):
    """A mark, and its line or place in the file."""

    place: int | str
    mark: Mark


def place_text(path: Path, place: int | str) -> str:
    """Write the place of a label for an error: `file:line`, or `file: place`.

    Parameters
    ----------
    path : Path
        Of the file.
    place : int or str
        The line, or the place in a file without lines.
    """
    return f"{path}:{place}" if isinstance(place, int) else f"{path}: {place}"


def make_mark(
    path: Path, label: FileLabel, coverage: Mapping[str, Coverage], microphone: str | None
) -> PlacedMark:
    """Make a mark of a label in a file.

    Parameters
    ----------
    path : Path
        Of the file, for errors.
    label : FileLabel
    coverage : mapping of str to Coverage
        By microphone.
    microphone : str or None
        The microphone of a label that names none; not needed if there is only one.

    Raises
    ------
    DataError
        With file and place, if the microphone is not in the logs or must be named, if a time, the
        label or a name is invalid, if the label is a point, ends before it starts or starts before
        the first frame, or if it is of a recording of another length.
    """
    where = place_text(path, label.place)
    only = next(iter(coverage)) if len(coverage) == 1 else ""
    name = label.microphone or microphone or only
    if name not in coverage:
        names = ", ".join(sorted(coverage))
        if name:
            raise DataError(f"{where}: no microphone {name[:64]!r} in the logs; there is {names}")
        raise DataError(f"{where}: of which microphone? choose one with --microphone ({names})")
    zero = _zero(where, label, coverage[name])
    start, end = _time(where, label.start, zero), _time(where, label.end, zero)
    if not CLASS_NAME.fullmatch(label.label):
        raise DataError(
            f"{where}: {label.label[:64]!r} cannot be the name of a class: use lower-case letters, "
            "digits and '_'"
        )
    if start == end:
        raise DataError(f"{where}: {label.label} is a point; mark a span of time")
    if start > end:
        raise DataError(f"{where}: {label.label} ends before it starts")
    if start < zero and label.start.startswith("-"):
        raise DataError(f"{where}: {label.label} starts at {label.start} s, before the first frame")
    return PlacedMark(label.place, Mark(name, start, end, label.label, *_origin(where, label)))


def check_overlaps(path: Path, placed: Sequence[PlacedMark]) -> None:
    """Check that marks of one microphone do not overlap.

    Parameters
    ----------
    path : Path
        Of the file, for the message.
    placed : sequence of PlacedMark
        In the order of the file.

    Raises
    ------
    DataError
        With file and place, if two of them overlap.
    """
    order = sorted(range(len(placed)), key=lambda i: placed[i].mark)
    for one, other in pairwise(order):
        earlier, later = placed[one].mark, placed[other].mark
        if earlier.microphone == later.microphone and later.start < earlier.end:
            first, last = (placed[i].place for i in sorted((one, other)))
            name = f"line {first}" if isinstance(first, int) else first
            raise DataError(f"{place_text(path, last)}: overlaps the label in {name}")


def read_seconds(where: str, text: str) -> Decimal:
    """Read a number of seconds.

    Parameters
    ----------
    where : str
        File and place, for the message.
    text : str
        A decimal number, with or without an exponent.

    Raises
    ------
    DataError
        If the text is no number, or has more than 10 digits before the point or 18 behind it.
    """
    if not _SECONDS.fullmatch(text):
        raise DataError(f"{where}: {text[:64]!r} is no number of seconds")
    return Decimal(text)


def made_text(mark: Mark) -> str:
    """Write the time at which a mark was made in ISO 8601; empty if it is unknown."""
    return time_text(mark.made) if mark.made else ""


def _zero(where: str, label: FileLabel, coverage: Coverage) -> int:
    """Return the time from which seconds are counted."""
    if label.zero:
        return _time(where, label.zero, 0)
    if label.length:
        labelled = round(read_seconds(where, label.length) * NANOSECONDS)
        recorded = coverage.ends[-1] - coverage.starts[0]
        if abs(labelled - recorded) > _LENGTH_TOLERANCE:
            raise DataError(
                f"{where}: labels a recording of {label.length} s, and these logs are of "
                f"{recorded / NANOSECONDS:.3f} s; name the logs of that recording, no others"
            )
    return coverage.starts[0]


def _origin(where: str, label: FileLabel) -> tuple[str, int, str]:
    """Return the reviewer, when the label was made, and the labelling that it corrects."""
    reviewer, corrects = label.reviewer.strip(), label.corrects.strip()
    for text in (reviewer, corrects):
        if not PERSON_NAME.fullmatch(text):
            raise DataError(f"{where}: {text[:64]!r} cannot be a name: use up to 200 characters")
    made = _time(where, label.made, -1) if label.made else 0
    if not 0 <= made <= LATEST:
        raise DataError(f"{where}: a label cannot be made at {label.made[:64]!r}")
    return reviewer, made, corrects


def _time(where: str, text: str, zero: int) -> int:
    """Read seconds since `zero`, or ISO 8601, in nanoseconds of UTC."""
    if _SECONDS.fullmatch(text):
        return zero + round(Decimal(text) * NANOSECONDS)
    try:
        return read_time(text)
    except (ValueError, OverflowError) as error:
        raise DataError(
            f"{where}: {text[:64]!r} is neither seconds nor a time such as 2026-03-01T07:00:00"
        ) from error
