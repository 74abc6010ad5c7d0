"""Timeline: lanes and plots of some logs on a time grid, and the clock of the home."""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta, tzinfo
from enum import Enum, auto
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.logs.layers import Coverage
from hearthlog.analyzer.logs.local_time import home_zone, local_time
from hearthlog.models.classes import Colour, in_words, ordered
from hearthlog.schemas.arrays import Bool, Float32, Float64, Indices, Int16, Int64
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.messages.topics import scenario_name


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

    def find(self, times: Int64) -> Indices:
        """Find the share with each time (ns of UTC), 0 to count - 1, or the nearest one."""
        places = (times - self.start) * (self.count / (self.end - self.start))
        return np.clip(places.astype(np.int64), 0, self.count - 1)


class GridMeans:
    """Means of rows in each share of a grid."""

    def __init__(self, grid: TimelineGrid, width: int) -> None:
        self._grid = grid
        self._sums = np.zeros((grid.count, width))
        self._counts = np.zeros(grid.count, np.int64)

    def add(self, times: Int64, values: NDArray[np.floating]) -> None:
        """Add rows, at least one, in order of time (ns of UTC); non-finite values count as 0."""
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
    """Local wall clock of a home, as nanoseconds since 1970."""

    name: str  # of the axis, with the offset from UTC
    offset: int  # local time minus UTC, in nanoseconds

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
    """Spans of time, each with a text: a label, or a reason."""

    starts: Int64  # [shape=(n,)], in nanoseconds of UTC, in time order
    ends: Int64  # likewise
    texts: NDArray[np.object_]  # [shape=(n,)] of str

    def __len__(self) -> int:
        return len(self.starts)

    def where(self, rows: Bool) -> "LabelledSpans":
        """Return some of the spans."""
        return LabelledSpans(self.starts[rows], self.ends[rows], self.texts[rows])


def labelled_spans(rows: Iterable[tuple[int, int, str]] = ()) -> LabelledSpans:
    """Collect spans, each given as its start, end and text, in time order."""
    rows = list(rows)
    return LabelledSpans(
        np.array([start for start, _, _ in rows], np.int64),
        np.array([end for _, end, _ in rows], np.int64),
        np.array([text for _, _, text in rows], object),
    )


def no_spans() -> LabelledSpans:
    """Return an empty `LabelledSpans`."""
    return labelled_spans()


class Style(Enum):
    """Drawing of values: stacked bands or a row each (shares of one), dark to bright, and so on."""

    BANDS = auto()
    ROWS = auto()
    HEAT_MAP = auto()
    LINE = auto()
    POINTS = auto()


def _unchanged(values: NDArray[np.floating]) -> NDArray[np.floating]:
    return values


@dataclass(frozen=True, eq=False)
class PlotKind:
    """Values and appearance of plots of one kind."""

    name: str  # of the entity
    # Title of the view, shared by all kinds with the same title. Placeholders: {first} and {last}
    # are names of columns, {end} is the last number.
    title: str
    height: int  # relative to other views
    style: Style
    colour: Colour = (235, 215, 140)  # of a line, or of points
    scale: tuple[float, float] | None = None  # None fits the values
    live_scale: tuple[float, float] | None = None  # replaces `scale` where values are added live
    frame_step: float = 0.0  # of single frames, smaller ones are invisible; 0 draws no frames
    of_means: Callable[[NDArray[np.floating]], NDArray[np.floating]] = _unchanged

    @property
    def view(self) -> str:
        """Short name of the view."""
        return re.split("[:,]", self.title)[0]


class Plot(NamedTuple):
    """Values of a plot, or an addition to it: logged rows, or what is drawn of their means."""

    kind: PlotKind
    microphone: str
    labelling: str  # empty if the plot belongs to none
    names: tuple[str, ...]  # of the drawn columns
    times: Int64  # [shape=(n,)]; starts of frames, or middles of spans, in nanoseconds of UTC
    values: NDArray[np.floating]  # [shape=(n, k)]; NaN where nothing was recorded
    length: int = NANOSECONDS  # of a span, in nanoseconds

    @property
    def title(self) -> str:
        """Title of the plot's view."""
        last = len(self.names) - 1
        return self.kind.title.format(first=self.names[0], last=self.names[-1], end=last)

    @property
    def text(self) -> str:
        """Text next to the plot: its title, or the names of rows from above."""
        if self.kind.style is not Style.BANDS:
            return self.title
        return ", ".join(map(in_words, ordered(self.names)))

    def between(self, start: int | None, end: int | None) -> "Plot":
        """Return the frames that begin in a span (ns of UTC; None for no limit)."""
        first = 0 if start is None else int(np.searchsorted(self.times, start))
        last = len(self.times) if end is None else int(np.searchsorted(self.times, end))
        return self._replace(times=self.times[first:last], values=self.values[first:last])

    def fifths(self) -> "Plot":
        """Average over each fifth of a second, enough to show the noise of a room."""
        fifths = self.times // (NANOSECONDS // 5)
        first = np.flatnonzero(np.diff(fifths, prepend=-1))
        sizes = np.diff(first, append=len(self.times))
        means = np.add.reduceat(self.values, first, axis=0) / sizes[:, np.newaxis]
        return self._replace(times=self.times[first], values=means.astype(np.float32))


PlotKey = tuple[PlotKind, str]  # with the labelling


class LogLines(NamedTuple):
    """Text lines logged by the recorder, in time order."""

    times: Int64  # [shape=(n,)], in nanoseconds of UTC
    levels: NDArray[np.integer]  # [shape=(n,)], of `rcl_interfaces/msg/Log`
    texts: NDArray[np.object_]  # [shape=(n,)] of str


