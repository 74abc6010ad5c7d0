"""What a label file says, and the marks that this makes."""

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
_OTHER_SOUND = NANOSECONDS  # what a recording and the logs of it may differ in length


class FileLabel(NamedTuple):
    """A label as it is in a file, all of it text.

    Attributes
    ----------
    place : int or str
        Its line, or its place in a file that has no lines.
    start, end : str
        Seconds from `zero` on, or ISO 8601.
    zero : str
        ISO 8601; by default it is the first frame of the microphone.
    length : str
        Of the recording that was labelled, in seconds; empty if nobody knows.
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
    """A mark, and the place in the file where it is."""

    place: int | str
    mark: Mark


def place_text(path: Path, place: int | str) -> str:
    """Name a place in a file, for a message."""
    return f"{path}:{place}" if isinstance(place, int) else f"{path}: {place}"


def make_mark(
    path: Path, label: FileLabel, heard: Mapping[str, Coverage], microphone: str | None
) -> PlacedMark:
    """Make a mark of a label.

    Raises
    ------
    DataError
        With file and place, if it cannot be one.
    """
    where = place_text(path, label.place)
    name = label.microphone or microphone or (next(iter(heard)) if len(heard) == 1 else "")
    if name not in heard:
        known = ", ".join(sorted(heard))
        if name:
            raise DataError(f"{where}: no microphone {name[:64]!r} in the logs; there is {known}")
        raise DataError(f"{where}: of which microphone? choose one with --microphone ({known})")
    zero = _zero(where, label, heard[name])
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
    return PlacedMark(label.place, Mark(name, start, end, label.label, *_says(where, label)))


def check_overlaps(path: Path, found: Sequence[PlacedMark]) -> None:
    """Raise DataError if labels of a microphone overlap."""
    order = sorted(range(len(found)), key=lambda i: found[i].mark)
    for one, other in pairwise(order):
        earlier, later = found[one].mark, found[other].mark
        if earlier.microphone == later.microphone and later.start < earlier.end:
            first, last = (found[i].place for i in sorted((one, other)))
            name = f"line {first}" if isinstance(first, int) else first
            raise DataError(f"{place_text(path, last)}: overlaps the label in {name}")


def read_seconds(where: str, text: str) -> Decimal:
    """Read a number of seconds.

    Raises
    ------
    DataError
        If it is none.
    """
    if not _SECONDS.fullmatch(text):
        raise DataError(f"{where}: {text[:64]!r} is no number of seconds")
    return Decimal(text)


def seconds_text(nanoseconds: int) -> str:
    """Write a time as seconds, none of whose digits is lost."""
    seconds, rest = divmod(abs(nanoseconds), NANOSECONDS)
    return f"{'-' if nanoseconds < 0 else ''}{seconds}.{rest:09}"


def made_text(mark: Mark) -> str:
    """Write when a mark was made; empty if nobody knows."""
    return time_text(mark.made) if mark.made else ""


def _zero(where: str, label: FileLabel, heard: Coverage) -> int:
    """Return the time that seconds are counted from."""
    if label.zero:
        return _time(where, label.zero, 0)
    if label.length:
        length = round(read_seconds(where, label.length) * NANOSECONDS)
        known = heard.ends[-1] - heard.starts[0]
        if abs(length - known) > _OTHER_SOUND:
            raise DataError(
                f"{where}: labels a recording of {label.length} s, and these logs are of "
                f"{known / NANOSECONDS:.3f} s; name the logs of that recording, no others"
            )
    return heard.starts[0]


def _says(where: str, label: FileLabel) -> tuple[str, int, str]:
    """Return who says so, when, and what is corrected."""
    reviewer, corrects = label.reviewer.strip(), label.corrects.strip()
    for text in (reviewer, corrects):
        if not PERSON_NAME.fullmatch(text):
            raise DataError(f"{where}: {text[:64]!r} cannot be a name: use up to 200 characters")
    made = _time(where, label.made, -1) if label.made else 0
    if not 0 <= made <= LATEST:
        raise DataError(f"{where}: a label cannot be made at {label.made[:64]!r}")
    return reviewer, made, corrects


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
