"""Messages that are there twice: of logs that overlap, or of a chunk that a file holds twice."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hearthlog.schemas.arrays import Indices
from hearthlog.schemas.mcap.message_blocks import message_blocks
from hearthlog.schemas.mcap.raw_messages import RawMessages


def without_repeats(batch: Sequence[RawMessages]) -> list[RawMessages]:
    """Leave out messages that are the same as an earlier one of their topic.

    Parameters
    ----------
    batch : sequence of RawMessages
        With all messages of a log time, or none.

    Returns
    -------
    list of RawMessages
        Of messages with the same topic, times, sequence and bytes, the first one stays.
    """
    topics: dict[tuple[str, str, str], list[int]] = {}
    for place, messages in enumerate(batch):
        kind = "" if messages.schema is None else messages.schema.name
        key = messages.channel.topic, messages.channel.message_encoding, kind
        topics.setdefault(key, []).append(place)
    kept = list(batch)
    for places in topics.values():
        dropped = _repeated([batch[place] for place in places])
        for place, rows in zip(places, dropped, strict=True):
            if len(rows):
                stay = np.delete(np.arange(len(batch[place])), rows)
                kept[place] = _at(batch[place], stay)
    return [messages for messages in kept if len(messages)]


def _at(messages: RawMessages, rows: Indices) -> RawMessages:
    return replace(messages, offsets=messages.offsets[rows], heads=messages.heads[rows])


def _repeated(parts: Sequence[RawMessages]) -> list[Indices]:
    """Find the rows of each part that repeat one before them, in this part or an earlier one."""
    dropped: list[list[Indices]] = [[np.arange(0)] for _ in parts]
    records: dict[int, list[tuple[int, Indices, NDArray[np.void]]]] = {}  # by their size
    for place, rows in enumerate(_of_one_time(parts)):
        chosen = _at(parts[place], rows)
        for block in message_blocks(chosen, 0):
            data = block.records()
            records.setdefault(data.dtype.itemsize, []).append((place, rows[block.rank], data))
    for same in records.values():
        data = np.concatenate([data for _, _, data in same])
        repeats = np.ones(len(data), bool)
        repeats[np.unique(data, return_index=True)[1]] = False
        ends = np.cumsum([len(rows) for _, rows, _ in same])
        for (place, rows, _), again in zip(same, np.split(repeats, ends[:-1]), strict=True):
            dropped[place].append(rows[again])
    return [np.concatenate(rows) for rows in dropped]


def _of_one_time(parts: Sequence[RawMessages]) -> list[Indices]:
    """Find the rows of each part that have the log time of another row, of any part."""
    times = np.concatenate([part.log_times for part in parts])
    order = np.argsort(times, kind="stable")
    again = np.diff(times[order]) == 0
    shared = np.zeros(len(times), bool)
    shared[order[1:]] = again
    shared[order[:-1]] |= again
    ends = np.cumsum([len(part) for part in parts])
    return [np.flatnonzero(rows) for rows in np.split(shared, ends[:-1])]
