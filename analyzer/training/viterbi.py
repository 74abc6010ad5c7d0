"""The likeliest path through the whole of a sound at once, by hmmlearn, which smoothing comes to.

hmmlearn has no wheel for Python 3.14 yet; nothing but this module needs it.
"""

import numpy as np
from hmmlearn.base import BaseHMM

from hearthlog.models.labels.smoothing import Indices, log_likelihoods
from hearthlog.schemas.arrays import Float32, Float64


def viterbi(probabilities: Float32, transitions: Float64) -> Indices:
    """Return the likeliest path through a sound, shape (n,).

    Parameters
    ----------
    probabilities : np.ndarray [shape=(n, C)], float32
        Of a classifier, frame by frame.
    transitions : np.ndarray [shape=(C, C)], float64
    """
    path: Indices = _model(transitions).predict(log_likelihoods(probabilities))
    return path


def smoothed(probabilities: Float32, transitions: Float64) -> Float64:
    """Return the probability of each class at each frame, given the whole sound.

    Takes what `viterbi` takes; gives an array of shape (n, C), float64.
    """
    posteriors: Float64 = _model(transitions).predict_proba(log_likelihoods(probabilities))
    return posteriors


def _model(transitions: Float64) -> "_ObservedHMM":
    count = len(transitions)
    model = _ObservedHMM(count)
    model.startprob_ = np.full(count, 1.0 / count)
    model.transmat_ = transitions
    return model


class _ObservedHMM(BaseHMM):  # type: ignore[misc]
    """A hidden Markov model that observes the log-likelihoods of its states themselves."""

    def _compute_log_likelihood(self, X: Float64) -> Float64:  # noqa: N803
        return X
