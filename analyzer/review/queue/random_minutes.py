"""Whole minutes drawn at random, which measure how right the labels of a home are."""

from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.logs.labelling import Labelling
from hearthlog.analyzer.logs.spans import NONE, Spans, common, joined, lengths
from hearthlog.models.classes import SILENCE, class_name
from hearthlog.schemas.arrays import Bool, Int64
from hearthlog.schemas.frames import NANOSECONDS

MINUTE = 60 * NANOSECONDS
SOUND_SHARE = 0.75  # of the minutes that are drawn has a sound, so that nights take no one's time
_SEED = 20_261_123
_UNLABELLED = NANOSECONDS // 10  # in a minute at most


class Minutes(NamedTuple):
    """Minutes of the clock that are labelled from start to end.

    Attributes
    ----------
    starts : np.ndarray [shape=(n,)], int64
        In nanoseconds of UTC, ascending.
    has_sound : np.ndarray [shape=(n,)], bool
        Whether a label in it is none of silence.
    """

    starts: Int64
    has_sound: Bool


def whole_minutes(labelling: Labelling) -> Minutes:
    """Find the minutes of a labelling, and tell those with a sound from those without."""
    if not len(labelling):
        return Minutes(np.empty(0, np.int64), np.empty(0, bool))
    stretches = joined(labelling.starts, labelling.ends, _UNLABELLED)
    numbers = [
        np.arange(-(-start // MINUTE), end // MINUTE)
        for start, end in zip(stretches.starts.tolist(), stretches.ends.tolist(), strict=True)
    ]
    starts = np.concatenate(numbers) * MINUTE
    names = {name: class_name(name) != SILENCE for name in set(labelling.labels)}
    loud = np.array([names[name] for name in labelling.labels], bool)
    sounds = joined(labelling.starts[loud], labelling.ends[loud])
    return Minutes(starts, _length_in(sounds, starts) > 0)


def draw_minutes(
    minutes: Minutes, count: int, drawn: Collection[int] = (), taken: Spans = NONE
) -> Int64:
    """Draw minutes at random, three of four of those with a sound.

    The same minutes and the same earlier draws give the same ones.

    Parameters
    ----------
    count : int
        How many, at most.
    drawn : collection of int
        Starts of the minutes that were drawn and reviewed before, in nanoseconds of UTC.
    taken : Spans
        Time that is reviewed already, of which no minute is drawn.

    Returns
    -------
    np.ndarray [shape=(m,)], int64
        Starts, in the order in which they were drawn.
    """
    before = minutes.has_sound[np.isin(minutes.starts, list(drawn))]
    shuffled = np.random.default_rng([_SEED, len(drawn)]).permutation(len(minutes.starts))
    free = shuffled[_length_in(taken, minutes.starts)[shuffled] == 0]
    left = {sound: free[minutes.has_sound[free] == sound].tolist()[::-1] for sound in (True, False)}
    total, sounds = len(before), int(before.sum())
    chosen: list[int] = []
    while len(chosen) < count and any(left.values()):
        sound = bool(left[True]) and (not left[False] or sounds < SOUND_SHARE * (total + 1))
        chosen.append(left[sound].pop())
        total, sounds = total + 1, sounds + sound
    return minutes.starts[np.array(chosen, np.intp)]


def _length_in(spans: Spans, minutes: Int64) -> Int64:
    """Return how much of each minute lies in spans, in nanoseconds."""
    if not len(minutes):
        return np.empty(0, np.int64)
    edges = np.unique(np.concatenate([minutes, minutes + MINUTE]))
    inside = lengths(common(spans, joined(minutes, minutes + MINUTE)), edges)
    return inside[np.searchsorted(edges, minutes)]
