"""Losses in a damaged file, found by its index and neighbouring records."""

from bisect import bisect_left
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from mcap.exceptions import McapError
from mcap.opcode import Opcode

from hearthlog.schemas.frames import millisecond_text
from hearthlog.schemas.logs.metadata import ROSBAG2_METADATA
from hearthlog.schemas.mcap.records import (
    CHUNK,
    HEAD,
    LIMIT,
    MESSAGE,
    Definitions,
)
from hearthlog.schemas.salvage.index import Index, MissingMessages
from hearthlog.schemas.salvage.intact_records import (
    SHORTEST,
    IntactRecord,
)
from hearthlog.schemas.salvage.record_verifier import RecordVerifier

_DAMAGES = 1000  # maximum number of separate damages
_MORE_IN_INDEX = "the index lists more than there is"
_NAME_AFTER = {Opcode.METADATA: 0, Opcode.ATTACHMENT: 16}  # offset of the name in bytes


@dataclass(frozen=True)
class Damage:
    """Damaged part of a file, and its losses."""

    start: int  # byte range in the file
    end: int
    why: str
    messages: Mapping[str, int] = field(default_factory=dict)  # lost messages by topic
    exact: bool = True  # whether these are all lost messages
    times: tuple[int, int] | None = None  # first and last log time of the lost messages
    others: tuple[str, ...] = ()  # names of lost metadata records and attachments
    cut: bool = False  # whether the file is truncated here
    sound: bool = False  # whether the file is undamaged here, but data are skipped

    @property
    def lossless(self) -> bool:
        """Whether nothing was lost."""
        return self.exact and not self.messages and not self.others

    def __str__(self) -> str:
        where = f"{self.why} at byte {self.start}"
        if not self.sound:
            where = f"damaged at byte {self.start} ({self.why})"
        if self.lossless:
            return f"{where}: nothing is lost"
        lost = [f"{count} of {topic}" for topic, count in sorted(self.messages.items())]
        if not self.exact:
            lost.append("perhaps more" if lost else "an unknown number of messages")
        span = "" if self.times is None else ", " + " to ".join(map(millisecond_text, self.times))
        return f"{where}: lost up to byte {self.end}: {', '.join([*lost, *self.others])}{span}"


class DamageList:
    """Damages of a file, and undamaged messages of undefined channels."""

    def __init__(self) -> None:
        # By channel: number of messages, first and last log time, and their byte range in the file.
        self.unnamed: dict[int, tuple[int, tuple[int, int], tuple[int, int]]] = {}
        self._damages: list[tuple[Damage, dict[int, int]]] = []

    def __len__(self) -> int:
        return len(self._damages)

    def add(self, damage: Damage, messages: dict[int, int] | None = None) -> None:
        """Add a damage behind all others in the file, with lost messages by channel.

        From the thousandth on, damages are merged, with the lost messages of the first of them.
        """
        if len(self._damages) == _DAMAGES:
            last, lost = self._damages.pop()
            lossless = damage.lossless and last.lossless and not messages and not lost
            damage = Damage(last.start, damage.end, "and more", exact=lossless, cut=damage.cut)
            messages = lost
        self._damages.append((damage, messages or {}))

    def add_unnamed(
        self, channel: int, messages: int, times: tuple[int, int], intact: IntactRecord
    ) -> None:
        """Add messages of a channel without a definition so far.

        `times` are their first and last log time in nanoseconds, `intact` is their record, behind
        those added before for the channel.
        """
        count, span, (start, _) = self.unnamed.get(channel, (0, times, (intact.offset, 0)))
        span = min(span[0], times[0]), max(span[1], times[1])
        self.unnamed[channel] = count + messages, span, (start, intact.end)

    def add_unmet(self, unmet: Iterable[MissingMessages], names: Sequence[str]) -> None:
        """Add records of the index that the file lacks, unless known damages cover them.

        If the index has more detail than a damage, the damage is updated. `names` are all missing
        metadata records and attachments of the index.
        """
        starts = [damage.start for damage, _ in self._damages]
        more: list[tuple[Damage, dict[int, int]]] = []
        for chunks in unmet:
            first = bisect_left(starts, chunks.start)
            last = bisect_left(starts, max(chunks.end, chunks.start + 1))
            lost = Counter(chunks.messages)
            for _, counts in self._damages[first:last]:
                lost.subtract(counts)
            lost = +lost
            if first < last:
                damage, counts = self._damages[last - 1]
                if lost or not damage.exact:
                    times = _span(damage.times, chunks.times)
                    damage = replace(damage, exact=chunks.exact, times=times)
                    self._damages[last - 1] = damage, dict(lost + Counter(counts))
            elif lost or not chunks.exact:
                damage = Damage(
                    chunks.start, chunks.end, _MORE_IN_INDEX, {}, chunks.exact, chunks.times
                )
                more.append((damage, dict(lost)))
        reported = Counter(name for damage, _ in self._damages for name in damage.others)
        others = tuple((Counter(names) - reported).elements())
        if others:
            more.append((Damage(0, 0, _MORE_IN_INDEX, others=others), {}))
        self._insert(more)

    def add_listed(self, missing: Iterable[MissingMessages]) -> None:
        """Add messages that message indexes list and no chunk holds."""
        why = "message indexes list more than there is"
        self._insert(
            [(Damage(m.start, m.end, why, times=m.times), dict(m.messages)) for m in missing]
        )

    def _insert(self, more: list[tuple[Damage, dict[int, int]]]) -> None:
        """Insert damages by offset; merge them beyond the limit."""
        room = max(_DAMAGES - len(self._damages), 1)
        if len(more) > room:
            rest = more[room - 1 :]
            exact = all(damage.exact for damage, _ in rest)
            ends = rest[0][0].start, max(damage.end for damage, _ in rest)
            lost = sum((Counter(lost) for _, lost in rest), Counter[int]())
            more[room - 1 :] = [(Damage(*ends, _MORE_IN_INDEX, exact=exact), dict(lost))]
        self._damages = sorted([*self._damages, *more], key=lambda each: each[0].start)

    def resolve(self, definitions: Definitions) -> list[Damage]:
        """List the damages, then the messages without a definition, with topic names."""
        damages = []
        for damage, lost in self._damages:
            messages: dict[str, int] = {}
            for channel, count in lost.items():
                topic = definitions.topic(channel)
                messages[topic] = messages.get(topic, 0) + count
            damages.append(replace(damage, messages=messages))
        for channel, (count, times, place) in self.unnamed.items():
            why = f"nothing that is left says what channel {channel} is"
            messages = {definitions.topic(channel): count}
            damages.append(Damage(*place, why, messages, times=times))
        return damages


