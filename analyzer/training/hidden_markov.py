"""The hidden Markov model over a whole sound, by hmmlearn: its likeliest path, and its learning.

hmmlearn has no wheel for Python 3.14 yet; nothing but this module needs it.
"""

import warnings
from collections.abc import Sequence

import numpy as np
from hmmlearn.base import BaseHMM

from hearthlog.models.labels.smoothing import log_likelihoods
from hearthlog.schemas.arrays import Float32, Float64, Indices

_ROUNDS = 10
# The windows of frames overlap, so that a wrong label comes in runs. If frames counted as in
# decoding, each run would be a sound of its own.
_SHARE_OF_FRAME = 0.25


def viterbi(probabilities: Float32, transitions: Float64, weight: float = 1.0) -> Indices:
    """Decode the likeliest path through a whole sound; all classes are equally likely to begin it.

    Parameters
    ----------
    probabilities : np.ndarray [shape=(n, C)], float32
        Of the classes, frame by frame, 0 to 1.
    transitions : np.ndarray [shape=(C, C)], float64
        Probability that a frame of the row's class is followed by one of the column's class.
    weight : float
        As of `log_likelihoods`.

    Returns
    -------
    np.ndarray [shape=(n,)], intp
        Index of the class of each frame.

    References
    ----------
    Viterbi, "Error bounds for convolutional codes", 1967.
    """
    count = len(transitions)
    model = _LikelihoodHMM(count)
    model.startprob_ = np.full(count, 1.0 / count)
    model.transmat_ = transitions
    path: Indices = model.predict(log_likelihoods(probabilities, weight))
    return path


def learn_transitions(sound: Sequence[Float32], counts: Float64, weight: float) -> Float64:
    """Estimate transition probabilities from sound without labels.

    By expectation maximisation: Baum et al., "A maximization technique occurring in the
    statistical analysis of probabilistic functions of Markov chains", 1970. The likelihoods are
    those of a classifier, and are not learned.

    Parameters
    ----------
    sound : sequence of np.ndarray [shape=(n, C)], float32
        Probabilities that the classifier gives to successive frames.
    counts : np.ndarray [shape=(C, C)], float64
        Transitions that are known, from `count_transitions`; all are positive.
    weight : float
        As of `hearthlog.models.labels.smoothing.log_likelihoods`.

    Returns
    -------
    np.ndarray [shape=(C, C)], float64
        Probability that a frame of the row's class is followed by one of the column's class.
    """
    transitions: Float64 = counts / counts.sum(axis=1, keepdims=True)
    sound = [part for part in sound if len(part)]
    if not sound:
        return transitions
    model = _Transitions(len(counts), weight * _SHARE_OF_FRAME)
    model.startprob_ = np.full(len(counts), 1.0 / len(counts))
    model.startprob_prior = 1.0
    model.transmat_ = transitions
    model.transmat_prior = 1.0 + counts
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # hmmlearn 0.3.3 with NumPy 2.5
        model.fit(np.concatenate(sound), [len(part) for part in sound])
    return model.transmat_


class _LikelihoodHMM(BaseHMM):  # type: ignore[misc]
    """A hidden Markov model whose observations are the log-likelihoods of its states."""

    def _compute_log_likelihood(self, X: Float64) -> Float64:  # noqa: N803
        return X


class _Transitions(BaseHMM):  # type: ignore[misc]
    """A hidden Markov model that learns its transitions only."""

    def __init__(self, count: int, weight: float) -> None:
        super().__init__(
            count, n_iter=_ROUNDS, params="t", init_params="", implementation="scaling"
        )
        self.weight = weight

    def _compute_likelihood(self, probabilities: Float32) -> Float64:
        return np.exp(log_likelihoods(probabilities, self.weight))

    def _compute_lower_bound(self, log_likelihood: float) -> float:
        return log_likelihood + float(np.sum((self.transmat_prior - 1.0) * np.log(self.transmat_)))

    def _check(self) -> None:
        """Everything is set by the caller."""

    def _get_n_fit_scalars_per_param(self) -> dict[str, int]:
        return {"t": self.n_components**2}
