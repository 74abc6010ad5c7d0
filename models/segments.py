"""Segments from the probabilities of classes: successive frames of one state, made one.

The state of a frame is the likeliest class, which is the paper's first way (section 4), or that of
the likeliest path through a hidden Markov model, which is known some frames later.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.modelfile import Smoothing
from models.smoothing import FixedLagSmoother

Float32 = NDArray[np.float32]
Int64 = NDArray[np.int64]
States = NDArray[np.intp]


@dataclass(frozen=True)
class Segment:
    """A span of one state.

    Attributes
    ----------
    start, end : int
        In nanoseconds of UTC.
    label : int
        Index of the class.
    confidence : float
        Its mean probability.
    known : int
        Start of the frame with which it was known where the segment ends, in nanoseconds of UTC;
        where the sound ends, its end.
    """

    start: int
    end: int
    label: int
    confidence: float
    known: int


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

    def __init__(
        self, smoothing: Smoothing, transitions: NDArray[np.float64], frame_seconds: float
    ) -> None:
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


@dataclass
class _Open:
    start: int
    label: int
    frames: int = 0
    confidence_sum: float = 0.0


class SegmentMerger:
    """Merges the states of one stream; at most one segment is open."""

    def __init__(self) -> None:
        self._open: _Open | None = None

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
        closed = []
        starts = np.flatnonzero(np.diff(states, prepend=-1)).tolist()
        for start, end in pairwise([*starts, len(states)]):
            label = int(states[start])
            if self._open is None or self._open.label != label:
                closed += self.close(int(stamps[start]), int(known[start]))
                self._open = _Open(int(stamps[start]), label)
            # A running sum from left to right, so that blocks of any size give the same bits.
            run = np.concatenate([[self._open.confidence_sum], confidences[start:end]])
            self._open.confidence_sum = float(np.add.accumulate(run)[-1])
            self._open.frames += end - start
        return closed

    def close(self, end: int, known: int) -> list[Segment]:
        """End the open segment, if there is one, at `end`, which is known at `known`."""
        if self._open is None:
            return []
        last, self._open = self._open, None
        confidence = last.confidence_sum / last.frames
        return [Segment(last.start, end, last.label, confidence, known)]


def _of(states: States, probabilities: Float32) -> NDArray[Any]:
    return probabilities[np.arange(len(states)), states]
