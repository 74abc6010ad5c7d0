"""The plots of a review and of a watch: which there are, how they look, and what they show."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum, auto
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.colours import Colour
from hearthlog.analyzer.review.timeline.model import MicrophoneTimeline, Timeline
from hearthlog.models.classes import in_words
from hearthlog.schemas.arrays import Float64, Int64
from hearthlog.schemas.frames import NANOSECONDS

_BRIGHT: Colour = (235, 215, 140)
_GROUND: Colour = (200, 120, 90)
_NEW: Colour = (160, 200, 255)
_TOWARDS: Colour = (150, 215, 150)
_HEAT_COLUMNS = 600  # at most: each value is a square, which costs the viewer some ten kilobytes
_HEAT_PERCENTILES = (2, 98)
_TINY = np.finfo(np.float64).tiny


class Style(Enum):
    """How values are drawn: shares of one in bands, 0 to 1 from dark to bright, a line, points."""

    BANDS = auto()
    HEAT_MAP = auto()
    LINE = auto()
    POINTS = auto()


@dataclass(frozen=True)
class PlotKind:
    """How plots of one kind look; they are shown in the order of `PLOTS`."""

    name: str  # of the entity
    # Of the view; kinds of one title share it. With {first} and {last} for names of columns, and
    # {end} for the last number.
    title: str
    height: int  # in relation to other views
    style: Style
    colour: Colour = _BRIGHT  # of a line, or of points
    scale: tuple[float, float] | None = None  # None fits the values
    live_scale: tuple[float, float] | None = None  # if another one, where values go on

    @property
    def view(self) -> str:
        """Short name of the view."""
        return re.split("[:,]", self.title)[0]


SHARES = PlotKind("shares", "How probable each class is", 280, Style.BANDS, scale=(0.0, 1.0))
_LEVELS = "Level, and floor of the room, in dBFS"
LEVEL = PlotKind("level", _LEVELS, 100, Style.LINE, live_scale=(-100.0, 0.0))
FLOOR = PlotKind("floor", _LEVELS, 100, Style.LINE, _GROUND, live_scale=(-100.0, 0.0))
NOVELTY = PlotKind(
    "novelty", "Novelty: how doubtful labels are", 90, Style.LINE, _NEW, live_scale=(0.0, 1.0)
)
FEATURES = PlotKind(
    "features", "Features: 0 ({first}) to {end} ({last}), dark is low", 180, Style.HEAT_MAP
)
DIRECTION = PlotKind(
    "direction",
    "Direction of the sound, in degrees: 0 ahead, 90 left",
    110,
    Style.POINTS,
    _TOWARDS,
    scale=(-180.0, 180.0),
)
PLOTS = (SHARES, LEVEL, FLOOR, DIRECTION, NOVELTY, FEATURES)


class Plot(NamedTuple):
    """A plot, or what is new in it: means over spans of time.

    Attributes
    ----------
    labelling : str
        Empty if the plot is of none.
    times : np.ndarray [shape=(n,)], int64
        Middles of the spans, in nanoseconds of UTC.
    values : np.ndarray [shape=(n, k)], float64
        NaN where nothing was recorded.
    length : int
        Of a span, in nanoseconds.
    """

    kind: PlotKind
    microphone: str
    labelling: str
    names: tuple[str, ...]
    times: Int64
    values: Float64
    length: int = NANOSECONDS

    @property
    def title(self) -> str:
        """Of a view of it."""
        last = len(self.names) - 1
        return self.kind.title.format(first=self.names[0], last=self.names[-1], end=last)

    @property
    def text(self) -> str:
        """What stands beside it: what it shows, of bands each from below."""
        if self.kind.style is not Style.BANDS:
            return self.title
        return f"From below: {', '.join(map(in_words, self.names))}"


def timeline_plots(timeline: Timeline) -> Iterator[Plot]:
    """Make the plots of a timeline, microphone by microphone in the order of `PLOTS`."""
    grid = timeline.grid
    times, length = grid.middles, grid.step
    for microphone in timeline.microphones.values():
        for kind, labelling, names, values in _values(microphone):
            rows = _shades(times, values) if kind is FEATURES else (times, values)
            yield Plot(kind, microphone.name, labelling, names, *rows, length)


def _values(
    microphone: MicrophoneTimeline,
) -> Iterator[tuple[PlotKind, str, tuple[str, ...], Float64]]:
    for one in microphone.labellings:
        if one.probabilities is not None:
            yield SHARES, one.name, *one.probabilities
    if microphone.level is not None:
        yield LEVEL, "", ("level",), microphone.level[:, np.newaxis]
    if microphone.floor is not None:
        yield FLOOR, "", ("floor",), microphone.floor[:, np.newaxis]
    if microphone.direction is not None:
        yield DIRECTION, "", ("direction",), microphone.direction[:, np.newaxis]
    for one in microphone.labellings:
        if one.novelty is not None:
            yield NOVELTY, one.name, (f"novelty, {one.name}",), one.novelty[:, np.newaxis]
    if microphone.features is not None:
        yield FEATURES, "", *microphone.features


def _shades(times: Int64, values: Float64) -> tuple[Int64, Float64]:
    """Scale each column from its low values (0) to its high ones (1), in few enough rows."""
    present = ~np.isnan(values[:, 0])
    if not present.any():
        return times[:0], values[:0]
    times, values = times[present], values[present]
    absent = np.isnan(values)  # where the logs are of another feature set
    times, values = _thin(times, np.where(absent, np.nanmin(values, axis=0), values))
    low, high = np.percentile(values, _HEAT_PERCENTILES, axis=0)
    return times, np.clip((values - low) / np.maximum(high - low, _TINY), 0.0, 1.0)


def _thin(times: Int64, values: Float64) -> tuple[Int64, Float64]:
    """Average successive rows until they are few enough."""
    size = -(-len(times) // _HEAT_COLUMNS)
    first = np.arange(0, len(times), size)
    sizes = np.diff(first, append=len(times))
    return times[first + sizes // 2], np.add.reduceat(values, first) / sizes[:, np.newaxis]
