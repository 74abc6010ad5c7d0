"""Logs of ours in the hands of other people's readers."""

import json
import shutil
import struct
from io import BytesIO

import numpy as np
import pytest
from logreader import LogReader
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader, make_reader
from mcap.records import Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap_ros2.decoder import DecoderFactory
from rerun.chunk import McapReader
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability, QosTime
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from hearthlog.models.modelfile import load_model, model_card
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS
from hearthlog.schemas.logs.files import find_logs

START = 1_772_348_370_123_456_789
LOST = {5: 7, 9: 40}
LEVELS = {"INFO": 20, "WARN": 30, "ERROR": 40}
FOR_EVER = QosTime(9_223_372_036, 854_775_807)
TOPICS = {
    f"/mic/{kind}": f"hearthlog_msgs/msg/Audio{name}"
    for kind, name in {
        "info": "StreamInfo",
        "features": "Features",
        "statistics": "Statistics",
        "label": "Label",
        "segment": "Segment",
        "gap": "Gap",
    }.items()
} | {"/diagnostics": "diagnostic_msgs/msg/DiagnosticArray", "/rosout": "rcl_interfaces/msg/Log"}


@pytest.fixture(scope="module")
def recorded(recorded):
    """Two logs of one recording with gaps, and the last of them when it was unfinished."""
    return find_logs(recorded), recorded.parent / "unfinished.mcap.active"


@pytest.fixture
def logs(recorded):
    return recorded[0]


def plain(value):
    """What a message says, whoever decoded it: numbers by their bits, fields by their names."""
    if isinstance(value, dict):
        return {name: plain(part) for name, part in value.items()}
    if isinstance(value, float | np.floating):
        return struct.pack("<d", value)
    if isinstance(value, str | int | np.integer):
        return value
    if isinstance(value, list | np.ndarray):
        if len(value) and isinstance(value[0], float | np.floating):
            return np.asarray(value, np.float64).tobytes()
        return [plain(part) for part in value]
    names = getattr(value, "__dataclass_fields__", None) or value.__slots__
    fields = [name for name in names if name != "__msgtype__" and not name.isupper()]  # constants
    return {name: plain(getattr(value, name)) for name in fields}


def ours(path):
    found = {topic: [] for topic in TOPICS}
    for item in LogReader(path).messages():
        assert TOPICS[item.topic] == item.type
        found[item.topic].append((item.log_time, plain(item.decode())))
    return found


def test_all_messages_of_all_topics_are_there_to_compare(logs):
    found = [ours(path) for path in logs]
    assert all(any(part[topic] for part in found) for topic in TOPICS)
    assert sum(len(part["/mic/gap"]) for part in found) == len(LOST)


def test_rosbags_reads_the_same_with_the_types_of_the_file(logs):
    for path in logs:
        with AnyReader([path]) as reader:
            found = {topic: [] for topic in TOPICS}
            for connection, time, data in reader.messages():
                assert connection.msgtype == TOPICS[connection.topic]
                decoded = reader.deserialize(data, connection.msgtype)
                found[connection.topic].append((time, plain(decoded)))
        assert found == ours(path)


def test_mcap_ros2_support_reads_the_same(logs):
    for path in logs:
        found = {topic: [] for topic in TOPICS}
        with path.open("rb") as stream:
            reader = make_reader(stream, decoder_factories=[DecoderFactory()])
            for _, channel, message, decoded in reader.iter_decoded_messages():
                found[channel.topic].append((message.log_time, plain(decoded)))
        assert found == ours(path)


def log_messages(batch):
    """The `Log` messages behind lines that Rerun has made its own."""
    stamps = batch.column("ros2_timestamp").cast("int64").to_pylist()
    names = ["file", "function", "line", "TextLog:level", "TextLog:text"]
    rows = zip(stamps, *(batch.column(name).to_pylist() for name in names), strict=True)
    found = []
    for stamp, (file,), (function,), (line,), (level,), (text,) in rows:
        sec, nanosec = divmod(stamp, NANOSECONDS)
        name, _, msg = text.removeprefix("[").partition("] ")
        about = {"stamp": {"sec": sec, "nanosec": nanosec}, "level": LEVELS[level], "name": name}
        found.append(about | {"msg": msg, "file": file, "function": function, "line": line})
    return found


