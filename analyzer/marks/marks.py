"""Marks and reviewed spans in the review layer next to a log."""

import re
import tempfile
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.layers import ROUNDING
from hearthlog.analyzer.logs.selection import decode_types, is_compatible, select
from hearthlog.models.classes import CLASS_NAME
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import Columns
from hearthlog.schemas.logs.files import SUFFIX, review_path, stem
from hearthlog.schemas.logs.metadata import provenance
from hearthlog.schemas.logs.writer import LogWriter, TopicBatch
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.cdr_codec import Column
from hearthlog.schemas.messages.topics import (
    LIVE,
    Topic,
    check_microphone_name,
    check_scenario_name,
    is_review,
    labelling_topic,
    parse_topic,
    review_labelling,
    scenario_name,
)
from hearthlog.schemas.new_files import locked_folder, readers_of, replaced_file

_KINDS = {
    message_types.SEGMENT: "segment",
    message_types.MARK: "mark",
    message_types.REVIEWED: "reviewed",
}
_SPAN = ("header.stamp", "duration")
_ORIGIN = ("reviewer", "made", "corrects")
# Fields of a row after microphone, start and end.
_OWN = {
    message_types.SEGMENT: ("label",),
    message_types.MARK: ("label", *_ORIGIN, "reason"),
    message_types.REVIEWED: (*_ORIGIN, "chosen"),
}
_FIELDS = {type_: (*_SPAN, *own) for type_, own in _OWN.items()}
Key = tuple[str, str]  # labelling, such as `review`, and message type
Row = tuple[Any, ...]


def read_rows(path: Path) -> dict[Key, list[Row]]:
    """Read a review layer by labelling and type.

    Rows have microphone, start and end in nanoseconds of UTC; then label for segments; label,
    reviewer, made, corrects and reason for marks; reviewer, made, corrects and chosen for reviewed
    spans. Raise `LogError` if the layer cannot be read, is damaged or cut off, or holds other
    topics.
    """
    with LogFile(path) as file:
        complete = file.complete
    selection = select([path])
    if not complete:
        raise LogError(f"{path}: is cut off; `hearthlog recover` saves what is there of it")
    for name, same in selection.channels.items():
        kind = next((k for k in _KINDS if all(is_compatible(*d, k, _FIELDS[k]) for d in same)), "")
        parts = parse_topic(name)
        if parts is None or not is_review(parts.labelling) or parts.kind != _KINDS.get(kind):
            raise LogError(f"{path}: is no review layer: it has a topic {name!r}; move it away")
    selection.verify()
    rows: dict[Key, list[Row]] = {}
    for batch in selection.messages():
        for columns in decode_types(path, batch, _FIELDS):
            parts = parse_topic(columns.topic)
            assert parts is not None
            key = parts.labelling, columns.type
            rows.setdefault(key, []).extend(_rows(parts.microphone, columns))
    return rows


def layer_bytes(name: str, spans: Mapping[Key, Sequence[Any]], metadata: dict[str, str]) -> bytes:
    """Return the file content of a review layer."""
    batches = [
        (
            Topic(labelling_topic(microphone, labelling, _KINDS[type_]), type_),
            [span for span in same if span.microphone == microphone],
        )
        for (labelling, type_), same in spans.items()
        for microphone in sorted({span.microphone for span in same})
    ]
    # In another folder, where no reader mistakes the file for an active log.
    with tempfile.TemporaryDirectory(prefix="hearthlog") as folder:
        writer = LogWriter(Path(folder) / name, [topic for topic, _ in batches], metadata)
        writer.write_columns([_batch(*batch) for batch in batches])
        return writer.finish().read_bytes()


def _rows(microphone: str, columns: Columns) -> Iterator[Row]:
    starts = columns["header.stamp"]
    ends = starts + columns["duration"]
    own = [columns[name].tolist() for name in _OWN[columns.type]]
    for row in zip(starts.tolist(), ends.tolist(), *own, strict=True):
        yield (microphone, *row)


def _batch(topic: Topic, spans: Sequence[Any]) -> TopicBatch:
    starts = np.array([span.start for span in spans])
    ends = np.array([span.end for span in spans])
    fields: dict[str, Column] = {
        "header.stamp": starts,
        "header.frame_id": spans[0].microphone,
        "duration": ends - starts,
    }
    if topic.type == message_types.SEGMENT:
        fields["confidence"] = np.ones(len(spans), np.float32)
    for name in _OWN[topic.type]:
        values = [getattr(span, name) for span in spans]
        fields[name] = np.array(values) if name == "made" else values
    return TopicBatch(topic.name, ends, fields)


LATEST = (1 << 31) * NANOSECONDS - 1  # maximum of builtin_interfaces/Time
PERSON_NAME = re.compile(r"[^\x00-\x1f\x7f\ud800-\udfff]{0,200}")  # of a reviewer or a labelling
PERSON, QUEUE, RANDOM = CHOICES = ("person", "queue", "random")  # how a reviewed span was selected


