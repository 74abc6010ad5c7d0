"""Segments from the probabilities of classes: successive frames of one state, made one.

The state of a frame is the likeliest class, which is the paper's first way (section 4), or that of
the likeliest path through a hidden Markov model, which is known some frames later.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hearthlog.models.classifiers.description import Smoothing
from hearthlog.models.labels.smoothing import FixedLagSmoother
from hearthlog.schemas.arrays import Float32, Float64, Int64

States = NDArray[np.intp]

_UNITS = 1 << 30  # to 1: finer than what a float32 below 1 can tell


class Run(NamedTuple):
    """Successive frames of one state, of which more may follow.

    Attributes
    ----------
    label : int
        Index of the class.
    start : int
        In nanoseconds of UTC.
    frames : int
    confidence : int
        Sum of the probabilities of the class, in units of 2**-30: whole numbers give the same sum
        in any order.
    """

    label: int
    start: int
    frames: int
    confidence: int

    def behind(self, before: "Run | None") -> "Run":
        """Return this run with the frames before it, which had the same label."""
        if before is None:
            return self
        frames, confidence = before.frames + self.frames, before.confidence + self.confidence
        return before._replace(frames=frames, confidence=confidence)


class Segment(NamedTuple):
    """A run that has ended.

    Attributes
    ----------
    run : Run
    end : int
        In nanoseconds of UTC.
    known : int
        Start of the frame with which it was known where the segment ends, in nanoseconds of UTC;
        where the sound ends, its end.
    """

    run: Run
    end: int
    known: int

    @property
    def start(self) -> int:
        """In nanoseconds of UTC."""
        return self.run.start

    @property
    def label(self) -> int:
        """Index of the class."""
        return self.run.label

    @property
    def confidence(self) -> float:
        """Mean probability of its class."""
        return self.run.confidence / self.run.frames / _UNITS


class Segmenter:
    """Divides one stream into segments, in the way that its model says.

    Parameters
    ----------
    smoothing : Smoothing
    transitions : np.ndarray [shape=(C, C)], float64
        Of the hidden Markov model; unused where segments are merged.
    frame_seconds : float

    Attributes
    ----------
    settled : bool
        Whether sound before the first frame would have left no trace in the segments to come.
    """

    def __init__(self, smoothing: Smoothing, transitions: Float64, frame_seconds: float) -> None:
        self._smoother = None
        self._lag = 0
        if smoothing.method == "hmm":
            self._lag = round(smoothing.lag_seconds / frame_seconds)
            self._smoother = FixedLagSmoother(transitions, self._lag)
        self._merger = SegmentMerger()
        self._waiting: tuple[Float32, Int64] | None = None
        self._count = 0  # of frames
        self._settled_at: int | None = None  # the stamp from which on states are sure
        self.settled = False

    @property
    def sure(self) -> bool:
        """Whether sound before the first frame would leave no trace in the states to come."""
        if self._waiting is None or self._settled_at is None:
            return False
        stamps = self._waiting[1]
        return not len(stamps) or self._settled_at <= int(stamps[0])

    @property
    def open(self) -> Run | None:
        """The frames behind the last segment, so far as their states are known."""
        return self._merger.open

    def forget(self) -> None:
        """Count no frame of what is open: the next run begins with the states to come."""
        if self._merger.open is not None:
            self._merger.open = self._merger.open._replace(frames=0, confidence=0)

    def push(self, probabilities: Float32, stamps: Int64) -> list[Segment]:
        """Add successive frames and return the segments of which the end is now known.

        Parameters
        ----------
        probabilities : np.ndarray [shape=(n, C)], float32
        stamps : np.ndarray [shape=(n,)], int64
            Starts of the frames in nanoseconds.
        """
        states = self._states(probabilities)
        self._settle(stamps)
        if self._waiting is not None:
            probabilities = np.concatenate([self._waiting[0], probabilities])
            stamps = np.concatenate([self._waiting[1], stamps])
        count = len(states)
        self._waiting = probabilities[count:], stamps[count:]
        known = stamps[self._lag :]
        closed = self._merger.push(states, _of(states, probabilities), stamps[:count], known)
        sure = self._settled_at
        self.settled |= sure is not None and any(segment.end > sure for segment in closed)
        return closed

    def close(self, end: int) -> list[Segment]:
        """Return the segments that are left of a sound that ends at `end`, and begin anew."""
        closed = []
        if self._smoother is not None and self._waiting is not None:
            probabilities, stamps = self._waiting
            states = self._smoother.close()
            known = np.full(len(states), end)
            closed = self._merger.push(states, _of(states, probabilities), stamps, known)
        self._waiting = self._settled_at = None
        self._count = 0
        closed += self._merger.close(end, end)
        self.settled |= bool(closed)
        return closed

    def _states(self, probabilities: Float32) -> States:
        if self._smoother is None:
            return probabilities.argmax(axis=1)
        return self._smoother.push(probabilities)

    def _settle(self, stamps: Int64) -> None:
        frames = 1 if self._smoother is None else self._smoother.settled
        if self._settled_at is None and frames is not None:
            self._settled_at = int(stamps[frames - 1 - self._count])
        self._count += len(stamps)


class SegmentMerger:
    """Merges the states of one stream.

    Attributes
    ----------
    open : Run or None
        The run that has not ended.
    """

    def __init__(self) -> None:
        self.open: Run | None = None

    def push(
        self, states: States, confidences: Float32, stamps: Int64, known: Int64
    ) -> list[Segment]:
        """Add the states of successive frames and return the segments that they close.

        Parameters
        ----------
        states : np.ndarray [shape=(n,)]
            Indices of classes.
        confidences : np.ndarray [shape=(n,)]
            Their probabilities.
        stamps : np.ndarray [shape=(n,)], int64
            Starts of the frames in nanoseconds.
        known : np.ndarray [shape=(n,)], int64
            When their states were known.
        """
        closed: list[Segment] = []
        starts = np.flatnonzero(np.diff(states, prepend=-1))
        if not len(starts):
            return closed
        units = np.rint(confidences.astype(np.float64) * _UNITS).astype(np.int64)
        columns = (
            states[starts],
            stamps[starts],
            np.diff(starts, append=len(states)),
            np.add.reduceat(units, starts),
        )
        rows = zip(*(column.tolist() for column in columns), strict=True)
        for run, when in zip(map(Run._make, rows), known[starts].tolist(), strict=True):
            last = self.open
            if last is not None and last.label == run.label:
                self.open = run.behind(last)
            else:
                closed += self.close(run.start, when)
                self.open = run
        return closed

    def close(self, end: int, known: int) -> list[Segment]:
        """End the open run, if there is one, at `end`, which is known at `known`."""
        if self.open is None:
            return []
        last, self.open = self.open, None
        return [Segment(last, end, known)]


def _of(states: States, probabilities: Float32) -> NDArray[Any]:
    return probabilities[np.arange(len(states)), states]
