"""What was lost where a file is damaged, as far as the file still shows it."""

from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from mcap.exceptions import McapError
from mcap.opcode import Opcode

from hearthlog.schemas.logs import rosbag2
from hearthlog.schemas.mcap.definitions import Definitions
from hearthlog.schemas.mcap.formats import CHUNK, HEAD, MESSAGE
from hearthlog.schemas.mcap.records import LIMIT
from hearthlog.schemas.salvage.file_index import Index, UnmetChunks
from hearthlog.schemas.salvage.index_claims import Claim
from hearthlog.schemas.salvage.record_sizes import SHORTEST
from hearthlog.schemas.salvage.record_verifier import RecordVerifier
from hearthlog.schemas.salvage.whole_records import WholeRecord
from hearthlog.schemas.times import millisecond_text

_DAMAGES = 1000  # as many are told apart
_UNMET = "the index lists more than there is"
_NAME_AFTER = {Opcode.METADATA: 0, Opcode.ATTACHMENT: 16}  # bytes


@dataclass(frozen=True)
class Damage:
    """A part of a file that is not whole, and what was lost with it."""

    start: int  # bytes of the file
    end: int
    why: str
    messages: Mapping[str, int] = field(default_factory=dict)  # that are lost, by topic
    exact: bool = True  # whether these are all that are lost
    times: tuple[int, int] | None = None  # log times of the first and last of them
    others: tuple[str, ...] = ()  # names of lost metadata records and attachments
    cut: bool = False  # whether the file just ends here
    sound: bool = False  # whether the file is whole here, and something is left out all the same

    @property
    def lossless(self) -> bool:
        """Whether nothing was lost with it."""
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
    """The damages of a file, and its whole messages of channels that are nowhere defined."""

    def __init__(self) -> None:
        # By channel: messages, first and last log time, and the bytes of the file between them.
        self.unnamed: dict[int, tuple[int, tuple[int, int], tuple[int, int]]] = {}
        self._damages: list[tuple[Damage, dict[int, int]]] = []

    def __len__(self) -> int:
        return len(self._damages)

    def add(self, damage: Damage, messages: dict[int, int] | None = None) -> None:
        """Add a damage, which must be behind all others in the file.

        All from the thousandth on count as one, with the lost messages of the first of them.

        Parameters
        ----------
        messages : dict of int to int, optional
            Lost messages by channel; None for none.
        """
        if len(self._damages) == _DAMAGES:
            last, lost = self._damages.pop()
            lossless = damage.lossless and last.lossless and not messages and not lost
            damage = Damage(last.start, damage.end, "and more", exact=lossless, cut=damage.cut)
            messages = lost
        self._damages.append((damage, messages or {}))

    def add_unnamed(
        self, channel: int, messages: int, times: tuple[int, int], whole: WholeRecord
    ) -> None:
        """Add messages of a channel that is not defined so far.

        Parameters
        ----------
        times : tuple of int
            First and last log time of them, in nanoseconds.
        whole : WholeRecord
            The record they are in, which must be behind those added before for the channel.
        """
        count, span, (start, _) = self.unnamed.get(channel, (0, times, (whole.offset, 0)))
        span = min(span[0], times[0]), max(span[1], times[1])
        self.unnamed[channel] = count + messages, span, (start, whole.end)

    def add_unmet(self, unmet: Iterable[UnmetChunks], names: Sequence[str]) -> None:
        """Add what an index lists and the file does not have, unless damages tell of it already.

        Where the index knows more than a damage, the damage is told.

        Parameters
        ----------
        names : sequence of str
            All metadata records and attachments of the index that were not met.
        """
        starts = [damage.start for damage, _ in self._damages]
        more: list[tuple[Damage, dict[int, int]]] = []
        for chunks in unmet:
            first = bisect_left(starts, chunks.start)
            last = bisect_left(starts, max(chunks.end, chunks.start + 1))
            lost = Counter(chunks.messages)
            for _, told in self._damages[first:last]:
                lost.subtract(told)
            lost = +lost
            if first < last:
                damage, told = self._damages[last - 1]
                if lost or not damage.exact:
                    times = _span(damage.times, chunks.times)
                    damage = replace(damage, exact=chunks.exact, times=times)
                    self._damages[last - 1] = damage, dict(lost + Counter(told))
            elif lost or not chunks.exact:
                damage = Damage(chunks.start, chunks.end, _UNMET, {}, chunks.exact, chunks.times)
                more.append((damage, dict(lost)))
        known = Counter(name for damage, _ in self._damages for name in damage.others)
        others = tuple((Counter(names) - known).elements())
        if others:
            more.append((Damage(0, 0, _UNMET, others=others), {}))
        self._insert(more)

    def add_claims(self, claims: Iterable[Claim]) -> None:
        """Add what message indexes list and no chunk has."""
        why = "message indexes list more than there is"
        self._insert(
            [(Damage(start, start, why, times=times), dict(lost)) for start, lost, times in claims]
        )

    def _insert(self, more: list[tuple[Damage, dict[int, int]]]) -> None:
        """Put damages among the others by their offsets; too many of them become one."""
        room = max(_DAMAGES - len(self._damages), 1)
        if len(more) > room:
            rest = more[room - 1 :]
            exact = all(damage.exact for damage, _ in rest)
            ends = rest[0][0].start, max(damage.end for damage, _ in rest)
            lost = sum((Counter(lost) for _, lost in rest), Counter[int]())
            more[room - 1 :] = [(Damage(*ends, _UNMET, exact=exact), dict(lost))]
        self._damages = sorted([*self._damages, *more], key=lambda each: each[0].start)

    def resolve(self, definitions: Definitions) -> list[Damage]:
        """List the damages, then the messages without a definition, with the names of topics."""
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


