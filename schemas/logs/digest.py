"""Which log it is: a digest that layers keep of the log that they were made from."""

import hashlib
from pathlib import Path

from hearthlog.schemas.logs.provenance import THINNED_OF, provenance_records
from hearthlog.schemas.mcap.logfile import LogFile

_TAIL = 1 << 16  # bytes


def log_digest(log: Path) -> str:
    """Identify a log: the SHA-256 of its size and its last 64 KiB.

    The end of a log holds its index, or the end of that, and the index's checksum. So a log can be
    recognised without reading all of it.

    Returns
    -------
    str
        64 hexadecimal digits.

    Raises
    ------
    LogError
        If the log cannot be read, or is not an MCAP file.
    """
    with LogFile(log, indexed=False) as file:
        size = file.size
        tail = file.read(max(size - _TAIL, 0), _TAIL)
    return hashlib.sha256(str(size).encode() + b"\0" + tail).hexdigest()


def earlier_digests(log: Path) -> list[str]:
    """Return the digests that a log had before it was thinned.

    Raise `LogError` if the log cannot be read or is damaged.
    """
    with LogFile(log) as file:
        records = provenance_records(file)
    return [digest for record in records for digest in record.get(THINNED_OF, "").split()]
