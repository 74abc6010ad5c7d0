"""Many chunks decompressed at once, without Python between one and the next."""

import zlib
from itertools import pairwise

import numpy as np
import zstandard
from mcap.opcode import Opcode

from hearthlog.schemas.arrays import Bytes, Int64, gather
from hearthlog.schemas.mcap.formats import HEAD, ZSTD_CHUNK_HEAD
from hearthlog.schemas.mcap.records import LIMIT, zstd_decompressor

_LARGE = 16 << 10  # bytes, uncompressed: for chunks of so many, a call of Python is nothing
_IS_POSSIBLE = "multi_decompress_to_buffer" in zstandard.backend_features


def decompress_together(
    raw: Bytes, starts: Int64, lengths: Int64, limit: int
) -> tuple[Bytes, Int64] | None:
    """Decompress chunks, and compare them with their checksums, if all are sound and of zstd.

    Parameters
    ----------
    raw : np.ndarray [shape=(b,)], uint8
        Holds the records of the chunks.
    starts, lengths : np.ndarray [shape=(n,)], int64
        Where each record begins, with its opcode, and its bytes, heads included.
    limit : int
        Bytes, uncompressed, that the chunks may have in all.

    Returns
    -------
    buffer : np.ndarray [shape=(c,)], uint8
        The records of all chunks, uncompressed, one behind the other.
    sizes : np.ndarray [shape=(n,)], int64
        Bytes of each chunk, uncompressed.
    """
    fixed = ZSTD_CHUNK_HEAD.itemsize
    if not _IS_POSSIBLE or (lengths < fixed).any():
        return None
    heads = gather(raw, starts, fixed).view(ZSTD_CHUNK_HEAD)
    sizes, stored = heads["size"], heads["stored"]
    simple = (
        (heads["opcode"] == Opcode.CHUNK)
        & (heads["length"] == lengths - HEAD.size)
        & (heads["name_length"] == len(b"zstd"))
        & (heads["name"] == b"zstd")
        & (stored > 0)
        & (stored <= lengths - fixed)
        & (sizes > 0)
        & (sizes <= LIMIT)
    )
    if not simple.all() or sizes.sum() > limit:
        return None
    ends = np.cumsum(sizes).astype(np.int64)
    first, last = starts + fixed, starts + fixed + stored.astype(np.int64)
    try:
        if ends[-1] >= _LARGE * len(sizes):
            buffer = _one_by_one(raw, first.tolist(), last.tolist(), ends.tolist())
        else:
            buffer = _all_at_once(raw, first, stored, sizes)
    except zstandard.ZstdError:
        return None
    sums = [zlib.crc32(buffer[start:end].data) for start, end in pairwise([0, *ends.tolist()])]
    if ((heads["crc"] != sums) & (heads["crc"] != 0)).any():
        return None
    return buffer, sizes.astype(np.int64)


def _one_by_one(raw: Bytes, first: list[int], last: list[int], ends: list[int]) -> Bytes:
    """Decompress chunks to where they are to lie."""
    buffer, decompressor, start = np.empty(ends[-1], np.uint8), zstd_decompressor(), 0
    content, out = raw.data, buffer.data
    for begin, end, stop in zip(first, last, ends, strict=True):
        reader = decompressor.stream_reader(content[begin:end])
        if reader.readinto(out[start:stop]) != stop - start or reader.read(1):
            raise zstandard.ZstdError("of another size")
        start = stop
    return buffer


def _all_at_once(raw: Bytes, first: Int64, stored: Int64, sizes: Int64) -> Bytes:
    """Decompress chunks without Python between them, and put them together."""
    frames = np.stack([first, stored], axis=1).astype(np.uint64)
    chunks = zstd_decompressor().multi_decompress_to_buffer(
        zstandard.BufferWithSegments(raw.data, frames.tobytes()),
        decompressed_sizes=sizes.astype(np.uint64).tobytes(),
        threads=1,  # whoever reads has threads of its own
    )
    return np.frombuffer(b"".join(chunks), np.uint8)  # type: ignore[arg-type]  # of buffers
