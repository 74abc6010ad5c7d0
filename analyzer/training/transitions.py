"""The transitions of the hidden Markov model behind smoothing."""

from collections.abc import Sequence

import numpy as np

from hearthlog.models.classes import SILENCE, class_name, find_class
from hearthlog.schemas.arrays import Float64
from hearthlog.schemas.frames import FRAME_SECONDS

LAG_SECONDS = 2.0  # gives the path of the whole sound in 90 minutes of real clips; 1 s does not
REACH_SECONDS = 0.3
SHORTEST_SECONDS = 0.25

_SOUND_AFTER_SOUND = 0.007  # times as likely as it were if all classes were equally likely
_SECONDS = 10.0  # expected duration of a class that is not in the table of classes


def default_transitions(classes: Sequence[str]) -> Float64:
    """Return the transition probabilities of classes by their expected durations.

    A sound is mostly followed by silence, if that is a class, and seldom by another sound: most
    changes from one sound to another are mistakes in the middle of one of them.

    Parameters
    ----------
    classes : sequence of str
        Names of the C classes, at least two; one that `hearthlog.models.classes` does not know
        lasts 10 s.

    Returns
    -------
    np.ndarray [shape=(C, C)], float64
        Probability that a frame of the row's class is followed by one of the column's class.
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
        Names of the C classes; one that `hearthlog.models.classes` does not know lasts 10 s.

    Returns
    -------
    np.ndarray [shape=(C,)], float64
        In seconds.
    """
    rows = map(find_class, classes)
    return np.array([_SECONDS if row is None else row.seconds for row in rows])