class DamagedRange(NamedTuple):
    """Bytes of a file that hold no whole record.

    Attributes
    ----------
    start, end : int
        Bytes of the file at which the range begins, and before which it ends.
    opcode : int
        The first byte of the range.
    ends : tuple of int
        Bytes at which the record should end that may have been here.
    """

    start: int
    end: int
    opcode: int
    ends: tuple[int, ...]


class Loss(NamedTuple):
    """What was lost in a damaged range; fields as of `Damage`, but messages by channel."""

    messages: dict[int, int]
    exact: bool
    times: tuple[int, int] | None = None
    others: tuple[str, ...] = ()


_NOTHING = Loss({}, exact=True)


def _span(first: tuple[int, int] | None, second: tuple[int, int]) -> tuple[int, int]:
    return second if first is None else (min(first[0], second[0]), max(first[1], second[1]))


def loss_in(reader: RecordVerifier, damaged: DamagedRange, index: Index | None) -> Loss:
    """Find out what was lost in a damaged range.

    Parameters
    ----------
    index : Index or None
        Index of the file. None if the file has none that is whole: the bytes of the range and the
        message indexes behind it then tell what was lost, as where the index has moved.
    """
    if index is None or index.moved:
        return _loss_by_neighbours(reader, damaged)
    others = tuple(
        name for offset, name in index.names.items() if damaged.start <= offset < damaged.end
    )
    if not len(index.chunks):
        lost = _loss_by_neighbours(reader, damaged)
        return lost._replace(others=others or lost.others)
    first, last = np.searchsorted(index.chunks[:, 0], [damaged.start, damaged.end])
    if first == last:
        return Loss({}, True, None, others)
    chunks = index.chunks[first:last]
    times = int(chunks[:, 3].min()), int(chunks[:, 4].max())
    messages = index.messages_of(int(first), int(last))
    return Loss(messages, exact=True, times=times, others=others)


def _loss_by_neighbours(reader: RecordVerifier, damaged: DamagedRange) -> Loss:
    start, end, opcode, ends = damaged
    is_cut_chunk = opcode == Opcode.CHUNK and (end == reader.end or max(ends, default=0) > end)
    if end - start < MESSAGE.size and not is_cut_chunk:
        return _NOTHING
    is_record = end in ends or end == reader.end
    if end in ends and reader.like_message_index(start):
        return _NOTHING  # whatever its first byte says
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
        name = _name(reader, start + HEAD.size + _NAME_AFTER[Opcode(opcode)])
        kind = "the metadata" if opcode == Opcode.METADATA else "the attachment"
        return Loss({}, True, None, () if name == rosbag2.METADATA else (f"{kind} {name!r}",))
    is_message = opcode == Opcode.MESSAGE or SHORTEST[opcode] > LIMIT
    return _NOTHING if is_record and not is_message else Loss({}, exact=False)


def _count(
    reader: RecordVerifier, offset: int, messages: dict[int, int]
) -> tuple[int, tuple[int, int] | None]:
    """Count messages by the indexes from here on; return where these end, and their times."""
    times = []
    with suppress(McapError):
        while True:
            channel, entries, offset = reader.message_index(offset)
            messages[channel] = messages.get(channel, 0) + len(entries)
            if len(entries):
                times += [int(entries["time"].min()), int(entries["time"].max())]
    return offset, (min(times), max(times)) if times else None


def _name(reader: RecordVerifier, offset: int) -> str:
    length = int.from_bytes(reader.read(offset, 4), "little")
    return reader.read(offset + 4, min(length, 100)).decode(errors="replace")
