"""Messages that several logs hold: those of a log and of its merged, cut or recovered copies."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hearthlog.schemas.arrays import Indices
from hearthlog.schemas.mcap.chunk_writer import message_blocks
from hearthlog.schemas.mcap.raw_messages import RawMessages


def without_repeats(batch: Sequence[RawMessages]) -> list[RawMessages]:
    """Leave out messages that another log holds, too.

    Parameters
    ----------
    batch : sequence of RawMessages
        With all messages of a log time, or none.

    Returns
    -------
    list of RawMessages
        Of messages with the same topic, times, sequence and bytes, the first ones stay: as many as
        one log has. Equal messages of one log are no repeats.
    """
    topics: dict[tuple[str, str, str], list[int]] = {}
    for place, messages in enumerate(batch):
        kind = "" if messages.schema is None else messages.schema.name
        key = messages.channel.topic, messages.channel.message_encoding, kind
        topics.setdefault(key, []).append(place)
    kept = list(batch)
    for places in topics.values():
        parts = [batch[place] for place in places]
        if len({part.source for part in parts}) == 1:
            continue
        for place, rows in zip(places, _repeated(parts), strict=True):
            if len(rows):
                kept[place] = batch[place].take(np.delete(np.arange(len(batch[place])), rows))
    return [messages for messages in kept if len(messages)]


def _repeated(parts: Sequence[RawMessages]) -> list[Indices]:
    """Find the rows of each part that repeat one of another source, in an earlier part."""
    dropped: list[list[Indices]] = [[np.arange(0)] for _ in parts]
    numbers = {source: number for number, source in enumerate({part.source for part in parts})}
    sources = [numbers[part.source] for part in parts]
    records: dict[int, list[tuple[int, Indices, NDArray[np.void]]]] = {}  # by their size
    for place, rows in enumerate(_of_shared_times(parts, sources)):
        for block in message_blocks(parts[place].take(rows), 0):
            data = block.records()
            records.setdefault(data.dtype.itemsize, []).append((place, rows[block.rank], data))
    for same in records.values():
        counts = [len(rows) for _, rows, _ in same]
        _, equal = np.unique(np.concatenate([data for _, _, data in same]), return_inverse=True)
        of_source = np.repeat([sources[place] for place, _, _ in same], counts)
        repeats = np.ones(len(equal), bool)
        number = _numbered(equal, of_source)
        firsts = np.unique(equal * len(equal) + number, return_index=True)[1]
        repeats[firsts] = False
        for (place, rows, _), again in zip(
            same, np.split(repeats, np.cumsum(counts)[:-1]), strict=True
        ):
            dropped[place].append(rows[again])
    return [np.concatenate(rows) for rows in dropped]


def _numbered(equal: Indices, sources: Indices) -> Indices:
    """Count equal messages of one source: 0, 1, 2 and so on."""
    order = np.lexsort((equal, sources))
    new = np.ones(len(order), bool)
    new[1:] = (np.diff(equal[order]) != 0) | (np.diff(sources[order]) != 0)
    places = np.arange(len(order))
    numbers = np.empty(len(order), np.intp)
    numbers[order] = places - np.maximum.accumulate(np.where(new, places, 0))
    return numbers


def _of_shared_times(parts: Sequence[RawMessages], sources: Sequence[int]) -> list[Indices]:
    """Find the rows of each part whose log time another source has as well."""
    counts = [len(part) for part in parts]
    times = np.concatenate([part.log_times for part in parts])
    of_source = np.repeat(sources, counts)
    order = np.argsort(times, kind="stable")
    firsts = np.flatnonzero(np.diff(times[order], prepend=times[order[0]] - 1))
    lowest, highest = (each.reduceat(of_source[order], firsts) for each in (np.minimum, np.maximum))
    shared = np.empty(len(times), bool)
    shared[order] = np.repeat(lowest != highest, np.diff(firsts, append=len(times)))
    return [np.flatnonzero(rows) for rows in np.split(shared, np.cumsum(counts)[:-1])]
