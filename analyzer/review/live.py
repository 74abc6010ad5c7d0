"""Live view of growing logs: updates of the timeline, and the current sound of each microphone."""

import math
import re
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from datetime import tzinfo
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.logs.hidden_classes import read_hidden_classes, recorded_hidden_classes
from hearthlog.analyzer.logs.layers import latest_records
from hearthlog.analyzer.logs.local_time import local_time
from hearthlog.analyzer.logs.selection import checked_array_names, decode_types
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
    decibel,
    read_rows,
    scenario_kind,
    scenario_sounds,
    state_lane,
    sure_state,
    unsure_state,
)
from hearthlog.analyzer.review.timeline import LabelledSpans, LogLines, Plot, PlotKind
from hearthlog.models.classes import UNKNOWN, class_name, in_words, ordered
from hearthlog.schemas.arrays import Float32, Float64, Int64
from hearthlog.schemas.errors import LogError, printable, shortened
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS
from hearthlog.schemas.logs.columns import Columns
from hearthlog.schemas.logs.files import find_logs, is_layer, time_span
from hearthlog.schemas.mcap.raw_messages import RawMessages
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import LIVE, is_scenario, parse_topic

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


AWAY_SECONDS = 15.0  # without labels, after which nobody listens
_FIELDS = {
    message_types.LABEL: ("header.stamp", "label", "confidence"),
    message_types.FEATURES: ("header.stamp", "values"),
}
_SECOND = 20  # frames that decide the class
_MOST_MICROPHONES = 64
_ENERGY = "energy"
_HIDDEN = "A sound"  # in place of a class that no output shows
_LONGEST_NAME = 40
_NOT_PLAIN = re.compile(r"[^\w\s.,'()%-]")  # markup in names of foreign logs


class CurrentSound:
    """Current sound of a microphone: the most probable class of the last second.

    `label` and its mean `confidence` are empty before the first label; `since` is the start of the
    sound, `time` the end of the newest label, in nanoseconds of UTC. `is_older` if the sound may
    have begun before: it was there in the first label. `level_dbfs` is the mean level of the last
    second; NaN if unknown.
    """

    def __init__(self, microphone: str) -> None:
        self.microphone = microphone
        self.label, self.confidence = "", 0.0
        self.since = self.time = 0
        self.is_older = True
        self.level_dbfs = math.nan
        self.seen = -math.inf  # of the newest label, by CLOCK_MONOTONIC
        self._times: Int64 = np.empty(0, np.int64)
        self._labels: NDArray[np.object_] = np.empty(0, object)
        self._confidences: Float32 = np.empty(0, np.float32)

    def is_listening(self) -> bool:
        """Whether labels have arrived in the last fifteen seconds."""
        return time.monotonic() - self.seen <= AWAY_SECONDS

    def push(self, times: Int64, labels: NDArray[np.object_], confidences: Float32) -> None:
        """Add labels, at least one; a pause, or a clock that was set back, begins a new sound."""
        times = np.concatenate([self._times, times])
        labels = np.concatenate([self._labels, labels])
        confidences = np.concatenate([self._confidences, confidences])
        new = len(self._times)
        steps = np.diff(times)
        breaks = np.flatnonzero((steps > NANOSECONDS) | (steps <= 0)) + 1
        if len(breaks):
            first = int(breaks[-1])
            self.label, self.is_older = "", False
            times, labels, confidences = times[first:], labels[first:], confidences[first:]
            new = max(new - first, 0)
        names, codes = np.unique(labels.astype(str), return_inverse=True)
        weights = np.zeros((len(times) + 1, len(names)))
        weights[np.arange(1, len(times) + 1), codes] = np.nan_to_num(confidences) + 1e-6
        sums = np.cumsum(weights, axis=0)
        starts = np.maximum(np.arange(1, len(times) + 1) - _SECOND, 0)
        best = (sums[1:] - sums[starts]).argmax(axis=1)
        if not self.label or names[best[-1]] != self.label or (best[new:] != best[-1]).any():
            changes = np.flatnonzero(best[:-1] != best[1:]) + 1
            run = int(changes[-1]) if len(changes) else 0
            window = slice(int(starts[run]), run + 1)
            self.is_older = self.is_older and not len(changes) and not self.label
            self.since = int(times[window][codes[window] == best[-1]][0])
            self.label = str(names[best[-1]])
        own = codes[starts[-1] :] == best[-1]
        self.confidence = float(confidences[starts[-1] :][own].mean())
        self.time = int(times[-1]) + FRAME_NANOSECONDS
        last = slice(1 - _SECOND, None)
        self._times, self._labels, self._confidences = times[last], labels[last], confidences[last]


