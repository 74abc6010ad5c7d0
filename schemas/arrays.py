"""Array types, copies between buffers and rows, and array files with a digest."""

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
    """Copy pieces of `size` bytes at offsets, 0 to b - `size`, from a buffer [shape=(b,)].

    The pieces [shape=(n,), dtype V`size`] are in the order of the offsets [shape=(n,)], and may
    overlap.
    """
    return _pieces(buffer, size)[offsets]


def scatter(rows: NDArray[np.void], buffer: Bytes, offsets: Int64) -> None:
    """Copy rows [shape=(n,), dtype V`size`] to offsets [shape=(n,)] of a buffer [shape=(b,)].

    Offsets are 0 to b - `size`; the rows overwrite the buffer, and must not overlap.
    """
    _pieces(buffer, rows.dtype.itemsize)[offsets] = rows


def _pieces(buffer: Bytes, size: int) -> NDArray[np.void]:
    """View a buffer as overlapping pieces, one for each possible offset."""
    return np.ndarray((len(buffer) - size + 1,), f"V{size}", buffer.data, strides=(1,))


_DIGEST = "sha256"
_ALIGNMENT = 8  # bytes, in safetensors files


def write_sealed(arrays: Mapping[str, NDArray[Any]], key: str, text: str) -> bytes:
    """Return a safetensors file of arrays, with a text and a digest of both."""
    from safetensors.numpy import save  # noqa: PLC0415  everything imports this module

    data = save(dict(arrays), {key: text})
    length = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + length])
    # Inserted here, as safetensors writes several metadata entries in random order.
    header["__metadata__"][_DIGEST] = _digest(arrays, text)
    own = json.dumps(header, ensure_ascii=False, separators=(",", ":")).encode()
    own += b" " * (-len(own) % _ALIGNMENT)
    return len(own).to_bytes(8, "little") + own + data[8 + length :]


def read_sealed(path: Path, data: bytes, key: str) -> tuple[dict[str, NDArray[Any]], str, str]:
    """Parse the bytes of an array file to arrays, text (may be empty), and damage.

    The damage is an error text with advice if the digest differs; empty otherwise, and for files
    without digest, from old versions. Raise `safetensors.SafetensorError` if the data are no
    safetensors file, `KeyError` if numpy does not support the type of an array.
    """
    from safetensors.numpy import load  # noqa: PLC0415  everything imports this module

    arrays = load(data)
    length = int.from_bytes(data[:8], "little")
    metadata = json.loads(data[8 : 8 + length]).get("__metadata__", {})
    text, expected = metadata.get(key, ""), metadata.get(_DIGEST)
    if expected is None or (found := _digest(arrays, text)) == expected:
        return arrays, text, ""
    return arrays, text, damage(path, expected, found)


def damage(
    path: Path, expected: str, found: str, cure: str = "restore it from a backup, or make it again"
) -> str:
    """Return the error line for a file with a wrong digest."""
    expected = ascii(expected[:12])[1:-1]  # it may be any text
    return (
        f"{path}: is not as it was written (digest {found[:12]}, not {expected}): it was "
        f"changed, by the disk or by somebody; {cure}"
    )


def _digest(arrays: Mapping[str, NDArray[Any]], text: str) -> str:
    digest = hashlib.sha256(text.encode(errors="surrogatepass"))
    for name, array in sorted(arrays.items()):
        digest.update(f"\0{name} {array.dtype.str} {array.shape}\0".encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()
