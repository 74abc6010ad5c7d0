"""Labels and segments as they were recorded, and as they come out now."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from hearthlog.recorder.pipeline import Record
from hearthlog.schemas import messages
from hearthlog.schemas.chunks import RawMessages
from hearthlog.schemas.columns import decode
from hearthlog.schemas.layout import message_type
from hearthlog.schemas.rows import decode_rows


@dataclass
class Comparison:
    """Counts of what was recorded and of how much of it came out again.

    Attributes
    ----------
    labels, segments : int
        Recorded ones.
    same_labels : int
        Came out with the same name for the same frame.
    identical_labels, identical_segments : int
        Came out bit for bit.
    """

    labels: int = 0
    same_labels: int = 0
    identical_labels: int = 0
    segments: int = 0
    identical_segments: int = 0
    _waiting: set[tuple[int, bytes]] = field(default_factory=set, repr=False)

    @property
    def identical(self) -> bool:
        """Whether all that was recorded came out bit for bit."""
        return (self.labels, self.segments) == (self.identical_labels, self.identical_segments)

    def add_labels(
        self, recorded: Sequence[RawMessages], replayed: Sequence[Record], end: int
    ) -> None:
        """Count the labels of one span of time; those from `end` on were not replayed."""
        old = dict(item for raw in recorded for item in _payloads(raw) if item[0] < end)
        new = {record.log_time: record.data for record in replayed}
        other = {time: data for time, data in new.items() if time in old and data != old[time]}
        identical = len(old.keys() & new.keys()) - len(other)
        self.labels += len(old)
        self.identical_labels += identical
        self.same_labels += identical + _count_same(recorded, other)

    def add_segments(
        self, recorded: Sequence[RawMessages], replayed: Sequence[Record], end: int
    ) -> None:
        """Count the segments of one span of time.

        Parameters
        ----------
        recorded, replayed : sequence
            A segment that closes at a gap is recorded earlier than it is replayed.
        end : int
            Of the last frame that was replayed: earlier segments come out no more.
        """
        self._waiting.update(item for raw in recorded for item in _payloads(raw))
        met = self._waiting & {(record.log_time, record.data) for record in replayed}
        over = {item for item in self._waiting if item[0] < end}
        self.segments += len(met | over)
        self.identical_segments += len(met)
        self._waiting -= met | over

    def finish(self, *, cut: bool) -> None:
        """Count what was recorded and never came; not so if the replay was cut before it."""
        if not cut:
            self.segments += len(self._waiting)
        self._waiting.clear()


def _payloads(raw: RawMessages) -> Iterator[tuple[int, bytes]]:
    places = zip(raw.log_times.tolist(), raw.offsets.tolist(), raw.sizes.tolist(), strict=True)
    return ((time, raw.buffer[place : place + size].tobytes()) for time, place, size in places)


def _count_same(recorded: Sequence[RawMessages], replayed: Mapping[int, bytes]) -> int:
    """Count the replayed labels whose names are the recorded ones of their times."""
    if not replayed:
        return 0
    sizes = np.array([len(data) for data in replayed.values()])
    buffer = np.frombuffer(b"".join(replayed.values()), np.uint8)
    kind = message_type(messages.LABEL)
    names = decode_rows(kind, buffer, np.cumsum(sizes) - sizes, sizes, ["label"])["label"]
    new = dict(zip(replayed, names.tolist(), strict=True))
    old = {
        time: name
        for columns in decode(recorded, ["label"])
        for time, name in zip(columns.log_times.tolist(), columns["label"].tolist(), strict=True)
    }
    return sum(old[time] == name for time, name in new.items())
