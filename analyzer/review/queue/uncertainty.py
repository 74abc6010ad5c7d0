"""How sure a model was of its labels, window by window."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.logs.channel_names import array_names
from hearthlog.analyzer.review.queue.judgeable_spans import JudgeableSpans
from hearthlog.schemas.arrays import Float64, Int64
from hearthlog.schemas.logs.columns import Columns


class ModelUncertainty:
    """Means over windows, of labels that come batch by batch.

    Parameters
    ----------
    windows : JudgeableSpans
        At least one.
    classes : sequence of str
        What their labels stand for.

    Attributes
    ----------
    uncertainty, novelty : SpanMeans
    """

    def __init__(self, windows: JudgeableSpans, classes: Sequence[str]) -> None:
        self._windows, self._classes = windows, classes
        self.uncertainty, self.novelty = SpanMeans(len(windows)), SpanMeans(len(windows))

    def add(self, frames: Columns) -> None:
        """Add frames; probabilities without names say nothing."""
        stamps, probabilities = frames["header.stamp"], frames["probabilities"]
        window = np.searchsorted(self._windows.starts, stamps, side="right") - 1
        inside = (window >= 0) & (stamps < self._windows.ends[window])
        window = window[inside]
        self.novelty.add(window, frames["novelty"][inside].astype(np.float64))
        names = array_names(frames.metadata, "probabilities")
        if probabilities.ndim == 2 and probabilities.shape[1] == len(names) > 1:
            place = {name: i for i, name in enumerate(names)}
            columns = np.array([place.get(name, -1) for name in self._classes])
            said = columns[self._windows.labels[window]]
            self.uncertainty.add(window, uncertainty(probabilities[inside], said))


def uncertainty(probabilities: NDArray[np.floating], said: Int64) -> Float64:
    """Tell how far the likeliest other class comes up to the one that is said, or exceeds it.

    Smoothing may say something else than the likeliest class, so the two likeliest would not do.

    Parameters
    ----------
    probabilities : np.ndarray [shape=(n, C)]
    said : np.ndarray [shape=(n,)], int64
        Columns; -1 for a class that is none of them.

    Returns
    -------
    np.ndarray [shape=(n,)]
        0 where all speaks for the label, 0.5 where another class is as likely, 1 where all speaks
        for another.
    """
    others = probabilities.astype(np.float64)
    known = np.flatnonzero(said >= 0)
    own = np.zeros(len(others))
    own[known] = others[known, said[known]]
    others[known, said[known]] = 0.0
    return np.clip((1.0 - own + others.max(axis=1, initial=0.0)) / 2.0, 0.0, 1.0)


class SpanMeans:
    """Means by window, of what is finite."""

    def __init__(self, count: int) -> None:
        self._sums, self._counts = np.zeros(count), np.zeros(count)

    def add(self, window: Int64, values: Float64) -> None:
        """Add values, and the windows that they are in."""
        finite = np.isfinite(values)
        window, values = window[finite], values[finite]
        if len(window):
            first = int(window.min())
            part = slice(first, int(window.max()) + 1)
            self._sums[part] += np.bincount(window - first, values)
            self._counts[part] += np.bincount(window - first)

    @property
    def known(self) -> bool:
        """Whether there is any value."""
        return bool(self._counts.any())

    def values(self) -> Float64:
        """Return the means; 0 where there is no value."""
        return self._sums / np.maximum(self._counts, 1.0)
