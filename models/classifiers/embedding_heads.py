"""Heads on what a network hears: linear ones, and what its names say, mixed with a classifier.

A network that was trained on millions of clips knows sounds of homes that no model has heard, but
not when they begin. So the classifier of the features says what is silence, and all of them
together which sound it is.
"""

from collections.abc import Sequence

import numpy as np

from hearthlog.models.classes import SILENCE
from hearthlog.models.classifiers.description import EmbeddingMix, NamesHead
from hearthlog.models.embedding.embeddings import Int8
from hearthlog.schemas.arrays import Float64, Indices, Int32

# Of weights and biases. A sum of 1024 products of 32 with 8 bits has fewer than 53 bits, so it is
# exact in a float64: the same in any order, and from any BLAS.
UNIT = 2.0**-22
LEAST = 1e-4  # probability of a head or a classifier for a class: none has a veto
UNTAUGHT = -(2**31)  # bias of a class of which a head has learned nothing
_OF_UNTAUGHT = -0.9  # what it says of such a class: as much as of the right one on average, a log
_STEP = 2.0**-20  # of logarithms: what is finer depends on the processor
_ROWS_AT_ONCE = 4096


class EmbeddingHeads:
    """The heads of one model.

    A window's result does not depend on the windows computed together with it, nor on threads.

    Parameters
    ----------
    weights : np.ndarray [shape=(H, W, C)], int32
        Of the linear heads, in units of `UNIT`.
    bias : np.ndarray [shape=(H, C)], int32
        In the same units; `UNTAUGHT` for a class that is left to the other heads.
    """

    def __init__(
        self, mix: EmbeddingMix, weights: Int32, bias: Int32, classes: Sequence[str]
    ) -> None:
        self.network, self.projection_sha256 = mix.network, mix.projection_sha256
        self._classes = len(classes)
        self._sounds = sounds_of(classes)
        self._weights = weights[..., self._sounds].astype(np.float64)
        self._untaught = bias[:, self._sounds] == UNTAUGHT
        self._bias = UNIT * bias[:, self._sounds].astype(np.float64)
        self._of_heads, self._of_home = mix.head_weights, mix.of_home
        names = [classes[number] for number in self._sounds]
        self._names = [_Names(head, names) for head in mix.names]

    def log_probabilities(self, values: Int8) -> Float64:
        """Return what the heads say of windows.

        Parameters
        ----------
        values : np.ndarray [shape=(m, W)], int8
            As they are logged.

        Returns
        -------
        np.ndarray [shape=(m, C)], float64
            Sums of the logarithms of the heads' probabilities, times their weights in the mix, and
            of what a home adds; 0 for silence, of which the heads say nothing.
        """
        result = np.zeros((len(values), self._classes))
        for start in range(0, len(values), _ROWS_AT_ONCE):
            rows = slice(start, start + _ROWS_AT_ONCE)
            result[rows, self._sounds] = self._of_sounds(values[rows])
        return result

    def _of_sounds(self, values: Int8) -> Float64:
        steps, total = values.astype(np.float64), np.zeros((len(values), len(self._sounds)))
        for number, weight in enumerate(self._of_heads):
            taught = ~self._untaught[number]
            by_heads = np.full(total.shape, _OF_UNTAUGHT)
            if taught.any():
                slopes, bias = self._weights[number][:, taught], self._bias[number, taught]
                by_heads[:, taught] = floored(UNIT * (steps @ slopes) + bias)
            total += weight * by_heads
        if self._of_home:
            total += UNIT * (steps @ self._weights[-1]) + self._bias[-1]
        for head in self._names:
            total += head.weight * floored(head.decide(values))
        return np.rint(total / _STEP) * _STEP


class _Names:
    """What the names of a network say of some classes."""

    def __init__(self, head: NamesHead, classes: Sequence[str]) -> None:
        self.weight, self._slope = head.weight, head.slope
        named = [number for number, name in enumerate(classes) if name in head.classes]
        lists = [head.classes[classes[number]] for number in named]
        self._values = np.array([value for one in lists for value in one], np.intp)
        self._starts = np.cumsum([0, *map(len, lists)])[:-1].astype(np.intp)
        self._named = np.array(named, np.intp)
        self._bias = np.array([head.bias.get(name, 0.0) for name in classes])[named]
        self._count = len(classes)

    def decide(self, values: Int8) -> Float64:
        """Return decision values; -inf for classes without names."""
        decisions = np.full((len(values), self._count), -np.inf)
        highest = np.maximum.reduceat(values[:, self._values], self._starts, axis=1)
        decisions[:, self._named] = self._slope * highest.astype(np.float64) + self._bias
        return decisions


def sounds_of(classes: Sequence[str]) -> Indices:
    """Return the numbers of the classes that are no silence."""
    sounds = [number for number, name in enumerate(classes) if name != SILENCE]
    return np.array(sounds, np.intp)


def floored(decisions: Float64) -> Float64:
    """Return the logarithms of probabilities, of which none is below about `LEAST`.

    Parameters
    ----------
    decisions : np.ndarray [shape=(n, C)], float64
        -inf is allowed, but not for a whole row.
    """
    grown = np.exp(decisions - decisions.max(axis=1, keepdims=True))
    logarithms: Float64 = np.log(grown / grown.sum(axis=1, keepdims=True) + LEAST)
    return logarithms


def mixed(
    decisions: Float64, by_heads: Float64, mix: EmbeddingMix, classes: Sequence[str]
) -> Float64:
    """Mix what a classifier and heads say.

    Silence has the probability that the classifier gives it; the classes of sound share the rest.

    Parameters
    ----------
    decisions : np.ndarray [shape=(n, C)], float64
        Logarithms of the probabilities of a classifier, plus any constant for each row.
    by_heads : np.ndarray [shape=(n, C)], float64
        As `EmbeddingHeads.log_probabilities` gives them.

    Returns
    -------
    np.ndarray [shape=(n, C)], float64
        Logarithms of probabilities.
    """
    sounds = sounds_of(classes)
    of_sounds = decisions[:, sounds]
    total = mix.machine_weight * floored(of_sounds) + by_heads[:, sounds]
    total /= mix_weight(mix)
    total += np.array([mix.bias.get(classes[number], 0.0) for number in sounds])
    total *= mix.inverse_temperature
    result = np.empty_like(decisions)
    result[:, sounds] = total - _log_sum(total) + _log_sum(of_sounds) - _log_sum(decisions)
    if len(sounds) < len(classes):
        silence = list(classes).index(SILENCE)
        result[:, silence] = decisions[:, silence] - _log_sum(decisions)[:, 0]
    return result


def mix_weight(mix: EmbeddingMix) -> float:
    """Return the sum of all weights of a mix."""
    return sum(mix.head_weights) + sum(head.weight for head in mix.names) + mix.machine_weight


def _log_sum(values: Float64) -> Float64:
    """Return the logarithms of sums of exponentials, shape (n, 1)."""
    highest = values.max(axis=1, keepdims=True)
    total: Float64 = np.log(np.exp(values - highest).sum(axis=1, keepdims=True)) + highest
    return total
