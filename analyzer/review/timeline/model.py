"""What a timeline shows: by microphone and labelling, as arrays."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.logs.coverage import Coverage
from hearthlog.analyzer.review.timeline.grid import Grid
from hearthlog.schemas.arrays import Float32, Float64, Int64


class LabelledSpans(NamedTuple):
    """Spans of time that say something.

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


class GridSeries(NamedTuple):
    """Means on the grid of a timeline.

    Attributes
    ----------
    names : tuple of str
        Of the columns.
    values : np.ndarray [shape=(count, k)], float64
        NaN where nothing was heard.
    """

    names: tuple[str, ...]
    values: Float64


class FrameValues(NamedTuple):
    """Successive frames, 20 a second, as they are in a log.

    Attributes
    ----------
    names : tuple of str
        Of the columns.
    times : np.ndarray [shape=(n,)], int64
    values : np.ndarray [shape=(n, k)], float32
    """

    names: tuple[str, ...]
    times: Int64
    values: Float32


class LogLines(NamedTuple):
    """Events in words, in the order of time.

    Attributes
    ----------
    times : np.ndarray [shape=(n,)], int64
    levels : np.ndarray [shape=(n,)], int
        Of `rcl_interfaces/msg/Log`.
    texts : np.ndarray [shape=(n,)] of str
    """

    times: Int64
    levels: NDArray[np.integer]
    texts: NDArray[np.object_]


class SoundClip(NamedTuple):
    """Sound that was kept: `samples` at `rate` a second, from `start` on, in -1 to 1."""

    start: int
    rate: int
    samples: Float32

    @property
    def end(self) -> int:
        """When it ends, in nanoseconds of UTC."""
        return self.start + len(self.samples) * 1_000_000_000 // self.rate


@dataclass
class LabellingTimeline:
    """What somebody says that was heard: the recorder (`live`), a model, a reviewer.

    Attributes
    ----------
    spans : LabelledSpans
    probabilities : GridSeries or None
        Of each class.
    novelty : np.ndarray [shape=(count,)], float64, or None
    frames : list of FrameValues
        The probabilities, frame by frame.
    """

    name: str
    spans: LabelledSpans
    probabilities: GridSeries | None = None
    novelty: Float64 | None = None
    frames: Sequence[FrameValues] = ()


@dataclass
class MicrophoneTimeline:
    """What a microphone heard.

    Attributes
    ----------
    labellings : list of LabellingTimeline
        The recorder's first, the reviewer's last.
    features : GridSeries or None
    level : np.ndarray [shape=(count,)], float64, or None
        Of the mean energy, in dB relative to full scale (a square wave of full scale has 0).
    level_frames : list of FrameValues
        The level, frame by frame.
    gaps, troubles : LabelledSpans
        What was not heard, and what was not well, each with the reason.
    clips : list of SoundClip
    """

    name: str
    labellings: list[LabellingTimeline]
    features: GridSeries | None
    level: Float64 | None
    level_frames: Sequence[FrameValues]
    gaps: LabelledSpans
    troubles: LabelledSpans
    clips: list[SoundClip]


@dataclass
class Timeline:
    """What some logs hold.

    Attributes
    ----------
    grid : Grid
        The whole span, in shares as wide as a pixel or two.
    microphones : dict of str to MicrophoneTimeline
    lines : LogLines
    zone : str
        IANA name of the home's time zone.
    heard : dict of str to Coverage
        Which log has what of each microphone.
    every : int
        One of so many parts of the logs was read.
    losses : list of str
        What could not be shown, and why.
    """

    grid: Grid
    microphones: dict[str, MicrophoneTimeline]
    lines: LogLines
    zone: str
    heard: dict[str, Coverage]
    every: int = 1
    losses: list[str] = field(default_factory=list)


def no_spans() -> LabelledSpans:
    """Make spans of which there is none."""
    return LabelledSpans(np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, object))
