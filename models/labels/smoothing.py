"""Smoothing: the likeliest path through a hidden Markov model, some frames after the sound."""

import numpy as np
from numpy.typing import NDArray

from hearthlog.schemas.arrays import Float32, Float64

_FLOOR = 1e-6  # of a probability: no single frame forbids a class
# Logarithms are rounded to multiples of this, so that their sums are exact. The path then does not
# depend on when the scores are brought back to zero, nor on what is long past.
_STEP = 2.0**-30
_FRAMES_AT_ONCE = 4096
_LANE = 128  # frames
_WARM_UP = 64  # frames; in real sound 99 of 100 beginnings are forgotten after 32

States = NDArray[np.intp]


def log_likelihoods(probabilities: Float32) -> Float64:
    """Turn the probabilities of a classifier into what a hidden Markov model observes.

    They are taken for likelihoods as they are: classes are trained with even weights, so their
    prior is uniform. That successive windows overlap by 19 frames of 20, and say nearly the same,
    would speak for a smaller weight, but any smaller one loses single coughs (docs/models.md).

    Parameters
    ----------
    probabilities : np.ndarray [shape=(n, C)], float32

    Returns
    -------
    np.ndarray [shape=(n, C)], float64
        Finite.
    """
    return _rounded(np.log(np.maximum(probabilities, _FLOOR, dtype=np.float64)))


class FixedLagSmoother:
    """Decides the state of each frame once `lag_frames` more are known.

    It is the state on the likeliest path up to the last of these: that of Viterbi over the whole
    sound where later frames do not change it. The same frames give the same states in blocks of
    any size.

    Parameters
    ----------
    transitions : np.ndarray [shape=(C, C)], float64
        Probability of each column's class in the frame after one of the row's class. Any class
        may be the first.
    lag_frames : int

    Attributes
    ----------
    settled : int or None
        After how many frames sound before the first one would have left no trace: the states from
        the last of these on do not depend on it. None if that is later.
    """

    def __init__(self, transitions: Float64, lag_frames: int) -> None:
        with np.errstate(divide="ignore"):  # never: minus infinity
            self._transitions = _rounded(np.log(transitions))
        self._lag = lag_frames
        self._restart()

    def push(self, probabilities: Float32) -> States:
        """Add successive frames and return the states that they decide.

        Parameters
        ----------
        probabilities : np.ndarray [shape=(n, C)], float32

        Returns
        -------
        np.ndarray [shape=(m,)], intp
            Of the frames that follow those decided before, up to `lag_frames` before the last.
        """
        starts = range(0, len(probabilities), _FRAMES_AT_ONCE)
        blocks = (probabilities[start : start + _FRAMES_AT_ONCE] for start in starts)
        parts = [self._push(log_likelihoods(block)) for block in blocks]
        return np.concatenate([np.empty(0, np.intp), *parts])

    def close(self) -> States:
        """Return the states of the frames that are left, and begin anew."""
        states = np.empty(len(self._back), np.intp)
        if len(states):
            states[-1] = self._score.argmax()
        for frame in range(len(states) - 1, 0, -1):
            states[frame - 1] = self._back[frame, states[frame]]
        self._restart()
        return states

    def _restart(self) -> None:
        count = len(self._transitions)
        self.settled: int | None = None
        self._count = 0  # of frames
        self._score = np.zeros(count)  # of the likeliest path to each state
        self._back = np.empty((0, count), np.intp)  # of each frame that is not decided
        # Scores if the sound had begun in each of the states: once they are the same but for a
        # constant, any other beginning would have led to them too.
        self._scores_from = np.where(np.eye(count, dtype=bool), 0.0, -np.inf)

    def _push(self, observed: Float64) -> States:
        count = len(observed)
        steps = observed if self._count else observed[1:]
        start = self._score if self._count else observed[0]
        self._count += count
        if self.settled is None:
            self._settle(steps)
        scores = _forward_in_lanes(self._transitions, start, steps)
        back = np.zeros((count, len(start)), np.intp)
        reached = scores[:-1, :, np.newaxis] + self._transitions
        reached.argmax(axis=1, out=back[count - len(steps) :])
        best = scores[-count:].argmax(axis=1)
        self._score = scores[-1] - scores[-1].max()
        return self._decide(back, best)

    def _decide(self, back: States, best: States) -> States:
        """Trace back from the best state of each new frame to the frame `lag_frames` before it."""
        back = np.concatenate([self._back, back])
        decided = max(len(back) - self._lag, 0)
        self._back = back[decided:]
        states = best[len(best) - decided :]
        if not decided:
            return states
        frames = np.arange(self._lag, len(back))
        for lag in range(self._lag):
            states = back[frames - lag, states]
        return states

    def _settle(self, steps: Float64) -> None:
        scores = _forward(self._transitions, self._scores_from, steps[..., np.newaxis])
        scores -= scores.max(axis=1, keepdims=True)
        self._scores_from = scores[-1]
        same = (scores == scores[..., :1]).all(axis=(1, 2))
        if same[-1]:
            self.settled = self._count - int(same[::-1].argmin()) + 1


