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
    # A view whose elements overlap: one for every offset at which a piece may begin.
    view: NDArray[np.void] = np.ndarray(
        (len(buffer) - size + 1,), f"V{size}", buffer.data, strides=(1,)
    )
    return view[offsets]


def scatter(rows: NDArray[np.void], buffer: Bytes, offsets: Int64) -> None:
    """Copy rows of bytes to any offsets of a buffer, at which they do not overlap.

    Parameters
    ----------
    rows : np.ndarray [shape=(n,)], of dtype V`size`
    buffer : np.ndarray [shape=(b,)], uint8
    offsets : np.ndarray [shape=(n,)], int64
    """
    size = rows.dtype.itemsize
    view: NDArray[np.void] = np.ndarray(
        (len(buffer) - size + 1,), f"V{size}", buffer.data, strides=(1,)
    )
    view[offsets] = rows
