"""What is new in logs that are being written, second by second; what is kept does not grow."""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from datetime import tzinfo
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.logs.channel_names import checked_array_names
from hearthlog.analyzer.logs.spans import rows_at
from hearthlog.analyzer.logs.typed_columns import decode_types
from hearthlog.analyzer.review.timeline.decode import FIELDS, decibel, shown_topic, spans_of
from hearthlog.analyzer.review.timeline.grid import Grid
from hearthlog.analyzer.review.timeline.lanes import Changes, changes, clock
from hearthlog.analyzer.review.timeline.model import LabelledSpans, LogLines
from hearthlog.schemas.arrays import Float64, Int64
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import FRAME_NANOSECONDS
from hearthlog.schemas.logs.columns import Columns
from hearthlog.schemas.logs.files import find_logs, is_layer
from hearthlog.schemas.mcap.raw_messages import RawMessages
from hearthlog.schemas.mcap.statistics import time_span
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import LIVE
from hearthlog.schemas.times import NANOSECONDS

LIVE_LANE, GAP_LANE, TROUBLE_LANE = "live", "not heard", "trouble"
NOT_HEARD = "not heard"
TROUBLES = ("warning", "error", "stale")  # by the level of a diagnostic status, from 1 on
_MEMORY = 600  # seconds that the scale of a feature follows
_SPREAD = 2.0  # standard deviations from its middle to its ends
_MOST_OPEN = 100_000  # seconds of a segment that may be shown before it closes
_TINY = np.finfo(np.float64).tiny


class Means(NamedTuple):
    """Means of successive seconds, or of what is there of them.

    Attributes
    ----------
    microphone : str
    kind : str
        "shares" (of each class, 0 to 1), "novelty", "level" (in dB), "features" (0 to 1).
    names : tuple of str
        Of the columns.
    times : np.ndarray [shape=(n,)], int64
        Their middles.
    values : np.ndarray [shape=(n, k)], float64
        A row of NaN where frames are missing.
    """

    microphone: str
    kind: str
    names: tuple[str, ...]
    times: Int64
    values: Float64


class Lane(NamedTuple):
    """What a lane of a microphone shows from when on; the clock is of no microphone."""

    microphone: str
    name: str
    changes: Changes


News = Means | Lane | LogLines


def last_time(folder: Path) -> int | None:
    """Return the last log time of the log in a folder that was written to last; None without one.

    Raises
    ------
    LogError
        If there is no such folder.
    """
    if not folder.is_dir():
        raise LogError(f"{folder}: no such folder; name the one that `hearthlog record` writes to")
    logs: list[tuple[int, Path]] = []
    with suppress(LogError):  # none yet
        for path in find_logs(folder):
            with suppress(FileNotFoundError):  # it got its final name at this moment
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


