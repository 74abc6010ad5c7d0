"""Smoothing: fixed-lag Viterbi decoding of the classifier's probabilities.

The algorithm is from Viterbi, "Error bounds for convolutional codes", 1967; each state is decided a
fixed number of frames later.
"""

from typing import NamedTuple

import numpy as np

from hearthlog.schemas.arrays import Float32, Float64, Indices

_TINY = 1e-38  # about the smallest normal float32
_LEAST = np.log(1e-6)  # so that no single frame excludes a class
# Logarithms are rounded to multiples of this step, so their sums are exact. The path is then
# independent of when the scores are rescaled to zero, and of frames long past.
_STEP = 2.0**-30
_FRAMES_AT_ONCE = 4096
_LANE = 64  # frames
_WARM_UP = 32  # frames; in dense sound half of the lanes need more
_FEWEST_LANES = 3


class ClassesApart(NamedTuple):
    """How uncertainty between sound classes is kept from favouring silence."""

    silence: int
    exponent: float


def log_likelihoods(
    probabilities: Float32, weight: float, apart: ClassesApart | None = None
) -> Float64:
    """Convert probabilities [shape=(n, C)] to finite log-likelihoods of a hidden Markov model.

    Classes are trained with equal weights, so their prior is uniform.
    """
    logarithms = np.log(np.maximum(probabilities, _TINY, dtype=np.float64))
    if apart is not None:
        logarithms = _with_classes_apart(logarithms, probabilities, apart)
    return _rounded(np.maximum(weight * logarithms, _LEAST))


def _with_classes_apart(
    logarithms: Float64, probabilities: Float32, apart: ClassesApart
) -> Float64:
    sounds = np.delete(np.arange(logarithms.shape[1]), apart.silence)
    likeliest = logarithms[:, sounds].max(axis=1, keepdims=True)
    sound = 1.0 - probabilities[:, apart.silence].astype(np.float64)
    result = apart.exponent * (logarithms - likeliest)
    result += np.log(np.maximum(sound, _TINY))[:, np.newaxis]
    result[:, apart.silence] = logarithms[:, apart.silence]
    return result


class FixedLagSmoother:
    """Decides the state of each frame `lag_frames` frames later.

    The decided state lies on the likeliest path up to that later frame. It equals the Viterbi state
    over the complete sound unless still later frames change the path. The same frames give the same
    states in blocks of any size. `transitions` [shape=(C, C)] is the probability of the column's
    class after a frame of the row's class; the first frame may be of any class. The states are
    independent of earlier sound from the last of `converged_after` frames on; None if not yet
    reached.
    """

    def __init__(
        self,
        transitions: Float64,
        lag_frames: int,
        weight: float = 1.0,
        apart: ClassesApart | None = None,
    ) -> None:
        with np.errstate(divide="ignore"):  # log(0) means never
            self._transitions = _rounded(np.log(transitions))
        self._to_each = np.ascontiguousarray(self._transitions.T)
        self._lag = lag_frames
        self._weight = weight
        self._apart = apart
        self._restart()

    def forget(self) -> None:
        """Mark all frames so far as unconverged for `converged_after`."""
        count = len(self._transitions)
        self.converged_after: int | None = None
        # Scores for a sound that begins in each of the states: once they differ only by constants,
        # any other beginning would have led to the same path.
        self._scores_from = np.where(np.eye(count, dtype=bool), 0.0, -np.inf)

    def push(self, probabilities: Float32) -> Indices:
        """Add probabilities [shape=(n, C)], 0 to 1; return the states now decided [shape=(m,)].

        They follow those already decided, up to `lag_frames` before the last frame.
        """
        starts = range(0, len(probabilities), _FRAMES_AT_ONCE)
        blocks = (probabilities[start : start + _FRAMES_AT_ONCE] for start in starts)
        parts = [self._push(log_likelihoods(block, self._weight, self._apart)) for block in blocks]
        return np.concatenate([np.empty(0, np.intp), *parts])

    def close(self) -> Indices:
        """Return the states of the remaining frames, at most `lag_frames`, and reset."""
        states = np.empty(len(self._back), np.intp)
        if len(states):
            states[-1] = self._score.argmax()
        for frame in range(len(states) - 1, 0, -1):
            states[frame - 1] = self._back[frame, states[frame]]
        self._restart()
        return states

    def _restart(self) -> None:
        count = len(self._transitions)
        self._count = 0  # number of frames so far
        self._score = np.zeros(count)  # score of the likeliest path to each state
        self._back = np.empty((0, count), np.intp)  # best predecessors of undecided frames
        self.forget()

    def _push(self, observed: Float64) -> Indices:
        count = len(observed)
        steps = observed if self._count else observed[1:]
        start = self._score if self._count else observed[0]
        self._count += count
        if self.converged_after is None:
            self._note_convergence(steps)
        scores = _forward_in_lanes(self._transitions, start, steps)
        back = np.zeros((count, len(start)), np.intp)
        # Sources last: numpy finds the largest of adjacent values three times as fast.
        reached = scores[:-1, np.newaxis] + self._to_each
        reached.argmax(axis=2, out=back[count - len(steps) :])
        best = scores[-count:].argmax(axis=1)
        self._score = scores[-1] - scores[-1].max()
        return self._decide(back, best)

    def _decide(self, back: Indices, best: Indices) -> Indices:
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

    def _note_convergence(self, steps: Float64) -> None:
        before = self._count - len(steps)
        for start in range(0, len(steps), _LANE):
            part = steps[start : start + _LANE, :, np.newaxis]
            scores = _forward(self._transitions, self._scores_from, part)
            scores -= scores.max(axis=1, keepdims=True)
            self._scores_from = scores[-1]
            same = (scores == scores[..., :1]).all(axis=(1, 2))
            if same[-1]:  # so they stay
                end = before + start + len(part)
                self.converged_after = end - int(same[::-1].argmin()) + 1
                return


