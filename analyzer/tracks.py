"""Logs as arrays: what was heard and recognised, by topic and in the order of time."""

import json
from array import array
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas import messages
from schemas.errors import LogError
from schemas.messages import nanoseconds
from schemas.reader import LogMessage, LogReader

Int64 = NDArray[np.int64]
Float32 = NDArray[np.float32]

_VALUES = {messages.FEATURES: "values", messages.LABEL: "probabilities"}
_SPAN_TEXTS = {messages.SEGMENT: "label", messages.GAP: "reason"}


@dataclass(frozen=True)
class Rows:
    """The values of all frames of a topic.

    Attributes
    ----------
    names : tuple of str
        Of the columns.
    times : np.ndarray [shape=(n,)], int64
        Starts of the frames in nanoseconds of UTC, ascending.
    frames : np.ndarray [shape=(n,)], uint64
        Their numbers; one that does not follow the one before comes after a gap.
    values : np.ndarray [shape=(n, k)], float32
        NaN where a log did not know the name.
    labels : np.ndarray [shape=(n,)], int64
        Column whose name is the frame's label; -1 for features, which have none.
    """

    names: tuple[str, ...]
    times: Int64
    frames: NDArray[np.uint64]
    values: Float32
    labels: Int64

    @property
    def ends(self) -> Int64:
        """Ends of the frames in nanoseconds of UTC, shape (n,)."""
        length = np.median(np.diff(self.times)) if len(self.times) > 1 else 0
        return self.times + np.int64(length)

    @property
    def breaks(self) -> NDArray[np.intp]:
        """Indices of the frames that do not follow the one before, the first left out."""
        return np.flatnonzero(np.diff(self.frames) != 1) + 1


@dataclass
class Spans:
    """Segments or gaps of a topic: starts and ends in nanoseconds of UTC, label or reason."""

    starts: list[int] = field(default_factory=list)
    ends: list[int] = field(default_factory=list)
    texts: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Tracks:
    """What some logs hold, by type (as in `schemas.messages`) and topic; nothing is empty."""

    rows: dict[str, dict[str, Rows]]
    spans: dict[str, dict[str, Spans]]

    @property
    def range(self) -> tuple[int, int]:
        """Start of the first and end of the last of everything, in nanoseconds of UTC."""
        rows = [rows for topics in self.rows.values() for rows in topics.values()]
        spans = [spans for topics in self.spans.values() for spans in topics.values()]
        starts = [int(r.times[0]) for r in rows] + [min(s.starts) for s in spans]
        ends = [int(r.ends[-1]) for r in rows] + [max(s.ends) for s in spans]
        return min(starts, default=0), max(ends, default=0)


def read_tracks(logs: Iterable[Path]) -> Tracks:
    """Read features, labels, segments and gaps.

    Raises
    ------
    LogError
        If one of the files is no log, is damaged, or does not name its values.
    """
    blocks: dict[str, dict[str, list[_Block]]] = {kind: {} for kind in _VALUES}
    spans: dict[str, dict[str, Spans]] = {kind: {} for kind in _SPAN_TEXTS}
    for path in logs:
        log = LogReader(path)
        open_blocks: dict[str, _Block] = {}
        for item in log.messages():
            if item.type in _SPAN_TEXTS:
                _add_span(spans[item.type].setdefault(item.topic, Spans()), item)
            elif item.type in _VALUES:
                block = open_blocks.get(item.topic)
                if block is None:
                    block = open_blocks[item.topic] = _Block(log, item)
                    blocks[item.type].setdefault(item.topic, []).append(block)
                block.add(item)
    rows = {
        kind: {topic: _joined(found) for topic, found in topics.items()}
        for kind, topics in blocks.items()
    }
    return Tracks(rows, spans)


def _add_span(spans: Spans, item: LogMessage) -> None:
    content = item.decode()
    start = nanoseconds(content.header.stamp)
    spans.starts.append(start)
    spans.ends.append(start + nanoseconds(content.duration))
    spans.texts.append(getattr(content, _SPAN_TEXTS[item.type]))


class _Block:
    """Rows of one topic in one log, in machine arrays: a day has 1.7 million of them."""

    def __init__(self, log: LogReader, first: LogMessage) -> None:
        self._where = f"{log.path}: {first.topic}"
        self._field = _VALUES[first.type]
        text = log.channels[first.topic].metadata.get(f"{self._field}_names", "")
        self.names = _names(text, self._where)
        self._index = {name: i for i, name in enumerate(self.names)}
        self._times, self._frames, self._labels = array("q"), array("Q"), array("q")
        self._values = array("f")

    def add(self, item: LogMessage) -> None:
        content = item.decode()
        values = getattr(content, self._field)
        if len(values) != len(self.names):
            raise LogError(f"{self._where}: {len(values)} values for {len(self.names)} names")
        label = self._index.get(content.label) if item.type == messages.LABEL else -1
        if label is None:
            raise LogError(f"{self._where}: label {content.label!r} is none of its classes")
        self._times.append(nanoseconds(content.header.stamp))
        self._frames.append(content.frame)
        self._labels.append(label)
        self._values.frombytes(np.asarray(values, np.float32).tobytes())

    def rows(self) -> Rows:
        """Return what was added."""
        return Rows(
            self.names,
            np.frombuffer(self._times, np.int64),
            np.frombuffer(self._frames, np.uint64),
            np.frombuffer(self._values, np.float32).reshape(-1, len(self.names)),
            np.frombuffer(self._labels, np.int64),
        )


def _names(text: str, where: str) -> tuple[str, ...]:
    try:
        names: Any = json.loads(text)
    except ValueError:
        names = None
    if not isinstance(names, list) or not names or not all(isinstance(n, str) for n in names):
        raise LogError(f"{where}: the channel does not name its values")
    return tuple(names)


def _joined(blocks: list[_Block]) -> Rows:
    """Join the rows of several logs, whose columns may differ, in the order of time."""
    parts = [block.rows() for block in blocks]
    names = tuple(dict.fromkeys(name for part in parts for name in part.names))
    values = np.full((sum(len(part.times) for part in parts), len(names)), np.nan, np.float32)
    labels = []
    start = 0
    for part in parts:
        place = np.array([names.index(name) for name in part.names])
        values[start : start + len(part.times), place] = part.values
        labels.append(np.where(part.labels < 0, -1, place[part.labels]))
        start += len(part.times)
    times = np.concatenate([part.times for part in parts])
    order = np.argsort(times, kind="stable")
    return Rows(
        names,
        times[order],
        np.concatenate([part.frames for part in parts])[order],
        values[order],
        np.concatenate(labels)[order],
    )