class Live:
    """Turns messages into what is new on a timeline.

    Parameters
    ----------
    zone : tzinfo
        Of the home.
    """

    def __init__(self, zone: tzinfo) -> None:
        self._zone = zone
        self._newest: int | None = None
        self._ends: dict[tuple[str, ...], int] = {}  # of the last frame, by what was named
        self._scales: dict[tuple[str, ...], _Scale] = {}
        self._open: dict[str, Int64] = {}  # seconds that no segment has settled, by microphone

    def take(self, path: Path, batch: Sequence[RawMessages]) -> Iterator[News]:
        """Take what was written to a log since the last time.

        Raises
        ------
        LogError
            If its messages are not what they say.
        """
        for columns in decode_types(path, batch, FIELDS):
            if len(columns):
                yield from self._take(path, columns)

    def _take(self, path: Path, columns: Columns) -> Iterator[News]:
        if columns.type == message_types.LOG:
            yield LogLines(columns["stamp"], columns["level"], columns["msg"])
        elif columns.type == message_types.DIAGNOSTICS:
            yield from _health(columns)
        elif (topic := shown_topic(columns.topic)) and topic.labelling == LIVE:
            microphone = topic.microphone
            if columns.type == message_types.FEATURES:
                yield from self._clock(columns["header.stamp"])
                yield from self._features(path, microphone, columns)
            elif columns.type == message_types.LABEL:
                yield from self._labels(path, microphone, columns)
            elif columns.type == message_types.SEGMENT:
                yield from self._segments(microphone, spans_of(columns, "label"))
            elif columns.type == message_types.GAP:
                yield from _gaps(microphone, spans_of(columns, "reason"))

    def _clock(self, times: Int64) -> Iterator[Lane]:
        first = int(times[0]) if self._newest is None else self._newest
        newest = int(times[-1])
        if newest > first:
            hours = clock(Grid(first, newest, 1), self._zone)
            yield Lane("", str(self._zone), Changes(hours.starts, list(hours.texts)))
        self._newest = max(first, newest)

    def _features(self, path: Path, microphone: str, columns: Columns) -> Iterator[Means]:
        names = checked_array_names(path, columns, "values")
        _, times, values = self._by_second(
            (microphone, "features", *names), columns["header.stamp"], columns["values"]
        )
        if "energy" in names:
            level = decibel(values[:, [names.index("energy")]])
            yield Means(microphone, "level", ("level",), times, level)
        heard = ~np.isnan(values[:, 0])
        scale = self._scales.setdefault((microphone, *names), _Scale())
        yield Means(microphone, "features", names, times[heard], scale(values[heard]))

    def _labels(self, path: Path, microphone: str, columns: Columns) -> Iterator[News]:
        names = checked_array_names(path, columns, "probabilities")
        values = np.column_stack([columns["probabilities"], columns["novelty"]])
        starts, times, means = self._by_second(
            (microphone, "label", *names), columns["header.stamp"], values
        )
        shares, novelty = means[:, :-1], means[:, -1:]
        yield Means(microphone, "shares", names, times, shares)
        if np.isfinite(columns["novelty"]).any():
            yield Means(microphone, "novelty", ("novelty",), times, novelty)
        heard = ~np.isnan(shares[:, 0])
        best = np.where(heard, np.nan_to_num(shares).argmax(axis=1), len(names))
        states = np.array([*names, None], object)[best]
        yield Lane(microphone, LIVE_LANE, Changes(starts, states.tolist()))
        known = self._open.get(microphone, np.empty(0, np.int64))
        self._open[microphone] = np.append(known, starts[heard])[-_MOST_OPEN:]

    def _segments(self, microphone: str, spans: LabelledSpans) -> Iterator[Lane]:
        """Say again what was heard in the seconds that segments settle: now it is smoothed."""
        seconds = self._open.get(microphone, np.empty(0, np.int64))
        times = np.unique(np.append(seconds, spans.starts))
        rows = rows_at(spans, times)
        settled = rows >= 0
        texts = spans.texts[rows[settled]]
        yield Lane(microphone, LIVE_LANE, Changes(times[settled], texts.tolist()))
        self._open[microphone] = seconds[seconds >= spans.ends[-1]]

    def _by_second(
        self, key: tuple[str, ...], times: Int64, values: NDArray[np.floating]
    ) -> tuple[Int64, Int64, Float64]:
        """Average frames over each second, and put a row of NaN where frames are missing.

        Returns
        -------
        starts, middles : np.ndarray [shape=(m,)], int64
        means : np.ndarray [shape=(m, k)], float64
        """
        before = np.append(self._ends.get(key, times[0]), times[:-1] + FRAME_NANOSECONDS)
        self._ends[key] = int(times[-1]) + FRAME_NANOSECONDS
        missing = np.abs(times - before) > FRAME_NANOSECONDS // 2
        first = np.flatnonzero(missing | (np.diff(times // NANOSECONDS, prepend=-1) != 0))
        last = np.append(first[1:], len(times)) - 1
        finite = np.nan_to_num(values, posinf=0.0, neginf=0.0)
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
    """Where values lie among those of the last minutes: 0 low, 1 high."""

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


def _gaps(microphone: str, spans: LabelledSpans) -> Iterator[Lane]:
    later = spans.ends > spans.starts  # where the clock was set back nothing is missing
    spans = LabelledSpans(
        spans.starts[later], spans.ends[later], np.full(later.sum(), NOT_HEARD, object)
    )
    yield Lane(microphone, GAP_LANE, changes(spans))


def _health(columns: Columns) -> Iterator[Lane]:
    names = columns["header.frame_id"]
    for name in np.unique(names.astype(str)).tolist():
        if not shown_topic(f"/{name}/gap"):
            continue
        own = names == name
        levels = [
            max((status["level"] for status in each), default=0) for each in columns["status"][own]
        ]
        states = [TROUBLES[min(level, len(TROUBLES)) - 1] if level else None for level in levels]
        yield Lane(name, TROUBLE_LANE, Changes(columns["header.stamp"][own], states))
