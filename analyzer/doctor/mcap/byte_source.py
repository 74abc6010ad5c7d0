"""One file, read once from its beginning to its end, with the checksum of what was read."""

import os
import zlib
from pathlib import Path
from typing import Self

from hearthlog.schemas.files import open_regular

_PIECE = 1 << 20  # bytes
_READ_ANYWAY = 1 << 30  # bytes; what is longer may be a hole in the file, and has no end


class ByteSource:
    """The bytes of a file, as many as it had when it was opened.

    Raise `OSError` if it cannot be opened, or is no regular file.
    """

    def __init__(self, path: Path) -> None:
        self._stream = os.fdopen(open_regular(path), "rb", buffering=_PIECE)
        self.size = os.fstat(self._stream.fileno()).st_size
        self.offset = 0  # of the next byte
        self.crc: int | None = 0  # checksum of all bytes before that; None if some were not read

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stream.close()

    def take(self, length: int) -> bytes:
        """Read the next bytes, and add them to the checksum.

        Parameters
        ----------
        length : int
            Bytes; fewer are returned at the end of the file.
        """
        data = self._stream.read(min(length, self.size - self.offset))
        self.offset += len(data)
        if self.crc is not None:
            self.crc = zlib.crc32(data, self.crc)
        return data

    def skip(self, offset: int) -> None:
        """Go on to a later byte; what is passed over is read for the checksum, up to 1 GiB.

        Parameters
        ----------
        offset : int
            Byte of the file, from 0; an earlier one than the next changes nothing.
        """
        if offset - self.offset > _READ_ANYWAY:
            self.crc = None
            self.offset = self._stream.seek(offset)
        while self.offset < offset and self.take(min(_PIECE, offset - self.offset)):
            pass

    def tail(self, length: int) -> bytes:
        """Read the last bytes of the file, and leave `offset` as it is.

        Parameters
        ----------
        length : int
            Bytes; fewer are returned of a shorter file.
        """
        return self.at(max(self.size - length, 0), length)

    def at(self, offset: int, length: int) -> bytes:
        """Read bytes anywhere in the file, and leave `offset` as it is.

        Parameters
        ----------
        offset : int
            Byte of the file, from 0.
        length : int
            Bytes; fewer are returned at the end of the file.
        """
        return os.pread(self._stream.fileno(), length, offset)
