"""Arrays: names of their types, and pieces of buffers."""

import numpy as np
from numpy.typing import NDArray

Bool = NDArray[np.bool_]
Bytes = NDArray[np.uint8]
Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Indices = NDArray[np.intp]
Int16 = NDArray[np.int16]
Int64 = NDArray[np.int64]


def gather(buffer: Bytes, offsets: Int64, size: int) -> NDArray[np.void]:
    """Copy pieces of `size` bytes, at any offsets, out of a buffer.

    Returns
    -------
    np.ndarray [shape=(n,)], of dtype V`size`
    """
    return _pieces(buffer, size)[offsets]


def scatter(rows: NDArray[np.void], buffer: Bytes, offsets: Int64) -> None:
    """Copy rows of dtype V`size` to offsets of a buffer, at which they do not overlap."""
    _pieces(buffer, rows.dtype.itemsize)[offsets] = rows


def _pieces(buffer: Bytes, size: int) -> NDArray[np.void]:
    """View a buffer as pieces that overlap: one for every offset at which one may begin."""
    return np.ndarray((len(buffer) - size + 1,), f"V{size}", buffer.data, strides=(1,))
