"""Embeddings of one stream of frames, in the integers in which they are logged."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hearthlog.schemas.arrays import Indices, Int64

WINDOW_FRAMES = 20  # of a window: a second, in whose middle the network's input lies
HOP_FRAMES = 10  # from one window to the next; windows begin at multiples of it
DELAY_FRAMES = WINDOW_FRAMES - 1  # from a frame to the last one of the last window that says of it

Int8 = NDArray[np.int8]


class Embeddings(NamedTuple):
    """Embeddings of windows in which there was sound.

    Attributes
    ----------
    frames : np.ndarray [shape=(m,)], int64
        Number of the first frame of each window, a multiple of ten; increasing.
    stamps : np.ndarray [shape=(m,)], int64
        Starts of these frames in nanoseconds of UTC.
    values : np.ndarray [shape=(m, W)], int8
        As `Projection.quantise` gives them.
    """

    frames: Int64
    stamps: Int64
    values: Int8

    @property
    def last_frames(self) -> Int64:
        """Numbers of the frames with which the windows are complete."""
        return self.frames + (WINDOW_FRAMES - 1)

    def rows(self, chosen: slice | Indices) -> "Embeddings":
        """Return some of the embeddings."""
        return Embeddings(self.frames[chosen], self.stamps[chosen], self.values[chosen])

    def known_at(self, first: int, count: int) -> "Embeddings":
        """Return those that become known with some successive frames.

        Parameters
        ----------
        first, count : int
            Number of the first frame, and how many.
        """
        begin, end = np.searchsorted(self.last_frames, [first, first + count])
        return self.rows(slice(begin, end))

    def followed_by(self, later: "Embeddings") -> "Embeddings":
        """Join these embeddings with those that follow; where one has none, its width is free."""
        if not len(self.frames):
            return later
        if not len(later.frames):
            return self
        return Embeddings(
            np.concatenate([self.frames, later.frames]),
            np.concatenate([self.stamps, later.stamps]),
            np.concatenate([self.values, later.values]),
        )


NO_EMBEDDINGS = Embeddings(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 0), np.int8))
