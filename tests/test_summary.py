"""What a summary says of logs is what is read of them message by message, and of any MCAP file."""

import json
import shutil
from collections import Counter
from pathlib import Path
from threading import Event

import numpy as np
import pytest
from logreader import LogReader
from logs import read
from lossy_source import LossySource
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter

from hearthlog.analyzer.logs.recorder_info import Status
from hearthlog.analyzer.logs.summary import summarise
from hearthlog.analyzer.marks.marks import Mark, write_marks
from hearthlog.models.features.installed import DEFAULT
from hearthlog.models.modelfile import load_model
from hearthlog.recorder.config import MicrophoneSettings, Settings
from hearthlog.recorder.recording import record
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.schemas.errors import HearthlogWarning
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.contents import LoggedGap
from hearthlog.schemas.logs.files import active_path, find_logs
from hearthlog.schemas.logs.writer import LogWriter, TopicBatch
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.message_types import (
    definition,
    encode,
    header,
    message,
    nanoseconds,
    typestore,
)
from hearthlog.schemas.messages.topics import DIAGNOSTICS, Topic

SECOND = NANOSECONDS
START = 1_772_348_370_123_456_789
LOST = {5: 7, 9: 400}


@pytest.fixture(scope="module")
def logs(tmp_path_factory, model_file, day):
    """Three files of one recording with gaps."""
    folder = tmp_path_factory.mktemp("logs")
    settings = Settings(
        output=folder,
        model=model_file,
        microphone=[MicrophoneSettings(name="hall")],
        max_bag_duration=60,
    )
    return record(settings, LossySource(FileSource([day], START), LOST), Event()).logs


def counted(paths):
    """Messages, payload bytes, first and last log time of each topic, message by message."""
    found = {}
    for item in (item for path in paths for item in LogReader(path).messages()):
        count, size, times = found.get(item.topic, (0, 0, ()))
        times = (min([item.log_time, *times]), max([item.log_time, *times]))
        found[item.topic] = count + 1, size + len(item.data), times
    return found


def figures(summary):
    return {
        name: (topic.messages, topic.bytes, topic.span)
        for name, topic in summary.topics.items()
        if topic.messages
    }


