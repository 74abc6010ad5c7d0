"""Count what is in a log, or in a folder of logs."""

import struct
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from hearthlog.analyzer.logs.health import statuses_of
from hearthlog.analyzer.logs.summary import GapSummary, Summary, TopicSummary, worse
from hearthlog.analyzer.logs.typed_columns import decode_types, is_compatible
from hearthlog.models.classes import SILENCE, UNKNOWN, class_name
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import FRAME_SECONDS
from hearthlog.schemas.logs.columns import Columns
from hearthlog.schemas.logs.files import is_layer
from hearthlog.schemas.logs.provenance import read_provenance, version_text
from hearthlog.schemas.mcap.chunk_table import RecordLocation
from hearthlog.schemas.mcap.chunks import read_in_batches
from hearthlog.schemas.mcap.formats import HEAD
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import REVIEW
from hearthlog.schemas.times import NANOSECONDS

_STREAM = {
    "microphone": "header.frame_id",
    "device": "device",
    "feature_set": "feature_set",
    "frame_seconds": "frame_seconds",
    "model": "model",
    "model_sha256": "model_sha256",
}
_FIELDS = {
    message_types.STREAM_INFO: _STREAM.values(),
    message_types.LABEL: ("label",),
    message_types.SEGMENT: ("label", "duration", "confidence"),
    message_types.GAP: ("header.stamp", "duration", "reason", "frames_lost"),
    message_types.DIAGNOSTICS: ("status",),
}
_UNSURE = 0.5  # of a segment with a lower confidence another label is likelier than its own
_NAME_LENGTH = struct.Struct("<I")
_NAME_LIMIT = 1000
_TIMES = 16  # bytes of an attachment before its name


def summarise(paths: Iterable[Path]) -> Summary:
    """Count what is in some logs.

    Parameters
    ----------
    paths : iterable of Path
        Logs and layers, not folders.

    Returns
    -------
    Summary
        Of all of them; `damaged` names those that cannot be read.
    """
    total = Summary()
    for path in paths:
        try:
            total.add(_summarise(path))
        except LogError as error:
            total.damaged[path] = str(error)
    return total


def _summarise(path: Path) -> Summary:
    with LogFile(path) as file:
        summary = _without_messages(file)
        ours = any(
            is_compatible(*channel, *fields)
            for channel in _channels(file)
            for fields in _FIELDS.items()
        )
        if _is_counted(file) and not ours:
            _count_by_index(file, summary)
        else:
            _read_through(file, summary)
    return summary


def _channels(file: LogFile) -> list[tuple[Channel, Schema | None]]:
    return [(channel, file.schemas.get(channel.schema_id)) for channel in file.channels.values()]


def _without_messages(file: LogFile) -> Summary:
    """Summarise a log without a look at its messages."""
    chunks = file.chunks[file.chunks["index_length"] >= 0]
    summary = Summary(
        files=[file.path],
        unfinished=[] if file.complete else [file.path],
        layers=[file.path] if is_layer(file.path) else [],
        size=file.size,
        chunks=len(chunks),
        chunk_bytes=int(chunks["length"].sum()),
        raw_bytes=int(chunks["size"].sum()),
    )
    if file.header is not None:
        summary.profiles |= {file.header.profile} - {""}
        summary.libraries |= {file.header.library} - {""}
    for location in file.record_locations:
        names = summary.metadata if location.opcode == Opcode.METADATA else summary.attachments
        names.add(_name(file, location))
    summary.schema_versions |= {version_text(record) for record in read_provenance(file)}
    return summary


def _name(file: LogFile, location: RecordLocation) -> str:
    """Read the name of a metadata record or an attachment, and nothing else of it."""
    head = file.read(location.offset + HEAD.size, _TIMES + _NAME_LENGTH.size + _NAME_LIMIT)
    start = 0 if location.opcode == Opcode.METADATA else _TIMES
    try:
        (length,) = _NAME_LENGTH.unpack_from(head, start)
    except struct.error as error:
        raise file.damaged(location.offset, "a record is too short") from error
    start += _NAME_LENGTH.size
    return head[start : start + min(length, _NAME_LIMIT)].decode(errors="replace")


