"""A timeline as arrays, by microphone and labelling."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.logs.layers import Coverage
from hearthlog.analyzer.logs.local_time import home_zone
from hearthlog.analyzer.review.timeline.grid import Grid
from hearthlog.analyzer.review.timeline.home_clock import HomeClock, home_clock
from hearthlog.schemas.arrays import Float32, Float64, Int16, Int64
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.messages.topics import scenario_name


class LabelledSpans(NamedTuple):
    """Spans of time, each with a text: a label, or a reason.

    Attributes
    ----------
    starts, ends : np.ndarray [shape=(n,)], int64
        In nanoseconds of UTC, in the order of time.
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
    """Values of successive frames, 20 a second, as they are in a log.

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
    """Lines that the recorder logged in words, in the order of time.

    Attributes
    ----------
    times : np.ndarray [shape=(n,)], int64
        In nanoseconds of UTC.
    levels : np.ndarray [shape=(n,)], int
        Those of `rcl_interfaces/msg/Log`.
    texts : np.ndarray [shape=(n,)] of str
    """

    times: Int64
    levels: NDArray[np.integer]
    texts: NDArray[np.object_]


class SoundClip(NamedTuple):
    """Kept sound.

    Attributes
    ----------
    rate : int
        Samples a second.
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
    """The labels of one source: the recorder (`live`), a relabelling, a reviewer (`review`).

    Attributes
    ----------
    novelty : np.ndarray [shape=(count,)], float64, or None
    frames : list of FrameValues
        The probabilities, frame by frame; none of more than three hours, see `read_frames`.
    """

    name: str
    spans: LabelledSpans
    probabilities: GridSeries | None = None
    novelty: Float64 | None = None
    frames: Sequence[FrameValues] = ()


@dataclass
class MicrophoneTimeline:
    """What the logs have of a microphone.

    Attributes
    ----------
    level : np.ndarray [shape=(count,)], float64, or None
        Level of the mean energy, in dB relative to full scale (0 for a square wave of full scale).
    level_frames : list of FrameValues
        The level, frame by frame; none of more than three hours.
    floor : np.ndarray [shape=(count,)], float64, or None
        Level of the floor of the room, in the same unit; NaN where it is not known.
    direction : np.ndarray [shape=(count,)], float64, or None
        Whence the sound of an array came, in degrees; NaN where nothing was located.
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
        """The classes of the models but those of scenarios, then other labels that there are."""
        return self.classes_of("")

    def classes_of(self, scenario: str) -> list[str]:
        """Return the classes of a scenario, then other labels that there are.

        Parameters
        ----------
        scenario : str
            Its name; empty for all labellings that are of none.
        """
        labellings = [one for one in self.labellings if scenario_name(one.name) == scenario]
        series = [one.probabilities for one in labellings if one.probabilities is not None]
        names = [name for each in series for name in each.names]
        return list(dict.fromkeys([*names, *(t for one in labellings for t in one.spans.texts)]))


@dataclass
class Timeline:
    """What some logs hold, at the resolution of a screen.

    Attributes
    ----------
    grid : Grid
        The whole span, in shares that are a pixel or two wide.
    """

    grid: Grid
    microphones: Mapping[str, MicrophoneTimeline]
    lines: LogLines
    zone: str
    coverage: Mapping[str, Coverage]
    every: int = 1
    losses: list[str] = field(default_factory=list)

    @property
    def clock(self) -> HomeClock:
        """The clock of the home.

        Raise `DataError` if there is no such time zone.
        """
        return home_clock(home_zone(self.zone), self.grid.start, self.grid.end)