def _forward_in_lanes(transitions: Float64, start: Float64, observed: Float64) -> Float64:
    """Score as `_forward` does, up to a constant per frame, in lanes that run in parallel.

    All lanes but the first start from a guess: an uninformed start some frames earlier. A lane
    whose guess differs from the end of the lane before it is scored again from there. As the sums
    are exact, the final result is exact.
    """
    count = -(-len(observed) // _LANE)
    if count < _FEWEST_LANES:
        return _forward(transitions, start, observed)
    classes = len(transitions)
    lanes = np.zeros((count, _LANE, classes))
    lanes.reshape(-1, classes)[: len(observed)] = observed
    lanes = np.ascontiguousarray(lanes.transpose(1, 2, 0))
    unknown = np.zeros((classes, count - 1))
    guesses = _forward(transitions, unknown, lanes[-_WARM_UP:, :, :-1])[-1]
    starts = _normalized(np.concatenate([start[:, np.newaxis], guesses], axis=1))
    scores = _forward(transitions, starts, lanes)
    while True:
        ends = _normalized(scores[-1, :, :-1])
        wrong = np.flatnonzero((ends != scores[0, :, 1:]).any(axis=0))
        if not len(wrong):
            break
        again = np.ascontiguousarray(lanes[..., wrong + 1])
        scores[..., wrong + 1] = _forward(transitions, ends[:, wrong], again)
    successive = scores[1:].transpose(2, 0, 1).reshape(-1, classes)[: len(observed)]
    return np.concatenate([scores[:1, :, 0], successive])


def _normalized(scores: Float64) -> Float64:
    return scores - scores.max(axis=0)


def _forward(transitions: Float64, start: Float64, observed: Float64) -> Float64:
    """Score the likeliest path to each state of each frame [shape=(n + 1, C) or (n + 1, C, k)].

    `observed` has [shape=(n, C), (n, C, 1) or (n, C, k)], `transitions` [shape=(C, C)]. `start`
    [shape=(C,) or (C, k)], the first row, has the scores of the previous frame, for k sounds.
    """
    scores = np.empty((len(observed) + 1, *start.shape))
    scores[0] = start
    reached = np.empty((len(start), *start.shape))
    if start.ndim > 1:
        transitions = transitions[..., np.newaxis]
    steps = zip(scores[:-1, :, np.newaxis], scores[1:], observed, strict=True)
    for before, after, likelihoods in steps:
        np.add(before, transitions, out=reached)
        np.maximum.reduce(reached, axis=0, out=after)
        np.add(after, likelihoods, out=after)
    return scores


def _rounded(logarithms: Float64) -> Float64:
    return np.round(logarithms / _STEP) * _STEP
