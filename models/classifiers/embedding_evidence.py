"""Evidence of frames by embeddings: that of the two windows around, interpolated or the higher."""

from collections.abc import Callable

import numpy as np

from hearthlog.models.embedding.embeddings import (
    HOP_FRAMES,
    WINDOW_FRAMES,
    Embeddings,
    Int8,
)
from hearthlog.schemas.arrays import Float64

_MIDDLE = WINDOW_FRAMES // 2


class EmbeddingEvidence:
    """Brings the evidence of windows, a value for each class, to frames.

    A frame lies between the middles of two windows, of which one or both may be missing.

    Parameters
    ----------
    of_windows : callable
        Turns embeddings, shape (m, W), into values, shape (m, C).
    """

    def __init__(self, of_windows: Callable[[Int8], Float64], classes: int) -> None:
        self._evidence_of = of_windows
        self._classes = classes
        self.restart()

    def restart(self) -> None:
        """Forget the past: the next frame does not follow the last one."""
        self._windows = np.empty(0, np.int64)  # numbers of the windows, in the order of time
        self._values = np.empty((0, self._classes))
        self._first: int | None = None

    def push(self, embeddings: Embeddings, first: int) -> None:
        """Add embeddings."""
        if self._first is None:
            self._first = first
        if not len(embeddings.frames):
            return
        values = self._evidence_of(embeddings.values)
        self._windows = np.append(self._windows, embeddings.frames // HOP_FRAMES)
        self._values = np.concatenate([self._values, values])

    def is_full(self, frame: int) -> bool:
        """Tell whether embeddings before the first frame leave no trace from a frame on."""
        begin = frame - frame % HOP_FRAMES - _MIDDLE
        return self._first is not None and begin >= self._first

    def at(self, first: int, count: int) -> Float64:
        """Interpolate the evidence to successive frames, and forget that of earlier ones.

        Returns
        -------
        np.ndarray [shape=(count, C)], float64
            NaN where there is no window.
        """
        share = ((np.arange(first, first + count) - _MIDDLE) % HOP_FRAMES + 0.5) / HOP_FRAMES
        earlier, later = self._around(first, count)
        earlier = np.where(np.isnan(earlier), later, earlier)
        later = np.where(np.isnan(later), earlier, later)
        evidence: Float64 = (1.0 - share[:, np.newaxis]) * earlier + share[:, np.newaxis] * later
        return evidence

    def highest_at(self, first: int, count: int) -> Float64:
        """Return the higher evidence of the two windows, as `at` returns the interpolated one."""
        highest: Float64 = np.fmax(*self._around(first, count))
        return highest

    def _around(self, first: int, count: int) -> tuple[Float64, Float64]:
        """Return the values of the windows before and after frames, and forget earlier windows."""
        before = (np.arange(first, first + count) - _MIDDLE) // HOP_FRAMES
        earlier, later = self._of_windows(before), self._of_windows(before + 1)
        keep = np.searchsorted(self._windows, (first + count - _MIDDLE) // HOP_FRAMES)
        self._windows, self._values = self._windows[keep:], self._values[keep:]
        return earlier, later

    def _of_windows(self, numbers: np.ndarray[tuple[int], np.dtype[np.int64]]) -> Float64:
        """Return the log-probabilities of windows; NaN where there is none."""
        values = np.full((len(numbers), self._classes), np.nan)
        if len(self._windows):
            places = np.minimum(np.searchsorted(self._windows, numbers), len(self._windows) - 1)
            there = self._windows[places] == numbers
            values[there] = self._values[places[there]]
        return values
