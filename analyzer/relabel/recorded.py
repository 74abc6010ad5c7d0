"""Recorded events of a log, and the comparison of labels and segments with a replay."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.logs.recorder_info import RecorderInfo, features_of
from hearthlog.analyzer.logs.selection import is_compatible
from hearthlog.analyzer.logs.sound_vectors import (
    DIRECTION_FIELDS,
    EMBEDDING_FIELDS,
    LARGEST_FRAME,
    directions_of,
    embeddings_of,
)
from hearthlog.models.classifiers.evidence import NO_AUXILIARY, NOWHERE, Auxiliary, Directions
from hearthlog.models.embedding import NO_EMBEDDINGS, Embeddings
from hearthlog.recorder.events import Gap, SourceHealth
from hearthlog.recorder.stream import EncodedMessage
from hearthlog.schemas.arrays import Bytes, Float32, Int64
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.columns import Columns, decode
from hearthlog.schemas.logs.merged_reading import iterate_messages
from hearthlog.schemas.mcap.raw_messages import RawMessages
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.cdr_codec import Fields, decode_rows
from hearthlog.schemas.messages.fields import fields_of, lacking
from hearthlog.schemas.messages.topics import DIAGNOSTICS, EmbeddingSource, topic
from hearthlog.schemas.messages.type_definitions import MessageType, message_type

_SOUND_TYPES = {"features": message_types.FEATURES, "gap": message_types.GAP}
_AUXILIARY_TYPES = {
    "direction": message_types.DIRECTION,
    "embedding": message_types.EMBEDDING,
}
_TYPES = _SOUND_TYPES | {"label": message_types.LABEL, "segment": message_types.SEGMENT}
_FIELDS = {
    message_types.FEATURES: ("header.stamp", "frame", "values"),
    message_types.GAP: ("header.stamp", "duration", "reason", "frames_lost"),
    message_types.DIRECTION: DIRECTION_FIELDS,
    message_types.EMBEDDING: EMBEDDING_FIELDS,
    message_types.DIAGNOSTICS: ("status",),
    message_types.LABEL: ("label",),
    message_types.SEGMENT: ("label",),
}
_LARGEST_VALUE = 1e30  # of a feature: its statistics are still finite
_PLACE_BITS = 40

_RawByType = dict[str, list[RawMessages]]
_Rows = TypeVar("_Rows", Directions, Embeddings)


class Features(NamedTuple):
    """Features of successive frames, as input of `Pipeline.push_features`."""

    first: int
    values: Float32  # [shape=(n, d)]
    stamps: Int64  # [shape=(n,)]; starts in nanoseconds of UTC
    auxiliary: Auxiliary = NO_AUXILIARY

    def part(self, frames: slice) -> "Features":
        """Return some of the frames."""
        first, stamps = self.first + (frames.start or 0), self.stamps[frames]
        auxiliary = self.auxiliary.available_at(first, len(stamps))
        return Features(first, self.values[frames], stamps, auxiliary)


class RecordedBatch(NamedTuple):
    """Messages of one span of time of a log; events are in log order."""

    events: list[Features | Gap | SourceHealth]
    labels: list[RawMessages]
    segments: list[RawMessages]


def read_recorded(
    info: RecorderInfo,
    start: int,
    end: int,
    *,
    sound_only: bool = False,
    auxiliary: bool = True,
) -> Iterator[RecordedBatch]:
    """Read a log, one span of time after the other, between log times (ns of UTC, end excluded).

    With `sound_only` read only features and gaps, and verify their checksums; with `auxiliary` also
    the directions of an array and the embeddings of a network. Raise `LogError` if the log is
    damaged, or was not written by a recorder, or its feature set is not installed.
    """
    width = features_of(info).width
    kinds = _SOUND_TYPES if sound_only else _TYPES
    if auxiliary:
        kinds = kinds | _AUXILIARY_TYPES
    topics = {topic(info.microphone, kind): type_ for kind, type_ in kinds.items()}
    if not sound_only:
        topics[DIAGNOSTICS] = message_types.DIAGNOSTICS
    for batch in iterate_messages([info.path], topics, start, end):
        by_type: _RawByType = {type_: [] for type_ in _FIELDS}
        for raw in batch:
            type_ = topics[raw.channel.topic]
            if type_ == message_types.EMBEDDING and not _is_of(raw, info):
                continue  # embeddings of another network, in a merged log
            if is_compatible(raw.channel, raw.schema, type_, _FIELDS[type_]):
                by_type[type_].append(raw)
        buffers = list(dict.fromkeys(id(raw.buffer) for raw in batch))
        try:
            events = _events(by_type, info.microphone, width, buffers)
        except LogError as error:
            raise LogError(f"{info.path}: {error}") from error
        yield RecordedBatch(events, by_type[message_types.LABEL], by_type[message_types.SEGMENT])


def _is_of(raw: RawMessages, info: RecorderInfo) -> bool:
    """Return whether embeddings are of the microphone's network."""
    source = EmbeddingSource.from_metadata(raw.channel.metadata)
    return source is not None and source == info.embedding


