"""How uncertain a model was of its labels, span by span."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.logs.selection import array_names
from hearthlog.analyzer.review.queue.judgeable_spans import JudgeableSpans
from hearthlog.models.classes import SILENCE, class_name
from hearthlog.schemas.arrays import Float64, Int64
from hearthlog.schemas.logs.columns import Columns


class ModelUncertainty:
    """Mean uncertainty, novelty and silence of spans, of labels that come batch by batch.

    Parameters
    ----------
    spans : JudgeableSpans
        At least one.

    Attributes
    ----------
    uncertainty, novelty : SpanMeans
        0 to 1.
    silence : SpanMeans
        The probability of silence, which is 1 where nothing is above the floor of the room.
    """

    def __init__(self, spans: JudgeableSpans, classes: Sequence[str]) -> None:
        self._spans, self._classes = spans, classes
        self.uncertainty, self.novelty, self.silence = (SpanMeans(len(spans)) for _ in range(3))

    def add(self, frames: Columns) -> None:
        """Add the labels of frames; probabilities without names are left out.

        Parameters
        ----------
        frames : Columns
            Label messages with stamp, probabilities and novelty, in any order.
        """
        stamps, probabilities = frames["header.stamp"], frames["probabilities"]
        row = np.searchsorted(self._spans.starts, stamps, side="right") - 1
        inside = (row >= 0) & (stamps < self._spans.ends[row])
        row = row[inside]
        self.novelty.add(row, frames["novelty"][inside].astype(np.float64))
        names = array_names(frames.metadata, "probabilities")
        if probabilities.ndim == 2 and probabilities.shape[1] == len(names) > 1:
            place = {name: i for i, name in enumerate(names)}
            columns = np.array([place.get(name, -1) for name in self._classes])
            labelled = columns[self._spans.labels[row]]
            self.uncertainty.add(row, uncertainty(probabilities[inside], labelled))
            silent = [class_name(name) == SILENCE for name in names]
            self.silence.add(row, probabilities[inside][:, silent].sum(axis=1, dtype=np.float64))


def uncertainty(probabilities: NDArray[np.floating], labelled: Int64) -> Float64:
    """Return (1 - p + q) / 2, of the probabilities p of the label and q of the best other class.

    Smoothing may choose another label than the most probable class, so the difference of the two
    highest probabilities would not do.

    Parameters
    ----------
    probabilities : np.ndarray [shape=(n, C)], float
        Of each class, 0 to 1.
    labelled : np.ndarray [shape=(n,)], int64
        Columns of the labels; -1 for a label without a column, whose p is 0.

    Returns
    -------
    np.ndarray [shape=(n,)], float64
        0 (certain) to 1; 0.5 where another class is as probable as the label.
    """
    others = probabilities.astype(np.float64)
    rows = np.flatnonzero(labelled >= 0)
    own = np.zeros(len(others))
    own[rows] = others[rows, labelled[rows]]
    others[rows, labelled[rows]] = 0.0
    return np.clip((1.0 - own + others.max(axis=1, initial=0.0)) / 2.0, 0.0, 1.0)


class SpanMeans:
    """Means of the finite values in each span."""

    def __init__(self, count: int) -> None:
        self._sums, self._counts = np.zeros(count), np.zeros(count)

    def add(self, row: Int64, values: Float64) -> None:
        """Add values to their spans; those that are not finite are left out.

        Parameters
        ----------
        row : np.ndarray [shape=(n,)], int64
            Of the span that each value is in.
        values : np.ndarray [shape=(n,)], float64
        """
        finite = np.isfinite(values)
        row, values = row[finite], values[finite]
        if len(row):
            first = int(row.min())
            part = slice(first, int(row.max()) + 1)
            self._sums[part] += np.bincount(row - first, values)
            self._counts[part] += np.bincount(row - first)

    @property
    def exist(self) -> bool:
        """Whether there is any value."""
        return bool(self._counts.any())

    def values(self) -> Float64:
        """Return the means, shape (count,); 0 where there is no value."""
        return self._sums / np.maximum(self._counts, 1.0)
