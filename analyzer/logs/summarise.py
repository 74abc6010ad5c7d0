"""Count what is in a log, or in a folder of logs."""

import struct
from collections import Counter
from collections.abc import Iterable
from functools import reduce
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from hearthlog.analyzer.logs.selection import Damages
from hearthlog.analyzer.logs.summary import Summary, TopicSummary, worse
from hearthlog.analyzer.logs.typed_columns import is_compatible
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import FRAME_SECONDS
from hearthlog.schemas.logs.contents import LogContents, has_contents, is_review, stated_contents
from hearthlog.schemas.logs.files import is_layer
from hearthlog.schemas.logs.metadata import read_provenance, version_text
from hearthlog.schemas.mcap.chunk_index import RecordLocation
from hearthlog.schemas.mcap.chunks import read_in_batches
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.mcap.records import HEAD

_NAME_LENGTH = struct.Struct("<I")
_NAME_LIMIT = 1000
_TIMES = 16  # bytes of an attachment before its name


def summarise(paths: Iterable[Path]) -> Summary:
    """Count what is in some logs."""
    total = Summary()
    for path in paths:
        try:
            total.add(_summarise(path))
        except LogError as error:
            total.damaged[path] = str(error)
    return total


def _summarise(path: Path) -> Summary:
    with LogFile(path, partial=True) as file:
        summary = _without_messages(file)
        ours = [has_contents(*channel, is_compatible) for channel in _channels(file)]
        if _is_counted(file) and not any(ours):
            _count_by_index(file, summary)
        else:
            _add_contents(summary, _stated(file, summary) or _read(file, summary))
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
    if file.statistics is None or file.late:
        return False
    counts = file.statistics.channel_message_counts
    is_whole = sum(counts.values()) == file.statistics.message_count
    indexed = (file.chunks["index_length"] > 0).any()
    is_whole &= bool(not indexed or file.lists_all_messages())
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


def _stated(file: LogFile, summary: Summary) -> LogContents | None:
    """Read what a finished log says of its messages."""
    contents = stated_contents(file)
    if contents is not None:
        for channel in _channels(file):
            _topic(summary, *channel)
    return contents


def _read(file: LogFile, summary: Summary) -> LogContents:
    """Read all messages of a log."""
    for channel in _channels(file):
        _topic(summary, *channel)
    contents = LogContents()
    damages = Damages()
    for batch in read_in_batches(file, file.chunks, on_damage=damages.add):
        for raw in batch:
            _topic(summary, raw.channel, raw.schema)
        try:
            contents.add(batch, is_compatible)
        except LogError as error:
            raise LogError(f"{file.path}: {error}") from error
    damages.warn_of_more()
    return contents


def _topic(summary: Summary, channel: Channel, schema: Schema | None) -> TopicSummary:
    new = TopicSummary("" if schema is None else schema.name, channel.message_encoding)
    return summary.topics.setdefault(channel.topic, new)


def _add_contents(summary: Summary, contents: LogContents) -> None:
    for name, counted in contents.topics.items():
        span = counted.start, counted.end
        summary.topics[name].add(counted.messages, counted.bytes, span)
    summary.segments = contents.segments
    summary.unsure = contents.unsure
    for microphone, seconds in contents.seconds.items():
        of_review = is_review(microphone)  # which has no labels frame by frame
        (summary.label_seconds if of_review else summary.segment_seconds)[microphone] = seconds
    lengths = {stream["microphone"]: stream["frame_seconds"] for stream in contents.streams}
    for microphone, counts in contents.frames.items():
        length = lengths.get(microphone.partition("/")[0], FRAME_SECONDS)
        frames = {label: round(count * length, 3) for label, count in counts.items()}
        summary.label_seconds[microphone] = Counter(frames)
    summary.gaps = contents.gaps
    summary.streams = contents.streams
    summary.health = contents.health
    last = contents.last.values()  # of a finished log, which is not read, the worst has to do
    summary.latest_health = reduce(worse, last, None) if last else contents.health