def _events(
    by_type: _RawByType, microphone: str, width: int, buffers: Sequence[int]
) -> list[Features | Gap | SourceHealth]:
    """Return features, gaps and health in the order of the log."""
    features = [_features(raw, width) for raw in by_type[message_types.FEATURES]]
    others: list[Gap | SourceHealth | None] = [
        gap for raw in by_type[message_types.GAP] for gap in _gaps(raw)
    ]
    for raw in by_type[message_types.DIAGNOSTICS]:
        others += _health(raw, microphone)
    kinds = message_types.FEATURES, message_types.GAP, message_types.DIAGNOSTICS
    raws = [raw for kind in kinds for raw in by_type[kind]]
    if not raws:
        return []
    times = np.concatenate([raw.log_times for raw in raws])
    places = [raw.offsets + (buffers.index(id(raw.buffer)) << _PLACE_BITS) for raw in raws]
    order = np.lexsort((np.concatenate(places), times))
    frames = {
        path: np.concatenate([fields[path] for fields in features])
        for path in (features[0] if features else ())
    }
    directions = _timed(by_type[message_types.DIRECTION], DIRECTION_FIELDS, directions_of)
    embeddings = _timed(by_type[message_types.EMBEDDING], EMBEDDING_FIELDS, embeddings_of)
    count = len(times) - len(others)
    events: list[Features | Gap | SourceHealth] = []
    begin = 0
    for position in [*np.flatnonzero(order >= count).tolist(), len(order)]:
        if position > begin:
            for run in _runs(frames, order[begin:position]):
                here = Auxiliary(
                    _rows_at(run, directions, NOWHERE), _rows_at(run, embeddings, NO_EMBEDDINGS)
                )
                events.append(run._replace(auxiliary=here))
        if position < len(order) and (event := others[order[position] - count]) is not None:
            events.append(event)
        begin = position + 1
    return events


def _runs(frames: Fields, rows: NDArray[np.intp]) -> Iterator[Features]:
    """Split features where frame numbers are not contiguous."""
    numbers = frames["frame"][rows]
    for run in np.split(rows, np.flatnonzero(np.diff(numbers) != 1) + 1):
        first = int(frames["frame"][run[0]])
        yield Features(first, frames["values"][run], frames["header.stamp"][run])


def _features(raw: RawMessages, width: int) -> Fields:
    (columns,) = decode([raw], _FIELDS[message_types.FEATURES])
    values, numbers = columns["values"], columns["frame"]
    if values.shape[1:] != (width,):
        raise LogError(f"{columns.topic}: frames are not of {width} values")
    if not np.abs(values).max() < _LARGEST_VALUE:  # a NaN compares as false
        raise LogError(f"{columns.topic}: holds values that no sound has")
    if numbers.max() > LARGEST_FRAME:
        raise LogError(f"{columns.topic}: holds a frame of number {numbers.max()}")
    _check_times(columns, columns["header.stamp"])
    return columns.fields | {"frame": numbers.astype(np.int64)}


def _timed(
    same: Iterable[RawMessages], fields: Sequence[str], convert: Callable[[Columns], _Rows]
) -> list[tuple[Int64, _Rows]]:
    """Return auxiliary data with their log times."""
    return [
        (columns.log_times, convert(columns)) for raw in same for columns in decode([raw], fields)
    ]


def _rows_at(run: Features, read: Sequence[tuple[Int64, _Rows]], nothing: _Rows) -> _Rows:
    """Return the auxiliary data logged with some frames; the rest belongs to other sound.

    Frames of another recorder run may have the same numbers, but not the same times.
    """
    found = nothing
    for times, rows in read:
        places = rows.last_frames - run.first
        inside = np.flatnonzero((places >= 0) & (places < len(run.stamps)))
        same = inside[run.stamps[places[inside]] == times[inside]]
        found = found.followed_by(rows.rows(same))
    _, once = np.unique(found.frames, return_index=True)
    return found.rows(once)


def _gaps(raw: RawMessages) -> list[Gap]:
    (columns,) = decode([raw], _FIELDS[message_types.GAP])
    starts = columns["header.stamp"]
    ends = starts + columns["duration"]
    _check_times(columns, ends)
    lists = (starts, ends, columns["reason"], columns["frames_lost"])
    return [Gap(*row) for row in zip(*(values.tolist() for values in lists), strict=True)]


