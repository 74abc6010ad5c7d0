"""Timeline: rows of messages, their arrays on a time grid, and the clock of the home."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta, tzinfo
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.logs.layers import Coverage
from hearthlog.analyzer.logs.local_time import home_zone, local_time
from hearthlog.analyzer.logs.recorder_info import MicrophoneHealth, microphone_states
from hearthlog.analyzer.logs.selection import checked_array_names
from hearthlog.analyzer.logs.sound_vectors import as_vectors
from hearthlog.models.classes import in_words
from hearthlog.schemas.arrays import Float32, Float64, Int16, Int64
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import Columns
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import TopicName, is_review, parse_topic, scenario_name


@dataclass(frozen=True)
class TimelineGrid:
    """A span of time, divided into equal shares."""

    start: int
    end: int
    count: int

    @property
    def edges(self) -> Int64:
        """Starts of the shares, then the end of the last share; shape (count + 1,)."""
        shares = np.arange(self.count + 1) / self.count
        return self.start + np.round(shares * (self.end - self.start)).astype(np.int64)

    @property
    def step(self) -> int:
        """Length of a share in nanoseconds, except for rounding."""
        return (self.end - self.start) // self.count

    @property
    def middles(self) -> Int64:
        """Middles of the shares; shape (count,)."""
        edges = self.edges
        return edges[:-1] + (edges[1:] - edges[:-1]) // 2

    def find(self, times: Int64) -> NDArray[np.intp]:
        """Find the share that contains each time.

        Parameters
        ----------
        times : np.ndarray [shape=(n,)], int64
            In nanoseconds of UTC.

        Returns
        -------
        np.ndarray [shape=(n,)], int
            0 to count - 1; the nearest share for a time outside the grid.
        """
        places = (times - self.start) * (self.count / (self.end - self.start))
        return np.clip(places.astype(np.int64), 0, self.count - 1)


class GridMeans:
    """Means of rows in each share of a grid."""

    def __init__(self, grid: TimelineGrid, width: int) -> None:
        self._grid = grid
        self._sums = np.zeros((grid.count, width))
        self._counts = np.zeros(grid.count, np.int64)

    def add(self, times: Int64, values: NDArray[np.floating]) -> None:
        """Add rows in time order; values that are not finite count as 0.

        Parameters
        ----------
        times : np.ndarray [shape=(n,)], int64
            In nanoseconds of UTC, at least one.
        values : np.ndarray [shape=(n, width)], float
        """
        share = self._grid.find(times)
        first = np.flatnonzero(np.diff(share, prepend=-1))
        if not np.isfinite(values).all():
            values = np.nan_to_num(values, posinf=0.0, neginf=0.0)
        self._sums[share[first]] += np.add.reduceat(values, first, axis=0, dtype=np.float64)
        self._counts[share[first]] += np.diff(first, append=len(share))

    @property
    def values(self) -> Float64:
        """Means, shape (count, width); NaN in shares without a row."""
        with np.errstate(invalid="ignore"):
            return self._sums / self._counts[:, np.newaxis]


@dataclass(frozen=True)
class HomeClock:
    """Local wall clock of a home, as nanoseconds since 1970.

    Attributes
    ----------
    name : str
        Name of the axis, with the offset from UTC.
    offset : int
        Local time minus UTC, in nanoseconds.
    """

    name: str
    offset: int

    def shown(self, utc: Any) -> Any:
        """Convert UTC to local time, both in nanoseconds (int or np.ndarray of int64)."""
        return utc + self.offset

    def utc(self, shown: Any) -> Any:
        """Convert local time to UTC, both in nanoseconds (int or np.ndarray of int64)."""
        return shown - self.offset


def home_clock(zone: tzinfo, start: int, end: int) -> HomeClock:
    """Make the clock of a home for a span of time.

    If the clocks change within the span, the offset at its middle is used throughout, and the name
    states it: a time axis has no hour twice.
    """
    ahead = _ahead((start + end) // 2, zone)
    is_one = _ahead(start, zone) == ahead == _ahead(max(start, end - 1), zone)
    hours = "" if not ahead else f"{datetime(1970, 1, 2, tzinfo=UTC) + abs(ahead):%H:%M}"
    sign = "+" if ahead > timedelta() else "-"
    distance = f"UTC{sign}{hours}" if hours else "UTC"
    return HomeClock(
        f"clock of the home ({distance}{'' if is_one else ' throughout'})",
        round(ahead.total_seconds()) * NANOSECONDS,
    )


def _ahead(time: int, zone: tzinfo) -> timedelta:
    return local_time(time, zone).utcoffset() or timedelta()


class LabelledSpans(NamedTuple):
    """Spans of time, each with a text: a label, or a reason.

    Attributes
    ----------
    starts, ends : np.ndarray [shape=(n,)], int64
        In nanoseconds of UTC, in time order.
    texts : np.ndarray [shape=(n,)] of str
    """

    starts: Int64
    ends: Int64
    texts: NDArray[np.object_]

    def __len__(self) -> int:
        return len(self.starts)


def no_spans() -> LabelledSpans:
    """Return an empty `LabelledSpans`."""
    return LabelledSpans(np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, object))


class GridSeries(NamedTuple):
    """Means on the grid of a timeline.

    Attributes
    ----------
    values : np.ndarray [shape=(count, k)], float64
        NaN where nothing was recorded.
    """

    names: tuple[str, ...]
    values: Float64


class FrameValues(NamedTuple):
    """Values of successive frames of a log, 20 a second.

    Attributes
    ----------
    times : np.ndarray [shape=(n,)], int64
        Starts of the frames, in nanoseconds of UTC.
    values : np.ndarray [shape=(n, k)], float32
    """

    names: tuple[str, ...]
    times: Int64
    values: Float32


class LogLines(NamedTuple):
    """Text lines logged by the recorder, in time order.

    Attributes
    ----------
    times : np.ndarray [shape=(n,)], int64
        In nanoseconds of UTC.
    levels : np.ndarray [shape=(n,)], int
        Levels of `rcl_interfaces/msg/Log`.
    texts : np.ndarray [shape=(n,)] of str
    """

    times: Int64
    levels: NDArray[np.integer]
    texts: NDArray[np.object_]


class SoundClip(NamedTuple):
    """Clip of kept sound.

    Attributes
    ----------
    rate : int
        Samples per second.
    samples : np.ndarray [shape=(n,)], int16
    """

    start: int
    rate: int
    samples: Int16

    @property
    def end(self) -> int:
        """End of the clip, in nanoseconds of UTC."""
        return self.start + len(self.samples) * NANOSECONDS // self.rate


@dataclass
class LabellingTimeline:
    """Labels of one source: the recorder (`live`), a relabelling, a reviewer (`review`).

    Attributes
    ----------
    novelty : np.ndarray [shape=(count,)], float64, or None
    frames : list of FrameValues
        Probabilities of each frame; empty above three hours, see `read_frames`.
    """

    name: str
    spans: LabelledSpans
    probabilities: GridSeries | None = None
    novelty: Float64 | None = None
    frames: Sequence[FrameValues] = ()


@dataclass
class MicrophoneTimeline:
    """Logged data of a microphone.

    Attributes
    ----------
    level : np.ndarray [shape=(count,)], float64, or None
        Level of the mean energy, in dB relative to full scale (0 for a square wave of full scale).
    level_frames : list of FrameValues
        Level of each frame; empty above three hours.
    floor : np.ndarray [shape=(count,)], float64, or None
        Noise floor of the room, in the same unit; NaN where unknown.
    direction : np.ndarray [shape=(count,)], float64, or None
        Direction of the sound at an array, in degrees; NaN where nothing was located.
    """

    name: str
    labellings: list[LabellingTimeline]
    features: GridSeries | None
    level: Float64 | None
    level_frames: Sequence[FrameValues]
    floor: Float64 | None
    reviewed: LabelledSpans
    gaps: LabelledSpans
    troubles: LabelledSpans
    clips: list[SoundClip]
    recurring: LabelledSpans = field(default_factory=no_spans)
    spoken: LabelledSpans = field(default_factory=no_spans)
    direction: Float64 | None = None
    reviewed_scenarios: dict[str, LabelledSpans] = field(default_factory=dict)

    @property
    def classes(self) -> list[str]:
        """Classes of the models except scenarios, then other labels."""
        return self.classes_of("")

    def classes_of(self, scenario: str) -> list[str]:
        """Return the classes of a scenario, then other labels.

        Parameters
        ----------
        scenario : str
            Its name; empty for all labellings without a scenario.
        """
        labellings = [one for one in self.labellings if scenario_name(one.name) == scenario]
        series = [one.probabilities for one in labellings if one.probabilities is not None]
        names = [name for each in series for name in each.names]
        return list(dict.fromkeys([*names, *(t for one in labellings for t in one.spans.texts)]))


@dataclass
class Timeline:
    """Content of some logs, at the resolution of a screen.

    Attributes
    ----------
    grid : TimelineGrid
        Complete span, in shares one or two pixels wide.
    """

    grid: TimelineGrid
    microphones: Mapping[str, MicrophoneTimeline]
    lines: LogLines
    zone: str
    coverage: Mapping[str, Coverage]
    every: int = 1
    losses: list[str] = field(default_factory=list)

    @property
    def clock(self) -> HomeClock:
        """Clock of the home.

        Raise `DataError` if the time zone is unknown.
        """
        return home_clock(home_zone(self.zone), self.grid.start, self.grid.end)


ENERGY = "energy"
_SEGMENT_LINE = re.compile(r"^(\w+) for(?= [\d.]+ s \(\d+ %\)$)")
FIELDS = {
    message_types.FEATURES: ("header.stamp", "values"),
    message_types.LABEL: ("header.stamp", "novelty", "probabilities"),
    message_types.SEGMENT: ("header.stamp", "duration", "label"),
    message_types.GAP: ("header.stamp", "duration", "reason"),
    message_types.DIRECTION: ("header.stamp", "azimuth", "confidence"),
    message_types.DIAGNOSTICS: ("header.stamp", "header.frame_id", "status"),
    message_types.LOG: ("stamp", "level", "msg"),
}
_KINDS = {"features", "label", "segment", "gap", "direction"}
_QUIETEST = 1e-10  # mean square: -100 dB


class FeatureRows(NamedTuple):
    """Features of n frames.

    Attributes
    ----------
    times : np.ndarray [shape=(n,)], int64
        Starts of the frames, in nanoseconds of UTC.
    values : np.ndarray [shape=(n, k)], float32
    """

    microphone: str
    names: tuple[str, ...]
    times: Int64
    values: Float32


class LabelRows(NamedTuple):
    """Probabilities of k classes, and novelty, in n frames.

    Attributes
    ----------
    times : np.ndarray [shape=(n,)], int64
        Starts of the frames, in nanoseconds of UTC.
    probabilities : np.ndarray [shape=(n, k)], float32
    novelty : np.ndarray [shape=(n,)], float32
        NaN where the model has none.
    """

    microphone: str
    labelling: str
    names: tuple[str, ...]
    times: Int64
    probabilities: Float32
    novelty: Float32


class SegmentRows(NamedTuple):
    """Segments of a labelling."""

    microphone: str
    labelling: str
    spans: LabelledSpans


class GapRows(NamedTuple):
    """Gaps of a microphone, with their reasons."""

    microphone: str
    spans: LabelledSpans


class DirectionRows(NamedTuple):
    """Directions of the sound at an array, in n blocks.

    Attributes
    ----------
    times : np.ndarray [shape=(n,)], int64
        Starts of the blocks, in nanoseconds of UTC.
    directions : np.ndarray [shape=(n, 2)], float64
        Ahead and left; the length is the confidence.
    """

    microphone: str
    times: Int64
    directions: Float64


class StateRows(NamedTuple):
    """Health of microphones, from the diagnostics."""

    states: list[MicrophoneHealth]


Rows = FeatureRows | LabelRows | SegmentRows | GapRows | DirectionRows | StateRows | LogLines


def read_rows(path: Path, columns: Columns) -> Rows | None:
    """Extract the fields from the messages of one topic.

    Parameters
    ----------
    columns : Columns
        At least one message, with the `FIELDS` of its type.

    Returns
    -------
    FeatureRows, LabelRows, SegmentRows, GapRows, DirectionRows, StateRows, LogLines or None
        None if a timeline does not show the topic.

    Raises
    ------
    LogError
        If a channel does not name its values, or names another number of them.
    """
    if columns.type == message_types.LOG:
        texts = np.array([worded(text) for text in columns["msg"]], object)
        return LogLines(columns["stamp"], columns["level"], texts)
    if columns.type == message_types.DIAGNOSTICS:
        return StateRows(list(microphone_states(columns)))
    topic = shown_topic(columns.topic)
    return topic and _microphone_rows(path, columns, topic)


def worded(line: str) -> str:
    """Return a line about a segment, with the class name replaced by its lane's name."""
    return _SEGMENT_LINE.sub(lambda found: f"{in_words(found[1])} for", line)