class CurrentSounds:
    """Current sounds of the microphones of a folder of logs, within bounded memory.

    `lose` is called with a problem of the list of hidden classes.
    """

    def __init__(self, folder: Path, lose: Callable[[object], None]) -> None:
        self.microphones: dict[str, CurrentSound] = {}
        self.is_live = False  # whether all earlier messages have been read
        self._folder, self._lose = folder, lose
        self._log: Path | None = None
        self._recorded: frozenset[str] = frozenset()
        self._listed: frozenset[str] = frozenset()

    def push(self, path: Path, batch: Sequence[RawMessages]) -> None:
        """Add new messages of a log.

        Raise `LogError` if the messages are not of the types of their channels.
        """
        if not batch or is_layer(path):
            return
        if path != self._log:
            self._log = path
            self._recorded = recorded_hidden_classes(next(latest_records([path]), {}))
        for columns in decode_types(path, batch, _FIELDS):
            topic = parse_topic(columns.topic)
            if topic is None or topic.labelling != LIVE or not len(columns):
                continue
            if topic.microphone in self.microphones or len(self.microphones) < _MOST_MICROPHONES:
                own = self.microphones.setdefault(topic.microphone, CurrentSound(topic.microphone))
                self._add(path, columns, own)

    @property
    def hidden(self) -> frozenset[str]:
        """Classes that no output shows."""
        return self._recorded | self._listed

    def hide(self) -> None:
        """Read which classes no output shows; a damaged list hides what it hid before."""
        try:
            self._listed = read_hidden_classes(self._folder)
        except (LogError, OSError) as error:
            self._lose(error)

    def words(self, sound: CurrentSound) -> str:
        """Return the displayed name of the class."""
        is_hidden = class_name(sound.label) in self.hidden
        return _HIDDEN if is_hidden else plain(in_words(sound.label))

    def _add(self, path: Path, columns: Columns, sound: CurrentSound) -> None:
        if columns.type == message_types.FEATURES:
            with suppress(LogError):  # the timeline reports it
                names = checked_array_names(path, columns, "values")
                if _ENERGY in names:
                    energy = columns["values"][-_SECOND:, names.index(_ENERGY)]
                    sound.level_dbfs = float(decibel(np.nan_to_num(energy).mean()))
            return
        age = 0.0 if self.is_live else (time.time_ns() - int(columns.log_times[-1])) / NANOSECONDS
        sound.seen = max(sound.seen, time.monotonic() - max(age, 0.0))
        sound.push(columns["header.stamp"], columns["label"], columns["confidence"])


def plain(name: str) -> str:
    """Return a name of a log without markup."""
    return shortened(_NOT_PLAIN.sub("", printable(name)), _LONGEST_NAME)


def microphone_words(name: str) -> str:
    """Return the displayed name of a microphone: `Living room`."""
    return plain(name.replace("_", " ").capitalize())


def lasting(sound: CurrentSound) -> str:
    """Return how long the sound has lasted: `for 2 s`, `for over 5 min`."""
    seconds = max(round((sound.time - sound.since) / NANOSECONDS), 1)
    amount, unit = (seconds, "s") if seconds < 60 else (seconds // 60, "min")
    text = f"{amount} {unit}" if seconds < 3600 else f"{amount // 60} h {amount % 60} min"
    return f"for {'over ' * sound.is_older}{text}"


def silent_since(sound: CurrentSound, zone: tzinfo) -> str:
    """Return since when nobody listens; the date, too, if it is another day."""
    moment, now = local_time(sound.time, zone), local_time(time.time_ns(), zone)
    day = "" if moment.date() == now.date() else f"{moment:%Y-%m-%d} "
    return f"Nobody listens since {day}{moment:%H:%M}"
