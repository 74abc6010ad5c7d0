"""Timeline updates from growing logs, second by second, within bounded memory."""

from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from hearthlog.analyzer.logs.selection import decode_types
from hearthlog.analyzer.logs.spans import rows_at
from hearthlog.analyzer.review.lanes import (
    DIRECTION,
    FEATURES,
    FIELDS,
    FLOOR,
    GAP_STATE,
    GAPS,
    LEVEL,
    PROBABILITIES,
    RECORDER,
    TROUBLE,
    TROUBLES,
    LaneRows,
    Rows,
    StateLane,
    StateRows,
    read_rows,
    scenario_kind,
    scenario_sounds,
    state_lane,
    sure_state,
    unsure_state,
)
from hearthlog.analyzer.review.timeline import LabelledSpans, LogLines, Plot, PlotKind
from hearthlog.models.classes import UNKNOWN, class_name, ordered
from hearthlog.schemas.arrays import Float64, Int64
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS
from hearthlog.schemas.logs.files import find_logs, is_layer, time_span
from hearthlog.schemas.mcap.raw_messages import RawMessages
from hearthlog.schemas.messages.topics import is_scenario

_MEMORY = 600  # seconds covered by the scale of a feature
_SPREAD = 2.0  # standard deviations from the middle of a scale to its ends
_MOST_OPEN = 100_000  # maximum seconds of a segment shown before it closes
_TINY = np.finfo(np.float64).tiny

Update = Plot | StateLane | LogLines


def last_time(folder: Path) -> int | None:
    """Return the last log time (nanoseconds of UTC) of the most recently written log in a folder.

    None if no log has a message yet. Raise `LogError` if the folder does not exist.
    """
    if not folder.is_dir():
        raise LogError(f"{folder}: no such folder; name the one that `hearthlog record` writes to")
    logs: list[tuple[int, Path]] = []
    with suppress(LogError):  # none yet
        for path in find_logs(folder):
            with suppress(FileNotFoundError):  # it was renamed at this moment
                logs.append((path.stat().st_mtime_ns, path))
    for _, path in sorted(logs, reverse=True):
        if is_layer(path):
            continue
        try:
            span = time_span(path)
        except LogError:
            continue
        if span is not None:
            return span[1]
    return None


