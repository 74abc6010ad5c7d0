"""The events that a recorder's pipeline was given, read back from its log."""

from collections.abc import Iterator, Sequence
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
from hearthlog.models.embedding.projection import NO_EMBEDDINGS, Embeddings
from hearthlog.recorder.events import Gap, SourceHealth
from hearthlog.schemas.arrays import Float32, Int64
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.columns import Columns, decode
from hearthlog.schemas.logs.merged_reading import iterate_messages
from hearthlog.schemas.mcap.raw_messages import RawMessages
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.cdr_codec import Fields
from hearthlog.schemas.messages.topics import DIAGNOSTICS, EmbeddingSource, topic

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
_Known = TypeVar("_Known", Directions, Embeddings)


class Features(NamedTuple):
    """Features of successive frames, as `Pipeline.push_features` takes them.

    Attributes
    ----------
    values : np.ndarray [shape=(n, d)], float32
    stamps : np.ndarray [shape=(n,)], int64
        Starts of the frames in nanoseconds of UTC.
    """

    first: int
    values: Float32
    stamps: Int64
    auxiliary: Auxiliary = NO_AUXILIARY

    def part(self, frames: slice) -> "Features":
        """Return some of the frames."""
        first, stamps = self.first + (frames.start or 0), self.stamps[frames]
        known = self.auxiliary.known_at(first, len(stamps))
        return Features(first, self.values[frames], stamps, known)


class RecordedBatch(NamedTuple):
    """The messages of one span of time of a log; events are in the order of the log."""

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
    """Read a log, one span of time after the other.

    Parameters
    ----------
    start, end : int
        Log times, in nanoseconds of UTC: from `start` on, before `end`.
    sound_only : bool
        Read only features and gaps, and compare the checksums of what is read.
    auxiliary : bool
        Read the directions of an array and the embeddings of a network, too.

    Raises
    ------
    LogError
        If the log is damaged, or its messages are not those of a recorder, or its feature set is
        not installed.
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
                continue  # those of another network, in a log that was merged
            if is_compatible(raw.channel, raw.schema, type_, _FIELDS[type_]):
                by_type[type_].append(raw)
        buffers = list(dict.fromkeys(id(raw.buffer) for raw in batch))
        try:
            events = _events(by_type, info.microphone, width, buffers)
        except LogError as error:
            raise LogError(f"{info.path}: {error}") from error
        yield RecordedBatch(events, by_type[message_types.LABEL], by_type[message_types.SEGMENT])


def _is_of(raw: RawMessages, info: RecorderInfo) -> bool:
    """Return whether embeddings are of the network that is that of the microphone."""
    source = EmbeddingSource.from_metadata(raw.channel.metadata)
    return source is not None and source == info.embedding


def _events(
    by_type: _RawByType, microphone: str, width: int, buffers: Sequence[int]
) -> list[Features | Gap | SourceHealth]:
    """Return features, gaps and health in the order in which they were written."""
    features = [_features(raw, width) for raw in by_type[message_types.FEATURES]]
    others: list[Gap | SourceHealth | None] = [
        gap for raw in by_type[message_types.GAP] for gap in _gaps(raw)
    ]
    for raw in by_type[message_types.DIAGNOSTICS]:
        others += _health(raw, microphone)
    raws = [
        *by_type[message_types.FEATURES],
        *by_type[message_types.GAP],
        *by_type[message_types.DIAGNOSTICS],
    ]
    if not raws:
        return []
    times = np.concatenate([raw.log_times for raw in raws])
    places = [raw.offsets + (buffers.index(id(raw.buffer)) << _PLACE_BITS) for raw in raws]
    order = np.lexsort((np.concatenate(places), times))
    frames = {
        path: np.concatenate([fields[path] for fields in features])
        for path in (features[0] if features else ())
    }
    directions = [_directions(raw) for raw in by_type[message_types.DIRECTION]]
    embeddings = [_embeddings(raw) for raw in by_type[message_types.EMBEDDING]]
    count = len(times) - len(others)
    events: list[Features | Gap | SourceHealth] = []
    begin = 0
    for position in [*np.flatnonzero(order >= count).tolist(), len(order)]:
        if position > begin:
            for run in _runs(frames, order[begin:position]):
                here = Auxiliary(
                    _known(run, directions, NOWHERE), _known(run, embeddings, NO_EMBEDDINGS)
                )
                events.append(run._replace(auxiliary=here))
        if position < len(order) and (event := others[order[position] - count]) is not None:
            events.append(event)
        begin = position + 1
    return events


def _runs(frames: Fields, rows: NDArray[np.intp]) -> Iterator[Features]:
    """Cut features where a frame does not follow the one before."""
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


def _directions(raw: RawMessages) -> tuple[Int64, Directions]:
    """Return directions, and when they were known."""
    (columns,) = decode([raw], _FIELDS[message_types.DIRECTION])
    return columns.log_times, directions_of(columns)


def _embeddings(raw: RawMessages) -> tuple[Int64, Embeddings]:
    """Return embeddings, and when they were known."""
    (columns,) = decode([raw], _FIELDS[message_types.EMBEDDING])
    return columns.log_times, embeddings_of(columns)


def _known(run: Features, read: Sequence[tuple[Int64, _Known]], nothing: _Known) -> _Known:
    """Return what became known with some frames; the rest is of sound that is not here.

    Frames of another run of a recorder may have the same numbers, but not the same times.
    """
    known = nothing
    for times, rows in read:
        places = rows.last_frames - run.first
        inside = np.flatnonzero((places >= 0) & (places < len(run.stamps)))
        same = inside[run.stamps[places[inside]] == times[inside]]
        known = known.followed_by(rows.rows(same))
    _, once = np.unique(known.frames, return_index=True)
    return known.rows(once)


def _gaps(raw: RawMessages) -> list[Gap]:
    (columns,) = decode([raw], _FIELDS[message_types.GAP])
    starts = columns["header.stamp"]
    ends = starts + columns["duration"]
    _check_times(columns, ends)
    lists = (starts, ends, columns["reason"], columns["frames_lost"])
    return [Gap(*row) for row in zip(*(values.tolist() for values in lists), strict=True)]


def _health(raw: RawMessages, microphone: str) -> list[SourceHealth | None]:
    """Read the health of the source; None for messages about something else."""
    (columns,) = decode([raw], _FIELDS[message_types.DIAGNOSTICS])
    name = f"hearthlog: {microphone}"
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