def bag(folder, counts):
    """Make a ROS 2 bag by rosbags, messages of one topic 0.1 s apart, and return its MCAP file."""
    store = typestore()
    kind = "std_msgs/msg/String"
    with BagWriter(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for topic, count in counts.items():
            connection = writer.add_connection(topic, kind, typestore=store)
            for i in range(count):
                data = store.serialize_cdr(store.types[kind](data="x" * i), kind)
                writer.write(connection, START + i * SECOND // 10, data)
    (path,) = folder.glob("*.mcap")
    return path


def foreign(path, **options):
    """Make an MCAP file of messages in JSON, one of them without a schema."""
    with path.open("wb") as stream:
        writer = McapWriter(stream, **options)
        writer.start(profile="", library="someone else's")
        schema = writer.register_schema("Reading", "jsonschema", b"{}")
        channel = writer.register_channel("/reading", "json", schema)
        for i in range(21):
            data = json.dumps({"value": i}).encode()
            writer.add_message(channel, START + i * SECOND // 2, data, START)
        plain = writer.register_channel("/plain", "text", 0)
        writer.add_message(plain, START, b"hello", START)
        writer.finish()
    return path


def cut(path, folder):
    """Copy the first half of a log, as a recorder that was killed leaves it."""
    copy = active_path(folder / path.name)
    copy.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    return copy


def damaged(path, folder):
    """Copy a log with a few bytes overwritten in the middle, and one of what it says of itself."""
    data = bytearray(path.read_bytes().replace(b'"topics"', b'"Topics"'))
    middle = len(data) // 2
    data[middle : middle + 3000] = bytes(3000)
    copy = folder / path.name
    copy.write_bytes(data)
    return copy


def test_topics_have_the_messages_bytes_and_times_that_are_read_one_by_one(logs):
    summary = summarise(logs)
    assert summary.files == logs
    assert figures(summary) == counted(logs)
    assert summary.span == (
        min(first for _, _, (first, _) in counted(logs).values()),
        max(last for _, _, (_, last) in counted(logs).values()),
    )
    assert summary.topics["/hall/features"].type == message_types.FEATURES
    assert summary.topics["/hall/features"].encoding == "cdr"
    assert summary.size == sum(path.stat().st_size for path in logs)
    assert summary.raw_bytes > sum(size for _, size, _ in counted(logs).values())
    assert 1.2 < summary.compression_ratio < 3
    assert not summary.unfinished
    assert not summary.damaged
    assert not summary.layers


def test_labels_segments_and_gaps_are_those_of_the_messages(logs, model_file):
    summary = summarise(logs)
    frames = Counter(m.label for path in logs for m in read(path, "label"))
    (seconds,) = (summary.label_seconds.pop("hall"),)
    assert summary.label_seconds == {}
    assert seconds == pytest.approx({label: count * 0.05 for label, count in frames.items()})
    segments = Counter(m.label for path in logs for m in read(path, "segment"))
    assert summary.segments == {"hall": segments}
    doubtful = [
        m
        for path in logs
        for m in read(path, "segment")
        if m.confidence < 0.5 and m.label not in {"silence", "unknown"}
    ]
    assert len(doubtful) > 3
    assert summary.unsure["hall"]["segments"] == len(doubtful)
    assert summary.unsure["hall"]["seconds"] == pytest.approx(
        sum(nanoseconds(m.duration) for m in doubtful) / SECOND
    )
    assert summary.gaps == [
        LoggedGap(
            "hall",
            nanoseconds(m.header.stamp),
            nanoseconds(m.duration) / SECOND,
            m.reason,
            m.frames_lost,
        )
        for path in logs
        for m in read(path, "gap")
    ]
    assert [gap.frames_lost for gap in summary.gaps] == list(LOST.values())
    assert summary.gap_seconds == pytest.approx(sum(LOST.values()) * 0.05)
    (stream,) = summary.streams
    assert stream["microphone"] == "hall"
    assert stream["feature_set"] == DEFAULT.name
    assert stream["model_sha256"] == load_model(model_file).sha256


def test_what_a_file_is_and_what_it_carries_is_named(logs):
    summary = summarise(logs)
    assert summary.profiles == {"ros2"}
    assert summary.libraries == {"hearthlog"}
    reader = LogReader(logs[0])
    assert summary.metadata == reader.metadata.keys()
    assert summary.attachments == reader.attachments.keys()
    assert len(summary.attachments) == 3


def test_an_unfinished_log_counts_as_far_as_it_goes(logs, tmp_path):
    path = cut(logs[0], tmp_path)
    summary = summarise([path])
    assert summary.unfinished == [path]
    assert figures(summary) == counted([path])
    assert summary.topics["/hall/label"].messages > 100
    assert summary.metadata == {"hearthlog"}


def test_of_a_damaged_log_the_rest_is_counted_and_of_what_is_no_log_nothing(logs, tmp_path):
    bad = damaged(logs[1], tmp_path)
    nothing = tmp_path / "nothing.mcap"
    nothing.write_bytes(b"no log")
    with pytest.warns(HearthlogWarning, match="damaged at byte .* left out up to byte"):
        summary = summarise([logs[0], bad, nothing, logs[2]])
    assert list(summary.damaged) == [nothing]
    assert all(error.startswith(f"{path}: ") for path, error in summary.damaged.items())
    assert summary.files == [logs[0], bad, logs[2]]
    found, sound, all_ = figures(summary), counted([logs[0], logs[2]]), counted(logs)
    for topic, (messages, *_) in all_.items():
        assert sound.get(topic, (0,))[0] <= found[topic][0] <= messages
    assert found != sound
    assert found != all_


def test_a_ros_bag_is_counted_by_its_index(tmp_path):
    path = bag(tmp_path / "bag", {"/a": 21, "/b": 1, "/silent": 0})
    summary = summarise([path])
    assert {name: topic.messages for name, topic in summary.topics.items()} == {
        "/a": 21,
        "/b": 1,
        "/silent": 0,
    }
    assert summary.topics["/a"].type == "std_msgs/msg/String"
    assert summary.topics["/a"].rate == pytest.approx(10)
    assert summary.topics["/a"].bytes is None
    assert summary.span == (START, START + 2 * SECOND)
    assert summary.label_seconds == summary.segments == {}
    assert summary.health is None


def test_topics_of_a_bag_and_of_a_log_stand_beside_each_other(logs, tmp_path):
    path = bag(tmp_path / "bag", {"/a": 3})
    summary = summarise([*logs, path])
    assert summary.topics["/a"].messages == 3
    assert summary.topics["/hall/label"].bytes == counted(logs)["/hall/label"][1]
    assert summary.profiles == {"ros2"}
    assert len(summary.libraries) == 2


@pytest.mark.parametrize(
    ("options", "size"),
    [
        ({}, None),
        ({"compression": CompressionType.LZ4, "chunk_size": 100}, None),
        ({"use_statistics": False}, 263),
        ({"use_chunking": False}, 263),
        ({"index_types": IndexType.NONE, "use_summary_offsets": False}, 263),
    ],
)
def test_messages_of_other_encodings_are_counted_with_an_index_and_without(tmp_path, options, size):
    path = foreign(tmp_path / "a.mcap", **options)
    summary = summarise([path])
    assert not summary.damaged
    reading, plain = summary.topics["/reading"], summary.topics["/plain"]
    assert (reading.type, reading.encoding, reading.messages) == ("Reading", "json", 21)
    assert (plain.type, plain.encoding, plain.messages) == ("", "text", 1)
    assert reading.bytes == size
    assert reading.rate == pytest.approx(2)
    assert summary.libraries == {"someone else's"}


def test_a_log_without_messages_has_no_span(tmp_path):
    path = LogWriter(tmp_path / "a.mcap", [Topic("/mic/gap", message_types.GAP)], {}).finish()
    active = tmp_path / "b.mcap.active"
    active.touch()
    summary = summarise([path, active])
    assert summary.files == [path, active]
    assert summary.unfinished == [active]
    assert summary.span is None
    assert summary.seconds == 0
    assert summary.compression_ratio is None
    assert summary.topics["/mic/gap"].messages == 0
    assert summary.topics["/mic/gap"].rate == 0


def test_a_relabelling_is_a_layer_with_labels_of_its_own(logs, tmp_path):
    path = tmp_path / (logs[0].stem + ".relabel-better.mcap")
    topic = "/hall/relabel/better/label"
    times = START + np.arange(10) * SECOND // 20
    fields = {
        "header.stamp": times,
        "header.frame_id": "hall",
        "frame": np.arange(10, dtype=np.uint64),
        "label": ["speech"] * 4 + ["crying"] * 6,
        "confidence": np.ones(10, np.float32),
        "novelty": np.full(10, np.nan, np.float32),
        "probabilities": np.ones((10, 2), np.float32),
    }
    writer = LogWriter(path, [Topic(topic, message_types.LABEL)], {})
    writer.write_columns([TopicBatch(topic, times, fields)])
    writer.finish()
    alone, both = summarise([path]), summarise([*logs, path])
    assert both.layers == [path]
    assert alone.label_seconds == {"hall/relabel/better": {"speech": 0.2, "crying": 0.3}}
    assert both.label_seconds == alone.label_seconds | summarise(logs).label_seconds


def test_minutes_of_a_review_are_those_of_its_marks(logs, tmp_path):
    log = Path(shutil.copy(logs[0], tmp_path))
    spans = [(0, 2, "speech"), (3, 7, "silence"), (8, 9, "speech")]
    marks = [Mark("hall", START + a * SECOND, START + b * SECOND, name) for a, b, name in spans]
    found = summarise([write_marks(log, marks)])
    assert found.label_seconds == {"hall/review": {"speech": 3, "silence": 4}}
    assert found.segments == {"hall/review": {"speech": 2, "silence": 1}}


def status(level, name, text):
    return message(
        "diagnostic_msgs/msg/DiagnosticStatus",
        level=level,
        name=name,
        message=text,
        hardware_id="",
        values=[],
    )


def test_health_is_the_worst_that_was_said_and_of_that_the_last(tmp_path):
    output = [
        [status(0, "a", "fine")],
        [status(2, "a", "lost"), status(1, "b", "late")],
        [status(1, "a", "late"), status(2, "b", "lost again")],
        [status(0, "a", "fine"), status(0, "b", "fine")],
    ]
    paths = []
    for number, part in enumerate([output[:2], output[2:]]):
        writer = LogWriter(
            tmp_path / f"{number}.mcap", [Topic(DIAGNOSTICS, message_types.DIAGNOSTICS)], {}
        )
        for i, statuses in enumerate(part, 2 * number):
            array = message(message_types.DIAGNOSTICS, header=header(START, "mic"), status=statuses)
            writer.write(DIAGNOSTICS, START + i, encode(array))
        paths.append(writer.finish())
    worst = Status("b", START + 2, 2, "lost again")
    assert summarise(paths).health == summarise(paths[::-1]).health == worst


def test_of_a_log_that_is_still_written_the_latest_health_is_that_of_its_end(tmp_path):
    writer = LogWriter(tmp_path / "a.mcap", [Topic(DIAGNOSTICS, message_types.DIAGNOSTICS)], {})
    output = [status(2, "a", "lost"), status(1, "b", "late")], [status(0, "a", "listening")]
    for i, statuses in enumerate(output):
        array = message(message_types.DIAGNOSTICS, header=header(START, "mic"), status=statuses)
        writer.write(DIAGNOSTICS, START + i, encode(array))
    writer.flush()
    (path,) = tmp_path.iterdir()
    summary = summarise([path])
    assert summary.health == Status("a", START, 2, "lost")
    assert summary.latest_health == Status("b", START, 1, "late")
    assert summarise([writer.finish()]).health == summary.health


def test_a_type_that_only_has_the_name_of_ours_is_counted(tmp_path):
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start(profile="ros2", library="another")
        schema = writer.register_schema(message_types.LABEL, "ros2msg", b"uint32 label\n")
        channel = writer.register_channel("/mic/label", "cdr", schema)
        writer.add_message(channel, START, b"\x00\x01\x00\x00\x05\x00\x00\x00", START)
        writer.finish()
    with pytest.warns(HearthlogWarning, match="AudioLabel is defined without label as") as warned:
        summary = summarise([path])
    assert warned[0].message.where == "/mic/label"
    assert summary.topics["/mic/label"].messages == 1
    assert summary.label_seconds == {}


def test_a_type_of_ours_with_another_field_is_understood(tmp_path):
    path = tmp_path / "a.mcap"
    lines = definition(message_types.GAP).splitlines()
    lines.insert(lines.index("uint64 frames_lost") + 1, "uint32 later")
    gap = message(
        message_types.GAP,
        header=header(START, "mic"),
        duration=message("builtin_interfaces/msg/Duration", sec=2, nanosec=0),
        reason="overrun",
        frames_lost=40,
    )
    with path.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start(profile="ros2", library="a later version")
        schema = writer.register_schema(message_types.GAP, "ros2msg", "\n".join(lines).encode())
        channel = writer.register_channel("/mic/gap", "cdr", schema)
        writer.add_message(channel, START, encode(gap) + bytes(4), START)
        writer.finish()
    assert summarise([path]).gaps == [LoggedGap("mic", START, 2.0, "overrun", 40)]


def test_a_message_that_is_not_of_its_type_is_damage_in_its_file(tmp_path):
    writer = LogWriter(tmp_path / "a.mcap", [Topic("/mic/gap", message_types.GAP)], {})
    writer.write("/mic/gap", START, b"\x00\x01\x00\x00\x05\x00")
    path = writer.finish()
    summary = summarise([path])
    assert summary.damaged[path].startswith(f"{path}: /mic/gap: ")
    assert summary.files == []


def test_the_files_of_a_folder_are_found_with_those_still_being_written(logs, tmp_path):
    cut(logs[0], tmp_path)
    assert summarise(find_logs(tmp_path)).unfinished == find_logs(tmp_path)
