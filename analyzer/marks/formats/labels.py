"""Labels of a label file, the marks they become, and errors of those that are skipped."""

import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from decimal import Decimal
from pathlib import Path
from typing import NamedTuple

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.layers import Coverage
from hearthlog.analyzer.marks.marks import LATEST, PERSON_NAME, Mark
from hearthlog.schemas.errors import shortened
from hearthlog.schemas.frames import NANOSECONDS, read_time, time_text

UNREADABLE, EMPTY, POINT, OVERLAP = "unreadable line", "empty label", "point", "overlap"
WRONG_TIME = "wrong time"
OTHER = "label"


def place_text(path: Path, place: int | str) -> str:
    """Write the place of a label for an error: `file:line`, or `file: place`."""
    return f"{path}:{place}" if isinstance(place, int) else f"{path}: {place}"


class LineError(DataError):
    """A label of a file that cannot be a mark.

    Parameters
    ----------
    alike : str, optional
        What labels of the kind must have in common to be counted together.
    """

    def __init__(self, where: str, kind: str, reason: str, alike: str = "") -> None:
        super().__init__(f"{where}: {reason}")
        self.kind = kind
        self.alike = alike


class SkippedLabels:
    """Labels of a file that are left out: how many of each kind, and the first of them.

    Parameters
    ----------
    strict : bool
        Whether none may be left out.
    """

    def __init__(self, *, strict: bool) -> None:
        self._strict = strict
        self._counts: Counter[tuple[str, str]] = Counter()
        self._first: dict[tuple[str, str], LineError] = {}

    def add(self, error: LineError) -> None:
        """Leave out a label.

        Raise `LineError` if none may be left out.
        """
        if self._strict:
            raise error
        key = error.kind, error.alike
        self._counts[key] += 1
        self._first.setdefault(key, error)

    def kinds(self) -> Iterator[tuple[int, LineError]]:
        """Yield how many there are of each kind, and the first; the most first."""
        for key, count in self._counts.most_common():
            yield count, self._first[key]


_SECONDS = re.compile(r"[-+]?([0-9]{1,10}(\.[0-9]{0,18})?|\.[0-9]{1,18})([eE][-+]?[0-9]{1,2})?")
_DECIMAL_COMMA = re.compile(r"([-+]?[0-9]*),([0-9]+([eE][-+]?[0-9]{1,2})?)")
_LENGTH_TOLERANCE = NANOSECONDS  # between a labelled recording and the logs of it
_SHOWN = 64  # characters of a text


