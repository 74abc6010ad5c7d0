"""Arrays: names of their types, and pieces of buffers."""

import numpy as np
from numpy.typing import NDArray

Bool = NDArray[np.bool_]
Bytes = NDArray[np.uint8]
Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Indices = NDArray[np.intp]
Int16 = NDArray[np.int16]
Int32 = NDArray[np.int32]
Int64 = NDArray[np.int64]


def gather(buffer: Bytes, offsets: Int64, size: int) -> NDArray[np.void]:
    """Copy pieces of `size` bytes, at any offsets, out of a buffer.

    Parameters
    ----------
    buffer : np.ndarray [shape=(b,)], uint8
        At least `size` bytes.
    offsets : np.ndarray [shape=(n,)], int64
        Bytes of the buffer at which the pieces begin, 0 to b - `size`; pieces may overlap.
    size : int
        Bytes of each piece.

    Returns
    -------
    np.ndarray [shape=(n,)], of dtype V`size`
        The pieces, in the order of their offsets in `offsets`.
    """
    return _pieces(buffer, size)[offsets]


def scatter(rows: NDArray[np.void], buffer: Bytes, offsets: Int64) -> None:
    """Copy rows to offsets of a buffer.

    Parameters
    ----------
    rows : np.ndarray [shape=(n,)], of dtype V`size`
        Pieces of `size` bytes.
    buffer : np.ndarray [shape=(b,)], uint8
        At least `size` bytes, which the rows overwrite.
    offsets : np.ndarray [shape=(n,)], int64
        Bytes of the buffer at which the rows begin, 0 to b - `size`; they must not
        overlap there.
    """
    _pieces(buffer, rows.dtype.itemsize)[offsets] = rows


def _pieces(buffer: Bytes, size: int) -> NDArray[np.void]:
    """View a buffer as pieces that overlap: one for every offset at which one may begin."""
    return np.ndarray((len(buffer) - size + 1,), f"V{size}", buffer.data, strides=(1,))
