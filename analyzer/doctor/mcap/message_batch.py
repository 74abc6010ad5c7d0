"""Messages of some chunks, in the order in which they are in the file."""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from hearthlog.schemas.arrays import Bytes, Int64
from hearthlog.schemas.mcap.raw_messages import RawMessages
from hearthlog.schemas.mcap.records import MESSAGE_HEAD

BATCH_SIZE = 4 << 20  # bytes


class ChunkContent(NamedTuple):
    """The records of a chunk.

    Attributes
    ----------
    starts : np.ndarray [shape=(n,)], int64
        Bytes in `records` at which its messages begin, ascending.
    heads : np.ndarray [shape=(n,)], of dtype `MESSAGE_HEAD`
        The heads of these messages.
    """

    records: bytes
    starts: Int64
    heads: NDArray[np.void]


class MessageBatch(NamedTuple):
    """Some messages, still encoded."""

    buffer: Bytes  # [shape=(b,)], uint8: holds their records, and others
    starts: Int64  # [shape=(n,)], int64: where in the buffer their records begin
    heads: NDArray[np.void]  # [shape=(n,)], of dtype `MESSAGE_HEAD`

    def by_channel(
        self, channels: Mapping[int, Channel], schemas: Mapping[int, Schema]
    ) -> Iterator[RawMessages]:
        """Group the messages by channel, without those of channels that are not defined."""
        for identity in np.flatnonzero(np.bincount(self.heads["channel"])).tolist():
            if identity in channels:
                channel = channels[identity]
                rows = self.heads["channel"] == identity
                offsets = self.starts[rows] + MESSAGE_HEAD.itemsize
                schema = schemas.get(channel.schema_id)
                yield RawMessages(channel, schema, self.buffer, offsets, self.heads[rows])


def batches(chunks: Sequence[ChunkContent]) -> Iterator[MessageBatch]:
    """Yield the messages of some chunks, a few megabytes each time, however large a chunk is.

    Parameters
    ----------
    chunks : sequence of ChunkContent
        At least one.
    """
    firsts = np.cumsum([0, *(len(chunk.records) for chunk in chunks[:-1])]).tolist()
    buffer = np.frombuffer(b"".join(chunk.records for chunk in chunks), np.uint8)
    starts = np.concatenate([c.starts + first for c, first in zip(chunks, firsts, strict=True)])
    heads = np.concatenate([chunk.heads for chunk in chunks])
    number = np.cumsum(heads["length"]) // BATCH_SIZE
    for rows in np.split(np.arange(len(starts)), np.flatnonzero(np.diff(number)) + 1):
        if len(rows):
            some = slice(rows[0], rows[-1] + 1)
            yield MessageBatch(buffer, starts[some], heads[some])
