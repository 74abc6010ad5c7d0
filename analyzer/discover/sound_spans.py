"""Where something is heard without a pause, and what its labels say."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.logs.spans import ranges
from hearthlog.models.classes import SILENCE, UNKNOWN
from hearthlog.schemas.arrays import Bool, Float64, Int64
from hearthlog.schemas.frames import FRAME_NANOSECONDS
from hearthlog.schemas.logs.columns import Columns

ALL, UNSURE, NOT_KNOWN = CHOICES = ("all", "unsure", "unknown")
LABEL_FIELDS = ("frame", "label", "confidence")
FEATURE_FIELDS = ("header.stamp", "frame", "values")
_PAUSE_FRAMES = 2  # that a sound may have within it
_LEAST_FRAMES = 4
_BEFORE = np.int64(-1 << 62)  # any frame
_UNSURE_CONFIDENCE = 0.5  # as of the clips of what a model is unsure of


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
        return SoundSpans(
            self.starts[keep],
            self.ends[keep],
            self.first[keep],
            self.last[keep],
            self.labels[keep],
            self.confidence[keep],
        )


def find_sounds(features: Columns, labels: Columns) -> SoundSpans:
    """Find the sounds of a log: runs of labels other than silence.

    Parameters
    ----------
    features : Columns
        Of a microphone, with `FEATURE_FIELDS`, in the order of their frames.
    labels : Columns
        Of the same, with `LABEL_FIELDS`. Frames without features are left out.
    """
    heard = labels["label"] != SILENCE
    frames, rows = labels["frame"][heard].astype(np.int64), _rows(features, labels, heard)
    there = rows >= 0
    frames, rows = frames[there], rows[there]
    first = np.flatnonzero(np.diff(frames, prepend=_BEFORE) > _PAUSE_FRAMES + 1)
    counts = np.diff(np.append(first, len(frames)))
    enough = frames[first + counts - 1] - frames[first] + 1 >= _LEAST_FRAMES
    first, counts = first[enough], counts[enough]
    begin, end = rows[first], rows[first + counts - 1]
    sound, inside = ranges(first, counts)
    stamps = features["header.stamp"]
    sums = np.bincount(sound, labels["confidence"][heard][there][inside], len(first))
    return SoundSpans(
        stamps[begin],
        stamps[end] + FRAME_NANOSECONDS,
        begin,
        end + 1,
        _most_frequent(labels["label"][heard][there][inside], sound, len(first)),
        sums / counts,
    )


def _rows(features: Columns, labels: Columns, heard: Bool) -> Int64:
    """Return the row of the features of each frame that is heard; -1 where there are none."""
    known, frames = features["frame"], labels["frame"][heard]
    rows = np.minimum(np.searchsorted(known, frames), len(known) - 1)
    return np.where(known[rows] == frames, rows, -1).astype(np.int64)


def _most_frequent(labels: NDArray[Any], sound: Int64, count: int) -> NDArray[np.str_]:
    """Return the most frequent label of each sound; the first in the alphabet of several."""
    names, codes = np.unique(labels.astype(np.str_), return_inverse=True)
    shape = count, max(len(names), 1)
    counts = np.bincount(sound * shape[1] + codes, minlength=shape[0] * shape[1])
    return names[counts.reshape(shape).argmax(axis=1)] if count else names
