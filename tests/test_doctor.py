"""The doctor sees every rule that is broken, and nothing where none is."""

import json
import re
import shutil
import struct
import zlib
from collections import Counter
from threading import Event as Flag
from types import SimpleNamespace

import numpy as np
import pytest
import soundfile
import zstandard
from lossy_source import LossySource
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import CompressionType, IndexType, Writer
from mcap_ros2.writer import Writer as Ros2Writer
from rewriting import HEAD, Chunked, Log, Raw, as_raw, parsed, split
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter
from rosbags.typesys import Stores, get_typestore

from hearthlog.analyzer.doctor.examination import examine
from hearthlog.analyzer.marks.marks import Mark, write_marks
from hearthlog.models.features.floor import BLOCK_FRAMES
from hearthlog.models.features.installed import DEFAULT
from hearthlog.recorder.config import Settings
from hearthlog.recorder.events import Gap
from hearthlog.recorder.log.description import describe_log
from hearthlog.recorder.log.recovery import recover_active
from hearthlog.recorder.log.rolling_log import RollingLog
from hearthlog.recorder.recording import record
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.recorder.stream import stream_info
from hearthlog.recorder.stream.pipeline import Pipeline
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS
from hearthlog.schemas.logs.files import find_logs, review_path
from hearthlog.schemas.mcap.records import MAGIC
from hearthlog.schemas.messages import message_types

START = 1_772_348_400 * NANOSECONDS  # a full hour
NAME = "home_20260301T070000Z.mcap"
GAP = "gap"  # the log has one; what breaks another rule must not hide it


@pytest.fixture(scope="module")
def recorded(tmp_path_factory, day, model_file):
    """Forty seconds with a gap of 7 frames, in one log, with statistics of every frame."""
    folder = tmp_path_factory.mktemp("recorded")
    samples, rate = soundfile.read(day, frames=40 * 16_000, dtype="int16")
    soundfile.write(folder / "sound.wav", samples, rate)
    settings = Settings(output=folder, model=model_file, statistics_every=1)
    source = LossySource(FileSource([folder / "sound.wav"], START), {2: 7})
    (path,) = record(settings, source, Flag()).logs
    return path


@pytest.fixture
def log(recorded):
    return Log(recorded)


def found(path):
    """Level and rule of everything that is found."""
    return {kind for findings in examine(path) for kind in findings.counts}


def errors(path):
    return {rule for level, rule in found(path) if level == "error"}


def test_a_log_that_was_recorded_is_sound_but_for_its_gap(recorded):
    assert found(recorded) == {("warning", GAP)}


def test_what_the_recorder_said_of_itself_is_said_once(hearthlog, tmp_path):
    rng = np.random.default_rng(0)
    soundfile.write(tmp_path / "clips.wav", rng.normal(0.0, 1.0, 40 * 16_000).clip(-1, 1), 16_000)
    recording = hearthlog("record", tmp_path / "clips.wav", "-o", tmp_path / "logs")
    assert recording.returncode == 0, recording.stderr
    (findings,) = examine(tmp_path / "logs")
    assert findings.counts == {("warning", "health"): 1}
    expected = "the file clips: check with what it was recorded, and how [health]"
    assert expected in str(findings.shown[0])


def test_a_log_that_was_put_together_again_is_the_same(recorded, tmp_path):
    log = Log(recorded, contents=True)
    assert log.write(tmp_path / NAME).stat().st_size == recorded.stat().st_size
    assert found(tmp_path / NAME) == {("warning", GAP)}


@pytest.mark.parametrize("time", [0, (1 << 63) - 1, 1 << 63, (1 << 64) - 1])
def test_a_time_that_a_chunk_does_not_speak_of_is_an_error_whatever_it_is(log, tmp_path, time):
    moved = struct.pack("<Q", log.messages(FEATURES)[30].log_time)

    def edit(records):
        for raw in (raw for raw in records if raw.opcode == Opcode.CHUNK):
            chunk = parsed(raw, Chunk)
            content = zstandard.decompress(chunk.data).replace(moved, struct.pack("<Q", time))
            chunk.data, chunk.uncompressed_crc = zstandard.compress(content), zlib.crc32(content)
            raw.content = as_raw(chunk).content

    assert {"chunk-times", "log-time"} <= errors(log.write(tmp_path / NAME, edit))


@pytest.mark.parametrize("inner", [b"", b"\x05" + struct.pack("<QHIQQ", 22, 1, 0, 1, 1)])
def test_of_a_small_file_of_countless_records_few_are_looked_at(tmp_path, inner):
    content = (inner or bytes(9)) * 1_200_000
    head = struct.pack("<QQQII", 1, 1, len(content), zlib.crc32(content), 4) + b"zstd"
    packed = zstandard.compress(content)
    chunk = head + struct.pack("<Q", len(packed)) + packed
    header = b"\x01" + struct.pack("<Q", 8) + bytes(8)
    path = tmp_path / "small.mcap"
    path.write_bytes(MAGIC + header + b"\x06" + struct.pack("<Q", len(chunk)) + chunk)
    counts = Counter(f.rule for found in examine(path) for f in found.shown)
    assert counts["too-large" if inner else "chunk-records"] == 1
    assert not counts["chunk-opcode"]


# What is wrong with the records of the data section. Everything that refers to them is right.

FEATURES, LABEL, STATISTICS = "/mic/features", "/mic/label", "/mic/statistics"
SEGMENT, GAPS, INFO = "/mic/segment", "/mic/gap", "/mic/info"