def test_rerun_reads_the_same_at_the_same_times(logs):
    for path in logs:
        found = {topic: [] for topic in TOPICS}
        for chunk in McapReader(path).stream():
            if chunk.is_static:
                continue
            batch = chunk.to_record_batch()
            name = TOPICS[str(chunk.entity_path)].replace("/", ".") + ":message"
            times = [
                batch.column(timeline).cast("int64").to_pylist()
                for timeline in ("message_log_time", "message_publish_time")
            ]
            assert times[0] == times[1]
            if str(chunk.entity_path) == "/rosout":
                rows = log_messages(batch)
            else:
                rows = [plain(row) for (row,) in batch.column(name).to_pylist()]
            found[str(chunk.entity_path)] += zip(times[0], rows, strict=True)
        for rows in found.values():
            rows.sort(key=lambda row: row[0])
        assert found == ours(path)


def test_log_time_never_runs_backwards_and_tells_when_a_message_was_known(logs):
    for path in logs:
        last = 0
        with path.open("rb") as stream:
            messages = NonSeekingReader(stream).iter_messages(log_time_order=False)
            raw = [(channel.topic, message) for _, channel, message in messages]
        decoded = {topic: iter(rows) for topic, rows in ours(path).items()}
        for topic, message in raw:
            content = next(decoded[topic])[1]
            stamp = content["stamp"] if topic == "/rosout" else content["header"]["stamp"]
            duration = content.get("duration")
            time = stamp["sec"] * NANOSECONDS + stamp["nanosec"]
            if duration is not None:
                time += duration["sec"] * NANOSECONDS + duration["nanosec"]
            assert message.log_time == message.publish_time >= last
            late = message.log_time - time
            if topic in {"/mic/label", "/mic/segment"}:  # known with the end of a window
                assert late == 3 * FRAME_NANOSECONDS or (topic == "/mic/segment" and late == 0)
            else:
                assert late == 0
            last = message.log_time


def test_frames_are_50_ms_apart_and_jump_over_what_was_lost(logs):
    rows = [row for path in logs for row in ours(path)["/mic/features"]]
    frames = np.array([content["frame"] for _, content in rows])
    times = np.array([time for time, _ in rows])
    np.testing.assert_array_equal(times, START + frames * 50_000_000)
    steps = np.diff(frames)
    assert sorted(steps[steps != 1] - 1) == sorted(LOST.values())


def test_the_file_has_the_profile_the_metadata_and_the_attachments_of_the_contract(
    logs, model_file
):
    model = load_model(model_file)
    for path in logs:
        with path.open("rb") as stream:
            reader = make_reader(stream)
            assert reader.get_header().profile == "ros2"
            metadata = {record.name: record.metadata for record in reader.iter_metadata()}
            attachments = {record.name: record for record in reader.iter_attachments()}
            counts = reader.get_summary().statistics.channel_message_counts
            channels = reader.get_summary().channels
        assert metadata.keys() == {"hearthlog", "rosbag2", "hearthlog_contents"}
        assert metadata["hearthlog"]["node"] == "home"
        assert metadata["hearthlog"]["feature_set"] == model.description.feature_set
        assert metadata["hearthlog"]["model_sha256"] == model.sha256
        assert attachments.keys() == {"configuration.json", "model.json", "model_card.md"}
        assert json.loads(attachments["configuration.json"].data)["node"] == "home"
        assert attachments["model_card.md"].data.decode() == model_card(model)
        found = ours(path)
        assert {channels[i].topic: n for i, n in counts.items() if n} == {
            topic: len(rows) for topic, rows in found.items() if rows
        }


def test_the_metadata_in_the_file_serves_as_a_rosbag2_metadata_file(logs, tmp_path):
    for path in logs:
        with path.open("rb") as stream:
            (text,) = (
                record.metadata["serialized_metadata"]
                for record in make_reader(stream).iter_metadata()
                if record.name == "rosbag2"
            )
        bag = tmp_path / path.stem
        bag.mkdir()
        shutil.copy(path, bag)
        (bag / "metadata.yaml").write_text(f"rosbag2_bagfile_information: {text}")
        found = ours(path)
        times = [time for rows in found.values() for time, _ in rows]
        with Reader(bag) as reader:
            assert {c.topic: c.msgcount for c in reader.connections} == {
                topic: len(rows) for topic, rows in found.items()
            }
            assert reader.message_count == len(times) == len(list(reader.messages()))
            assert reader.start_time == min(times)
            assert reader.start_time + reader.duration - 1 == max(times)
            assert all(c.digest.startswith("RIHS01_") for c in reader.connections)


