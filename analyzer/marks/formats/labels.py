"""Labels of a label file, their conversion to marks, and errors of skipped labels."""

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from decimal import Decimal
from pathlib import Path
from typing import Any, NamedTuple

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.layers import Coverage
from hearthlog.analyzer.marks.marks import LATEST, PERSON_NAME, Mark
from hearthlog.schemas.errors import shortened
from hearthlog.schemas.frames import NANOSECONDS, read_time, time_text

UNREADABLE, EMPTY, POINT, OVERLAP = "unreadable line", "empty label", "point", "overlap"
WRONG_TIME = "wrong time"
OTHER = "label"


def place_text(path: Path, place: int | str) -> str:
    """Format the place of a label for an error: `file:line`, or `file: place`."""
    return f"{path}:{place}" if isinstance(place, int) else f"{path}: {place}"


class LineError(DataError):
    """A label of a file that cannot become a mark.

    Labels of the same kind, with the same key `alike`, are counted together.
    """

    def __init__(self, where: str, kind: str, reason: str, alike: str = "") -> None:
        super().__init__(f"{where}: {reason}")
        self.kind = kind
        self.alike = alike


class SkippedLabels:
    """Skipped labels of a file: number and first of each kind; an error instead if `strict`."""

    def __init__(self, *, strict: bool) -> None:
        self._strict = strict
        self._counts: Counter[tuple[str, str]] = Counter()
        self._first: dict[tuple[str, str], LineError] = {}

    def add(self, error: LineError) -> None:
        """Skip a label; raise its `LineError` if strict."""
        if self._strict:
            raise error
        key = error.kind, error.alike
        self._counts[key] += 1
        self._first.setdefault(key, error)

    def kinds(self) -> Iterator[tuple[int, LineError]]:
        """Yield the count and the first error of each kind, most frequent first."""
        for key, count in self._counts.most_common():
            yield count, self._first[key]


_SECONDS = re.compile(r"[-+]?([0-9]{1,10}(\.[0-9]{0,18})?|\.[0-9]{1,18})([eE][-+]?[0-9]{1,2})?")
_DECIMAL_COMMA = re.compile(r"([-+]?[0-9]*),([0-9]+([eE][-+]?[0-9]{1,2})?)")
_LENGTH_TOLERANCE = NANOSECONDS  # between a labelled recording and its logs
_SHOWN = 64  # characters of a text in an error


class FileLabel(NamedTuple):
    """A label as in the file: texts, empty if missing."""

    start: str  # seconds since `zero`, or ISO 8601
    end: str  # likewise
    label: str
    microphone: str = ""
    reviewer: str = ""
    made: str = ""  # time at which the label was made, ISO 8601
    corrects: str = ""
    zero: str = ""  # ISO 8601; by default the first frame of the microphone
    length: str = ""  # of the labelled recording, in seconds
    place: int | str = 0


class Choice(NamedTuple):
    """Parts of a file to read as labels, if there are several."""

    tiers: Sequence[str] = ()  # of ELAN; empty for all top tiers
    columns: Mapping[str, str] = {}


class LabelCodec(NamedTuple):
    """Reader and writer of a format.

    Attributes
    ----------
    read : callable
        Yields the labels of a file in its order, from its path (for messages), its text and a
        `Choice`; a `LineError` for a line that is no label. Raises `DataError`, with file and
        place, if the text is not of this format.
    write : callable
        Returns the text of a file that `read` can read, from its path (for messages), at least
        one mark, and the coverage of all their microphones. Raises `DataError` if the format
        supports only one microphone.
    """

    read: Callable[[Path, str, Choice], Iterator[FileLabel | LineError]]
    write: Callable[[Path, Sequence[Mark], Mapping[str, Coverage]], str]


def scan(
    path: Path,
    entries: Iterable[tuple[int | str, Any]],
    parse: Callable[[str, Any], FileLabel | None],
) -> Iterator[FileLabel | LineError]:
    """Parse the entries of a file, with their places.

    `parse` returns the label of an entry, given its place for errors; None for an entry that is
    skipped. It raises `LineError` for an entry that is no label.
    """
    for place, entry in entries:
        try:
            label = parse(place_text(path, place), entry)
        except LineError as error:
            yield error
        else:
            if label is not None:
                yield label._replace(place=place)


class PlacedMark(NamedTuple):
    """A mark with its line or place in the file."""

    place: int | str
    mark: Mark


def make_mark(
    path: Path, label: FileLabel, coverage: Mapping[str, Coverage], microphone: str | None
) -> PlacedMark:
    """Convert a label of a file to a mark.

    `microphone` is that of labels that name none; not needed if there is only one. Raise
    `LineError`, with file and place, if the microphone is not in the logs or must be named, if a
    time or a name is invalid, if the label is empty or a point, ends before it starts or starts
    before the first frame, or if the labelled recording has another length.
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
    """Whether a text is a valid number of seconds."""
    return _SECONDS.fullmatch(text) is not None


def with_point(number: str) -> str:
    """Replace the decimal comma of a number with a point; other texts are returned unchanged."""
    comma = _DECIMAL_COMMA.fullmatch(number)
    return f"{comma[1]}.{comma[2]}" if comma else number


def add_seconds(where: str, start: str, duration: str) -> str:
    """Return the end of a label from its start and duration, decimal numbers of seconds.

    They may have an exponent. Raise `LineError` if a value is no number, or has more than 10 digits
    before the point or 18 after it.
    """
    return f"{_seconds(where, start) + _seconds(where, duration):f}"


def _seconds(where: str, text: str) -> Decimal:
    if not is_seconds(text):
        raise LineError(where, WRONG_TIME, f"{text[:_SHOWN]!r} is no number of seconds")
    return Decimal(text)


def made_text(mark: Mark) -> str:
    """Return the time at which a mark was made in ISO 8601; empty if unknown."""
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
    """Return the reviewer, the time of the label, and the corrected labelling."""
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
    """Parse seconds since `zero`, or ISO 8601, to nanoseconds of UTC."""
    if _SECONDS.fullmatch(text):
        return zero + round(Decimal(text) * NANOSECONDS)
    try:
        return read_time(text)
    except (ValueError, OverflowError) as error:
        reason = f"{text[:_SHOWN]!r} is neither seconds nor a time such as 2026-03-01T07:00:00"
        raise LineError(where, WRONG_TIME, reason) from error
