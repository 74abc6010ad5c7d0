"""Segments from labels: successive equal labels merged into one.

This is the paper's first way (section 4). The other, smoothing the posteriors with a hidden
Markov model, takes the same place: labels and their probabilities in, closed segments out.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Segment:
    """A span of one label: nanoseconds of UTC, index of the class, mean probability."""

    start: int
    end: int
    label: int
    confidence: float


@dataclass
class _Open:
    start: int
    label: int
    frames: int = 0
    confidence_sum: float = 0.0


class SegmentMerger:
    """Merges the labels of one stream; at most one segment is open."""

    def __init__(self) -> None:
        self._open: _Open | None = None

    def push(
        self,
        labels: NDArray[np.intp],
        confidences: NDArray[np.float32],
        stamps: NDArray[np.int64],
    ) -> list[Segment]:
        """Add the labels of successive frames and return the segments that they close.

        Parameters
        ----------
        labels : np.ndarray [shape=(n,)]
            Indices of classes.
        confidences : np.ndarray [shape=(n,)]
            Probabilities of these labels.
        stamps : np.ndarray [shape=(n,)], int64
            Starts of the frames in nanoseconds.
        """
        closed = []
        starts = np.flatnonzero(np.diff(labels, prepend=-1))
        for start, end in zip(starts, [*starts[1:], len(labels)], strict=True):
            label = int(labels[start])
            if self._open is None or self._open.label != label:
                closed += self.close(int(stamps[start]))
                self._open = _Open(int(stamps[start]), label)
            # A running sum from left to right, so that blocks of any size give the same bits.
            run = np.concatenate([[self._open.confidence_sum], confidences[start:end]])
            self._open.confidence_sum = float(np.add.accumulate(run)[-1])
            self._open.frames += int(end - start)
        return closed

    def close(self, end: int) -> list[Segment]:
        """End the open segment, if there is one, at `end`."""
        if self._open is None:
            return []
        last, self._open = self._open, None
        return [Segment(last.start, end, last.label, last.confidence_sum / last.frames)]
