"""Segments from the probabilities of classes: successive frames of one state, merged.

The state of a frame is the likeliest class, which is the paper's first way (section 4), or that of
the likeliest path through a hidden Markov model, which is decided some frames later.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hearthlog.models.classes import SILENCE
from hearthlog.models.classifiers.description import Smoothing
from hearthlog.models.labels.borders import Borders
from hearthlog.models.labels.smoothing import ClassesApart, FixedLagSmoother
from hearthlog.schemas.arrays import Float32, Float64, Indices, Int64
from hearthlog.schemas.frames import FRAME_SECONDS

_UNITS = 1 << 30  # to 1: finer than what a float32 below 1 can tell


class Run(NamedTuple):
    """Successive frames of one state, of which more may follow.

    Attributes
    ----------
    start : int
        Start of the first frame, in nanoseconds of UTC.
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
        """
        if earlier is None:
            return self
        frames, confidence = earlier.frames + self.frames, earlier.confidence + self.confidence
        return earlier._replace(frames=frames, confidence=confidence)


class Segment(NamedTuple):
    """A run that has ended.

    Attributes
    ----------
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


class LabelledFrames(NamedTuple):
    """Successive frames with the probabilities of classes.

    Attributes
    ----------
    probabilities : np.ndarray [shape=(n, C)], float32
    powers : np.ndarray [shape=(n,)]
        Mean squares of the samples.
    stamps : np.ndarray [shape=(n,)], int64
        Starts of the frames in nanoseconds of UTC.
    known_at : np.ndarray [shape=(n,)], int64
        Starts of the frames with which the probabilities became known.
    """

    probabilities: Float32
    powers: NDArray[Any]
    stamps: Int64
    known_at: Int64

    def followed_by(self, later: "LabelledFrames") -> "LabelledFrames":
        """Join these frames with those that follow."""
        return LabelledFrames(
            np.concatenate([self.probabilities, later.probabilities]),
            np.concatenate([self.powers, later.powers]),
            np.concatenate([self.stamps, later.stamps]),
            np.concatenate([self.known_at, later.known_at]),
        )

    def part(self, frames: slice) -> "LabelledFrames":
        """Return some of the frames."""
        return LabelledFrames(
            self.probabilities[frames],
            self.powers[frames],
            self.stamps[frames],
            self.known_at[frames],
        )


class Segmenter:
    """Divides one stream of frames into segments, as a model's smoothing says.

    Parameters
    ----------
    classes : sequence of str
        Names behind the columns of the probabilities.
    transitions : np.ndarray [shape=(C, C)], float64
        Transition probabilities of the hidden Markov model; unused where segments are merged.

    Attributes
    ----------
    segments_converged : bool
        Whether frames before the first one would leave no trace in the segments to come.
    """

    def __init__(self, classes: Sequence[str], smoothing: Smoothing, transitions: Float64) -> None:
        self._smoother, lag = None, 0
        silence = classes.index(SILENCE) if SILENCE in classes else -1
        if smoothing.method == "hmm":
            lag, exponent = _frames(smoothing.lag_seconds), smoothing.class_exponent
            apart = (
                ClassesApart(silence, exponent) if exponent is not None and silence >= 0 else None
            )
            self._smoother = FixedLagSmoother(transitions, lag, smoothing.weight, apart)
        self._reach = _frames(smoothing.reach_seconds) if silence >= 0 else 0
        shortest = max(_frames(smoothing.shortest_seconds), 1)
        self._borders = Borders(silence, self._reach, shortest)
        self._forgetting = 2 * self._reach + shortest  # equal states, after which borders converge
        self._delay = lag + self._borders.delay
        self.segments_converged = False
        self.open_run: Run | None = None
        self._restart()

    def _restart(self) -> None:
        self._undecided: LabelledFrames | None = None
        self._decided = 0  # number of frames whose states are decided
        self._states = 0  # number of states so far, before their borders are moved
        self._doubtful = 0  # number of frames that may depend on those before the first one
        self._same = -1, 0  # the last of them that have converged: their value and number
        self._converged_at: int | None = None  # stamp from which on states have converged

    @property
    def states_converged(self) -> bool:
        """Whether frames before the first one would leave no trace in the states to come."""
        if self._undecided is None or self._converged_at is None:
            return False
        stamps = self._undecided.stamps
        return not len(stamps) or self._converged_at <= int(stamps[0])

    def discard_open(self) -> None:
        """Set the counts of the open run to zero; its label and start stay."""
        if self.open_run is not None:
            self.open_run = self.open_run._replace(frames=0, confidence=0)

    def forget(self) -> None:
        """Doubt all frames so far: only later ones count for `segments_converged`."""
        undecided = 0 if self._undecided is None else len(self._undecided.stamps)
        self._doubtful = self._decided + undecided
        self._same, self._converged_at, self.segments_converged = (-1, 0), None, False
        if self._smoother is not None:
            self._smoother.forget()

    def push(self, frames: LabelledFrames) -> list[Segment]:
        """Add successive frames and return the segments whose end they decide.

        Parameters
        ----------
        frames : LabelledFrames
            At least one.
        """
        states = frames.probabilities.argmax(axis=1)
        if self._smoother is not None:
            states = self._smoother.push(frames.probabilities)
        refined = self._borders.push(states, frames.powers)
        if self._undecided is not None:
            frames = self._undecided.followed_by(frames)
        self._note_convergence(states, frames.stamps)
        count = len(refined)
        self._decided += count
        self._undecided = frames.part(slice(count, None))
        segments = self._merge(refined, frames.part(slice(count)), frames.known_at[self._delay :])
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
        """
        segments = []
        if self._undecided is not None:
            states = np.empty(0, np.intp) if self._smoother is None else self._smoother.close()
            early = self._borders.push(states, np.empty(0))
            refined = np.concatenate([early, self._borders.close()])
            decided_at = np.full(len(refined), end)
            segments = self._merge(refined, self._undecided, decided_at)
        self._restart()
        segments += self._end_run(end, end)
        self.segments_converged |= bool(segments)
        return segments

    def _note_convergence(self, states: Indices, stamps: Int64) -> None:
        """Note from when on states have converged; `stamps` are those of all undecided frames.

        Borders have where enough states that have are equal.
        """
        first = self._states
        self._states += len(states)
        after = self._doubtful + 1 if self._smoother is None else self._smoother.converged_after
        if self._converged_at is not None or after is None:
            return
        states, first = states[max(after - 1 - first, 0) :], max(after - 1, first)
        if not len(states):
            return
        starts = np.flatnonzero(np.diff(states, prepend=-1))
        lengths = np.diff(starts, append=len(states))
        value, before = self._same
        if states[0] == value:
            starts[0] -= before
            lengths[0] += before
        enough = np.flatnonzero(lengths >= self._forgetting)
        if len(enough):
            frame = first + int(starts[enough[0]]) + self._reach
            self._converged_at = int(stamps[frame - self._decided])
        self._same = int(states[-1]), int(lengths[-1])

    def _merge(self, states: Indices, frames: LabelledFrames, decided_at: Int64) -> list[Segment]:
        """Add the states of successive frames, decided at these times, to the open run."""
        segments: list[Segment] = []
        starts = np.flatnonzero(np.diff(states, prepend=-1))
        if not len(starts):
            return segments
        confidences = frames.probabilities[np.arange(len(states)), states].astype(np.float64)
        columns = (
            states[starts],
            frames.stamps[starts],
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


def _frames(seconds: float) -> int:
    return round(seconds / FRAME_SECONDS)