def _forward_in_lanes(transitions: Float64, start: Float64, observed: Float64) -> Float64:
    """Score as `_forward` does, but for constants that scores of one frame have in common.

    The frames are divided into lanes, scored side by side: each from some frames before it on,
    as if nothing was known there. Where that led to what the lane before ends with, it is right,
    for the sums are exact; elsewhere the lane is scored once more.
    """
    count = len(observed) // _LANE - 1  # the first lane has no frames before it
    if count < 2:
        return _forward(transitions, start, observed)
    frames = np.arange(_LANE + _WARM_UP)[:, np.newaxis] + _LANE * np.arange(1, count + 1) - _WARM_UP
    side_by_side = observed[frames].transpose(0, 2, 1)
    unknown = np.zeros((len(transitions), count))
    lanes = _forward(transitions, unknown, np.ascontiguousarray(side_by_side))[_WARM_UP:]
    scores = np.empty((len(observed) + 1, len(transitions)))
    scores[: _LANE + 1] = _forward(transitions, start, observed[:_LANE])
    for lane in range(count):
        begin = (lane + 1) * _LANE
        guess, place = lanes[..., lane], slice(begin, begin + _LANE + 1)
        if (guess[0] - guess[0].max() == scores[begin] - scores[begin].max()).all():
            scores[place] = guess
        else:
            scores[place] = _forward(transitions, scores[begin], observed[begin : begin + _LANE])
    end = (count + 1) * _LANE
    scores[end:] = _forward(transitions, scores[end], observed[end:])
    return scores


def _forward(transitions: Float64, start: Float64, observed: Float64) -> Float64:
    """Score the likeliest path to each state of each frame.

    Parameters
    ----------
    transitions : np.ndarray [shape=(C, C)], float64
    start : np.ndarray [shape=(C,) or (C, k)], float64
        Scores of the frame before, of k sounds.
    observed : np.ndarray [shape=(n, C), (n, C, 1) or (n, C, k)], float64

    Returns
    -------
    np.ndarray [shape=(n + 1, C) or (n + 1, C, k)], float64
        The first is `start`.
    """
    scores = np.empty((len(observed) + 1, *start.shape))
    scores[0] = start
    reached = np.empty((len(start), *start.shape))
    if start.ndim > 1:
        transitions = transitions[..., np.newaxis]
    steps = zip(scores[:-1, :, np.newaxis], scores[1:], observed, strict=True)
    for before, after, seen in steps:
        np.add(before, transitions, out=reached)
        np.maximum.reduce(reached, axis=0, out=after)
        np.add(after, seen, out=after)
    return scores


def _rounded(logarithms: Float64) -> Float64:
    return np.round(logarithms / _STEP) * _STEP