def _is_counted(file: LogFile) -> bool:
    """Tell whether the index says how many messages each channel has, and which these are."""
    if file.statistics is None:
        return False
    counts = file.statistics.channel_message_counts
    is_whole = sum(counts.values()) == file.statistics.message_count
    return is_whole and counts.keys() <= file.channels.keys()


def _count_by_index(file: LogFile, summary: Summary) -> None:
    assert file.statistics is not None
    counts = file.statistics.channel_message_counts
    for identity, channel in file.channels.items():
        topic = _topic(summary, channel, file.schemas.get(channel.schema_id))
        chunks = file.with_channels(file.chunks, {identity})
        count = counts.get(identity, 0)
        if count and len(chunks):
            topic.add(count, None, (int(chunks["start"].min()), int(chunks["end"].max())))


def _read_through(file: LogFile, summary: Summary) -> None:
    for channel in _channels(file):
        _topic(summary, *channel)
    frames: dict[str, Counter[str]] = {}
    for batch in read_in_batches(file, file.chunks):
        for raw in batch:
            times = raw.log_times
            topic = _topic(summary, raw.channel, raw.schema)
            topic.add(len(raw), int(raw.sizes.sum()), (int(times[0]), int(times[-1])))
        for columns in decode_types(file.path, batch, _FIELDS):
            _note(summary, frames, columns)
    lengths = {stream["microphone"]: stream["frame_seconds"] for stream in summary.streams}
    for microphone, counts in frames.items():
        length = lengths.get(microphone.partition("/")[0], FRAME_SECONDS)
        seconds = {label: round(count * length, 3) for label, count in counts.items()}
        summary.label_seconds[microphone] = Counter(seconds)


def _topic(summary: Summary, channel: Channel, schema: Schema | None) -> TopicSummary:
    new = TopicSummary("" if schema is None else schema.name, channel.message_encoding)
    return summary.topics.setdefault(channel.topic, new)


def _note(summary: Summary, frames: dict[str, Counter[str]], columns: Columns) -> None:
    microphone = columns.topic.strip("/").rpartition("/")[0]
    if columns.type == message_types.LABEL:
        frames.setdefault(microphone, Counter()).update(columns["label"].tolist())
    elif columns.type == message_types.SEGMENT:
        summary.segments.setdefault(microphone, Counter()).update(columns["label"].tolist())
        if microphone.endswith(f"/{REVIEW}"):  # which has no labels frame by frame
            _note_marks(summary.label_seconds.setdefault(microphone, Counter()), columns)
        else:
            _note_segments(summary, microphone, columns)
    elif columns.type == message_types.GAP:
        starts, seconds = columns["header.stamp"], columns["duration"] / NANOSECONDS
        fields = starts, seconds, columns["reason"], columns["frames_lost"]
        rows = zip(*(column.tolist() for column in fields), strict=True)
        summary.gaps += [GapSummary(microphone, *row) for row in rows]
    elif columns.type == message_types.STREAM_INFO:
        for row in zip(*(columns[path].tolist() for path in _STREAM.values()), strict=True):
            stream = dict(zip(_STREAM, row, strict=True))
            if stream not in summary.streams:
                summary.streams.append(stream)
    else:
        for status in statuses_of(columns):
            summary.health = worse(summary.health, status)


def _note_segments(summary: Summary, microphone: str, columns: Columns) -> None:
    seconds = summary.segment_seconds.setdefault(microphone, Counter())
    unsure = summary.unsure.setdefault(microphone, Counter())
    durations = (columns["duration"] / NANOSECONDS).tolist()
    doubtful = (columns["confidence"] < _UNSURE).tolist()
    for label, duration, doubted in zip(
        columns["label"].tolist(), durations, doubtful, strict=True
    ):
        seconds[label] += duration
        if doubted and class_name(label) not in {SILENCE, UNKNOWN}:
            unsure.update({"segments": 1, "seconds": duration})


def _note_marks(seconds: Counter[str], columns: Columns) -> None:
    durations = (columns["duration"] / NANOSECONDS).tolist()
    for label, duration in zip(columns["label"].tolist(), durations, strict=True):
        seconds[label] += duration
