"""Spans of frames with values: the base of directions of blocks and embeddings of windows."""

from dataclasses import dataclass, fields
from typing import ClassVar, Self

import numpy as np

from hearthlog.schemas.arrays import Bool, Indices, Int64


@dataclass(frozen=True, eq=False)
class FrameSpans:
    """Spans of equal length, with a row for each in every field.

    Attributes
    ----------
    frames : np.ndarray [shape=(m,)], int64
        Number of the first frame of each; increasing.
    stamps : np.ndarray [shape=(m,)], int64
        Starts of these frames in nanoseconds of UTC.
    """

    LENGTH: ClassVar[int]  # frames

    frames: Int64
    stamps: Int64

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def last_frames(self) -> Int64:
        """Numbers of the frames with which they are known."""
        return self.frames + (self.LENGTH - 1)

    def rows(self, chosen: slice | Indices | Bool) -> Self:
        """Return some of them."""
        return type(self)(*(getattr(self, each.name)[chosen] for each in fields(self)))

    def known_at(self, first: int, count: int) -> Self:
        """Return those that become known with some successive frames."""
        begin, end = np.searchsorted(self.last_frames, [first, first + count])
        return self.rows(slice(begin, end))

    def begun_in(self, start: int, end: int) -> Self:
        """Return those that begin in a span of time.

        Parameters
        ----------
        start, end : int
            In nanoseconds of UTC: from `start` on, before `end`.
        """
        return self.rows(slice(*np.searchsorted(self.stamps, [start, end])))

    def followed_by(self, later: Self) -> Self:
        """Join these with those that follow; those of none take any width."""
        if not len(self):
            return later
        if not len(later):
            return self
        names = [each.name for each in fields(self)]
        pairs = ((getattr(self, name), getattr(later, name)) for name in names)
        return type(self)(*map(np.concatenate, pairs))
