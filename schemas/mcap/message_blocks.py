"""Many messages at once, on their way into a file: blocks of one channel and one size."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from hearthlog.schemas.arrays import Bytes, Int64, gather, scatter
from hearthlog.schemas.mcap.formats import HEAD, MESSAGE_FIXED, MESSAGE_HEAD
from hearthlog.schemas.mcap.raw_messages import RawMessages


class Block(NamedTuple):
    """Messages of one channel whose payloads have one size.

    Attributes
    ----------
    log_times, publish_times : np.ndarray [shape=(n,)], int64
        Nanoseconds of UTC.
    sequences : np.ndarray [shape=(n,)], uint32
    payloads : np.ndarray [shape=(n,)], of a dtype of the payloads' size
    rank : np.ndarray [shape=(n,)], int64
        Where log times are equal, the message of lower rank comes first.
    """

    channel: int
    log_times: Int64
    publish_times: Int64
    sequences: NDArray[np.uint32]
    payloads: NDArray[np.void]
    rank: Int64

    def records(self) -> NDArray[np.void]:
        """Encode the messages as MCAP records.

        Returns
        -------
        np.ndarray [shape=(n,)], of dtype V`size`
            One record in each row, with opcode and length; `size` is that of a whole record.
        """
        size = self.payloads.dtype.itemsize
        records = np.empty(len(self.payloads), [("head", MESSAGE_HEAD), ("payload", f"V{size}")])
        head = records["head"]
        head["opcode"] = Opcode.MESSAGE
        head["length"] = MESSAGE_FIXED + size
        head["channel"] = self.channel
        head["sequence"] = self.sequences
        head["log_time"] = self.log_times
        head["publish_time"] = self.publish_times
        records["payload"] = self.payloads.view(f"V{size}")
        return records.view(f"V{records.dtype.itemsize}")


def message_blocks(messages: RawMessages, channel: int, first_rank: int = 0) -> Iterator[Block]:
    """Group messages by the sizes of their payloads, to write them unchanged to a channel."""
    for size in np.unique(messages.sizes).tolist():
        rows = np.flatnonzero(messages.sizes == size)
        heads = messages.heads[rows]
        yield Block(
            channel,
            heads["log_time"],
            heads["publish_time"],
            heads["sequence"],
            gather(messages.buffer, messages.offsets[rows], size),
            first_rank + rows,
        )


class MessageRecords(NamedTuple):
    """Message records of one or more channels, in the order of their log times.

    Attributes
    ----------
    data : np.ndarray [shape=(b,)], uint8
        The records, one behind the other.
    ends : np.ndarray [shape=(n,)], int64
        Bytes of the data before which each record ends.
    sizes : np.ndarray [shape=(n,)], int64
        Bytes of each record.
    channels : np.ndarray [shape=(n,)], int64
        Number of the channel of each.
    times : np.ndarray [shape=(n,)], int64
        Log time of each in nanoseconds, ascending.
    """

    data: Bytes
    ends: Int64
    sizes: Int64
    channels: Int64
    times: Int64


def join_messages(
    channels: Sequence[int], times: Sequence[int], payloads: Sequence[bytes]
) -> MessageRecords:
    """Encode messages as records, in their order.

    Parameters
    ----------
    channels : sequence of int
        Number of the channel of each; one message at least.
    times : sequence of int
        Log time of each, which is also its publish time, in nanoseconds; ascending.
    """
    heads = np.empty(len(payloads), MESSAGE_HEAD)
    heads["opcode"] = Opcode.MESSAGE
    heads["length"] = np.fromiter(map(len, payloads), np.int64, len(payloads)) + MESSAGE_FIXED
    heads["channel"] = channels
    heads["sequence"] = 0
    heads["log_time"] = heads["publish_time"] = times
    pieces = [b""] * (2 * len(payloads))
    pieces[::2] = heads.view(f"V{MESSAGE_HEAD.itemsize}").tolist()  # bytes; S would lose zeros
    pieces[1::2] = payloads
    sizes = heads["length"].astype(np.int64) + HEAD.size
    return MessageRecords(
        np.frombuffer(b"".join(pieces), np.uint8),
        np.cumsum(sizes),
        sizes,
        heads["channel"].astype(np.int64),
        heads["log_time"].astype(np.int64),
    )


def merge_blocks(blocks: Sequence[Block]) -> MessageRecords:
    """Encode the messages of several blocks in the order of their log times.

    Parameters
    ----------
    blocks : sequence of Block
        One or more, none of them empty. Messages of the same log time are sorted by their ranks.
    """
    times = np.concatenate([block.log_times for block in blocks])
    order = np.lexsort((np.concatenate([block.rank for block in blocks]), times))
    counts = [len(block.log_times) for block in blocks]
    records = [block.records() for block in blocks]
    sizes = np.repeat([rows.dtype.itemsize for rows in records], counts)[order]
    ends = np.cumsum(sizes)
    starts = np.empty_like(ends)
    starts[order] = ends - sizes
    data = np.empty(int(ends[-1]), np.uint8)
    first = 0
    for rows in records:
        scatter(rows, data, starts[first : first + len(rows)])
        first += len(rows)
    channels = np.repeat([block.channel for block in blocks], counts)[order]
    return MessageRecords(data, ends, sizes, channels, times[order])