class Mark(NamedTuple):
    """A reviewer's label of a span of time.

    Attributes
    ----------
    microphone : str
    start, end : int
        In nanoseconds of UTC.
    label : str
    reviewer : str
        Empty if unknown.
    made : int
        Time at which the mark was made, in nanoseconds of UTC; 0 if unknown.
    corrects : str
        The corrected labelling: `live`, or the name of a model; empty if unknown.
    reason : str
        Origin of a mark made as part of a group, such as `group 3 of 5b4e0d1c`; else empty.
    """

    microphone: str
    start: int
    end: int
    label: str
    reviewer: str = ""
    made: int = 0
    corrects: str = ""
    reason: str = ""


class MarkedSpan(NamedTuple):
    """A span of time of a microphone, in nanoseconds of UTC."""

    microphone: str
    start: int
    end: int


class ReviewedSpan(NamedTuple):
    """A span that a reviewer has checked: labels without a mark in it are correct.

    `chosen` is how the span was selected: `person`, `queue`, or `random`. Random spans are reserved
    to measure label accuracy, and not used for training.
    """

    microphone: str
    start: int  # in nanoseconds of UTC
    end: int  # likewise
    reviewer: str = ""  # empty if unknown
    made: int = 0  # time of the review, in nanoseconds of UTC; 0 if unknown
    corrects: str = LIVE
    chosen: str = PERSON


class Reviewed(NamedTuple):
    """Marks and reviewed spans of a log, or of one of its scenarios."""

    marks: list[Mark]
    reviewed: list[ReviewedSpan]


def read_review(log: Path) -> dict[str, Reviewed]:
    """Read all marks and reviewed spans of a log, by scenario; empty without a review layer.

    The scenario is empty for the sounds of the home. Raise `LogError` if the review layer cannot be
    read, is damaged or cut off, holds other topics, or has marks that are invalid or overlap.
    """
    return _read_layer(review_path(log))


def read_marks(log: Path, scenario: str = "") -> list[Mark]:
    """Read the marks of a log by microphone and time, without overlaps; by default of no scenario.

    Empty if there is no review layer. Raise `LogError` as `read_review` does.
    """
    return read_review(log).get(scenario, _NOTHING).marks.copy()


def read_reviewed(log: Path, scenario: str = "") -> list[ReviewedSpan]:
    """Read the reviewed spans of a log by microphone and time; they may overlap.

    Empty if there is no review layer. Raise `LogError` as `read_review` does.
    """
    return read_review(log).get(scenario, _NOTHING).reviewed.copy()


_NOTHING = Reviewed([], [])


def _read_layer(path: Path) -> dict[str, Reviewed]:
    """Read a layer; retry if another process replaces it meanwhile, empty if it is gone."""
    while (before := _identity(path)) is not None:
        try:
            rows = read_rows(path)
            return {
                name: _reviewed(path, rows, name)
                for name in sorted({scenario_name(labelling) for labelling, _ in rows})
            }
        except LogError:
            if _identity(path) == before:
                raise
    return {}