class Loss(NamedTuple):
    """Losses in a damaged range; fields as in `Damage`, but messages by channel."""

    messages: dict[int, int]
    exact: bool
    times: tuple[int, int] | None = None
    others: tuple[str, ...] = ()


_NOTHING = Loss({}, exact=True)


def _span(first: tuple[int, int] | None, second: tuple[int, int]) -> tuple[int, int]:
    return second if first is None else (min(first[0], second[0]), max(first[1], second[1]))


def loss_in(
    reader: RecordVerifier, start: int, end: int, ends: Collection[int], index: Index | None
) -> Loss:
    """Determine the losses in a byte range without any complete record.

    `ends` are possible ends of the damaged record. Without a valid index the bytes of the range and
    the message indexes behind it are used instead, as for a moved index.
    """
    if index is None or index.moved:
        return _loss_by_neighbours(reader, start, end, ends)
    others = tuple(name for offset, name in index.names.items() if start <= offset < end)
    if not len(index.chunks):
        lost = _loss_by_neighbours(reader, start, end, ends)
        return lost._replace(others=others or lost.others)
    first, last = np.searchsorted(index.chunks[:, 0], [start, end])
    if first == last:
        return Loss({}, True, None, others)
    chunks = index.chunks[first:last]
    times = int(chunks[:, 3].min()), int(chunks[:, 4].max())
    messages = index.messages_of(int(first), int(last))
    return Loss(messages, exact=True, times=times, others=others)


def _loss_by_neighbours(
    reader: RecordVerifier, start: int, end: int, ends: Collection[int]
) -> Loss:
    opcode = reader.read(start, 1)[0]
    is_cut_chunk = opcode == Opcode.CHUNK and (end == reader.end or max(ends, default=0) > end)
    if end - start < MESSAGE.size and not is_cut_chunk:
        return _NOTHING
    is_record = end in ends or end == reader.end
    if end in ends and reader.like_message_index(start):
        return _NOTHING  # regardless of the first byte
    if opcode == Opcode.CHUNK:
        messages: dict[int, int] = {}
        behind, span = _count(reader, end, messages)
        head = reader.read(start + HEAD.size, CHUNK.size).ljust(CHUNK.size, b"\0")
        times = CHUNK.unpack(head)[:2]
        exact = bool(messages) and end in ends and behind < reader.end and reader.plausible(behind)
        exact = exact and reader.read(behind, 1)[0] != Opcode.MESSAGE_INDEX
        is_sound = 0 < times[0] <= times[1] < 1 << 63
        return Loss(messages, exact, span or (times if is_sound else None))
    if opcode in _NAME_AFTER and is_record:
        place = start + HEAD.size + _NAME_AFTER[Opcode(opcode)]
        length = int.from_bytes(reader.read(place, 4), "little")
        name = reader.read(place + 4, min(length, 100)).decode(errors="replace")
        kind = "the metadata" if opcode == Opcode.METADATA else "the attachment"
        return Loss({}, True, None, () if name == ROSBAG2_METADATA else (f"{kind} {name!r}",))
    is_message = opcode == Opcode.MESSAGE or SHORTEST[opcode] > LIMIT
    return _NOTHING if is_record and not is_message else Loss({}, exact=False)


def _count(
    reader: RecordVerifier, offset: int, messages: dict[int, int]
) -> tuple[int, tuple[int, int] | None]:
    """Count messages by the message indexes at an offset; return their end and log times."""
    times = []
    with suppress(McapError):
        while True:
            channel, entries, offset = reader.message_index(offset)
            messages[channel] = messages.get(channel, 0) + len(entries)
            if len(entries):
                times += [int(entries["time"].min()), int(entries["time"].max())]
    return offset, (min(times), max(times)) if times else None
