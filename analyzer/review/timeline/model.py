"""A timeline as arrays, by microphone and labelling."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.logs.coverage import Coverage
from hearthlog.analyzer.review.timeline.grid import Grid
from hearthlog.schemas.arrays import Float32, Float64, Int64


class LabelledSpans(NamedTuple):
    """Spans of time in their order, in ns of UTC, each with a text: a label, or a reason."""

    starts: Int64
    ends: Int64
    texts: NDArray[np.object_]

    def __len__(self) -> int:
        return len(self.starts)


class GridSeries(NamedTuple):
    """Means in the shares of a grid, NaN where nothing was recorded."""

    names: tuple[str, ...]  # of k columns
    values: Float64  # shape (count, k)


class FrameValues(NamedTuple):
    """Values of successive frames, 20 a second, as they are in a log."""

    names: tuple[str, ...]  # of k columns
    times: Int64  # starts, shape (n,), in nanoseconds of UTC
    values: Float32  # shape (n, k)


class LogLines(NamedTuple):
    """Lines that the recorder logged in words, in the order of time."""

    times: Int64  # in nanoseconds of UTC
    levels: NDArray[np.integer]  # of `rcl_interfaces/msg/Log`
    texts: NDArray[np.object_]


class SoundClip(NamedTuple):
    """Kept sound."""

    start: int  # in nanoseconds of UTC
    rate: int  # samples a second
    samples: Float32  # -1 to 1

    @property
    def end(self) -> int:
        """The end, in nanoseconds of UTC."""
        return self.start + len(self.samples) * 1_000_000_000 // self.rate


@dataclass
class LabellingTimeline:
    """The labels of one source: the recorder (`live`), a relabelling, a reviewer (`review`)."""

    name: str
    spans: LabelledSpans  # segments or marks
    probabilities: GridSeries | None = None  # a column for each class
    novelty: Float64 | None = None  # shape (count,)
    frames: Sequence[FrameValues] = ()  # the probabilities, frame by frame


@dataclass
class MicrophoneTimeline:
    """What the logs have of a microphone.

    The level is in dB relative to full scale: 0 for a square wave of full scale.
    """

    name: str
    labellings: list[LabellingTimeline]  # the recorder's first, the reviewer's last
    features: GridSeries | None
    level: Float64 | None  # of the mean energy, shape (count,)
    level_frames: Sequence[FrameValues]
    gaps: LabelledSpans
    troubles: LabelledSpans  # warnings and errors of the diagnostics
    clips: list[SoundClip]

    @property
    def classes(self) -> list[str]:
        """The classes of the models, then other labels that there are."""
        series = [one.probabilities for one in self.labellings if one.probabilities is not None]
        names = [name for each in series for name in each.names]
        return list(
            dict.fromkeys([*names, *(t for one in self.labellings for t in one.spans.texts)])
        )


@dataclass
class Timeline:
    """What some logs hold, at the resolution of a screen."""

    grid: Grid  # the whole span, in shares that are a pixel or two wide
    microphones: Mapping[str, MicrophoneTimeline]
    lines: LogLines
    zone: str  # IANA name of the home's time zone
    coverage: Mapping[str, Coverage]  # by microphone
    every: int = 1  # one in so many parts of the logs was read
    losses: list[str] = field(default_factory=list)  # what could not be shown, and why


def no_spans() -> LabelledSpans:
    """Return an empty `LabelledSpans`."""
    return LabelledSpans(np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, object))