def _identity(path: Path) -> tuple[int, int] | None:
    """Return inode and modification time of a file, to detect replacement; None if missing."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_ino, status.st_mtime_ns


def _reviewed(path: Path, rows: Mapping[Key, Sequence[Row]], scenario: str) -> Reviewed:
    """Extract and check the marks and reviewed spans of a scenario."""

    def of_type(type_: str) -> Sequence[Row]:
        return rows.get((review_labelling(scenario), type_), ())

    with_origin = {mark[:4]: mark for mark in (Mark(*row) for row in of_type(message_types.MARK))}
    marks = [Mark(*row) for row in of_type(message_types.SEGMENT)]
    try:
        return Reviewed(
            _checked(with_origin.get(mark[:4], mark) for mark in marks),
            _checked_reviewed(ReviewedSpan(*row) for row in of_type(message_types.REVIEWED)),
        )
    except (DataError, LogError) as error:
        raise LogError(f"{path}: {error}; move this layer away to begin anew") from error


def write_marks(  # noqa: PLR0913
    log: Path,
    marks: Iterable[Mark],
    deleted: Iterable[MarkedSpan] = (),
    *,
    reviewed: Iterable[ReviewedSpan] = (),
    not_reviewed: Iterable[ReviewedSpan] = (),
    scenario: str = "",
) -> Path:
    """Add marks to the review layer of a log; they replace overlapping older marks.

    Older marks in `deleted` are deleted or cut before the new marks are added; `not_reviewed` is
    removed before `reviewed` is added. Marks of other scenarios, or of the sounds of the home, are
    kept. The layer is replaced atomically. Concurrent writers to the same folder wait for each
    other. Return the layer; without marks and reviewed spans the file does not exist.

    Raise `DataError` if the new marks overlap each other, or new marks or spans are invalid;
    `LogError` if there is no such log, if its layer cannot be read or is damaged, if the name of a
    microphone or the scenario is invalid, or if the layer cannot be written.
    """
    new, all_reviewed = _checked(marks), _checked_reviewed(reviewed)
    if scenario:
        check_scenario_name(scenario)
    path = review_path(log)
    with ExitStack() as stack:
        try:
            stack.enter_context(locked_folder(path.parent))
        except OSError as error:
            raise LogError(f"{path}: cannot be written ({error.strerror})") from error
        layer = _read_layer(path)
        kept, before = layer.get(scenario, _NOTHING)
        for span in deleted:
            kept = list(_subtract(kept, [span]))
        kept = _checked([*_subtract(kept, new), *new])
        all_reviewed = sorted(set(before).difference(not_reviewed).union(all_reviewed))
        spans = _by_topic(layer | {scenario: Reviewed(kept, all_reviewed)})
        if not any(spans.values()):
            path.unlink(missing_ok=True)
            return path
        node = next((record.get("node", "") for record in select([log]).metadata), "")
        metadata = provenance(node, log=stem(log) + SUFFIX)
        with replaced_file(path, readers=readers_of(log)) as temporary:
            temporary.write_bytes(layer_bytes(path.name, spans, metadata))
    return path


def _by_topic(layer: Mapping[str, Reviewed]) -> dict[Key, Sequence[Mark | ReviewedSpan]]:
    spans: dict[Key, Sequence[Mark | ReviewedSpan]] = {}
    for scenario in sorted(layer):
        labelling, (marks, reviewed) = review_labelling(scenario), layer[scenario]
        spans[labelling, message_types.SEGMENT] = spans[labelling, message_types.MARK] = marks
        spans[labelling, message_types.REVIEWED] = reviewed
    return spans


def _checked(marks: Iterable[Mark]) -> list[Mark]:
    """Return sorted marks; raise DataError if a mark is invalid."""
    ordered = sorted(marks)
    for mark in ordered:
        _check(mark, "mark")
        if not CLASS_NAME.fullmatch(mark.label):
            raise DataError(f"{mark.label[:64]!r} cannot be the name of a class")
    for one, other in pairwise(ordered):
        if one.microphone == other.microphone and other.start < one.end:
            raise DataError(f"{one.label} and {other.label} overlap at {other.start} ns")
    return ordered


def _checked_reviewed(spans: Iterable[ReviewedSpan]) -> list[ReviewedSpan]:
    """Return sorted reviewed spans; raise DataError if a span is invalid."""
    ordered = sorted(set(spans))
    for span in ordered:
        _check(span, "review")
        if not CLASS_NAME.fullmatch(span.chosen):
            raise DataError(f"a reviewed span cannot be chosen by {span.chosen[:64]!r}")
    return ordered


def _check(span: Mark | ReviewedSpan, what: str) -> None:
    if not 0 <= span.start < span.end <= LATEST:
        raise DataError(f"a {what} from {span.start} to {span.end} ns is no span of time")
    own = span.reason if isinstance(span, Mark) else ""
    names = all(map(PERSON_NAME.fullmatch, (span.reviewer, span.corrects, own)))
    if not (0 <= span.made <= LATEST and names):
        raise DataError(f"a {what} cannot be made by {span.reviewer[:64]!r} at {span.made} ns")
    check_microphone_name(span.microphone)


def _subtract(old: Sequence[Mark], new: Sequence[Mark | MarkedSpan]) -> Iterator[Mark]:
    """Yield the parts of old marks outside of new ones."""
    for microphone in sorted({mark.microphone for mark in old}):
        own = [mark for mark in new if mark.microphone == microphone]
        starts, ends = [mark.start for mark in own], [mark.end for mark in own]
        for mark in old:
            if mark.microphone == microphone:
                yield from _around(mark, starts, ends)


def _around(old: Mark, starts: Sequence[int], ends: Sequence[int]) -> list[Mark]:
    """Cut a mark around spans that are sorted and do not overlap."""
    over = range(bisect_right(ends, old.start), bisect_left(starts, old.end))
    if not over:
        return [old]
    begins = [old.start, *(ends[i] for i in over)]
    stops = [*(starts[i] for i in over), old.end]
    return [
        old._replace(start=start, end=end)
        for start, end in zip(begins, stops, strict=True)
        if end - start > ROUNDING
    ]


def new_marks(marks: Iterable[Mark], existing: Sequence[Mark]) -> list[Mark]:
    """Return the marks that do not exist yet, comparing times to within 1 ms.

    A mark without reviewer, time or labelling equals an existing mark with them: importing a file
    without these fields does not remove them, and rounded times do not move marks.
    """
    ordered = sorted(existing)
    keys = [mark[:2] for mark in ordered]
    return [mark for mark in marks if not _exists(mark, ordered, keys)]


def _exists(mark: Mark, ordered: Sequence[Mark], keys: Sequence[tuple[str, int]]) -> bool:
    first = bisect_left(keys, (mark.microphone, mark.start - ROUNDING))
    last = bisect_left(keys, (mark.microphone, mark.start + ROUNDING + 1))
    return any(
        old.label == mark.label
        and abs(old.end - mark.end) <= ROUNDING
        and all(new in {"", 0, own} for new, own in zip(mark[4:], old[4:], strict=True))
        for old in ordered[first:last]
    )
