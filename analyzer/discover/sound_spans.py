"""Where something is heard without a pause, and what its labels say."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.logs.spans import ranges
from hearthlog.models.classes import SILENCE, UNKNOWN
from hearthlog.schemas.arrays import Bool, Float32, Float64, Int64
from hearthlog.schemas.frames import FRAME_NANOSECONDS

ALL, UNSURE, NOT_KNOWN = CHOICES = ("all", "unsure", "unknown")
# A sound may have two frames of silence within it, and has four frames; stamps follow a clock.
_PAUSE = 3 * FRAME_NANOSECONDS + FRAME_NANOSECONDS // 2
_LEAST = 3 * FRAME_NANOSECONDS - FRAME_NANOSECONDS // 2
_BEFORE = np.int64(-1 << 62)  # any time
_UNSURE_CONFIDENCE = 0.5  # as of the clips of what a model is unsure of


class FrameLabels(NamedTuple):
    """Labels of frames.

    Attributes
    ----------
    stamps : np.ndarray [shape=(n,)], int64
        Ascending, in nanoseconds of UTC.
    labels : np.ndarray [shape=(n,)] of str
    confidence : np.ndarray [shape=(n,)], float32
    """

    stamps: Int64
    labels: NDArray[np.object_]
    confidence: Float32

    def rows(self, rows: Bool) -> "FrameLabels":
        """Return some of the labels."""
        return FrameLabels(self.stamps[rows], self.labels[rows], self.confidence[rows])


class SoundSpans(NamedTuple):
    """Sounds of one microphone in one log.

    Attributes
    ----------
    starts, ends : np.ndarray [shape=(n,)], int64
        In nanoseconds of UTC, ascending.
    first, last : np.ndarray [shape=(n,)], int64
        Rows of the features: from `first` on, before `last`.
    labels : np.ndarray [shape=(n,)], str
        The label that most of the sounding frames have.
    confidence : np.ndarray [shape=(n,)], float64
        Mean confidence of their labels.
    """

    starts: Int64
    ends: Int64
    first: Int64
    last: Int64
    labels: NDArray[np.str_]
    confidence: Float64

    def chosen(self, choice: str) -> "SoundSpans":
        """Return all, those that the model is unsure of, or those that it does not know."""
        if choice == ALL:
            return self
        keep = self.labels == UNKNOWN
        if choice == UNSURE:
            keep |= self.confidence < _UNSURE_CONFIDENCE
        return self.rows(keep)

    def rows(self, rows: Bool) -> "SoundSpans":
        """Return some of the sounds."""
        return SoundSpans(
            self.starts[rows],
            self.ends[rows],
            self.first[rows],
            self.last[rows],
            self.labels[rows],
            self.confidence[rows],
        )


def find_sounds(stamps: Int64, labels: FrameLabels) -> SoundSpans:
    """Find the sounds of a log: runs of labels other than silence.

    Parameters
    ----------
    stamps : np.ndarray [shape=(m,)], int64
        Of the frames that have features, ascending.
    """
    heard = labels.rows(labels.labels != SILENCE)
    rows = np.minimum(np.searchsorted(stamps, heard.stamps), max(len(stamps) - 1, 0))
    there = stamps[rows] == heard.stamps if len(stamps) else np.zeros(len(rows), np.bool_)
    heard, rows = heard.rows(there), rows[there]
    first = np.flatnonzero(np.diff(heard.stamps, prepend=_BEFORE) > _PAUSE)
    counts = np.diff(np.append(first, len(rows)))
    enough = heard.stamps[first + counts - 1] - heard.stamps[first] >= _LEAST
    first, counts = first[enough], counts[enough]
    sound, inside = ranges(first, counts)
    begin, end = rows[first], rows[first + counts - 1]
    sums = np.bincount(sound, heard.confidence[inside], len(first))
    return SoundSpans(
        stamps[begin],
        stamps[end] + FRAME_NANOSECONDS,
        begin.astype(np.int64),
        end.astype(np.int64) + 1,
        _most_frequent(heard.labels[inside], sound, len(first)),
        sums / counts,
    )


def _most_frequent(labels: NDArray[Any], sound: Int64, count: int) -> NDArray[np.str_]:
    """Return the most frequent label of each sound; the first in the alphabet of several."""
    names, codes = np.unique(labels.astype(np.str_), return_inverse=True)
    shape = count, max(len(names), 1)
    counts = np.bincount(sound * shape[1] + codes, minlength=shape[0] * shape[1])
    return names[counts.reshape(shape).argmax(axis=1)] if count else names
