"""Labels and segments as they were recorded, and as they come out now."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hearthlog.recorder.pipeline import EncodedMessage
from hearthlog.schemas.arrays import Bytes, Int64
from hearthlog.schemas.logs.columns import decode
from hearthlog.schemas.mcap.raw_messages import RawMessages
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.cdr_codec import decode_rows
from hearthlog.schemas.messages.cdr_layout import MessageType, message_type
from hearthlog.schemas.messages.fields import fields_of, lacking

_Without = frozenset[str]  # fields that messages of another version do not have
_Content = bytes | tuple[bytes, ...]  # of a message: all of it, or field by field


@dataclass
class ReplayComparison:
    """Counts of what was recorded and of how much of it came out again.

    Attributes
    ----------
    labels, segments : int
        Recorded ones.
    same_labels : int
        Came out with the same name for the same frame.
    identical_labels, identical_segments : int
        Came out bit for bit, in the fields that they were recorded with.
    """

    labels: int = 0
    same_labels: int = 0
    identical_labels: int = 0
    segments: int = 0
    identical_segments: int = 0
    _waiting: set[tuple[int, _Without | None, _Content]] = field(default_factory=set, repr=False)

    @property
    def identical(self) -> bool:
        """Whether all that was recorded came out bit for bit."""
        return (self.labels, self.segments) == (self.identical_labels, self.identical_segments)

    def add_labels(
        self, recorded: Sequence[RawMessages], replayed: Sequence[EncodedMessage], end: int
    ) -> None:
        """Count the labels of one span of time; those from `end` on were not replayed."""
        for without, same in _by_version(recorded).items():
            old = {time: data for time, data in _recorded(same, without) if time < end}
            new = dict(_replayed(replayed, message_types.LABEL, without))
            other = {time for time in old.keys() & new.keys() if new[time] != old[time]}
            identical = len(old.keys() & new.keys()) - len(other)
            self.labels += len(old)
            self.identical_labels += identical
            changed = {r.log_time: r.data for r in replayed if r.log_time in other}
            self.same_labels += identical + _count_same(same, changed)

    def add_segments(
        self, recorded: Sequence[RawMessages], replayed: Sequence[EncodedMessage], end: int
    ) -> None:
        """Count the segments of one span of time.

        Parameters
        ----------
        recorded, replayed : sequence
            A segment that closes at a gap is recorded earlier than it is replayed.
        end : int
            Of the last frame that was replayed: earlier segments come out no more.
        """
        for without, same in _by_version(recorded).items():
            self._waiting.update((time, without, data) for time, data in _recorded(same, without))
        met = self._waiting & {
            (time, without, data)
            for without in {without for _, without, _ in self._waiting}
            for time, data in _replayed(replayed, message_types.SEGMENT, without)
        }
        over = {item for item in self._waiting if item[0] < end}
        self.segments += len(met | over)
        self.identical_segments += len(met)
        self._waiting -= met | over

    def finish(self, *, cut: bool) -> None:
        """Count what was recorded and never came; not so if the replay was cut before it."""
        if not cut:
            self.segments += len(self._waiting)
        self._waiting.clear()


def _by_version(recorded: Iterable[RawMessages]) -> dict[_Without | None, list[RawMessages]]:
    """Sort messages by what they lack of what is replayed; None: they are of this version."""
    versions: dict[_Without | None, list[RawMessages]] = {}
    for raw in recorded:
        kind = _kind_of(raw)
        versions.setdefault(_without(kind) if kind.growth else None, []).append(raw)
    return versions


def _kind_of(raw: RawMessages) -> MessageType:
    assert raw.schema is not None  # or it was not read
    return message_type(raw.schema.name, raw.schema.encoding, raw.schema.data)


def _without(kind: MessageType) -> _Without:
    """Name the fields of ours that a file's definition does not have."""
    missing = lacking(kind, fields_of(message_type(kind.name)))
    absent = kind.growth[kind.name].absent if kind.name in kind.growth else ()
    return frozenset([*(path.partition(".")[0] for path in missing), *(name for name, _ in absent)])


def _recorded(
    same: Iterable[RawMessages], without: _Without | None
) -> Iterator[tuple[int, _Content]]:
    """Yield log times, and what messages say."""
    for raw in same:
        kind, times = _kind_of(raw), raw.log_times.tolist()
        if without is not None:
            contents = _contents(kind, without, raw.buffer, raw.offsets, raw.sizes)
            yield from zip(times, contents, strict=True)
            continue
        for time, place, size in zip(times, raw.offsets.tolist(), raw.sizes.tolist(), strict=True):
            yield time, raw.buffer[place : place + size].tobytes()


def _replayed(
    records: Sequence[EncodedMessage], typename: str, without: _Without | None
) -> Iterator[tuple[int, _Content]]:
    """Yield log times, and what messages say, as `_recorded` does with messages of a version."""
    times = (record.log_time for record in records)
    payloads = [record.data for record in records]
    if without is None or not payloads:
        return zip(times, payloads, strict=True)
    sizes = np.array([len(data) for data in payloads])
    buffer = np.frombuffer(b"".join(payloads), np.uint8)
    kind = message_type(typename)
    contents = _contents(kind, without, buffer, np.cumsum(sizes) - sizes, sizes)
    return zip(times, contents, strict=True)


def _contents(
    kind: MessageType, without: _Without, buffer: Bytes, offsets: Int64, sizes: Int64
) -> Iterator[_Content]:
    """Yield what messages say in the fields of ours, except some."""
    ours = fields_of(message_type(kind.name))
    paths = [path for path in ours if path.partition(".")[0] not in without]
    columns = decode_rows(kind, buffer, offsets, sizes, paths)
    return zip(*(map(_bits, columns[path]) for path in paths), strict=True)


def _bits(value: Any) -> bytes:
    if isinstance(value, np.ndarray | np.generic) and value.dtype != object:
        return value.tobytes()
    return repr(value.tolist() if isinstance(value, np.ndarray) else value).encode()


def _count_same(recorded: Sequence[RawMessages], replayed: Mapping[int, bytes]) -> int:
    """Count the replayed labels whose names are the recorded ones of their times."""
    if not replayed:
        return 0
    sizes = np.array([len(data) for data in replayed.values()])
    buffer = np.frombuffer(b"".join(replayed.values()), np.uint8)
    kind = message_type(message_types.LABEL)
    names = decode_rows(kind, buffer, np.cumsum(sizes) - sizes, sizes, ["label"])["label"]
    new = dict(zip(replayed, names.tolist(), strict=True))
    old = {
        time: name
        for columns in decode(recorded, ["label"])
        for time, name in zip(columns.log_times.tolist(), columns["label"].tolist(), strict=True)
    }
    return sum(old[time] == name for time, name in new.items())
