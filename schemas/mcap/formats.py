"""The binary layouts of MCAP records, each defined once (https://mcap.dev/spec).

All numbers are little-endian; times are nanoseconds. A record is its opcode, the length of its
content, and its content. A `Struct` is the fixed beginning of a content, unless its comment says
that opcode and length are part of it; a dtype has rows of whole numbers of records or entries.
"""

import struct

import numpy as np

MAGIC = b"\x89MCAP0\r\n"
UINT16, UINT32, UINT64 = struct.Struct("<H"), struct.Struct("<I"), struct.Struct("<Q")
HEAD = struct.Struct("<BQ")  # opcode, length of the content
MESSAGE = struct.Struct("<BQHIQQ")  # with HEAD: channel, sequence, log time, publish time; payload
MESSAGE_FIXED = MESSAGE.size - HEAD.size  # bytes of a message's content before its payload
MESSAGE_HEAD = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<i8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<i8"),
        ("publish_time", "<i8"),
    ]
)
# First and last log time, size and CRC uncompressed, length of the compression's name; that name,
# length of the data (UINT64), data.
CHUNK = struct.Struct("<QQQII")
ZSTD_CHUNK_HEAD = np.dtype(  # of a chunk whose compression's name has four letters
    [
        ("opcode", "u1"),
        ("length", "<i8"),
        ("start", "<i8"),
        ("end", "<i8"),
        ("size", "<i8"),
        ("crc", "<u4"),
        ("name_length", "<u4"),
        ("name", "S4"),
        ("stored", "<i8"),
    ]
)
MESSAGE_INDEX = struct.Struct("<HI")  # channel, bytes of the entries; entries
MESSAGE_INDEX_HEAD = np.dtype(
    [("opcode", "u1"), ("length", "<i8"), ("channel", "<u2"), ("size", "<u4")]
)
INDEX_ENTRY = struct.Struct("<QQ")  # log time of a message, offset in the uncompressed chunk
INDEX_ENTRIES = np.dtype([("time", "<i8"), ("offset", "<i8")])
# First and last log time, offset and length of the chunk, bytes of the index offsets; these, the
# tail, the compression's name, size compressed and uncompressed (UINT64 each).
CHUNK_INDEX = struct.Struct("<QQQQI")
INDEX_OFFSET = struct.Struct("<HQ")  # channel, offset of its message index
CHUNK_INDEX_TAIL = struct.Struct("<QI")  # bytes of the message indexes, length of a name
ATTACHMENT = struct.Struct("<QQI")  # log time, time of creation, length of the name
SUMMARY_OFFSET = struct.Struct("<9xBQQ")  # with HEAD: opcode, start and length of a group
FOOTER = struct.Struct("<QQ")  # start of the summary, start of the summary offsets; CRC (UINT32)
FOOTER_SIZE = HEAD.size + FOOTER.size + UINT32.size + len(MAGIC)
_OTHERS = {  # formats that are taken for MCAP, by how they begin, and what makes MCAP of them
    b"\x28\xb5\x2f\xfd": "is compressed as a whole: `zstd -d -o NEW.mcap` makes a log of it",
    b"\x04\x22\x4d\x18": "is compressed as a whole: `lz4 -d` makes a log of it",
    b"\x1f\x8b": "is compressed as a whole: `gzip -d` makes a log of it",
    b"BZh": "is compressed as a whole: `bzip2 -d` makes a log of it",
    b"\xfd7zXZ\0": "is compressed as a whole: `xz -d` makes a log of it",
    b"PK\3\4": "is an archive: `unzip` takes out what is in it",
    b"SQLite format 3\0": "is a bag in SQLite, no MCAP: `ros2 bag convert` makes MCAP of it",
    b"#ROSBAG": "is a bag of ROS 1, no MCAP: `rosbags-convert` makes a bag of ROS 2 of it",
}
_COMPRESSED = (".zst", ".zstd", ".lz4", ".gz", ".bz2", ".xz")
COMPRESSED_SUFFIXES = tuple(f".mcap{suffix}" for suffix in _COMPRESSED)
OTHER_SUFFIXES = (*_COMPRESSED, ".db3", ".bag")


def not_mcap(start: bytes) -> str:
    """Say what a file is that does not begin as MCAP does.

    Parameters
    ----------
    start : bytes
        The first 16 bytes of it, or all.
    """
    for magic, what in _OTHERS.items():
        if start.startswith(magic):
            return what
    return "is not an MCAP file"
