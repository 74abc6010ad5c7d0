"""Marks, the corrections of a reviewer, and what she looked at, in a layer beside the log."""

import re
import tempfile
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.coverage import ROUNDING
from hearthlog.analyzer.logs.selection import select
from hearthlog.analyzer.logs.typed_columns import decode_types, is_compatible
from hearthlog.models.classes import CLASS_NAME
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.columns import Columns
from hearthlog.schemas.logs.files import SUFFIX, review_path, stem
from hearthlog.schemas.logs.log_stream import TopicBatch
from hearthlog.schemas.logs.provenance import provenance
from hearthlog.schemas.logs.writer import LogWriter
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.cdr_codec import Column
from hearthlog.schemas.messages.topics import (
    LIVE,
    REVIEW,
    Topic,
    check_microphone_name,
    labelling_topic,
)
from hearthlog.schemas.storage.new_files import locked_folder, replaced_file
from hearthlog.schemas.times import NANOSECONDS

LATEST = (1 << 31) * NANOSECONDS - 1  # what builtin_interfaces/Time can hold
PERSON_NAME = re.compile(r"[^\x00-\x1f\x7f\ud800-\udfff]{0,200}")  # of a reviewer, of a labelling
_KINDS = {
    message_types.SEGMENT: "segment",
    message_types.MARK: "mark",
    message_types.REVIEWED: "reviewed",
}
PERSON, QUEUE, RANDOM = CHOICES = ("person", "queue", "random")  # how a reviewed span was chosen
_SPAN = ("header.stamp", "duration", "label")
_ORIGIN = ("reviewer", "made", "corrects")
_FIELDS = {
    message_types.SEGMENT: _SPAN,
    message_types.MARK: (*_SPAN, *_ORIGIN, "reason"),
    message_types.REVIEWED: ("header.stamp", "duration", *_ORIGIN, "chosen"),
}
_OWN_TEXTS = {
    message_types.SEGMENT: ("label",),
    message_types.MARK: ("label", "reason"),
    message_types.REVIEWED: ("chosen",),
}


class Mark(NamedTuple):
    """The label of a span of time by a reviewer.

    Attributes
    ----------
    microphone : str
    start, end : int
        In nanoseconds of UTC.
    label : str
    reviewer : str
        Empty if unknown.
    made : int
        When the mark was made, in nanoseconds of UTC; 0 if unknown.
    corrects : str
        The labelling that it corrects: `live`, or the name of a model; empty if unknown.
    reason : str
        Of a mark that was made with others, such as `group 3 of 5b4e0d1c`; else empty.
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
    """A span that a reviewer has looked at: what is not marked in it was labelled rightly.

    Attributes
    ----------
    microphone : str
    start, end : int
        In nanoseconds of UTC.
    reviewer : str
        Empty if unknown.
    made : int
        When it was looked at, in nanoseconds of UTC; 0 if unknown.
    corrects : str
        The labelling that was looked at: `live`, or the name of a model.
    chosen : str
        How the span was chosen: `person`, `queue`, or `random`. What was drawn at random is kept to
        measure how right labels are, and not learned from.
    """

    microphone: str
    start: int
    end: int
    reviewer: str = ""
    made: int = 0
    corrects: str = LIVE
    chosen: str = PERSON


def read_marks(log: Path) -> list[Mark]:
    """Read the marks of a log.

    Parameters
    ----------
    log : Path

    Returns
    -------
    list of Mark
        By microphone and time, without overlaps; empty if there is no review layer.

    Raises
    ------
    LogError
        If the review layer cannot be read, is damaged or cut off, holds other topics, or has marks
        that are invalid or overlap.
    """
    return _read_layer(review_path(log)).marks


def read_reviewed(log: Path) -> list[ReviewedSpan]:
    """Read the spans of a log that a reviewer has looked at.

    Parameters
    ----------
    log : Path

    Returns
    -------
    list of ReviewedSpan
        By microphone and time; they may overlap. Empty if there is no review layer.

    Raises
    ------
    LogError
        If the review layer cannot be read, is damaged or cut off, holds other topics, or has spans
        or marks that are invalid.
    """
    return _read_layer(review_path(log)).reviewed


class _Layer(NamedTuple):
    marks: list[Mark]
    reviewed: list[ReviewedSpan]


def _read_layer(path: Path) -> _Layer:
    """Read a layer; if another process replaces it meanwhile, read again, and it may be gone."""
    while (before := _identity(path)) is not None:
        try:
            return _read_existing(path)
        except LogError:
            if _identity(path) == before:
                raise
    return _Layer([], [])


def _identity(path: Path) -> tuple[int, int] | None:
    """Return what differs between two files of one name; None if there is no file."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_ino, status.st_mtime_ns


def _read_existing(path: Path) -> _Layer:
    with LogFile(path) as file:
        complete = file.complete
    selection = select([path])
    if not complete:
        raise LogError(f"{path}: is cut off; `hearthlog recover` saves what is there of it")
    for name, same in selection.channels.items():
        kind = next((k for k in _KINDS if all(is_compatible(*d, k, _FIELDS[k]) for d in same)), "")
        if not kind or not re.fullmatch(rf"/[^/]+/{REVIEW}/{_KINDS[kind]}", name):
            raise LogError(f"{path}: is no review layer: it has a topic {name!r}; move it away")
    selection.verify()
    spans: list[Mark] = []
    marks: dict[tuple[Any, ...], Mark] = {}
    reviewed: list[ReviewedSpan] = []
    for batch in selection.messages():
        for columns in decode_types(path, batch, _FIELDS):
            if columns.type == message_types.SEGMENT:
                spans += _marks(columns)
            elif columns.type == message_types.REVIEWED:
                reviewed += _reviewed(columns)
            else:
                marks |= {mark[:4]: mark for mark in _marks(columns)}
    try:
        return _Layer(
            _checked(marks.get(mark[:4], mark) for mark in spans), _checked_reviewed(reviewed)
        )
    except (DataError, LogError) as error:
        raise LogError(f"{path}: {error}; move this layer away to begin anew") from error


