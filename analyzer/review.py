"""Marks: what a reviewer says that was heard, in a layer beside the log it speaks about."""

import re
import tempfile
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator, Sequence
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from analyzer.errors import DataError
from analyzer.known import decode_known, is_of_type
from analyzer.selection import select
from models.modelfile import CLASS_NAME
from schemas import messages
from schemas.columns import Columns
from schemas.errors import LogError
from schemas.files import SUFFIX, replaced_file, stem
from schemas.topics import Topic, check_microphone_name, topic
from schemas.writer import LogWriter, Rows

ROUNDING = 1_000  # ns; times that passed through a label file are off by up to this
_KIND = "review/segment"
_TOPIC = re.compile(rf"/[^/]+/{_KIND}")
_FIELDS = {messages.SEGMENT: ("header.stamp", "duration", "label")}


class Mark(NamedTuple):
    """What was heard from `start` on, before `end`, in nanoseconds of UTC."""

    microphone: str
    start: int
    end: int
    label: str


def review_path(log: Path) -> Path:
    """Name the review layer of a log, finished or not."""
    return log.with_name(f"{stem(log)}.review{SUFFIX}")


def read_marks(log: Path) -> list[Mark]:
    """Read the marks of a log, those of each microphone in the order of time.

    Returns
    -------
    list of Mark
        Those of a microphone do not overlap. Empty if nobody has reviewed the log.

    Raises
    ------
    LogError
        If the layer is damaged, or its marks cannot be.
    """
    path = review_path(log)
    if not path.exists():
        return []
    selection = select([path])
    if selection.unfinished:
        raise LogError(f"{path}: is cut off; `hearthlog recover` saves what is there of it")
    for name, same in selection.channels.items():
        if not _TOPIC.fullmatch(name) or not all(is_of_type(*d, messages.SEGMENT) for d in same):
            raise LogError(f"{path}: is no review layer: it has a topic {name!r}; move it away")
    selection.verify()
    marks: list[Mark] = []
    for batch in selection.messages():
        for columns in decode_known(path, batch, _FIELDS):
            marks += _marks(columns)
    try:
        return _checked(marks)
    except (DataError, LogError) as error:
        raise LogError(f"{path}: {error}; move this layer away to begin anew") from error


def write_marks(log: Path, marks: Iterable[Mark]) -> Path:
    """Add marks to the review layer of a log; where they overlap older marks, they win.

    The layer is replaced in one step: whatever happens, the old or the new one is there.

    Returns
    -------
    Path
        The layer.

    Raises
    ------
    DataError
        If the new marks overlap each other, or cannot be.
    LogError
        If there is no such log, if its layer is damaged, or if it cannot be written.
    """
    new = _checked(marks)
    old = read_marks(log)
    about = {
        "version": version("hearthlog"),
        "node": next((found.get("node", "") for found in select([log]).metadata), ""),
        "log": stem(log) + SUFFIX,
    }
    path = review_path(log)
    with replaced_file(path) as temporary:
        temporary.write_bytes(_layer(path.name, _checked([*_left(old, new), *new]), about))
    return path


def _marks(columns: Columns) -> Iterator[Mark]:
    microphone = columns.topic.split("/")[1]
    starts = columns["header.stamp"]
    ends = starts + columns["duration"]
    for row in zip(starts.tolist(), ends.tolist(), columns["label"].tolist(), strict=True):
        yield Mark(microphone, *row)


def _checked(marks: Iterable[Mark]) -> list[Mark]:
    """Sort marks, and raise DataError if one cannot be."""
    ordered = sorted(marks)
    for mark in ordered:
        if not 0 <= mark.start < mark.end:
            raise DataError(f"a mark from {mark.start} to {mark.end} ns is no span of time")
        if not CLASS_NAME.fullmatch(mark.label):
            raise DataError(f"{mark.label[:64]!r} cannot be the name of a class")
    for microphone in {mark.microphone for mark in ordered}:
        check_microphone_name(microphone)
    for one, other in pairwise(ordered):
        if one.microphone == other.microphone and other.start < one.end:
            raise DataError(f"{one.label} and {other.label} overlap at {other.start} ns")
    return ordered


def _left(old: Sequence[Mark], new: Sequence[Mark]) -> Iterator[Mark]:
    """Yield what the new marks leave of the old ones."""
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


def _layer(name: str, marks: Sequence[Mark], about: dict[str, str]) -> bytes:
    """Make the file; elsewhere, for there it must not be taken for a log being written."""
    microphones = sorted({mark.microphone for mark in marks})
    topics = [Topic(topic(microphone, _KIND), messages.SEGMENT) for microphone in microphones]
    with tempfile.TemporaryDirectory(prefix="hearthlog") as folder:
        writer = LogWriter(Path(folder) / name, topics, about)
        writer.write_columns([_rows(microphone, marks) for microphone in microphones])
        return writer.finish().read_bytes()


def _rows(microphone: str, marks: Sequence[Mark]) -> Rows:
    own = [mark for mark in marks if mark.microphone == microphone]
    starts = np.array([mark.start for mark in own])
    ends = np.array([mark.end for mark in own])
    fields = {
        "header.stamp": starts,
        "header.frame_id": microphone,
        "duration": ends - starts,
        "label": [mark.label for mark in own],
        "confidence": np.ones(len(own), np.float32),
    }
    return Rows(topic(microphone, _KIND), ends, fields)
