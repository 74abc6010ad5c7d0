"""What several microphones hear at once: its loudness rises and falls in all of them together."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hearthlog.schemas.arrays import Bool, Float32, Float64, Int64
from hearthlog.schemas.frames import FRAME_NANOSECONDS

_ALIKE = 0.7  # correlation of loudness
_LATE = (0, -1, 1, -2, 2, -3, 3)  # frames: clocks differ, and so does the way through a device
_SHORT = 10  # frames, too few to compare: the time alone decides
_LEAST_ENERGY = 1e-12
_TINY = 1e-12


class SpeechFrames(NamedTuple):
    """Frames of speech of one microphone in one log.

    Attributes
    ----------
    frames : np.ndarray [shape=(n,)], int64
        When each begins, in frames since 1970; ascending.
    loudness : np.ndarray [shape=(n,)], float64
        In dB.
    turn : np.ndarray [shape=(n,)], int64
        The turn that each is of, from 0 on; ascending.
    """

    frames: Int64
    loudness: Float64
    turn: Int64

    def rows(self, rows: Bool) -> "SpeechFrames":
        """Return some of the frames."""
        return SpeechFrames(self.frames[rows], self.loudness[rows], self.turn[rows])


def speech_frames(stamps: Int64, energy: Float32, starts: Int64) -> SpeechFrames:
    """Return frames of speech as they are compared.

    Parameters
    ----------
    stamps : np.ndarray [shape=(n,)], int64
        In nanoseconds of UTC, ascending.
    energy : np.ndarray [shape=(n,)], float32
    starts : np.ndarray [shape=(turns,)], int64
        Stamps of the frames at which turns begin.
    """
    loudness = 10.0 * np.log10(np.maximum(energy.astype(np.float64), _LEAST_ENERGY))
    frames = (stamps + FRAME_NANOSECONDS // 2) // FRAME_NANOSECONDS
    return SpeechFrames(frames, loudness, np.searchsorted(starts, stamps, side="right") - 1)


def louder_elsewhere(speech: Sequence[SpeechFrames]) -> list[Bool]:
    """Tell which turns another microphone hears as well, and louder.

    That is so if in most of a turn's frames the other one hears speech, too, and if its loudness
    and theirs correlate by more than 0.7; for a turn of less than half a second the first is
    enough. Of what is as loud the first microphone's is kept.

    Returns
    -------
    list of np.ndarray [shape=(turns,)], bool
        For each microphone.
    """
    kept = list(speech)
    louder: list[Bool] = []
    for place, own in enumerate(speech):
        counts = np.bincount(own.turn)
        is_louder = np.zeros(len(counts), np.bool_)
        for before, other in enumerate(kept):
            if before != place and _is_of_one_time(own, other):
                is_louder |= _is_louder(own, counts, other, or_as_loud=before < place)
        louder.append(is_louder)
        # what was left out is no reason to leave out others, or nobody would have heard it
        kept[place] = own.rows(~is_louder[own.turn])
    return louder


def _is_of_one_time(own: SpeechFrames, other: SpeechFrames) -> bool:
    """Tell whether some of the frames may be the same; most logs of a home are of other times."""
    if not (len(own.frames) and len(other.frames)):
        return False
    early, late = min(_LATE), max(_LATE)
    return bool(
        own.frames[0] + early <= other.frames[-1] and other.frames[0] <= own.frames[-1] + late
    )


def _is_louder(own: SpeechFrames, counts: Int64, other: SpeechFrames, *, or_as_loud: bool) -> Bool:
    best, is_louder = np.full(len(counts), _ALIKE), np.zeros(len(counts), np.bool_)
    for late in _LATE:
        times = own.frames + late
        rows = np.minimum(np.searchsorted(other.frames, times), len(other.frames) - 1)
        both = other.frames[rows] == times
        turn, x, y = own.turn[both], own.loudness[both], other.loudness[rows[both]]
        common = np.bincount(turn, minlength=len(counts))
        per_frame = np.maximum(common, 1)
        mean_x, mean_y = (np.bincount(turn, z, len(counts)) / per_frame for z in (x, y))
        x, y = x - mean_x[turn], y - mean_y[turn]
        xy, xx, yy = (np.bincount(turn, z, len(counts)) for z in (x * y, x * x, y * y))
        alike = xy / np.sqrt(np.maximum(xx * yy, _TINY))
        alike[counts < _SHORT] = 1.0
        better = (2 * common > counts) & (alike > best)
        is_louder[better] = (mean_y >= mean_x if or_as_loud else mean_y > mean_x)[better]
        best[better] = alike[better]
    return is_louder
