"""Messages of one channel, still encoded."""

from dataclasses import dataclass, replace

import numpy as np
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from hearthlog.schemas.arrays import Bytes, Int64, gather
from hearthlog.schemas.mcap.formats import MESSAGE_FIXED, MESSAGE_HEAD


@dataclass(frozen=True)
class RawMessages:
    """Messages of one channel, in the order of their log times."""

    channel: Channel
    schema: Schema | None
    buffer: Bytes  # [shape=(b,)], uint8: holds the messages, and others
    offsets: Int64  # [shape=(n,)], int64: where in the buffer the payloads begin
    heads: NDArray[np.void]  # [shape=(n,)], of dtype `MESSAGE_HEAD`

    def __len__(self) -> int:
        return len(self.offsets)

    @property
    def sizes(self) -> Int64:
        """Bytes of the payloads."""
        return self.heads["length"] - MESSAGE_FIXED

    @property
    def log_times(self) -> Int64:
        """Log times in nanoseconds."""
        return self.heads["log_time"]

    def between(self, start: int | None, end: int | None) -> "RawMessages":
        """Return the messages with start <= log time < end."""
        rows = slice(*bounds(self.log_times, start, end))
        if rows == slice(0, len(self)):
            return self
        return replace(self, offsets=self.offsets[rows], heads=self.heads[rows])


def bounds(times: Int64, start: int | None, end: int | None) -> tuple[int, int]:
    """Return where in ascending times those with start <= time < end begin and stop."""
    first = 0 if start is None else int(np.searchsorted(times, start))
    last = len(times) if end is None else int(np.searchsorted(times, end))
    return first, max(first, last)


def gather_heads(buffer: Bytes | bytes, starts: Int64) -> NDArray[np.void]:
    """Copy the heads (`MESSAGE_HEAD`) of the messages that begin at some bytes of a buffer."""
    if not len(starts):
        return np.empty(0, MESSAGE_HEAD)
    array = np.frombuffer(buffer, np.uint8)
    return gather(array, starts, MESSAGE_HEAD.itemsize).view(MESSAGE_HEAD)
