"""Arrays: names of their types, pieces of buffers, and files with a digest of their content."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

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


_DIGEST = "sha256"
_ALIGNMENT = 8  # bytes, of the arrays of a safetensors file


def write_sealed(arrays: Mapping[str, NDArray[Any]], key: str, text: str) -> bytes:
    """Return the safetensors file of arrays, with a text and a digest of both."""
    from safetensors.numpy import save  # noqa: PLC0415  arrays are imported by everything

    data = save(dict(arrays), {key: text})
    length = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + length])
    # Put in here, as safetensors writes several metadata in an order of chance.
    header["__metadata__"][_DIGEST] = _digest(arrays, text)
    own = json.dumps(header, ensure_ascii=False, separators=(",", ":")).encode()
    own += b" " * (-len(own) % _ALIGNMENT)
    return len(own).to_bytes(8, "little") + own + data[8 + length :]


def read_sealed(path: Path, data: bytes, key: str) -> tuple[dict[str, NDArray[Any]], str, str]:
    """Read the bytes of a file; one of before there were digests has none to differ from.

    Returns
    -------
    text : str
        Empty if there is none.
    damage : str
        What is wrong if the digest differs, and what to do; else empty.

    Raises
    ------
    safetensors.SafetensorError
        If they are no such file.
    KeyError
        If an array has a type that numpy has not.
    """
    from safetensors.numpy import load  # noqa: PLC0415  as above

    arrays = load(data)
    length = int.from_bytes(data[:8], "little")
    metadata = json.loads(data[8 : 8 + length]).get("__metadata__", {})
    text, expected = metadata.get(key, ""), metadata.get(_DIGEST)
    if expected is None or (found := _digest(arrays, text)) == expected:
        return arrays, text, ""
    return arrays, text, damage(path, expected, found)


def damage(
    path: Path, expected: str, found: str, cure: str = "copy it back from a backup, or make it anew"
) -> str:
    """Return the line about a file whose digest is not what it was written with."""
    expected = ascii(expected[:12])[1:-1]  # it may be anything
    return (
        f"{path}: is not as it was written (digest {found[:12]}, not {expected}): the disk or "
        f"somebody has changed it; {cure}"
    )


def _digest(arrays: Mapping[str, NDArray[Any]], text: str) -> str:
    digest = hashlib.sha256(text.encode(errors="surrogatepass"))
    for name, array in sorted(arrays.items()):
        digest.update(f"\0{name} {array.dtype.str} {array.shape}\0".encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()
