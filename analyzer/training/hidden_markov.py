"""Likeliest path of the hidden Markov model over a sound, by hmmlearn (not yet for Python 3.14)."""

import numpy as np
from hmmlearn.base import BaseHMM

from hearthlog.models.labels.smoothing import log_likelihoods
from hearthlog.schemas.arrays import Float32, Float64, Indices


def viterbi(probabilities: Float32, transitions: Float64, weight: float = 1.0) -> Indices:
    """Decode the likeliest path [shape=(n,)] through a complete sound; its first class is any.

    `probabilities` [shape=(n, C)] are 0 to 1; `transitions` [shape=(C, C)] of a frame of the row's
    class to one of the column's class. Source: Viterbi, "Error bounds for convolutional codes",
    1967.
    """
    count = len(transitions)
    model = _LikelihoodHMM(count)
    model.startprob_ = np.full(count, 1.0 / count)
    model.transmat_ = transitions
    return model.predict(log_likelihoods(probabilities, weight))


class _LikelihoodHMM(BaseHMM):  # type: ignore[misc]
    """A hidden Markov model whose observations are the log-likelihoods of its states."""

    def _compute_log_likelihood(self, X: Float64) -> Float64:  # noqa: N803
        return X
