"""Labels and segments as they were recorded, compared with those of a replay."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hearthlog.recorder.stream.messages import EncodedMessage
from hearthlog.schemas.arrays import Bytes, Int64
from hearthlog.schemas.logs.columns import decode
from hearthlog.schemas.mcap.raw_messages import RawMessages
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.cdr_codec import decode_rows
from hearthlog.schemas.messages.fields import fields_of, lacking
from hearthlog.schemas.messages.type_definitions import MessageType, message_type

_Absent = frozenset[str]  # fields of ours that messages of another version do not have
_Content = bytes | tuple[bytes, ...]  # a whole message, or one field after the other


@dataclass
class ReplayComparison:
    """Counts of recorded labels and segments, and of how many came out again."""

    labels: int = 0  # recorded ones
    same_labels: int = 0  # came out with the same class for the same frame
    identical_labels: int = 0  # came out bit for bit, in the fields that were recorded
    segments: int = 0
    identical_segments: int = 0
    _unmatched: set[tuple[int, _Absent | None, _Content]] = field(default_factory=set, repr=False)

    @property
    def identical(self) -> bool:
        """Whether all recorded labels and segments came out bit for bit."""
        return (self.labels, self.segments) == (self.identical_labels, self.identical_segments)

    def add_labels(
        self, recorded: Sequence[RawMessages], replayed: Sequence[EncodedMessage], end: int
    ) -> None:
        """Count the labels of one span of time.

        Parameters
        ----------
        end : int
            Time from which on nothing was replayed, in nanoseconds of UTC.

        Raises
        ------
        LogError
            If a recorded message is not of the type that its channel says.
        """
        for absent, same in _by_version(recorded).items():
            old = {time: data for time, data in _recorded(same, absent) if time < end}
            new = dict(_replayed(replayed, message_types.LABEL, absent))
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
        replayed : sequence of EncodedMessage
            Segments as they came out again. One that closes at a gap is recorded earlier than it is
            replayed.
        end : int
            End of the last replayed frame, in nanoseconds of UTC: no earlier segment comes after.

        Raises
        ------
        LogError
            If a recorded message is not of the type that its channel says.
        """
        for absent, same in _by_version(recorded).items():
            self._unmatched.update((time, absent, data) for time, data in _recorded(same, absent))
        matched = self._unmatched & {
            (time, absent, data)
            for absent in {absent for _, absent, _ in self._unmatched}
            for time, data in _replayed(replayed, message_types.SEGMENT, absent)
        }
        missed = {item for item in self._unmatched if item[0] < end}
        self.segments += len(matched | missed)
        self.identical_segments += len(matched)
        self._unmatched -= matched | missed

    def finish(self, *, cut: bool) -> None:
        """Count the recorded segments that never came out.

        Parameters
        ----------
        cut : bool
            Whether the replay was cut short: then they are not counted, for they might have come
            out.
        """
        if not cut:
            self.segments += len(self._unmatched)
        self._unmatched.clear()


def _by_version(recorded: Iterable[RawMessages]) -> dict[_Absent | None, list[RawMessages]]:
    """Group messages by the fields of ours that they lack; None where they are of this version."""
    versions: dict[_Absent | None, list[RawMessages]] = {}
    for raw in recorded:
        kind = _kind_of(raw)
        versions.setdefault(_absent(kind) if kind.growth else None, []).append(raw)
    return versions


def _kind_of(raw: RawMessages) -> MessageType:
    assert raw.schema is not None  # or it was not read
    return message_type(raw.schema.name, raw.schema.encoding, raw.schema.data)


def _absent(kind: MessageType) -> _Absent:
    """Return the fields of ours that a file's definition does not have."""
    missing = lacking(kind, fields_of(message_type(kind.name)))
    left_out = kind.growth[kind.name].absent if kind.name in kind.growth else ()
    paths = [*missing, *(name for name, _ in left_out)]
    return frozenset(path.partition(".")[0] for path in paths)


def _recorded(
    same: Iterable[RawMessages], absent: _Absent | None
) -> Iterator[tuple[int, _Content]]:
    """Yield log times and contents of messages."""
    for raw in same:
        kind, times = _kind_of(raw), raw.log_times.tolist()
        if absent is not None:
            contents = _contents(kind, absent, raw.buffer, raw.offsets, raw.sizes)
            yield from zip(times, contents, strict=True)
            continue
        for time, place, size in zip(times, raw.offsets.tolist(), raw.sizes.tolist(), strict=True):
            yield time, raw.buffer[place : place + size].tobytes()


def _replayed(
    records: Sequence[EncodedMessage], typename: str, absent: _Absent | None
) -> Iterator[tuple[int, _Content]]:
    """Yield log times and contents of messages, as `_recorded` does for messages of a version."""
    times = (record.log_time for record in records)
    payloads = [record.data for record in records]
    if absent is None or not payloads:
        return zip(times, payloads, strict=True)
    sizes = np.array([len(data) for data in payloads])
    buffer = np.frombuffer(b"".join(payloads), np.uint8)
    kind = message_type(typename)
    contents = _contents(kind, absent, buffer, np.cumsum(sizes) - sizes, sizes)
    return zip(times, contents, strict=True)


def _contents(
    kind: MessageType, absent: _Absent, buffer: Bytes, offsets: Int64, sizes: Int64
) -> Iterator[_Content]:
    """Yield the fields of messages that we have, except those that are absent."""
    ours = fields_of(message_type(kind.name))
    paths = [path for path in ours if path.partition(".")[0] not in absent]
    columns = decode_rows(kind, buffer, offsets, sizes, paths)
    return zip(*(map(_bits, columns[path]) for path in paths), strict=True)


def _bits(value: Any) -> bytes:
    if isinstance(value, np.ndarray | np.generic) and value.dtype != object:
        return value.tobytes()
    return repr(value.tolist() if isinstance(value, np.ndarray) else value).encode()


def _count_same(recorded: Sequence[RawMessages], replayed: Mapping[int, bytes]) -> int:
    """Count the replayed labels whose class is the recorded one of the same time."""
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
