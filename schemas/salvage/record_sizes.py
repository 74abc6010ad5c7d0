"""How large records are at least and at most, and which lengths are inside of them."""

import struct

import numpy as np
from mcap.opcode import Opcode

from hearthlog.schemas.mcap.formats import HEAD, MESSAGE_FIXED, UINT32, UINT64
from hearthlog.schemas.mcap.records import LIMIT

UNKNOWN = 1 << 62  # bytes, more than any file has
# The content of each kind of record: so many bytes, or a length of this format and so many bytes.
FIELDS: dict[int, tuple[int | struct.Struct, ...]] = {
    Opcode.HEADER: (UINT32, UINT32),
    Opcode.FOOTER: (20,),
    Opcode.SCHEMA: (2, UINT32, UINT32, UINT32),
    Opcode.CHANNEL: (4, UINT32, UINT32, UINT32),
    Opcode.CHUNK: (28, UINT32, UINT64),
    Opcode.MESSAGE_INDEX: (2, UINT32),
    Opcode.CHUNK_INDEX: (32, UINT32, 8, UINT32, 16),
    Opcode.ATTACHMENT: (16, UINT32, UINT32, UINT64, 4),
    Opcode.ATTACHMENT_INDEX: (40, UINT32, UINT32),
    Opcode.STATISTICS: (42, UINT32),
    Opcode.METADATA: (UINT32, UINT32),
    Opcode.METADATA_INDEX: (16, UINT32),
    Opcode.SUMMARY_OFFSET: (17,),
    Opcode.DATA_END: (4,),
}
SHORTEST = np.full(256, UNKNOWN)  # bytes of the shortest content, by opcode
for _opcode, _fields in FIELDS.items():
    SHORTEST[_opcode] = sum(f if isinstance(f, int) else f.size for f in _fields)
SHORTEST[Opcode.MESSAGE] = MESSAGE_FIXED
LARGEST = np.full(256, 16 << 20)  # bytes of the largest record that is read, by opcode
LARGEST[[Opcode.ATTACHMENT, Opcode.MESSAGE_INDEX]] = LIMIT


def find_record_heads(window: bytes) -> list[int]:
    """Search for the heads of records, damaged or not.

    Returns
    -------
    list of int
        Bytes of the window at which an opcode and a length may stand that go together, ascending.
    """
    count = len(window) - HEAD.size + 1
    if count <= 0:
        return []
    shortest = SHORTEST[np.frombuffer(window, np.uint8)[:count]]
    places = np.flatnonzero(shortest <= LIMIT)
    lengths = np.ndarray((count,), "<u8", window, 1, (1,))[places]
    heads: list[int] = places[(lengths <= LIMIT) & (lengths >= shortest[places])].tolist()
    return heads