def _health(raw: RawMessages, microphone: str) -> list[SourceHealth | None]:
    """Read the health of the source; None for messages about other things."""
    (columns,) = decode([raw], _FIELDS[message_types.DIAGNOSTICS])
    name = message_types.status_name(microphone)
    return [
        next((_state(time, status) for status in array if status["name"] == name), None)
        for time, array in zip(columns.log_times.tolist(), columns["status"], strict=True)
    ]


def _state(time: int, status: dict[str, Any]) -> SourceHealth:
    values = {pair["key"]: pair["value"] for pair in status["values"]}
    return SourceHealth(time, status["level"], status["message"], values)


def _check_times(columns: Columns, times: Int64) -> None:
    if not np.array_equal(columns.log_times, times):
        raise LogError(
            f"{columns.topic}: log times are not those of the sound; this was not written by "
            "`hearthlog record`"
        )


_Absent = frozenset[str]  # fields of this version that other versions lack
_Content = bytes | tuple[bytes, ...]  # a complete message, or one field after the other


@dataclass
class ReplayComparison:
    """Counts of recorded labels and segments, and of identical replayed ones."""

    labels: int = 0  # recorded ones
    same_labels: int = 0  # replayed with the same class for the same frame
    identical_labels: int = 0  # replayed bit for bit, in the recorded fields
    segments: int = 0
    identical_segments: int = 0
    _unmatched: set[tuple[int, _Absent | None, _Content]] = field(default_factory=set, repr=False)

    @property
    def identical(self) -> bool:
        """Whether all recorded labels and segments were replayed bit for bit."""
        return (self.labels, self.segments) == (self.identical_labels, self.identical_segments)

    def add_labels(
        self, recorded: Sequence[RawMessages], replayed: Sequence[EncodedMessage], end: int
    ) -> None:
        """Count the labels of one span; the replay ended at `end`, in nanoseconds of UTC.

        Raise `LogError` if a recorded message does not have the type stated by its channel.
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
        """Count the segments of one span; none earlier than `end` (nanoseconds of UTC) comes after.

        That is the end of the last replayed frame. A segment that closes at a gap is recorded
        earlier than it is replayed. Raise `LogError` if a recorded message does not have the type
        stated by its channel.
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
        """Count the recorded segments that were never replayed.

        If the replay was `cut` short they are not counted, since they might have been replayed
        later.
        """
        if not cut:
            self.segments += len(self._unmatched)
        self._unmatched.clear()


def _by_version(recorded: Iterable[RawMessages]) -> dict[_Absent | None, list[RawMessages]]:
    """Group messages by the fields of this version that they lack; None for this version."""
    versions: dict[_Absent | None, list[RawMessages]] = {}
    for raw in recorded:
        kind = _kind_of(raw)
        versions.setdefault(_absent(kind) if kind.growth else None, []).append(raw)
    return versions


def _kind_of(raw: RawMessages) -> MessageType:
    assert raw.schema is not None  # otherwise it was not read
    return message_type(raw.schema.name, raw.schema.encoding, raw.schema.data)


def _absent(kind: MessageType) -> _Absent:
    """Return the fields of this version that a file's definition lacks."""
    missing = lacking(kind, fields_of(message_type(kind.name)))
    left_out = kind.growth[kind.name].absent if kind.name in kind.growth else ()
    paths = [*missing, *(name for name, _ in left_out)]
    return frozenset(path.partition(".")[0] for path in paths)


def _recorded(
    same: Iterable[RawMessages], absent: _Absent | None
) -> Iterator[tuple[int, _Content]]:
    """Yield log times and contents of recorded messages."""
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
    """Yield log times and contents of replayed messages, in the form of `_recorded`."""
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
    """Yield the fields of this version, except the absent ones."""
    ours = fields_of(message_type(kind.name))
    paths = [path for path in ours if path.partition(".")[0] not in absent]
    columns = decode_rows(kind, buffer, offsets, sizes, paths)
    return zip(*(map(_bits, columns[path]) for path in paths), strict=True)


def _bits(value: Any) -> bytes:
    if isinstance(value, np.ndarray | np.generic) and value.dtype != object:
        return value.tobytes()
    return repr(value.tolist() if isinstance(value, np.ndarray) else value).encode()


def _count_same(recorded: Sequence[RawMessages], replayed: Mapping[int, bytes]) -> int:
    """Count the replayed labels with the class recorded at the same time."""
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