class SoundClip(NamedTuple):
    """Clip of kept sound."""

    start: int
    rate: int  # samples per second
    samples: Int16  # [shape=(n,)]

    @property
    def end(self) -> int:
        """End of the clip, in nanoseconds of UTC."""
        return self.start + len(self.samples) * NANOSECONDS // self.rate


_SOUND_SCALE = np.float32(32768.0)


def sound_of(clips: Sequence[SoundClip], start: int, end: int) -> tuple[int, Float32]:
    """Return rate and samples (-1 to 1) of the kept sound of a span of time, without the holes.

    Clips with a sample rate other than the first clip's, in samples per second, are skipped; it is
    0 if no sound was kept.
    """
    parts, rate = [np.empty(0, np.float32)], 0
    for clip in clips:
        if clip.start < end and clip.end > start and rate in {0, clip.rate}:
            rate = clip.rate
            first, last = ((t - clip.start) * rate // NANOSECONDS for t in (start, end))
            samples = clip.samples[max(first, 0) : max(last, 0)].astype(np.float32)
            parts.append(samples / _SOUND_SCALE)
    return rate, np.concatenate(parts)


_WINDOW_SECONDS = 0.032
_HIGHEST = 8000.0  # Hz
_RANGE = 55.0  # dB below the peak of a spectrogram that are visible


def spectrogram(
    clips: Sequence[SoundClip], start: int, end: int, shape: tuple[int, int]
) -> Float64 | None:
    """Compute the spectrogram of the kept sound of a span in nanoseconds of UTC; None without any.

    `shape` has rows from 8 kHz down to 0, and columns from start to end. Values are 0 (55 dB below
    the loudest) to 1, and 0 where no sound was kept.
    """
    rows, count = shape
    times = start + (np.arange(count) + 0.5) * ((end - start) / count)
    power = np.zeros((count, rows))
    for clip in clips:
        inside = np.flatnonzero((times >= clip.start) & (times < clip.end))
        if not len(inside):
            continue
        window = max(round(clip.rate * _WINDOW_SECONDS), 2)
        middles = (times[inside] - clip.start) * (clip.rate / NANOSECONDS)
        places = middles.astype(np.int64)[:, np.newaxis] + np.arange(window) - window // 2
        exists = (places >= 0) & (places < len(clip.samples))
        frames = np.where(exists, clip.samples[np.clip(places, 0, len(clip.samples) - 1)], 0)
        bins = np.abs(np.fft.rfft(frames * np.hanning(window))) ** 2
        frequencies = np.linspace(_HIGHEST, 0.0, rows)
        nearest = np.rint(frequencies * window / clip.rate).astype(np.int64)
        audible = nearest < bins.shape[1]
        power[np.ix_(inside, np.flatnonzero(audible))] = bins[:, nearest[audible]]
    peak = power.max()
    if not peak:
        return None
    level = 10 * np.log10(np.maximum(power / peak, 1e-12))
    return np.clip(1 + level / _RANGE, 0.0, 1.0).T


@dataclass
class LabellingTimeline:
    """Labels of one source: the recorder (`live`), a relabelling, a reviewer (`review`)."""

    name: str
    spans: LabelledSpans
    classes: Sequence[str] = ()  # of its model
    unsure: LabelledSpans = field(default_factory=no_spans)  # segments of a low confidence


@dataclass
class MicrophoneTimeline:
    """Logged data of a microphone."""

    name: str
    labellings: list[LabellingTimeline]
    plots: Mapping[PlotKey, Plot]  # means on the grid, in the order of the views
    frames: Mapping[PlotKey, Sequence[Plot]]  # empty above three hours, see `read_frames`
    reviewed: LabelledSpans
    gaps: LabelledSpans
    troubles: LabelledSpans
    clips: list[SoundClip]
    recurring: LabelledSpans = field(default_factory=no_spans)
    spoken: LabelledSpans = field(default_factory=no_spans)
    reviewed_scenarios: dict[str, LabelledSpans] = field(default_factory=dict)

    @property
    def classes(self) -> list[str]:
        """Classes of the models except scenarios, then other labels."""
        return self.classes_of("")

    def classes_of(self, scenario: str) -> list[str]:
        """Return the classes of a scenario, or of all labellings without one, then other labels."""
        labellings = [one for one in self.labellings if scenario_name(one.name) == scenario]
        names = [name for one in labellings for name in one.classes]
        return list(dict.fromkeys([*names, *(t for one in labellings for t in one.spans.texts)]))


@dataclass
class Timeline:
    """Content of some logs, at the resolution of a screen."""

    grid: TimelineGrid  # complete span, in shares one or two pixels wide
    microphones: Mapping[str, MicrophoneTimeline]
    lines: LogLines
    zone: str
    coverage: Mapping[str, Coverage]
    every: int = 1
    losses: list[str] = field(default_factory=list)

    @property
    def has_sound(self) -> bool:
        """Whether some sound was kept."""
        return any(microphone.clips for microphone in self.microphones.values())

    @property
    def clock(self) -> HomeClock:
        """Clock of the home.

        Raise `DataError` if the time zone is unknown.
        """
        return home_clock(home_zone(self.zone), self.grid.start, self.grid.end)


class Key(NamedTuple):
    """A key of a review, its action, the colour of the class that it names, and its cap."""

    key: str
    text: str
    colour: Colour | None = None
    shown: str = ""  # as `Enter`; empty for the key itself

    @property
    def cap(self) -> str:
        """The label of the key."""
        return self.shown or self.key


class Question(NamedTuple):
    """A question about a span: its text, its place in a queue, and the keys that answer it."""

    text: str
    place: str
    keys: Sequence[Key] = ()
    keys_in: str = ""  # where they are pressed, if not in the viewer