class FileLabel(NamedTuple):
    """A label as it is in a file: text, empty where the file has none.

    Attributes
    ----------
    start, end : str
        Seconds since `zero`, or ISO 8601.
    made : str
        When the label was made, ISO 8601.
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


class Choice(NamedTuple):
    """What of a file is read, where it has more than one thing that may be labels.

    Attributes
    ----------
    tiers : sequence of str
        Of ELAN; empty for all.
    """

    tiers: Sequence[str] = ()
    columns: Mapping[str, str] = {}


class LabelCodec(NamedTuple):
    """The functions of a format.

    Attributes
    ----------
    read : callable
        Yields the labels of a file in its order, from its path (for messages), its text and a
        `Choice`; a `LineError` for a line that is no label. Raises `DataError`, with file and
        place, if the text is not of this format.
    write : callable
        Returns the text of a file that `read` reads again, from its path (for messages), at least
        one mark, and the coverage of all of their microphones. Raises `DataError` if the format
        has no place for several microphones.
    """

    read: Callable[[Path, str, Choice], Iterator[FileLabel | LineError]]
    write: Callable[[Path, Sequence[Mark], Mapping[str, Coverage]], str]


class PlacedMark(NamedTuple):
    """A mark, and its line or place in the file."""

    place: int | str
    mark: Mark


def make_mark(
    path: Path, label: FileLabel, coverage: Mapping[str, Coverage], microphone: str | None
) -> PlacedMark:
    """Make a mark of a label in a file.

    Parameters
    ----------
    microphone : str or None
        The microphone of a label that names none; not needed if there is only one.

    Raises
    ------
    LineError
        With file and place, if the microphone is not in the logs or must be named, if a time or a
        name is invalid, if the label is empty or a point, ends before it starts or starts before
        the first frame, or if it is of a recording of another length.
    """
    where = place_text(path, label.place)
    if not label.label:
        raise LineError(where, EMPTY, "has no text")
    only = next(iter(coverage)) if len(coverage) == 1 else ""
    name = label.microphone or microphone or only
    if name not in coverage:
        names = ", ".join(sorted(coverage))
        remedy = "`annotate import --microphone` takes them as of another"
        unknown = f"no microphone {name[:_SHOWN]!r} in the logs; there is {names}; {remedy}"
        which = f"of which microphone? choose one with --microphone ({names})"
        raise LineError(where, OTHER, unknown if name else which, name)
    zero = _zero(where, label, coverage[name])
    start, end = _time(where, label.start, zero), _time(where, label.end, zero)
    text = shortened(label.label, _SHOWN)
    if start == end:
        raise LineError(where, POINT, f"{text} is a point; mark a span of time")
    if start > end:
        raise LineError(where, WRONG_TIME, f"{text} ends before it starts")
    if start < zero and label.start.startswith("-"):
        reason = f"{text} starts at {label.start} s, before the first frame"
        raise LineError(where, WRONG_TIME, reason)
    return PlacedMark(label.place, Mark(name, start, end, label.label, *_origin(where, label)))


def is_seconds(text: str) -> bool:
    """Tell whether a text is a number of seconds that can be read."""
    return _SECONDS.fullmatch(text) is not None


def with_point(number: str) -> str:
    """Return a number that has a decimal comma with a point; any other text as it is."""
    comma = _DECIMAL_COMMA.fullmatch(number)
    return f"{comma[1]}.{comma[2]}" if comma else number


def add_seconds(where: str, start: str, duration: str) -> str:
    """Return the end of a label of which start and duration are known.

    Parameters
    ----------
    start, duration : str
        Decimal numbers of seconds, with or without an exponent.

    Raises
    ------
    LineError
        If one is no number, or has more than 10 digits before the point or 18 behind it.
    """
    return f"{_seconds(where, start) + _seconds(where, duration):f}"


def _seconds(where: str, text: str) -> Decimal:
    if not is_seconds(text):
        raise LineError(where, WRONG_TIME, f"{text[:_SHOWN]!r} is no number of seconds")
    return Decimal(text)


def made_text(mark: Mark) -> str:
    """Write the time at which a mark was made in ISO 8601; empty if it is unknown."""
    return time_text(mark.made) if mark.made else ""


def _zero(where: str, label: FileLabel, coverage: Coverage) -> int:
    """Return the time from which seconds are counted."""
    if label.zero:
        return _time(where, label.zero, 0)
    if label.length:
        labelled = round(_seconds(where, label.length) * NANOSECONDS)
        recorded = coverage.ends[-1] - coverage.starts[0]
        if abs(labelled - recorded) > _LENGTH_TOLERANCE:
            raise LineError(
                where,
                OTHER,
                f"labels a recording of {label.length} s, and these logs are of "
                f"{recorded / NANOSECONDS:.3f} s; name the logs of that recording, no others",
            )
    return coverage.starts[0]


def _origin(where: str, label: FileLabel) -> tuple[str, int, str]:
    """Return the reviewer, when the label was made, and the labelling that it corrects."""
    reviewer, corrects = label.reviewer.strip(), label.corrects.strip()
    for text in (reviewer, corrects):
        if not PERSON_NAME.fullmatch(text):
            reason = f"{text[:_SHOWN]!r} cannot be a name: use up to 200 characters"
            raise LineError(where, OTHER, reason)
    made = _time(where, label.made, -1) if label.made else 0
    if not 0 <= made <= LATEST:
        raise LineError(where, WRONG_TIME, f"a label cannot be made at {label.made[:_SHOWN]!r}")
    return reviewer, made, corrects


def _time(where: str, text: str, zero: int) -> int:
    """Read seconds since `zero`, or ISO 8601, in nanoseconds of UTC."""
    if _SECONDS.fullmatch(text):
        return zero + round(Decimal(text) * NANOSECONDS)
    try:
        return read_time(text)
    except (ValueError, OverflowError) as error:
        reason = f"{text[:_SHOWN]!r} is neither seconds nor a time such as 2026-03-01T07:00:00"
        raise LineError(where, WRONG_TIME, reason) from error