class LiveTimeline:
    """Converts messages into updates of lanes and plots; `hidden` classes become `unknown`."""

    def __init__(self) -> None:
        self.hidden: Collection[str] = frozenset()
        self._ends: dict[tuple[PlotKind, str, tuple[str, ...]], int] = {}  # of the last frame
        self._scales: dict[tuple[str, ...], _Scale] = {}
        self._open: dict[str, Int64] = {}  # seconds without a segment yet, by microphone

    def take(self, path: Path, batch: Sequence[RawMessages]) -> Iterator[Update]:
        """Yield the updates from new messages of a log.

        Raise `LogError` if the messages are not of the types of their channels, or a channel
        does not name its values.
        """
        for columns in decode_types(path, batch, FIELDS):
            for rows in read_rows(path, columns):
                yield from map(self._shown, self._update(rows))

    def _update(self, rows: Rows) -> Iterator[Update]:
        match rows:
            case LogLines():
                yield rows
            case StateRows():
                yield from _health(rows)
            case Plot() if rows.kind is DIRECTION:
                yield rows._replace(values=rows.kind.of_means(rows.values))
            case Plot(labelling="" | "live"):
                yield from self._add_seconds(rows)
            case LaneRows() if rows.kind is GAPS:
                yield _gaps(rows)
            case LaneRows(labelling="live"):
                texts = [
                    unsure_state(text) if unsure else text
                    for text, unsure in zip(rows.spans.texts, rows.unsure, strict=True)
                ]
                spans = LabelledSpans(*rows.spans[:2], np.array(texts, object))
                yield from self._segments(rows.microphone, spans)
            case LaneRows() if is_scenario(rows.labelling):
                kind = scenario_kind(rows.labelling)
                yield state_lane(kind, rows.microphone, scenario_sounds(rows.spans))

    def _shown(self, update: Update) -> Update:
        """Return an update without hidden classes."""
        if isinstance(update, StateLane):
            states = [UNKNOWN if self._is_hidden(state) else state for state in update.states]
            return update._replace(states=states)
        if isinstance(update, Plot) and update.kind is PROBABILITIES:
            rows = [row for row, name in enumerate(update.names) if not self._is_hidden(name)]
            names = tuple(update.names[row] for row in rows)
            return update._replace(names=names, values=update.values[:, rows])
        return update

    def _is_hidden(self, name: str | None) -> bool:
        return name is not None and class_name(sure_state(name)) in self.hidden

    def _add_seconds(self, rows: Plot) -> Iterator[Plot | StateLane]:
        starts, times, means = self._by_second(rows)
        present = ~np.isnan(means[:, 0])
        if rows.kind is FEATURES:
            scale = self._scales.setdefault((rows.microphone, *rows.names), _Scale())
            yield rows._replace(times=times[present], values=scale(means[present]))
            return
        if rows.kind is PROBABILITIES:
            names = ordered(rows.names)
            means = means[:, [rows.names.index(name) for name in names]]
            rows = rows._replace(names=tuple(names))
        values = rows.kind.of_means(means)
        yield rows._replace(times=times, values=values.round(1) if rows.kind is LEVEL else values)
        if rows.kind is PROBABILITIES:
            best = np.where(present, np.nan_to_num(means).argmax(axis=1), len(rows.names))
            states = np.array([*rows.names, None], object)[best]
            yield StateLane(RECORDER, rows.microphone, starts, states.tolist())
            seconds = np.append(self._open_seconds(rows.microphone), starts[present])
            self._open[rows.microphone] = seconds[-_MOST_OPEN:]

    def _segments(self, microphone: str, spans: LabelledSpans) -> Iterator[StateLane]:
        """Replace the labels of the seconds in closed segments with the segments' labels."""
        seconds = self._open_seconds(microphone)
        times = np.unique(np.append(seconds, spans.starts))
        rows = rows_at(spans, times)
        closed = rows >= 0
        states = spans.texts[rows[closed]].tolist()
        yield StateLane(RECORDER, microphone, times[closed], states)
        self._open[microphone] = seconds[seconds >= spans.ends[-1]]

    def _open_seconds(self, microphone: str) -> Int64:
        return self._open.get(microphone, np.empty(0, np.int64))

    def _by_second(self, rows: Plot) -> tuple[Int64, Int64, Float64]:
        """Average frames over each second; NaN where frames are missing.

        Return starts and middles [shape=(m,)] and means [shape=(m, k)].
        """
        key, times = (rows.kind, rows.microphone, rows.names), rows.times
        before = np.append(self._ends.get(key, times[0]), times[:-1] + FRAME_NANOSECONDS)
        self._ends[key] = int(times[-1]) + FRAME_NANOSECONDS
        missing = np.abs(times - before) > FRAME_NANOSECONDS // 2
        first = np.flatnonzero(missing | (np.diff(times // NANOSECONDS, prepend=-1) != 0))
        last = np.append(first[1:], len(times)) - 1
        finite = np.nan_to_num(rows.values, posinf=0.0, neginf=0.0)
        sums = np.add.reduceat(finite, first, axis=0, dtype=np.float64)
        means = sums / (last - first + 1)[:, np.newaxis]
        starts = times[first]
        middles = starts + (times[last] - starts + FRAME_NANOSECONDS) // 2
        holes = np.flatnonzero(missing[first])
        since = before[first[holes]]
        return (
            np.insert(starts, holes, since),
            np.insert(middles, holes, since),
            np.insert(means, holes, np.nan, axis=0),
        )


class _Scale:
    """Position of values among those of the last minutes: 0 low, 1 high."""

    def __init__(self) -> None:
        self._count = 0
        self._mean: Float64 | float = 0.0
        self._square: Float64 | float = 0.0

    def __call__(self, values: Float64) -> Float64:
        if len(values):
            self._count = min(self._count + len(values), max(_MEMORY, len(values)))
            share = len(values) / self._count
            self._mean += share * (values.mean(axis=0) - self._mean)
            self._square += share * ((values**2).mean(axis=0) - self._square)
        deviation = np.sqrt(np.maximum(self._square - self._mean**2, 0.0))
        scaled = (values - self._mean) / np.maximum(2 * _SPREAD * deviation, _TINY)
        return np.clip(scaled + 0.5, 0.0, 1.0)


def _gaps(rows: LaneRows) -> StateLane:
    spans = rows.spans
    later = spans.ends > spans.starts  # where the clock was set back nothing is missing
    texts = np.full(later.sum(), GAP_STATE, object)
    spans = LabelledSpans(spans.starts[later], spans.ends[later], texts)
    return state_lane(GAPS, rows.microphone, spans)


def _health(rows: StateRows) -> Iterator[StateLane | Plot]:
    times = np.array([state.time for state in rows.states])
    levels = (min(state.level, len(TROUBLES)) for state in rows.states)
    texts = [TROUBLES[level - 1] if level else None for level in levels]
    yield StateLane(TROUBLE, rows.microphone, times, texts)
    floors = np.array([[state.floor_dbfs] for state in rows.states])
    if not np.isnan(floors).all():
        yield Plot(FLOOR, rows.microphone, "", ("floor",), times, floors)
