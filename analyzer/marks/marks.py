"""Marks: the corrections of a reviewer, in a layer beside the log."""

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
from hearthlog.models.classifiers.description import CLASS_NAME
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.columns import Columns
from hearthlog.schemas.logs.files import SUFFIX, review_path, stem
from hearthlog.schemas.logs.log_stream import TopicBatch
from hearthlog.schemas.logs.provenance import provenance
from hearthlog.schemas.logs.writer import LogWriter
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import REVIEW, Topic, check_microphone_name, labelling_topic
from hearthlog.schemas.storage.new_files import locked_folder, replaced_file
from hearthlog.schemas.times import NANOSECONDS

LATEST = (1 << 31) * NANOSECONDS - 1  # what builtin_interfaces/Time can hold
PERSON_NAME = re.compile(r"[^\x00-\x1f\x7f\ud800-\udfff]{0,200}")  # of a reviewer, of a labelling
_KINDS = {message_types.SEGMENT: "segment", message_types.MARK: "mark"}
_SPAN = ("header.stamp", "duration", "label")
_ORIGIN = ("reviewer", "made", "corrects")
_FIELDS = {message_types.SEGMENT: _SPAN, message_types.MARK: (*_SPAN, *_ORIGIN)}


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
    """

    microphone: str
    start: int
    end: int
    label: str
    reviewer: str = ""
    made: int = 0
    corrects: str = ""


class MarkedSpan(NamedTuple):
    """A span of time of a microphone, in nanoseconds of UTC."""

    microphone: str
    start: int
    end: int


def read_marks(log: Path) -> list[Mark]:
    """Read the marks of a log.

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
    path = review_path(log)
    if not path.exists():
        return []
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
    for batch in selection.messages():
        for columns in decode_types(path, batch, _FIELDS):
            if columns.type == message_types.SEGMENT:
                spans += _marks(columns)
            else:
                marks |= {mark[:4]: mark for mark in _marks(columns)}
    try:
        return _checked(marks.get(mark[:4], mark) for mark in spans)
    except (DataError, LogError) as error:
        raise LogError(f"{path}: {error}; move this layer away to begin anew") from error


def write_marks(log: Path, marks: Iterable[Mark], deleted: Iterable[MarkedSpan] = ()) -> Path:
    """Add marks to the review layer of a log; where they overlap older marks, they replace these.

    The layer is replaced in one step. Processes that write to the same folder wait for each other.

    Parameters
    ----------
    log : Path
    marks : iterable of Mark
    deleted : iterable of MarkedSpan
        Where older marks are deleted, or cut off; before the new marks are added.

    Returns
    -------
    Path
        The layer; without marks there is no such file.

    Raises
    ------
    DataError
        If the new marks overlap each other, or are invalid.
    LogError
        If there is no such log, if its layer cannot be read or is damaged, if the name of a
        microphone is invalid, or if the layer cannot be written.
    """
    new = _checked(marks)
    path = review_path(log)
    with _locked(path):
        layer = read_marks(log)
        for span in deleted:
            layer = list(_subtract(layer, [span]))
        layer = _checked([*_subtract(layer, new), *new])
        if not layer:
            path.unlink(missing_ok=True)
            return path
        node = next((record.get("node", "") for record in select([log]).metadata), "")
        metadata = provenance(node, log=stem(log) + SUFFIX)
        with replaced_file(path) as temporary:
            temporary.write_bytes(_layer_bytes(path.name, layer, metadata))
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
    origin = [columns[name].tolist() for name in _ORIGIN if columns.type == message_types.MARK]
    for row in zip(starts.tolist(), ends.tolist(), columns["label"].tolist(), *origin, strict=True):
        yield Mark(microphone, *row)


def _checked(marks: Iterable[Mark]) -> list[Mark]:
    """Sort marks; raise DataError if one is invalid."""
    ordered = sorted(marks)
    for mark in ordered:
        if not 0 <= mark.start < mark.end <= LATEST:
            raise DataError(f"a mark from {mark.start} to {mark.end} ns is no span of time")
        if not CLASS_NAME.fullmatch(mark.label):
            raise DataError(f"{mark.label[:64]!r} cannot be the name of a class")
        names = PERSON_NAME.fullmatch(mark.reviewer) and PERSON_NAME.fullmatch(mark.corrects)
        if not (0 <= mark.made <= LATEST and names):
            raise DataError(f"a mark cannot be made by {mark.reviewer[:64]!r} at {mark.made} ns")
    for microphone in {mark.microphone for mark in ordered}:
        check_microphone_name(microphone)
    for one, other in pairwise(ordered):
        if one.microphone == other.microphone and other.start < one.end:
            raise DataError(f"{one.label} and {other.label} overlap at {other.start} ns")
    return ordered


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


def _layer_bytes(name: str, marks: Sequence[Mark], metadata: dict[str, str]) -> bytes:
    """Write the file in another folder, where nobody takes it for a log being recorded."""
    microphones = sorted({mark.microphone for mark in marks})
    topics = [
        Topic(labelling_topic(microphone, REVIEW, kind), type_)
        for type_, kind in _KINDS.items()
        for microphone in microphones
    ]
    with tempfile.TemporaryDirectory(prefix="hearthlog") as folder:
        writer = LogWriter(Path(folder) / name, topics, metadata)
        writer.write_columns([_rows(t.name, t.type, marks) for t in topics])
        return writer.finish().read_bytes()


def _rows(name: str, kind: str, marks: Sequence[Mark]) -> TopicBatch:
    microphone = name.split("/")[1]
    own = [mark for mark in marks if mark.microphone == microphone]
    starts = np.array([mark.start for mark in own])
    ends = np.array([mark.end for mark in own])
    fields = {
        "header.stamp": starts,
        "header.frame_id": microphone,
        "duration": ends - starts,
        "label": [mark.label for mark in own],
    }
    if kind == message_types.SEGMENT:
        return TopicBatch(name, ends, fields | {"confidence": np.ones(len(own), np.float32)})
    origin = {
        "reviewer": [mark.reviewer for mark in own],
        "made": np.array([mark.made for mark in own]),
        "corrects": [mark.corrects for mark in own],
    }
    return TopicBatch(name, ends, fields | origin)
