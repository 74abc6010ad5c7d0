"""A span of time divided into equal shares, and means of the values in each."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hearthlog.schemas.arrays import Float64, Int64


@dataclass(frozen=True)
class Grid:
    """A span of time, divided into equal shares."""

    start: int
    end: int
    count: int

    @property
    def edges(self) -> Int64:
        """Starts of the shares, and the end of the last one; shape (count + 1,)."""
        shares = np.arange(self.count + 1) / self.count
        return self.start + np.round(shares * (self.end - self.start)).astype(np.int64)

    @property
    def step(self) -> int:
        """Length of a share in nanoseconds, but for rounding."""
        return (self.end - self.start) // self.count

    @property
    def middles(self) -> Int64:
        """Middles of the shares; shape (count,)."""
        edges = self.edges
        return edges[:-1] + (edges[1:] - edges[:-1]) // 2

    def find(self, times: Int64) -> NDArray[np.intp]:
        """Find the share that contains each time.

        Parameters
        ----------
        times : np.ndarray [shape=(n,)], int64
            In nanoseconds of UTC.

        Returns
        -------
        np.ndarray [shape=(n,)], int
            0 to count - 1; for a time outside of the grid the nearest share.
        """
        places = (times - self.start) * (self.count / (self.end - self.start))
        return np.clip(places.astype(np.int64), 0, self.count - 1)


class GridMeans:
    """Means of rows of values in each share of a grid."""

    def __init__(self, grid: Grid, width: int) -> None:
        self._grid = grid
        self._sums = np.zeros((grid.count, width))
        self._counts = np.zeros(grid.count, np.int64)

    def add(self, times: Int64, values: NDArray[np.floating]) -> None:
        """Add rows in the order of time; values that are not finite count as 0.

        Parameters
        ----------
        times : np.ndarray [shape=(n,)], int64
            In nanoseconds of UTC, at least one.
        values : np.ndarray [shape=(n, width)], float
        """
        share = self._grid.find(times)
        first = np.flatnonzero(np.diff(share, prepend=-1))
        if not np.isfinite(values).all():
            values = np.nan_to_num(values, posinf=0.0, neginf=0.0)
        self._sums[share[first]] += np.add.reduceat(values, first, axis=0, dtype=np.float64)
        self._counts[share[first]] += np.diff(first, append=len(share))

    @property
    def values(self) -> Float64:
        """The means, shape (count, width); NaN in shares without a row."""
        with np.errstate(invalid="ignore"):
            return self._sums / self._counts[:, np.newaxis]