def _microphone_rows(path: Path, columns: Columns, topic: TopicName) -> Rows:
    microphone, labelling = topic.microphone, topic.labelling
    times = columns["header.stamp"]
    if columns.type == message_types.FEATURES:
        names = checked_array_names(path, columns, "values")
        return FeatureRows(microphone, names, times, columns["values"])
    if columns.type == message_types.LABEL:
        names = checked_array_names(path, columns, "probabilities")
        values = columns["probabilities"], columns["novelty"]
        return LabelRows(microphone, labelling, names, times, *values)
    if columns.type == message_types.DIRECTION:
        towards = as_vectors(columns["azimuth"], columns["confidence"])
        return DirectionRows(microphone, times, towards)
    ends = times + columns["duration"]
    if columns.type == message_types.SEGMENT:
        return SegmentRows(microphone, labelling, LabelledSpans(times, ends, columns["label"]))
    return GapRows(microphone, LabelledSpans(times, ends, columns["reason"]))


def shown_topic(name: str) -> TopicName | None:
    """Parse a topic shown in a timeline.

    Returns
    -------
    TopicName or None
        None for any other topic. Marks are read from their layers, not shown by topic.
    """
    topic = parse_topic(name)
    if topic is None or topic.kind not in _KINDS or is_review(topic.labelling):
        return None
    return topic


def decibel(energy: Any) -> Any:
    """Return the level of a mean square, in dB relative to full scale: 10 log10(energy).

    Parameters
    ----------
    energy : float or np.ndarray
        Mean square of samples from -1 to 1.

    Returns
    -------
    float or np.ndarray
        At least -100; 0 for a square wave of full scale.
    """
    return 10 * np.log10(np.maximum(energy, _QUIETEST))