def test_every_channel_offers_a_quality_of_service(logs):
    for path in logs:
        with AnyReader([path]) as reader:
            offered = {c.topic: c.ext.offered_qos_profiles for c in reader.connections}
        assert offered.keys() == TOPICS.keys()
        for topic, (profile,) in offered.items():
            kept = (profile.durability, profile.depth, profile.lifespan)
            if topic == "/mic/info":
                assert kept == (QosDurability.TRANSIENT_LOCAL, 1, FOR_EVER)
            elif topic == "/rosout":  # as ROS 2 itself offers it
                assert kept == (QosDurability.TRANSIENT_LOCAL, 1000, QosTime(10, 0))
            else:
                assert kept == (QosDurability.VOLATILE, 10, FOR_EVER)


def test_the_type_hash_is_that_of_the_definition_in_the_file(logs):
    with logs[0].open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert {schema.name for schema in summary.schemas.values()} == set(TOPICS.values())
    for channel in summary.channels.values():
        schema = summary.schemas[channel.schema_id]
        assert (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr")
        store = get_typestore(Stores.EMPTY)
        store.register(get_types_from_msg(schema.data.decode(), schema.name))
        assert channel.metadata["topic_type_hash"] == store.hash_rihs01(schema.name)


def test_the_channel_names_the_values_of_its_arrays(logs, model_file):
    with logs[0].open("rb") as stream:
        channels = make_reader(stream).get_summary().channels.values()
    named = {
        (c.topic, key.removesuffix("_names")): json.loads(text)
        for c in channels
        for key, text in c.metadata.items()
        if key.endswith("_names")
    }
    info = LogReader(logs[0])
    (output,) = (m.decode() for m in info.messages(["/mic/info"]))
    assert named == {
        ("/mic/features", "values"): output.feature_names,
        ("/mic/statistics", "mean"): output.feature_names,
        ("/mic/statistics", "std"): output.feature_names,
        ("/mic/label", "probabilities"): output.labels,
    }
    assert output.labels == list(load_model(model_file).classes)


def until_the_cut(messages):
    found = []
    try:
        for message in messages:
            found.append((message.channel_id, message.log_time, message.data))  # noqa: PERF401
    except (EndOfFile, struct.error):  # the latter where a message index is cut
        pass
    return found


def chunks(data):
    """Where each chunk of a file ends, and how many messages it holds.

    A record is an opcode, a length and as many bytes.
    """
    place, found = 8, []
    while place + 9 <= len(data):
        opcode, length = struct.unpack_from("<BQ", data, place)
        end = place + 9 + length
        if opcode == Opcode.CHUNK and end <= len(data):
            stream = ReadDataStream(BytesIO(data[place + 9 : end]))
            records = breakup_chunk(Chunk.read(stream))
            found.append((end, sum(isinstance(record, Message) for record in records)))
        place = end
    return found


def test_a_file_cut_anywhere_is_read_up_to_its_last_whole_chunk(recorded, tmp_path):
    _, unfinished = recorded
    full = unfinished.read_bytes()
    layout = chunks(full)
    assert len(layout) > 2
    middle = layout[len(layout) // 2][0]
    cut = tmp_path / "cut.mcap.active"
    rng = np.random.default_rng(5)
    for length in [*rng.integers(1000, len(full), 50).tolist(), middle - 1, middle, len(full)]:
        cut.write_bytes(full[:length])
        with cut.open("rb") as stream:
            records = StreamReader(stream).records
            streamed = until_the_cut(r for r in records if isinstance(r, Message))
        with cut.open("rb") as stream:
            messages = NonSeekingReader(stream).iter_messages(log_time_order=False)
            unseeked = until_the_cut(message for _, _, message in messages)
        log = LogReader(cut)
        read = [(item.log_time, item.data) for item in log.messages()]
        assert len(streamed) == sum(count for end, count in layout if end <= length)
        assert unseeked == streamed
        assert read == [(time, data) for _, time, data in streamed]
        assert not log.complete
