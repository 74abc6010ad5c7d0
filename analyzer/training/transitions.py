"""The transitions of the hidden Markov model behind smoothing."""

from collections.abc import Sequence

import numpy as np

from hearthlog.models.classes import find_class
from hearthlog.schemas.arrays import Float64, Int64
from hearthlog.schemas.frames import FRAME_SECONDS

LAG_SECONDS = 2.0  # gives the path of the whole sound in 90 minutes of real clips; 1 s does not
REACH_SECONDS = 0.3
SHORTEST_SECONDS = 0.25

_SECONDS = 10.0  # expected duration of a class that is not in the table of classes


def default_transitions(classes: Sequence[str]) -> Float64:
    """Return the transition probabilities of classes by their expected durations.

    Parameters
    ----------
    classes : sequence of str
        Names of the C classes; one that `hearthlog.models.classes` does not know lasts 10 s.

    Returns
    -------
    np.ndarray [shape=(C, C)], float64
        Probability that a frame of the row's class is followed by one of the column's class.
    """
    return transitions_from_durations(expected_durations(classes), FRAME_SECONDS)


def expected_durations(classes: Sequence[str]) -> Float64:
    """Return the expected durations of classes.

    Parameters
    ----------
    classes : sequence of str
        Names of the C classes; one that `hearthlog.models.classes` does not know lasts 10 s.

    Returns
    -------
    np.ndarray [shape=(C,)], float64
        In seconds.
    """
    rows = map(find_class, classes)
    return np.array([_SECONDS if row is None else row.seconds for row in rows])


def transitions_from_durations(durations: Float64, frame_seconds: float) -> Float64:
    """Return the transition probabilities of classes with these mean durations.

    All other classes are equally likely to follow a sound.

    Parameters
    ----------
    durations : np.ndarray [shape=(C,)], float64
        In seconds; less than a frame counts as a frame.
    frame_seconds : float
        Length of a frame, in seconds.

    Returns
    -------
    np.ndarray [shape=(C, C)], float64
        Probability that a frame of the row's class is followed by one of the column's class.
    """
    leave = 1.0 / np.maximum(durations / frame_seconds, 1.0)
    count = len(durations)
    if count == 1:
        return np.ones((1, 1))
    transitions = np.repeat(leave[:, np.newaxis] / (count - 1), count, axis=1)
    np.fill_diagonal(transitions, 1.0 - leave)
    return transitions


def count_transitions(
    sequences: Sequence[Int64],
    durations: Float64,
    frame_seconds: float = FRAME_SECONDS,
) -> Float64:
    """Count the transitions in labelled sequences, and add one visit to each class.

    Parameters
    ----------
    sequences : sequence of np.ndarray [shape=(n,)], int64
        Indices of the classes of successive frames.
    durations : np.ndarray [shape=(C,)], float64
        Of the visits that are added, in seconds; less than a frame counts as a frame.
    frame_seconds : float
        Length of a frame, in seconds.

    Returns
    -------
    np.ndarray [shape=(C, C)], float64
        Number of frames of the row's class that are followed by one of the column's class.
    """
    count = len(durations)
    frames = np.maximum(durations / frame_seconds, 1.0)
    counts = transitions_from_durations(durations, frame_seconds) * frames[:, np.newaxis]
    for sequence in sequences:
        pairs = sequence[:-1] * count + sequence[1:]
        counts += np.bincount(pairs, minlength=count * count).reshape(count, count)
    return counts
