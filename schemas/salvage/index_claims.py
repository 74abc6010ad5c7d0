"""Message indexes that list messages of no chunk that is there: their chunk is missing."""

import zlib
from array import array
from collections import Counter
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hearthlog.schemas.mcap.formats import INDEX_ENTRIES
from hearthlog.schemas.mcap.stored_chunk import LATEST, StoredChunk

_NO_TIMES = (LATEST, 0)
_KEPT = 1000  # claims
_INDEXES = 1 << 16  # behind a chunk: as many as there can be channels


class Claim(NamedTuple):
    """Messages that are listed by message indexes, and are in no chunk."""

    start: int  # byte of the file behind which they are missing
    messages: Counter[int]  # by channel
    times: tuple[int, int]  # first and last log time


class IndexClaims:
    """Compares the message indexes behind each chunk with the messages of the chunk."""

    def __init__(self) -> None:
        self._claims: list[Claim] = []
        self._spans = array("q")  # first and last log times of all chunks
        self._own: dict[int, NDArray[np.void]] | None = {}  # entries that the chunk should have
        self._listed: Counter[int] = Counter()  # entries by channel
        self._others: set[tuple[int, int]] = set()  # indexes that are not its own
        self._times = _NO_TIMES
        self._start = 0

    def add_chunk(self, end: int, chunk: StoredChunk) -> None:
        """Begin with a chunk.

        Parameters
        ----------
        end : int
            Byte of the file at which it ends.
        """
        self._spans.extend([chunk.start, chunk.end])
        self._begin(end)
        rows = chunk.entries.items()
        self._own = {channel: np.frombuffer(same, INDEX_ENTRIES) for channel, same in rows}

    def add_index(self, channel: int, entries: NDArray[np.void]) -> None:
        """Add the next message index.

        Parameters
        ----------
        entries : np.ndarray [shape=(n,)], of dtype `INDEX_ENTRIES`
        """
        if self._own is None or not len(entries):
            return
        own = self._own.get(channel)
        if own is not None and len(own) == len(entries) and (own == entries).all():
            self._listed[channel] = max(self._listed[channel], len(entries))
            return
        key = channel, zlib.crc32(entries.tobytes())
        if key not in self._others and len(self._others) < _INDEXES:
            self._others.add(key)
            self._listed[channel] += len(entries)
            first, last = int(entries["time"].min()), int(entries["time"].max())
            self._times = min(self._times[0], first), max(self._times[1], last)

    def close(self, end: int) -> None:
        """End with the indexes of a chunk: another record follows.

        Parameters
        ----------
        end : int
            Byte of the file at which that record begins.
        """
        if self._own is not None and self._others and len(self._claims) < _KEPT:
            own = Counter({channel: len(same) for channel, same in self._own.items()})
            if self._listed.total() > own.total():
                self._claims.append(Claim(self._start, self._listed - own, self._times))
        self._begin(end)

    def give_up(self) -> None:
        """Ignore the indexes that follow: the chunk before them is damaged, and tells of them."""
        self._begin(0)
        self._own = None

    def _begin(self, start: int) -> None:
        self._start, self._own, self._listed = start, {}, Counter()
        self._others, self._times = set(), _NO_TIMES

    def unmet(self) -> Iterator[Claim]:
        """List the claims whose time no chunk covers, wherever that is in the file."""
        spans = np.frombuffer(self._spans, np.int64).reshape(-1, 2)
        spans = spans[np.argsort(spans[:, 0], kind="stable")]
        ends = np.maximum.accumulate(spans[:, 1])
        for claim in self._claims:
            middle = sum(claim.times) // 2
            before = int(np.searchsorted(spans[:, 0], middle, side="right"))
            if not before or ends[before - 1] < middle:
                yield claim