def stamp(time):
    return SimpleNamespace(sec=time // NANOSECONDS, nanosec=time % NANOSECONDS)


def add(log, item, place=-1):
    log.items.insert(place, item)


def swap_definitions(log):
    first = log.chunks()[0].records
    channels = [r for r in first if isinstance(r, Channel)]
    first[:] = [*channels, *(r for r in first if not isinstance(r, Channel))]


def channel_after_messages(log):
    first = log.chunks()[0].records
    info = log.named(INFO)
    first.remove(info)
    first.append(info)


def without_channel(log):
    log.drop(log.named("/diagnostics"))


def other_schema(log):
    schema = log.schema(FEATURES)
    log.chunks()[1].records.insert(0, Schema(schema.id, schema.data, schema.encoding, "a/msg/B"))


def other_channel(log):
    channel = log.named(FEATURES)
    log.chunks()[1].records.insert(0, Channel(channel.id, "/else", "cdr", {}, channel.schema_id))


def change(topic, number=40, **fields):
    def edit(log):
        log.change(log.messages(topic)[number], **fields)

    return edit


def set_in(find, **fields):
    def edit(log):
        for name, value in fields.items():
            setattr(find(log), name, value)

    return edit


def drop(topic, number=40):
    def edit(log):
        log.drop(log.messages(topic)[number])

    return edit


def metadata(name, **values):
    def edit(log):
        about = log.metadata(name)
        for key, value in values.items():
            about.metadata.pop(key) if value is None else about.metadata.update({key: value})

    return edit


def attachment(log, name):
    return next(r for r in log.items if isinstance(r, Attachment) and r.name == name)


def drop_attachment(name):
    return lambda log: log.drop(attachment(log, name))


def twice(find):
    def edit(log):
        add(log, find(log))

    return edit


def info_message(log):
    return log.messages(INFO)[0]


def shift(topic, number, shift):
    """Give a message another time, in all places, where it stays in the order of the file."""

    def edit(log):
        message = log.messages(topic)[number]
        message.log_time += shift
        message.publish_time += shift
        log.change(message, header__stamp=stamp(message.log_time))

    return edit


def label_stamp(shift):
    """Give a label another stamp, but leave its log time."""

    def edit(log):
        message = log.messages(LABEL)[40]
        content = message_types.decode(message.data, message_types.LABEL)
        time = message_types.nanoseconds(content.header.stamp) + shift
        log.change(message, header__stamp=stamp(time))

    return edit


def late_from(topics, number, shift):
    """Give all messages of some frames on another time."""

    def edit(log):
        first = log.messages(topics[0])[number].log_time
        for topic in topics:
            for message in log.messages(topic):
                if message.log_time >= first:
                    message.log_time += shift
                    message.publish_time += shift
                    log.change(message, header__stamp=stamp(message.log_time))

    return edit


def move_last_chunk(log):
    """The second chunk of frames comes before the first."""
    places = [i for i, item in enumerate(log.items) if isinstance(item, Chunked)]
    one, other = places[3], places[4]
    log.items[one], log.items[other] = log.items[other], log.items[one]


def without_gap(log):
    log.drop(log.messages(GAPS)[0])


def gap_of(frames):
    return change(GAPS, 0, frames_lost=frames)


def short_gap(log):
    """A gap whose start and end are not those of the frames around it."""
    gap = log.messages(GAPS)[0]
    log.change(gap, header__stamp=stamp(gap.log_time - 300_000_000), duration=stamp(300_000_000))


def long_gap(log):
    gap = log.messages(GAPS)[0]
    log.change(gap, header__stamp=stamp(gap.log_time - 900_000_000), duration=stamp(900_000_000))


def jump_without_gap(log):
    """A second is cut out of the frames, and no gap tells of it."""
    first = log.messages(FEATURES)[60].log_time
    last = first + NANOSECONDS
    topics = (FEATURES, STATISTICS, LABEL, SEGMENT, "/diagnostics", "/rosout")
    for topic in topics:
        log.drop(*(m for m in log.messages(topic) if first <= m.log_time < last))


def slow_clock(log):
    """Every frame lasts 5 ms longer than its number says, in all messages."""
    shared = {m.log_time for m in log.messages(FEATURES)}
    for topic in (FEATURES, STATISTICS, LABEL):
        for message in log.messages(topic):
            if message.log_time in shared:
                _slow(message, log)
    for topic in (SEGMENT, GAPS, "/diagnostics", "/rosout"):
        log.drop(*log.messages(topic))


def _slow(message, log):
    message.log_time += (message.log_time - START) // 10
    message.publish_time = message.log_time
    log.change(message, header__stamp=stamp(message.log_time))


def reserved(log):
    add(log, Raw(0x7E, b"of a later version"))


def nothing_but_profile(log):
    log.items[0] = Header("ros1", "hearthlog")


def name_twice(log):
    """A key twice in the map of a metadata record."""
    raw = as_raw(Metadata("mine", {"a": "1", "b": "2"}))
    add(log, Raw(raw.opcode, raw.content.replace(b"b", b"a")))


def cut_field(log):
    add(log, Raw(Opcode.METADATA, b"\x04\0\0\0abc"))


def no_text(log):
    raw = as_raw(Metadata("mine", {}))
    add(log, Raw(raw.opcode, raw.content.replace(b"mine", b"m\xff\xfee")))


def attachment_checksum(log):
    raw = as_raw(Attachment(0, 0, "mine", "text/plain", b"hello"))
    add(log, Raw(raw.opcode, raw.content.replace(b"hello", b"hallo")))


def in_chunk(opcode, content):
    return lambda log: log.chunks()[2].records.append(Raw(opcode, content))


def loose(log):
    """The last message stands behind the last chunk."""
    add(log, log.chunks()[-1].records.pop())


def probabilities(log):
    content = np.full(len(log_classes(log)), 0.5, np.float32)
    log.change(log.messages(LABEL)[40], probabilities=content, confidence=0.5)


def log_classes(log):
    return json.loads(log.named(LABEL).metadata["probabilities_names"])


def negative(log):
    classes = len(log_classes(log))
    content = np.full(classes, 2 / (classes - 1), np.float32)
    content[0] = -1
    log.change(log.messages(LABEL)[40], probabilities=content, label=log_classes(log)[0])
    log.change(log.messages(LABEL)[40], confidence=-1.0)


def add_channel(topic, like=FEATURES, **metadata):
    """Define another channel, of which rosbag2 does not know."""

    def edit(log):
        channel = log.named(like)
        about = channel.metadata | metadata
        new = Channel(200, topic, "cdr", about, channel.schema_id)
        log.chunks()[0].records.append(new)

    return edit


def second_info(log):
    info = info_message(log)
    last = log.chunks()[-1].records[-1].log_time
    again = Message(info.channel_id, last, info.data, last, 0)
    log.change(again, header__stamp=stamp(last))
    log.chunks()[-1].records.append(again)


def segment_too_early(log):
    segment = log.messages(SEGMENT)[3]
    start = segment.log_time - 5 * 60 * NANOSECONDS
    log.change(segment, header__stamp=stamp(start), duration=stamp(5 * 60 * NANOSECONDS))


def end_of(segment):
    content = message_types.decode(segment.data, message_types.SEGMENT)
    begin = message_types.nanoseconds(content.header.stamp)
    return begin + message_types.nanoseconds(content.duration)


def segment_without_duration(log):
    segment = log.messages(SEGMENT)[3]
    log.change(segment, header__stamp=stamp(end_of(segment)), duration=stamp(0))


def segment_too_late(log):
    segment = log.messages(SEGMENT)[3]
    log.change(segment, header__stamp=stamp(end_of(segment) - 1), duration=stamp(1))


def features_of_nothing(log):
    message = log.messages(FEATURES)[40]
    message.data = message.data[:30]


def drop_definition(log):
    log.schema(FEATURES).data = b"std_msgs/Header header\n"


def new_definition(log):
    schema = log.schema(FEATURES)
    schema.data = b"uint64 more\n" + schema.data


UNKNOWN = {"index-missing", "statistics"}  # what is put in as bytes is not indexed
HOLE = {"frame-jump", "segment-hole"}  # where the gap is not known
# Of the cases with `...`, the other consequences do not matter.

DATA = {
    "no header": (lambda log: log.items.pop(0), {"header"}),
    "a second header": (lambda log: add(log, Header("ros2", "hearthlog")), {"header"}),
    "a key twice": (name_twice, {"fields", *UNKNOWN}),
    "a field that is cut": (cut_field, {"fields"}),
    "a text that is none": (no_text, {"fields"}),
    "schema 0": (
        lambda log: add(log, Schema(0, b"", "ros2msg", "a/msg/B")),
        {"schema-id", "statistics"},
    ),
    "a schema that changes": (other_schema, {"redefined"}),
    "a channel that changes": (other_channel, {"redefined"}),
    "a schema of no encoding": (
        lambda log: add(log, Schema(99, b"x", "", "a")),
        {"schema-encoding", "profile-schema"},
    ),
    "a schema of another encoding": (
        lambda log: add(log, Schema(99, b"x", "protobuf", "a")),
        {"profile-schema"},
    ),
    "a schema of no name": (
        lambda log: add(log, Schema(99, b"uint8 x\n", "ros2msg", "not a type")),
        {"schema-name", "schema-definition"},
    ),
    "a schema that is none": (
        lambda log: add(log, Schema(99, b"??", "ros2msg", "a/msg/B")),
        {"schema-definition"},
    ),
    "channels before schemas": (swap_definitions, {"schema-missing"}),
    "a channel of no encoding": (
        set_in(lambda log: log.named(GAPS), message_encoding=""),
        {"channel-encoding", *HOLE},
    ),
    "a channel of another encoding": (
        set_in(lambda log: log.named(GAPS), message_encoding="json"),
        {"profile-channel", *HOLE},
    ),
    "a channel of no schema": (
        lambda log: add(log, Channel(99, "/x", "cdr", {"offered_qos_profiles": "[]"}, 0)),
        {"profile-channel"},
    ),
    "a channel of no quality of service": (
        lambda log: log.named(GAPS).metadata.pop("offered_qos_profiles"),
        {"profile-qos"},
    ),
    "a channel after its messages": (channel_after_messages, {"channel-missing"}),
    "messages of no channel": (without_channel, {"channel-missing", "summary-copies", "rosbag2"}),
    "metadata in a chunk": (in_chunk(Opcode.METADATA, bytes(8)), {"chunk-opcode"}),
    "a message in a chunk that is too short": (in_chunk(Opcode.MESSAGE, b"abc"), {"message-short"}),
    "a message that is too short": (
        lambda log: add(log, Raw(Opcode.MESSAGE, b"abc")),
        {"message-short"},
    ),
    "a checksum of an attachment": (attachment_checksum, {"attachment-crc", *UNKNOWN}),
    "a message index of nothing": (
        lambda log: log.items.insert(2, MessageIndex(1, [])),
        {"message-index-place"},
    ),
    "statistics among the data": (
        lambda log: log.items.insert(2, Raw(Opcode.STATISTICS, bytes(50))),
        {"data-opcode"},
    ),
    # From here on the contract.
    "another profile": (nothing_but_profile, {"profile"}),
    "metadata twice": (twice(lambda log: log.metadata("hearthlog")), {"metadata"}),
    "no metadata": (lambda log: log.drop(log.metadata("hearthlog")), {"metadata"}),
    "metadata without a version": (metadata("hearthlog", version=None), {"metadata"}),
    "another node": (metadata("hearthlog", node="flat"), {"name"}),
    "another configuration": (metadata("hearthlog", configuration_sha256="0"), {"attachments"}),
    "another model": (metadata("hearthlog", model_sha256="0"), {"info"}),
    "no configuration": (drop_attachment("configuration.json"), {"attachments"}),
    "no model card": (drop_attachment("model_card.md"), {"attachments"}),
    "no description of the model": (drop_attachment("model.json"), {"attachments"}),
    "two models": (twice(lambda log: attachment(log, "model.json")), {"attachments"}),
    "two model cards": (twice(lambda log: attachment(log, "model_card.md")), {"attachments"}),
    "no rosbag2": (lambda log: log.drop(log.metadata("rosbag2")), {"rosbag2"}),
    "info of another rate": (change(INFO, 0, sample_rate=8000), {"info"}),
    "info of another frame": (change(INFO, 0, frame_seconds=0.1), {"info"}),
    "info of another feature set": (change(INFO, 0, feature_set="auros99"), {"info"}),
    "info without a model": (change(INFO, 0, model=""), {"info"}),
    "info that does not come first": (
        lambda log: log.drop(info_message(log)),
        {"info-first"},
    ),
    "info that comes again": (second_info, {"info-twice"}),
    "no gaps": (
        lambda log: log.drop(log.messages(GAPS)[0], log.named(GAPS)),
        {"topics", *HOLE},
    ),
    "two channels of one topic": (add_channel(FEATURES), {"topics"}),
    "a topic that should not be there": (add_channel("/attic/features"), {"topics"}),
    "another type": (set_in(lambda log: log.named(GAPS), schema_id=2), {"type", *HOLE}),
    "another definition": (
        new_definition,
        {"type", "label-frames", "statistics-frames", "segment-hole"},
    ),
    "another type hash": (
        lambda log: log.named(GAPS).metadata.update(topic_type_hash="RIHS01_0"),
        {"type"},
    ),
    "a quality of service that is none": (
        lambda log: log.named(GAPS).metadata.update(offered_qos_profiles="reliable"),
        {"qos"},
    ),
    "other names of an array": (
        lambda log: log.named(STATISTICS).metadata.update(std_names="[]"),
        {"array-names"},
    ),
    "features that are cut": (
        features_of_nothing,
        {"cdr", "label-frames", "statistics-frames", "segment-hole"},
    ),
    "chunks in another order": (move_last_chunk, {"log-time", ...}),
    "another publish time": (
        set_in(lambda log: log.messages(FEATURES)[40], publish_time=START),
        {"publish-time"},
    ),
    "another stamp": (
        change(FEATURES, header__stamp=stamp(START + 2_001_000_000)),
        {"stamp", "frame-stamp"},
    ),
    "another frame id": (change(FEATURES, header__frame_id="attic"), {"frame-id"}),
    "a frame twice": (
        change(FEATURES, frame=39),
        {"frame-order", "frame-jump", "label-frames", "statistics-frames"},
    ),
    "statistics twice": (
        lambda log: log.chunks()[1].records.append(log.messages(STATISTICS)[399]),
        {"frame-order"},
    ),
    "a frame missing": (drop(FEATURES), {"frame-jump", "label-frames", "statistics-frames"}),
    "a second missing": (jump_without_gap, {"frame-jump"}),
    "a gap missing": (without_gap, HOLE),
    "a gap of other frames": (gap_of(8), {"gap-frames"}),
    "a gap of many other frames": (gap_of(20), {"gap-frames", "gap-duration"}),
    "a gap at another time": (short_gap, {"gap-times"}),
    "a gap that is too long": (long_gap, {"gap-times", "gap-duration"}),
    "a stamp that jumps": (
        late_from((FEATURES, STATISTICS, LABEL, "/diagnostics"), 700, 300_000_000),
        {"stamp-step", ...},
    ),
    "a slow clock": (slow_clock, {"stamp-rate", ...}),
    "features of another width": (change(FEATURES, values=np.zeros(20, np.float32)), {"width"}),
    "features that are no numbers": (
        change(FEATURES, values=np.full(DEFAULT.width, np.nan, np.float32)),
        {"finite"},
    ),
    "statistics of another width": (change(STATISTICS, std=np.zeros(20, np.float32)), {"width"}),
    "statistics that are infinite": (
        change(STATISTICS, mean=np.full(DEFAULT.width, np.inf, np.float32)),
        {"finite"},
    ),
    "a negative deviation": (
        change(STATISTICS, std=np.full(DEFAULT.width, -1, np.float32)),
        {"negative-std"},
    ),
    "statistics missing": (drop(STATISTICS), {"statistics-frames"}),
    "statistics at another time": (
        shift(STATISTICS, 40, 1),
        {"frame-stamp", "log-time"},
    ),
    "a label missing": (drop(LABEL), {"label-frames"}),
    "a label by the stamp of another moment": (label_stamp(1), {"frame-stamp"}),
    "a label by the stamp of another frame": (label_stamp(FRAME_NANOSECONDS), {"frame-stamp"}),
    "a label of what is not over": (label_stamp(NANOSECONDS), {"frame-stamp", "stamp"}),
    "a label that is known too late": (label_stamp(-3 * NANOSECONDS), {"frame-stamp", "stamp"}),
    "a label of another width": (change(LABEL, probabilities=np.ones(1, np.float32)), {"width"}),
    "a label of no class": (change(LABEL, label="murder"), {"class"}),
    "a confidence that is another's": (change(LABEL, confidence=0.123), {"confidence"}),
    "probabilities that are too many": (probabilities, {"probabilities"}),
    "a negative probability": (negative, {"probabilities"}),
    "a segment of no class": (change(SEGMENT, 3, label="murder"), {"class"}),
    "a segment that is too sure": (change(SEGMENT, 3, confidence=1.5), {"confidence"}),
    "a segment that overlaps": (segment_too_early, {"segment-overlap"}),
    "a segment that lasts nothing": (segment_without_duration, {"duration", "segment-hole"}),
    "a segment that is too short": (segment_too_late, {"segment-hole"}),
}


@pytest.mark.parametrize("case", DATA)
def test_what_is_wrong_with_the_data_is_found(log, tmp_path, case):
    edit, expected = DATA[case]
    edit(log)
    assert_expected(errors(log.write(tmp_path / NAME)), expected)


def assert_expected(rules, expected):
    if ... in expected:
        assert rules >= expected - {...}
    else:
        assert rules == expected


@pytest.mark.parametrize(
    ("edit", "rule"),
    [
        (reserved, "reserved-opcode"),
        (add_channel("/mic/louder"), "other-topic"),
        (loose, "loose-messages"),
    ],
)
def test_what_is_unusual_is_a_warning(log, tmp_path, edit, rule):
    edit(log)
    assert found(log.write(tmp_path / NAME)) == {("warning", GAP), ("warning", rule)}


# What is wrong with what refers to other parts of the file.


def nth(records, opcode, number=0):
    return [raw for raw in records if raw.opcode == opcode][number]


def altered(kind, number=0, **fields):
    """Set fields of a record that stands in the file."""

    def edit(records):
        raw = nth(records, opcode_of(kind), number)
        record = parsed(raw, kind)
        for name, value in fields.items():
            setattr(record, name, value(getattr(record, name)) if callable(value) else value)
        raw.content = as_raw(record).content

    return edit


def opcode_of(kind):
    return Opcode[re.sub(r"(?<!^)(?=[A-Z])", "_", kind.__name__).upper()]


def both(*edits):
    def edit(records):
        for one in edits:
            one(records)

    return edit


def without(opcode, number=0):
    return lambda records: records.remove(nth(records, opcode, number))


def without_all(opcode):
    def edit(records):
        records[:] = [raw for raw in records if raw.opcode != opcode]

    return edit


def again(opcode, number=0):
    """Put a record of the summary in a second time, behind the first."""

    def edit(records):
        raw = nth(records, opcode, number)
        places = [i for i, other in enumerate(records) if other is raw]
        records.insert(places[0] + 1, raw)

    return edit


def more(number):
    return number + 1


def bits(data):
    return data[:-1] + bytes([data[-1] ^ 1])


def stored(chunk, change_content):
    """Put other content into a chunk, with the right size and checksum."""
    content = bytearray(zstandard.decompress(chunk.data))
    change_content(content)
    chunk.data = zstandard.compress(bytes(content))
    chunk.uncompressed_size = len(content)
    chunk.uncompressed_crc = zlib.crc32(content)


def longer_record(records):
    """The last record of a chunk claims a byte more than there is."""
    raw = nth(records, Opcode.CHUNK, 2)
    chunk = parsed(raw, Chunk)

    def change_content(content):
        place = 0
        while (end := place + HEAD.size + HEAD.unpack_from(content, place)[1]) < len(content):
            place = end
        struct.pack_into("<Q", content, place + 1, len(content) - place - HEAD.size + 1)

    stored(chunk, change_content)
    raw.content = as_raw(chunk).content


def in_summary(raw):
    return lambda records: records.insert(len(records) - 1, raw)


def apart(records):
    """A schema stands behind the channels."""
    end = records.index(nth(records, Opcode.DATA_END))
    schema = next(i for i, raw in enumerate(records) if i > end and raw.opcode == Opcode.SCHEMA)
    statistics = records.index(nth(records, Opcode.STATISTICS))
    records.insert(statistics, records.pop(schema))


def without_end(records):
    """As of a writer that does not know the Data End."""
    end = nth(records, Opcode.DATA_END)
    records.remove(end)
    length = HEAD.size + len(end.content)
    for raw in records:
        if raw.opcode == Opcode.SUMMARY_OFFSET:
            offset = parsed(raw, SummaryOffset)
            offset.group_start -= length
            raw.content = as_raw(offset).content
    footer = parsed(records[-1], Footer)
    footer.summary_start -= length
    footer.summary_offset_start -= length
    records[-1].content = as_raw(footer).content


def statistics_first(records):
    end = records.index(nth(records, Opcode.DATA_END))
    raw = nth(records, Opcode.STATISTICS)
    records.remove(raw)
    records.insert(end + 1, raw)


def without_copies(records):
    end = records.index(nth(records, Opcode.DATA_END))
    records[end:] = [raw for raw in records[end:] if raw.opcode != Opcode.CHANNEL]


def other_copy(records):
    end = records.index(nth(records, Opcode.DATA_END))
    raw = next(raw for raw in records[end:] if raw.opcode == Opcode.CHANNEL)
    channel = parsed(raw, Channel)
    channel.topic = "/mac/info"
    raw.content = as_raw(channel).content


def behind(records):
    """The first message index behind a chunk is put before the chunk."""
    index = nth(records, Opcode.MESSAGE_INDEX, 4)
    records.remove(index)
    records.insert(records.index(nth(records, Opcode.CHUNK)), index)


GROUPS = {"summary-offset", "footer"}  # if a group of the summary has another length
FILE = {
    "a checksum of the data": (altered(DataEnd, data_section_crc=1), {"data-crc"}),
    "no data end": (without_end, {"data-end"}),
    "a checksum of a chunk": (altered(Chunk, 2, uncompressed_crc=more), {"chunk-crc"}),
    "a chunk of another size": (
        altered(Chunk, 2, uncompressed_size=more),
        {"chunk-data", "index-differs"},
    ),
    "a chunk of no size": (altered(Chunk, 2, uncompressed_size=0), {"chunk-data", "index-differs"}),
    "a chunk of unknown compression": (
        altered(Chunk, 2, compression="zip!"),
        {"chunk-data", "index-differs"},
    ),
    "a chunk of wrong bytes": (
        altered(Chunk, 2, data=lambda data: bytes(len(data))),
        {"chunk-data"},
    ),
    "a chunk with a longer record": (longer_record, {"chunk-records", ...}),
    "a chunk that starts earlier": (
        both(altered(Chunk, 2, message_start_time=1), altered(ChunkIndex, 2, message_start_time=1)),
        {"chunk-times"},
    ),
    "a chunk that ends later": (
        both(
            altered(Chunk, 2, message_end_time=more), altered(ChunkIndex, 2, message_end_time=more)
        ),
        {"chunk-times"},
    ),
    "an entry of an index": (
        altered(MessageIndex, 8, records=lambda found: [(1, found[0][1]), *found[1:]]),
        {"message-index"},
    ),
    "an entry of an index that points elsewhere": (
        altered(MessageIndex, 8, records=lambda found: [(found[0][0], 1 << 63), *found[1:]]),
        {"message-index"},
    ),
    "an index of another channel": (
        altered(MessageIndex, 8, channel_id=99),
        {"message-index", "index-differs", "summary-copies"},
    ),
    "a place of a chunk": (
        altered(ChunkIndex, 2, chunk_start_offset=more),
        {"index-place", "index-missing"},
    ),
    "a chunk index twice": (again(Opcode.CHUNK_INDEX), {"index-twice", *GROUPS}),
    **{
        f"{what} not indexed": (edit, {"index-missing", *GROUPS})
        for what, edit in {
            "a chunk": without(Opcode.CHUNK_INDEX, 3),
            "all chunks": without_all(Opcode.CHUNK_INDEX),
            "an attachment": without(Opcode.ATTACHMENT_INDEX),
            "metadata": without(Opcode.METADATA_INDEX),
        }.items()
    },
    **{
        f"{kind.__name__} of another {field}": (
            altered(kind, number, **{field: value}),
            {"index-differs"},
        )
        for kind, number, field, value in (
            (ChunkIndex, 2, "message_end_time", more),
            (ChunkIndex, 2, "uncompressed_size", more),
            (
                ChunkIndex,
                2,
                "message_index_offsets",
                lambda old: {i: p + 1 for i, p in old.items()},
            ),
            (AttachmentIndex, 0, "data_size", more),
            (AttachmentIndex, 0, "name", "CONFIGURATION.json"),
            (MetadataIndex, 0, "name", "HEARTHLOG"),
        )
    },
    **{
        f"statistics of another {name}": (altered(Statistics, **{name: more}), {"statistics"})
        for name in vars(Statistics(0, 0, {}, 0, 0, 0, 0, 0, 0))
        if name != "channel_message_counts"
    },
    "statistics of other counts": (
        altered(Statistics, channel_message_counts=lambda counts: counts | {2: 1}),
        {"statistics"},
    ),
    "no statistics": (without_all(Opcode.STATISTICS), {"statistics", *GROUPS}),
    "statistics twice": (again(Opcode.STATISTICS), {"statistics", *GROUPS}),
    "statistics first": (statistics_first, {"statistics-channels", "summary-offset"}),
    "an attachment in the summary": (
        in_summary(Raw(Opcode.ATTACHMENT, bytes(40))),
        {"summary-opcode"},
    ),
    "a schema apart": (apart, {"summary-groups", "summary-offset"}),
    "a schema behind the offsets": (
        in_summary(Raw(Opcode.SCHEMA, bytes(14))),
        {"summary-groups", "summary-offset"},
    ),
    "no copies of channels": (
        without_copies,
        {"summary-copies", "statistics-channels", *GROUPS},
    ),
    "another copy of a channel": (other_copy, {"summary-copy"}),
    "an offset of a group": (altered(SummaryOffset, 2, group_start=more), {"summary-offset"}),
    "a length of a group": (altered(SummaryOffset, 2, group_length=more), {"summary-offset"}),
    "a checksum of the summary": (altered(Footer, summary_crc=more), {"summary-crc"}),
    "a start of the summary": (altered(Footer, summary_start=lambda start: start + 1), {"footer"}),
    "a start of the offsets": (altered(Footer, summary_offset_start=more), {"footer"}),
    "no footer": (without_all(Opcode.FOOTER), {"footer"}),
}


def uncounted_channel_in_summary_alone(records):
    """As `ros2 bag record` does of a channel that never spoke."""
    place = records.index(nth(records, Opcode.STATISTICS))
    channel = parsed(records[place - 1], Channel)
    channel.id = 99
    records.insert(place, as_raw(channel))
    for raw in records:
        if raw.opcode == Opcode.SUMMARY_OFFSET:
            offset = parsed(raw, SummaryOffset)
            length = HEAD.size + len(records[place].content)
            if offset.group_opcode == Opcode.CHANNEL:
                offset.group_length += length
            elif offset.group_opcode != Opcode.SCHEMA:
                offset.group_start += length
            raw.content = as_raw(offset).content
    altered(Footer, summary_offset_start=lambda start: start + length)(records)


def counted_channel_in_summary_alone(records):
    """As other writers do of it."""
    uncounted_channel_in_summary_alone(records)
    altered(Statistics, channel_count=more)(records)


@pytest.mark.parametrize(
    "edit", [uncounted_channel_in_summary_alone, counted_channel_in_summary_alone]
)
def test_a_channel_that_is_in_the_summary_alone_is_a_warning(log, tmp_path, edit):
    path = log.write(tmp_path / NAME, edit)
    assert found(path) == {("warning", GAP), ("warning", "summary-only")}


@pytest.mark.parametrize("case", FILE)
def test_what_is_wrong_with_the_rest_of_the_file_is_found(log, tmp_path, case):
    edit, expected = FILE[case]
    assert_expected(errors(log.write(tmp_path / NAME, edit)), expected)


# Files that end early, go on too long, or are none.


@pytest.mark.parametrize(
    ("edit", "rules"),
    [
        (lambda _: b"", {"magic"}),
        (lambda _: b"RIFF and so on", {"magic"}),
        (lambda _: MAGIC, {"cut"}),
        (lambda _: MAGIC + MAGIC, {"footer"}),
        (lambda data: data + b"more", {"after-end"}),
        (lambda data: data + MAGIC, {"after-end"}),
        (bits, {"magic"}),
    ],
)
def test_a_wrong_beginning_or_end_is_found(recorded, tmp_path, edit, rules):
    path = tmp_path / NAME
    path.write_bytes(edit(recorded.read_bytes()))
    assert errors(path) == rules


def test_a_log_that_cannot_be_opened_is_said_to_be_unreadable(tmp_path):
    (tmp_path / NAME).mkdir()
    (tmp_path / "gone.mcap").symlink_to(tmp_path / "nowhere")
    assert {rule for level, rule in found(tmp_path) if level == "error"} == {"unreadable"}


@pytest.mark.parametrize("share", [0.02, 0.3, 0.5, 0.9, 0.999])
def test_a_log_that_was_cut_off_is_an_error_and_one_being_written_a_warning(
    recorded, tmp_path, share
):
    data = recorded.read_bytes()
    path = tmp_path / NAME
    path.write_bytes(data[: int(len(data) * share)])
    assert errors(path) == {"cut"}
    active = tmp_path / "active" / (NAME + ".active")
    active.parent.mkdir()
    path.rename(active)
    assert found(active) - {("warning", GAP)} == {("warning", "unfinished")}


def test_a_log_that_was_recovered_is_sound(recorded, tmp_path):
    data = recorded.read_bytes()
    for share in (0.3, 0.6, 0.9):
        folder = tmp_path / str(share)
        folder.mkdir()
        (folder / (NAME + ".active")).write_bytes(data[: int(len(data) * share)])
        recover_active(folder, "home")
        assert found(folder / NAME) <= {("warning", GAP)}


@pytest.mark.parametrize("ending", [MAGIC, b""], ids=["finished", "unfinished"])
def test_behind_a_wrong_length_the_rest_of_the_file_is_checked(recorded, tmp_path, ending):
    records = split(recorded.read_bytes())
    places = np.cumsum([8, *(HEAD.size + len(raw.content) for raw in records)])
    second, third = [i for i, raw in enumerate(records) if raw.opcode == Opcode.CHUNK][1:3]
    data = bytearray(recorded.read_bytes())
    if not ending:
        del data[places[next(i for i, r in enumerate(records) if r.opcode == Opcode.DATA_END)] :]
    data[places[second] + 5] = 0x7F  # of the length
    data[places[third] + 60] ^= 0x55  # a byte of the next chunk
    path = tmp_path / (NAME if ending else NAME + ".active")
    path.write_bytes(data)
    (findings,) = examine(path)
    places = {finding.rule: finding.offset for finding in findings.shown}
    assert places["framing"] == 8 + sum(HEAD.size + len(r.content) for r in records[:second])
    assert "chunk-crc" in places or "chunk-data" in places
    assert errors(path) <= {"framing", "chunk-crc", "chunk-data"}


def test_of_what_is_wrong_a_thousand_times_a_few_lines_are_shown_and_all_counted(log, tmp_path):
    for message in log.messages(FEATURES):
        message.publish_time += 1
    (findings,) = examine(log.write(tmp_path / NAME))
    shown = [finding for finding in findings.shown if finding.rule == "publish-time"]
    assert len(shown) == 5
    assert findings.counts["error", "publish-time"] == len(log.messages(FEATURES))
    assert findings.more() == {("error", "publish-time"): len(log.messages(FEATURES)) - 5}


def test_every_finding_stays_on_its_line_whatever_a_file_says(log, tmp_path):
    for message in log.messages(LABEL):
        log.change(message, label="a\nb\x1b[31m" * 9999)
    (findings,) = examine(log.write(tmp_path / NAME))
    for finding in findings.shown:
        assert str(finding).isprintable()
        assert len(str(finding)) < 1500


# Logs of other writers.


def test_a_bag_of_rosbags_is_sound(tmp_path):
    store = get_typestore(Stores.ROS2_JAZZY)
    with BagWriter(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/text", "std_msgs/msg/String", typestore=store)
        for i in range(100):
            message = store.types["std_msgs/msg/String"](data="x" * i)
            data = store.serialize_cdr(message, "std_msgs/msg/String")
            writer.write(connection, i * NANOSECONDS, data)
    assert errors(tmp_path / "bag") == set()


def test_of_a_log_of_mcap_ros2_only_the_lack_of_a_quality_of_service_is_said(tmp_path):
    path = tmp_path / "other.mcap"
    with path.open("wb") as stream:
        writer = Ros2Writer(stream)
        schema = writer.register_msgdef("std_msgs/msg/String", "string data")
        for i in range(100):
            writer.write_message("/text", schema, {"data": "x" * i}, i, i)
        writer.finish()
    assert found(path) == {("warning", "profile-qos")}


@pytest.mark.parametrize("compression", CompressionType)
@pytest.mark.parametrize("index", [IndexType.ALL, IndexType.NONE])
@pytest.mark.parametrize("options", [{}, {"use_chunking": False}, {"enable_data_crcs": True}])
@pytest.mark.parametrize("less", [{}, {"use_statistics": False, "use_summary_offsets": False}])
def test_whatever_the_writer_of_mcap_writes_is_sound(tmp_path, compression, index, options, less):
    path = tmp_path / "other.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, 500, compression, index_types=index, **options, **less)
        writer.start()
        schema = writer.register_schema("Thing", "jsonschema", b"{}")
        channel = writer.register_channel("/thing", "json", schema)
        empty = writer.register_channel("/nothing", "json", 0)
        for i in range(100):
            writer.add_message(channel, (37 * i) % 100, b"{}", i)
        writer.add_attachment(1, 2, "a", "text/plain", b"hello")
        writer.add_metadata("mine", {"a": "b"})
        writer.finish()
    assert empty
    assert found(path) == set()


def test_messages_of_others_must_be_of_their_type(tmp_path):
    path = tmp_path / "other.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        channel = writer.register_channel("/text", "cdr", schema)
        writer.add_message(channel, 0, b"\0\1\0\0\xff\xff\xff\xffabc", 0)
        writer.finish()
    assert errors(path) == {"cdr"}


def test_a_layer_beside_a_log_is_not_held_to_the_contract_of_logs(log, tmp_path):
    log.drop(info_message(log))
    assert found(log.write(tmp_path / "home_20260301T070000Z.review.mcap")) == set()


@pytest.mark.parametrize(
    "command",
    [
        ["merge"],
        ["cut", "--start", "2026-03-01T07:00:05.01", "--end", "2026-03-01T07:00:33"],
        ["cut", "--topics", "/mic/label"],
    ],
)
def test_what_is_merged_or_cut_out_of_sound_logs_is_sound(hearthlog, series, tmp_path, command):
    verb, *options = command
    path = tmp_path / "part.mcap"
    assert hearthlog(verb, series, "-o", path, *options).returncode == 0
    assert found(path) <= {("warning", GAP)}


# Folders.


@pytest.fixture(scope="module")
def series(tmp_path_factory, recorded, model_file):
    """The same sound in logs of ten seconds."""
    folder = tmp_path_factory.mktemp("series")
    settings = Settings(output=folder, model=model_file, max_bag_duration=10)
    sound = next(recorded.parents[3].glob("*.wav"))
    record(settings, LossySource(FileSource([sound], START), {2: 7}), Flag())
    return folder


@pytest.fixture
def folder(series, tmp_path):
    return shutil.copytree(series, tmp_path / "logs")


def test_logs_that_follow_each_other_are_sound(folder):
    assert len(find_logs(folder)) == 5
    assert found(folder) == {("warning", GAP)}


def test_a_recorder_that_starts_again_begins_with_frame_0(folder, recorded, model_file):
    settings = Settings(output=folder, model=model_file)
    sound = next(recorded.parents[3].glob("*.wav"))
    record(settings, FileSource([sound], START + 60 * NANOSECONDS), Flag())
    assert found(folder) == {("warning", GAP)}


def test_a_log_that_is_missing_is_missed(folder):
    find_logs(folder)[2].unlink()
    assert found(folder) - {("warning", GAP)} == {("warning", "missing-log")}


def clock_set(folder, *steps):
    """Record ten seconds before and behind each step of the clock."""
    info = stream_info("mic", "test", DEFAULT, None)
    about = describe_log(Settings(output=folder), info, DEFAULT, None)
    log, pipeline = RollingLog(about, 3600, 1.0, 5.0), Pipeline("mic", DEFAULT)
    values = np.random.default_rng(0).random((200, DEFAULT.width)).astype(np.float32)
    stamps, first = START + np.arange(200) * FRAME_NANOSECONDS, 0
    log.write(pipeline.push_features(values, 0, stamps))
    for step in steps:
        end, first = int(stamps[-1]) + FRAME_NANOSECONDS, first + 201
        stamps = end + step * NANOSECONDS + np.arange(200) * FRAME_NANOSECONDS
        log.write(pipeline.push(Gap(end, int(stamps[0]), f"the clock was set by {step} s", 1)))
        log.write(pipeline.push_features(values, first, stamps))
    log.finish()
    return folder


AHEAD = 60 * 86_400
EVENING = (3600, AHEAD, -AHEAD, 3600)  # the clock was wrong by days


@pytest.mark.parametrize(("steps", "logs"), [((-9,), 2), (EVENING, 5)])
def test_each_step_of_the_clock_begins_another_log_that_may_overlap(tmp_path, steps, logs):
    assert len(find_logs(clock_set(tmp_path, *steps))) == logs
    assert found(tmp_path) == {("warning", GAP)}


def test_a_log_before_the_clock_was_set_may_have_been_deleted(tmp_path):
    _, second, *_ = find_logs(clock_set(tmp_path, *EVENING))
    second.unlink()
    assert found(tmp_path) == {("warning", GAP), ("warning", "missing-log")}


def test_a_log_whose_frames_do_not_continue_is_found(folder):
    path = find_logs(folder)[2]
    log = Log(path)
    for topic in (FEATURES, STATISTICS, LABEL):
        for message in log.messages(topic):
            data = bytearray(message.data)
            assert data[16:20] == b"mic\0"  # behind it, aligned, is the frame
            (frame,) = struct.unpack_from("<Q", data, 20)
            struct.pack_into("<Q", data, 20, frame + 15 * BLOCK_FRAMES)
            message.data = bytes(data)
    log.write(path)
    assert errors(folder) == {"frames-continue"}


def test_a_layer_that_lies_beside_a_log_of_another_time_is_found(folder):
    log, second = find_logs(folder)[:2]
    layer = write_marks(log, [Mark("mic", START, START + NANOSECONDS, "coughing")])
    shutil.copy(layer, review_path(second))  # ten seconds later, which may be the border's
    shutil.copy(layer, review_path(folder / "home_20270301T070000Z.mcap"))  # which is not there
    assert ("warning", "layer") not in found(folder)
    layer.unlink()
    late = START + 3600 * NANOSECONDS
    write_marks(log, [Mark("mic", late, late + NANOSECONDS, "coughing")])
    (findings,) = [each for each in examine(folder) if ("warning", "layer") in each.counts]
    assert f"a time when {log.name} was not recorded" in findings.shown[0].what


def test_logs_of_one_node_that_overlap_are_found(folder, recorded):
    other = folder / "other" / recorded.name
    other.parent.mkdir()
    shutil.copy(recorded, other)
    assert "overlap" in errors(folder)


def test_logs_of_two_homes_may_be_of_one_time(tmp_path, recorded):
    for home in ("anna", "bert"):
        place = tmp_path.joinpath(home, *recorded.parts[-4:])
        place.parent.mkdir(parents=True)
        shutil.copy(recorded, place)
    assert errors(tmp_path) == set()


@pytest.mark.parametrize("name", [NAME + ".damaged", NAME + ".recovering", f".{NAME}.7.tmp"])
def test_what_was_left_behind_is_found(folder, name):
    (folder / name).write_bytes(b"")
    assert found(folder) == {("warning", GAP), ("warning", "leftover")}


# The command.


def test_the_command_says_how_it_went_by_its_exit_status(hearthlog, recorded, log, tmp_path):
    result = hearthlog("doctor", recorded)
    assert result.returncode == 3
    finding, total = result.stdout.splitlines()
    assert finding.startswith(f"warning: {recorded}: 2026-03-01T07:00:20.350Z: /mic/gap: ")
    assert (total, result.stderr) == ("1 file: 0 errors, 1 warning", "")
    log.drop(log.messages(GAPS)[0])
    broken = log.write(tmp_path / NAME)
    assert hearthlog("doctor", broken).returncode == 1
    assert hearthlog("doctor", tmp_path / "none").returncode == 1


def test_a_sound_log_has_status_0_and_nothing_but_the_sum_is_said(hearthlog, series):
    result = hearthlog("doctor", find_logs(series)[0])
    assert (result.returncode, result.stdout) == (0, "1 file: 0 errors, 0 warnings\n")


def test_the_findings_as_json(hearthlog, recorded):
    found = json.loads(hearthlog("doctor", recorded, "--json").stdout)
    assert found["files"] == [str(recorded)]
    assert (found["errors"], found["warnings"], found["more"]) == (0, 1, [])
    (finding,) = found["findings"]
    assert (finding["path"], finding["level"], finding["rule"]) == (str(recorded), "warning", GAP)
    assert finding["time"] == START + 20 * NANOSECONDS + 350_000_000
    assert finding["offset"] is None
