"""Segments from the probabilities of classes: successive frames of one state, merged.

The state of a frame is the likeliest class, which is the paper's first way (section 4), or that of
the likeliest path through a hidden Markov model, which is decided some frames later.
"""

from typing import NamedTuple

import numpy as np

from hearthlog.models.classifiers.description import Smoothing
from hearthlog.models.labels.smoothing import FixedLagSmoother
from hearthlog.schemas.arrays import Float32, Float64, Indices, Int64

_UNITS = 1 << 30  # to 1: finer than what a float32 below 1 can tell


class Run(NamedTuple):
    """Successive frames of one state, of which more may follow.

    Attributes
    ----------
    label : int
        Index of the class.
    start : int
        Start of the first frame, in nanoseconds of UTC.
    frames : int
        Number of frames.
    confidence : int
        Sum of the probabilities of the class, in units of 2**-30: whole numbers give the same sum
        in any order.
    """

    label: int
    start: int
    frames: int
    confidence: int

    def prepend(self, earlier: "Run | None") -> "Run":
        """Join an earlier run to the start of this one.

        Parameters
        ----------
        earlier : Run or None
            Of the same label, ending where this run starts; None for none.

        Returns
        -------
        Run
            With the start of the earlier run, and the frames of both.
        """
        if earlier is None:
            return self
        frames, confidence = earlier.frames + self.frames, earlier.confidence + self.confidence
        return earlier._replace(frames=frames, confidence=confidence)


class Segment(NamedTuple):
    """A run that has ended.

    Attributes
    ----------
    run : Run
    end : int
        End of the last frame, in nanoseconds of UTC.
    decided_at : int
        Start of the frame with which the end became certain, in nanoseconds of UTC; where the
        sound ends, the end of the sound.
    """

    run: Run
    end: int
    decided_at: int

    @property
    def start(self) -> int:
        """Start of the first frame, in nanoseconds of UTC."""
        return self.run.start

    @property
    def label(self) -> int:
        """Index of the class."""
        return self.run.label

    @property
    def confidence(self) -> float:
        """Mean probability of the class, 0 to 1."""
        return self.run.confidence / self.run.frames / _UNITS


class Segmenter:
    """Divides one stream of frames into segments, as a model's smoothing says.

    Parameters
    ----------
    smoothing : Smoothing
    transitions : np.ndarray [shape=(C, C)], float64
        Transition probabilities of the hidden Markov model; unused where segments are merged.
    frame_seconds : float

    Attributes
    ----------
    open_run : Run or None
        The frames after the last segment, as far as their states are decided.
    segments_converged : bool
        Whether frames before the first one would leave no trace in the segments to come.
    """

    def __init__(self, smoothing: Smoothing, transitions: Float64, frame_seconds: float) -> None:
        self._smoother = None
        self._lag = 0
        if smoothing.method == "hmm":
            self._lag = round(smoothing.lag_seconds / frame_seconds)
            self._smoother = FixedLagSmoother(transitions, self._lag)
        self.open_run: Run | None = None
        self._undecided: tuple[Float32, Int64] | None = None  # probabilities and stamps of frames
        self._frames = 0  # number of frames so far
        self._converged_at: int | None = None  # stamp from which on states have converged
        self.segments_converged = False

    @property
    def states_converged(self) -> bool:
        """Whether frames before the first one would leave no trace in the states to come."""
        if self._undecided is None or self._converged_at is None:
            return False
        stamps = self._undecided[1]
        return not len(stamps) or self._converged_at <= int(stamps[0])

    def discard_open(self) -> None:
        """Set the counts of the open run to zero; its label and start stay."""
        if self.open_run is not None:
            self.open_run = self.open_run._replace(frames=0, confidence=0)

    def push(self, probabilities: Float32, stamps: Int64) -> list[Segment]:
        """Add successive frames and return the segments whose end they decide.

        Parameters
        ----------
        probabilities : np.ndarray [shape=(n, C)], float32
            At least one row.
        stamps : np.ndarray [shape=(n,)], int64
            Starts of the frames in nanoseconds of UTC.

        Returns
        -------
        list of Segment
            In the order of time.
        """
        states = self._states(probabilities)
        self._note_convergence(stamps)
        if self._undecided is not None:
            probabilities = np.concatenate([self._undecided[0], probabilities])
            stamps = np.concatenate([self._undecided[1], stamps])
        count = len(states)
        self._undecided = probabilities[count:], stamps[count:]
        segments = self._merge(states, probabilities, stamps[:count], stamps[self._lag :])
        converged_at = self._converged_at
        self.segments_converged |= converged_at is not None and any(
            segment.end > converged_at for segment in segments
        )
        return segments

    def close(self, end: int) -> list[Segment]:
        """Return the remaining segments of a sound that ends, and begin anew.

        Parameters
        ----------
        end : int
            End of the sound, in nanoseconds of UTC.

        Returns
        -------
        list of Segment
            In the order of time.
        """
        segments = []
        if self._smoother is not None and self._undecided is not None:
            probabilities, stamps = self._undecided
            states = self._smoother.close()
            decided_at = np.full(len(states), end)
            segments = self._merge(states, probabilities, stamps, decided_at)
        self._undecided = self._converged_at = None
        self._frames = 0
        segments += self._end_run(end, end)
        self.segments_converged |= bool(segments)
        return segments

    def _states(self, probabilities: Float32) -> Indices:
        if self._smoother is None:
            return probabilities.argmax(axis=1)
        return self._smoother.push(probabilities)

    def _note_convergence(self, stamps: Int64) -> None:
        frames = 1 if self._smoother is None else self._smoother.converged_after
        if self._converged_at is None and frames is not None:
            self._converged_at = int(stamps[frames - 1 - self._frames])
        self._frames += len(stamps)

    def _merge(
        self, states: Indices, probabilities: Float32, stamps: Int64, decided_at: Int64
    ) -> list[Segment]:
        """Add the states of successive frames, decided at these times, to the open run."""
        segments: list[Segment] = []
        starts = np.flatnonzero(np.diff(states, prepend=-1))
        if not len(starts):
            return segments
        confidences = probabilities[np.arange(len(states)), states].astype(np.float64)
        columns = (
            states[starts],
            stamps[starts],
            np.diff(starts, append=len(states)),
            np.add.reduceat(np.rint(confidences * _UNITS).astype(np.int64), starts),
        )
        rows = zip(*(column.tolist() for column in columns), strict=True)
        for run, time in zip(map(Run._make, rows), decided_at[starts].tolist(), strict=True):
            last = self.open_run
            if last is not None and last.label == run.label:
                self.open_run = run.prepend(last)
            else:
                segments += self._end_run(run.start, time)
                self.open_run = run
        return segments

    def _end_run(self, end: int, decided_at: int) -> list[Segment]:
        run, self.open_run = self.open_run, None
        return [] if run is None else [Segment(run, end, decided_at)]
