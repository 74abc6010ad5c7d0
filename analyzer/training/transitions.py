"""Transition probabilities of classes: from a table of durations, and learned in a home."""

from collections.abc import Sequence

import numpy as np

from hearthlog.models.classes import SILENCE, class_name, find_class
from hearthlog.schemas.arrays import Float64, Indices
from hearthlog.schemas.frames import FRAME_SECONDS

_SOUND_AFTER_SOUND = 0.007  # relative to equally likely classes
_DURATION_SECONDS = 10.0  # of a class outside the table of classes


def default_transitions(classes: Sequence[str]) -> Float64:
    """Return transition probabilities of classes from their expected durations.

    A sound is mostly followed by silence, if that is a class, and seldom by another sound: most
    changes from one sound to another are errors within one of them.

    Parameters
    ----------
    classes : sequence of str
        Names of the C classes, at least two; a class outside `hearthlog.models.classes` lasts 10 s.

    Returns
    -------
    np.ndarray [shape=(C, C)], float64
        Probability of the column's class in the frame after a frame of the row's class.
    """
    leave = 1.0 / np.maximum(expected_durations(classes) / FRAME_SECONDS, 1.0)
    is_sound = np.array([class_name(name) != SILENCE for name in classes])
    following = np.where(np.outer(is_sound, is_sound), _SOUND_AFTER_SOUND, 1.0)
    np.fill_diagonal(following, 0.0)
    transitions: Float64 = following * (leave / following.sum(axis=1))[:, np.newaxis]
    np.fill_diagonal(transitions, 1.0 - leave)
    return transitions


def expected_durations(classes: Sequence[str]) -> Float64:
    """Return the expected durations of classes.

    Parameters
    ----------
    classes : sequence of str
        Names of the C classes; a class outside `hearthlog.models.classes` lasts 10 s.

    Returns
    -------
    np.ndarray [shape=(C,)], float64
        In seconds.
    """
    rows = map(find_class, classes)
    return np.array([_DURATION_SECONDS if row is None else row.seconds for row in rows])


_PRIOR_FRAMES = 500.0  # that the table counts for, in each class


def learned_transitions(classes: Sequence[str], paths: Sequence[Indices]) -> Float64:
    """Learn transition probabilities from the true classes of a home's frames.

    The most probable ones given the paths, where the rows of `default_transitions` are the prior
    (Dirichlet, as if 500 frames of each class had been seen).

    Parameters
    ----------
    paths : sequence of np.ndarray [shape=(n,)], intp
        Index of the true class in each of n successive frames, without a gap.

    Returns
    -------
    np.ndarray [shape=(C, C)], float64
        As of `default_transitions`.
    """
    table = default_transitions(classes)
    paths = [path for path in paths if len(path) > 1]
    if not paths:
        return table
    from hmmlearn.hmm import CategoricalHMM  # noqa: PLC0415  not yet for Python 3.14

    count = len(classes)
    # Each state shows itself, so that a single step of expectation and maximisation is exact.
    model = CategoricalHMM(count, transmat_prior=1 + _PRIOR_FRAMES * table, n_iter=1, params="t")
    model.init_params, model.n_features = "", count
    model.startprob_, model.transmat_ = np.full(count, 1 / count), table
    model.emissionprob_ = np.eye(count)
    with np.errstate(divide="ignore"):  # logarithms of zeros
        model.fit(np.concatenate(paths)[:, np.newaxis], [len(path) for path in paths])
    learned: Float64 = model.transmat_
    return learned