def write_marks(
    log: Path,
    marks: Iterable[Mark],
    deleted: Iterable[MarkedSpan] = (),
    *,
    reviewed: Iterable[ReviewedSpan] = (),
    not_reviewed: Iterable[ReviewedSpan] = (),
) -> Path:
    """Add marks to the review layer of a log; where they overlap older marks, they replace these.

    The layer is replaced in one step. Processes that write to the same folder wait for each other.

    Parameters
    ----------
    log : Path
    marks : iterable of Mark
    deleted : iterable of MarkedSpan
        Where older marks are deleted, or cut off; before the new marks are added.
    reviewed : iterable of ReviewedSpan
        What a reviewer has looked at; added to what the layer has.
    not_reviewed : iterable of ReviewedSpan
        Spans of the layer that are taken out of it, before those are added.

    Returns
    -------
    Path
        The layer; without marks and reviewed spans there is no such file.

    Raises
    ------
    DataError
        If the new marks overlap each other, or new marks or spans are invalid.
    LogError
        If there is no such log, if its layer cannot be read or is damaged, if the name of a
        microphone is invalid, or if the layer cannot be written.
    """
    new, looked_at = _checked(marks), _checked_reviewed(reviewed)
    path = review_path(log)
    with _locked(path):
        layer, before = _read_layer(path)
        for span in deleted:
            layer = list(_subtract(layer, [span]))
        layer = _checked([*_subtract(layer, new), *new])
        kept = set(before).difference(not_reviewed)
        looked_at = sorted(kept.union(looked_at))
        if not (layer or looked_at):
            path.unlink(missing_ok=True)
            return path
        node = next((record.get("node", "") for record in select([log]).metadata), "")
        metadata = provenance(node, log=stem(log) + SUFFIX)
        with replaced_file(path) as temporary:
            temporary.write_bytes(_layer_bytes(path.name, layer, looked_at, metadata))
    return path


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Keep other writers of review layers out of the folder."""
    with ExitStack() as stack:
        try:
            stack.enter_context(locked_folder(path.parent))
        except OSError as error:
            raise LogError(f"{path}: cannot be written ({error.strerror})") from error
        yield


def _marks(columns: Columns) -> Iterator[Mark]:
    microphone = columns.topic.split("/")[1]
    starts = columns["header.stamp"]
    ends = starts + columns["duration"]
    names = (*_ORIGIN, "reason") if columns.type == message_types.MARK else ()
    origin = [columns[name].tolist() for name in names]
    for row in zip(starts.tolist(), ends.tolist(), columns["label"].tolist(), *origin, strict=True):
        yield Mark(microphone, *row)


def _reviewed(columns: Columns) -> Iterator[ReviewedSpan]:
    microphone = columns.topic.split("/")[1]
    starts = columns["header.stamp"]
    ends = starts + columns["duration"]
    others = [columns[name].tolist() for name in (*_ORIGIN, "chosen")]
    for row in zip(starts.tolist(), ends.tolist(), *others, strict=True):
        yield ReviewedSpan(microphone, *row)


def _checked(marks: Iterable[Mark]) -> list[Mark]:
    """Sort marks; raise DataError if one is invalid."""
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
    """Sort reviewed spans; raise DataError if one is invalid."""
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
    """Yield what is left of old marks outside of new ones."""
    for microphone in {mark.microphone for mark in old}:
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


def _layer_bytes(
    name: str,
    marks: Sequence[Mark],
    reviewed: Sequence[ReviewedSpan],
    metadata: dict[str, str],
) -> bytes:
    """Write the file in another folder, where nobody takes it for a log being recorded."""
    rows: dict[str, Sequence[Mark | ReviewedSpan]] = {
        message_types.SEGMENT: marks,
        message_types.MARK: marks,
        message_types.REVIEWED: reviewed,
    }
    batches = [
        (
            Topic(labelling_topic(microphone, REVIEW, kind), type_),
            [span for span in rows[type_] if span.microphone == microphone],
        )
        for type_, kind in _KINDS.items()
        for microphone in sorted({span.microphone for span in rows[type_]})
    ]
    with tempfile.TemporaryDirectory(prefix="hearthlog") as folder:
        writer = LogWriter(Path(folder) / name, [topic for topic, _ in batches], metadata)
        writer.write_columns([_rows(*batch) for batch in batches])
        return writer.finish().read_bytes()


def _rows(topic: Topic, spans: Sequence[Mark | ReviewedSpan]) -> TopicBatch:
    starts = np.array([span.start for span in spans])
    ends = np.array([span.end for span in spans])
    fields: dict[str, Column] = {
        "header.stamp": starts,
        "header.frame_id": spans[0].microphone,
        "duration": ends - starts,
    }
    if topic.type == message_types.SEGMENT:
        fields["confidence"] = np.ones(len(spans), np.float32)
    else:
        for name in ("reviewer", "corrects"):
            fields[name] = [getattr(span, name) for span in spans]
        fields["made"] = np.array([span.made for span in spans])
    for own in _OWN_TEXTS[topic.type]:
        fields[own] = [getattr(span, own) for span in spans]
    return TopicBatch(topic.name, ends, fields)
