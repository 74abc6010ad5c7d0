"""Logs as arrays: what was heard and recognised, by topic and in the order of time."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analyzer.known import decode_known
from schemas import messages
from schemas.columns import Columns
from schemas.errors import LogError
from schemas.series import iterate_messages

Int64 = NDArray[np.int64]
Float32 = NDArray[np.float32]

_VALUES = {messages.FEATURES: "values", messages.LABEL: "probabilities"}
_TEXTS = {messages.SEGMENT: "label", messages.GAP: "reason"}
_FIELDS = {
    messages.FEATURES: ("header.stamp", "frame", "values"),
    messages.LABEL: ("header.stamp", "frame", "label", "probabilities"),
    messages.SEGMENT: ("header.stamp", "duration", "label"),
    messages.GAP: ("header.stamp", "duration", "reason"),
}


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


@dataclass(frozen=True)
class Spans:
    """Segments or gaps of a topic.

    Attributes
    ----------
    starts, ends : np.ndarray [shape=(n,)], int64
        In nanoseconds of UTC, by start.
    texts : np.ndarray [shape=(n,)] of str
        Label or reason.
    """

    starts: Int64
    ends: Int64
    texts: NDArray[np.object_]


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
        starts = [int(r.times[0]) for r in rows] + [int(s.starts[0]) for s in spans]
        ends = [int(r.ends[-1]) for r in rows] + [int(s.ends.max()) for s in spans]
        return min(starts, default=0), max(ends, default=0)


def read_tracks(logs: Iterable[Path]) -> Tracks:
    """Read features, labels, segments and gaps.

    Raises
    ------
    LogError
        If one of the files is no log, is damaged, or does not name its values.
    """
    rows: dict[str, dict[str, dict[tuple[str, ...], _Growing]]] = {kind: {} for kind in _VALUES}
    spans: dict[str, dict[str, list[Spans]]] = {kind: {} for kind in _TEXTS}
    for path in logs:
        for batch in iterate_messages([path]):
            for columns in decode_known(path, batch, _FIELDS):
                kind, topic = columns.type, columns.topic
                if kind in spans:
                    spans[kind].setdefault(topic, []).append(_spans(columns))
                else:
                    part = _rows(path, columns)
                    parts = rows[kind].setdefault(topic, {})
                    parts.setdefault(part.names, _Growing()).add(part)
    return Tracks(
        {k: {t: _joined(parts) for t, parts in found.items()} for k, found in rows.items()},
        {k: {t: _chained(parts) for t, parts in found.items()} for k, found in spans.items()},
    )


class _Growing:
    """Rows that come piece by piece; memory that grows is moved by the page, not copied."""

    def __init__(self) -> None:
        self._times, self._frames = bytearray(), bytearray()
        self._values, self._labels = bytearray(), bytearray()

    def add(self, part: Rows) -> None:
        """Append rows; they must have the same names."""
        self._times += part.times.data
        self._frames += part.frames.data
        self._values += part.values.data
        self._labels += part.labels.data

    def rows(self, names: tuple[str, ...]) -> Rows:
        """Return all of them."""
        return Rows(
            names,
            np.frombuffer(self._times, np.int64),
            np.frombuffer(self._frames, np.uint64),
            np.frombuffer(self._values, np.float32).reshape(-1, len(names)),
            np.frombuffer(self._labels, np.int64),
        )


def _rows(path: Path, columns: Columns) -> Rows:
    where = f"{path}: {columns.topic}"
    column = _VALUES[columns.type]
    names = _names(columns.metadata.get(f"{column}_names", ""), where)
    values = columns[column]
    if values.shape[1:] != (len(names),):
        raise LogError(f"{where}: some messages do not have a value for each of {len(names)} names")
    labels = np.full(len(columns), -1)
    if columns.type == messages.LABEL:
        places = {name: place for place, name in enumerate(names)}
        try:
            labels = np.fromiter(map(places.__getitem__, columns["label"]), np.int64)
        except KeyError as error:
            raise LogError(f"{where}: label {error} is none of its classes") from error
    return Rows(names, columns["header.stamp"], columns["frame"], values, labels)


def _names(text: str, where: str) -> tuple[str, ...]:
    try:
        names: Any = json.loads(text)
    except ValueError:
        names = None
    if not isinstance(names, list) or not names or not all(isinstance(n, str) for n in names):
        raise LogError(f"{where}: the channel does not name its values")
    return tuple(names)


def _spans(columns: Columns) -> Spans:
    starts = columns["header.stamp"]
    return Spans(starts, starts + columns["duration"], columns[_TEXTS[columns.type]])


def _joined(found: Mapping[tuple[str, ...], _Growing]) -> Rows:
    """Join rows whose columns may differ, in the order of time."""
    parts = [growing.rows(names) for names, growing in found.items()]
    rows = parts[0] if len(parts) == 1 else _of_all_names(parts)
    return Rows(rows.names, *_by_time(rows.times, rows.frames, rows.values, rows.labels))


def _of_all_names(parts: Sequence[Rows]) -> Rows:
    names = tuple(dict.fromkeys(name for part in parts for name in part.names))
    times = np.concatenate([part.times for part in parts])
    frames = np.concatenate([part.frames for part in parts])
    values = np.full((len(times), len(names)), np.nan, np.float32)
    labels = np.full(len(times), -1)
    start = 0
    for part in parts:
        here = slice(start, start + len(part.times))
        place = np.array([names.index(name) for name in part.names])
        values[here, place] = part.values
        labels[here] = np.where(part.labels < 0, -1, place[part.labels])
        start = here.stop
    return Rows(names, times, frames, values, labels)


def _chained(parts: Sequence[Spans]) -> Spans:
    starts = np.concatenate([part.starts for part in parts])
    ends = np.concatenate([part.ends for part in parts])
    return Spans(*_by_time(starts, ends, np.concatenate([part.texts for part in parts])))


def _by_time(times: Int64, *others: NDArray[Any]) -> tuple[NDArray[Any], ...]:
    if (np.diff(times) >= 0).all():
        return times, *others
    order = np.argsort(times, kind="stable")
    return tuple(array[order] for array in (times, *others))
