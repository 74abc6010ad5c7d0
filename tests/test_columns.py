"""Topics read as columns are what is read message by message, whatever the file looks like."""

import io
import json
import random
import struct
import subprocess
import sys
import threading
import warnings
import zlib
from dataclasses import replace
from pathlib import Path
from threading import Event

import numpy as np
import pytest
import zstandard
from logreader import LogReader
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Schema
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter

from hearthlog.recorder.config import load_settings
from hearthlog.recorder.recording import record_files
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.schemas.errors import HearthlogWarning, LogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs import merged_reading
from hearthlog.schemas.logs.columns import iterate_columns, read_columns
from hearthlog.schemas.logs.files import active_path, time_span
from hearthlog.schemas.logs.writer import LogWriter, TopicBatch
from hearthlog.schemas.mcap import chunks as chunk_reading
from hearthlog.schemas.mcap import logfile
from hearthlog.schemas.mcap.chunk_writer import ChunkWriter
from hearthlog.schemas.mcap.chunks import read_chunks
from hearthlog.schemas.mcap.compressed_chunk import StoredChunk
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.mcap.records import FOOTER_SIZE, HEAD, read_footer
from hearthlog.schemas.mcap.records import encode as encode_record
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.message_types import (
    definition,
    encode,
    encode_gap,
    header,
    message,
    typestore,
)
from hearthlog.schemas.messages.topics import Topic

pytestmark = pytest.mark.fast

SECOND = NANOSECONDS


@pytest.fixture(scope="module")
def logs(sounds, tmp_path_factory, model_file):
    """Several files of one recording."""
    folder = tmp_path_factory.mktemp("logs")
    settings = load_settings(
        None, {"output": folder, "model": model_file, "max_bag_duration": 60}, {}
    )
    found = record_files(settings, FileSource(sounds, 1_772_348_370_123_456_789), Event()).logs
    assert len(found) > 2
    return found


@pytest.fixture(scope="module")
def log(logs):
    return logs[1]


def flat(item):
    """Return the fields of one decoded message by path."""
    found = {}

    def add(prefix, part):
        for name in part.__dataclass_fields__:
            value = getattr(part, name)
            if type(value).__name__.endswith(("msg__Time", "msg__Duration")):
                found[prefix + name] = message_types.nanoseconds(value)
            elif hasattr(value, "__dataclass_fields__"):
                add(f"{prefix}{name}.", value)
            elif name != "__msgtype__" and not name.isupper():
                found[prefix + name] = value

    add("", item)
    return found


def expected(paths, kind, start=None, end=None):
    """Read message by message: log times, and the fields as lists."""
    found = [
        (item.log_time, flat(item.decode()))
        for path in paths
        for item in LogReader(path).messages()
        if item.topic.endswith(kind)
    ]
    found.sort(key=lambda row: row[0])
    wanted = [row for row in found if (start or 0) <= row[0] < (end or 1 << 63)]
    return [time for time, _ in wanted], [fields for _, fields in wanted]


def assert_same(columns, times, rows):
    assert columns.log_times.tolist() == times
    for path in rows[0]:
        values = columns[path]
        assert len(values) == len(rows)
        if values.dtype == object:
            assert [as_list(v) for v in values] == [as_list(row[path]) for row in rows]
        else:
            stacked = np.array([row[path] for row in rows], values.dtype)
            assert values.tobytes() == stacked.tobytes()


def as_list(value):
    return value.tolist() if isinstance(value, np.ndarray) else value


@pytest.mark.parametrize("kind", ["info", "features", "statistics", "label", "segment"])
def test_columns_of_several_files_are_what_their_messages_say(logs, kind):
    columns = read_columns(reversed(logs), [f"/mic/{kind}"])
    assert list(columns) == [f"/mic/{kind}"]
    assert_same(columns[f"/mic/{kind}"], *expected(logs, kind))


@pytest.mark.parametrize("span", [(None, 20), (20, None), (3, 4.5), (10, 10), (-50, 0), (70, 71)])
def test_a_span_of_time_is_read_to_the_message(logs, span):
    first = 1_772_348_370_123_456_789
    start, end = (None if s is None else first + int(s * SECOND) for s in span)
    times, rows = expected(logs, "label", start, end)
    columns = read_columns(logs, ["/mic/label"], start, end)
    if not times:
        assert columns == {}
    else:
        assert_same(columns["/mic/label"], times, rows)


def test_fields_that_are_not_wanted_are_left_out(log):
    columns = read_columns([log], ["/mic/label"], fields=["header.stamp", "label"])
    assert list(columns["/mic/label"].fields) == ["header.stamp", "label"]


def test_the_names_behind_the_arrays_come_along(log):
    columns = read_columns([log], ["/mic/features"])["/mic/features"]
    assert len(json.loads(columns.metadata["values_names"])) == columns["values"].shape[1]


def rewritten(log, path, **options):
    """Write the messages of a log with the options of the writer of mcap."""
    with LogFile(log) as file:
        raw = read_chunks(file, file.chunks)
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=50_000, **options)
        writer.start("ros2", "another")
        channels = {}
        for part in raw:
            schema = writer.register_schema(
                part.schema.name, part.schema.encoding, part.schema.data
            )
            channels[part.channel.topic] = writer.register_channel(
                part.channel.topic, "cdr", schema, part.channel.metadata
            )
        every = [
            (offset, time, part.channel.topic, part.buffer[offset : offset + size].tobytes())
            for part in raw
            for offset, time, size in zip(
                part.offsets.tolist(), part.log_times.tolist(), part.sizes.tolist(), strict=True
            )
        ]
        for _, time, topic, data in sorted(every):
            writer.add_message(channels[topic], time, data, time)
        writer.finish()
    return path


@pytest.mark.parametrize(
    "options",
    [
        {"compression": CompressionType.LZ4},
        {"compression": CompressionType.NONE},
        {"use_chunking": False},
        {"index_types": IndexType.NONE},
        {"index_types": IndexType.CHUNK},
        {"index_types": IndexType.MESSAGE},
        {"repeat_channels": False, "repeat_schemas": False},
        {"use_statistics": False, "use_summary_offsets": False},
        {"index_types": IndexType.NONE, "use_statistics": False, "repeat_channels": False},
        {"enable_crcs": False},
    ],
    ids=str,
)
def test_a_file_is_read_whatever_it_leaves_out(log, tmp_path, options):
    other = rewritten(log, tmp_path / "other.mcap", **options)
    for kind in ("label", "segment"):
        columns = read_columns([other], [f"/mic/{kind}"])[f"/mic/{kind}"]
        assert_same(columns, *expected([log], kind))
    times, rows = expected([log], "features")
    middle = slice(100, 300)
    columns = read_columns([other], ["/mic/features"], times[100], times[300])["/mic/features"]
    assert_same(columns, times[middle], rows[middle])


@pytest.mark.parametrize("name", ["cut.mcap", "cut.mcap.active"])
@pytest.mark.parametrize("share", [0.25, 0.4, 0.77, 0.999])
def test_of_a_log_that_is_cut_everything_complete_is_read(log, tmp_path, name, share):
    data = log.read_bytes()
    cut = tmp_path / name
    cut.write_bytes(data[: int(len(data) * share)])
    times, rows = expected([cut], "features")
    assert_same(read_columns([cut], ["/mic/features"])["/mic/features"], times, rows)


def test_a_log_that_is_being_written_is_read_up_to_its_last_flush(tmp_path):
    names = ["a", "b"]
    writer = LogWriter(
        tmp_path / "home_20260301T070000Z.mcap",
        [Topic("/mic/features", message_types.FEATURES, array_names={"values": names})],
        {},
    )
    path = writer.active_path
    assert read_columns([path]) == {}
    for block in range(3):
        for row in range(5):
            stamp = (block * 5 + row) * SECOND
            frame = message(
                message_types.FEATURES,
                header=header(stamp, "mic"),
                frame=block * 5 + row,
                values=np.ones(2, np.float32),
            )
            writer.write("/mic/features", stamp, encode(frame))
        writer.flush()
        columns = read_columns([path])["/mic/features"]
        assert columns["frame"].tolist() == list(range(block * 5 + 5))
    columns = read_columns([writer.finish()])["/mic/features"]
    assert columns["frame"].tolist() == list(range(15))


def begun(path, first, chunks):
    """Begin a log of a frame a second, each in a chunk of its own."""
    writer = LogWriter(path, [Topic("/mic/gap", message_types.GAP)], {})
    go_on(writer, first, chunks)
    return writer


def go_on(writer, first, chunks):
    for second in range(first, first + chunks):
        gap = encode_gap("mic", second * SECOND, second * SECOND, "overrun", second)
        writer.write("/mic/gap", second * SECOND, gap)
        writer.flush()


def test_an_unfinished_log_is_walked_through_once_and_its_definitions_are_sought_once(
    tmp_path, monkeypatch
):
    walked, searched = [], []
    walk, search = logfile.walk_records, chunk_reading._index_records
    monkeypatch.setattr(
        logfile,
        "walk_records",
        lambda *a: (walked.append(record[0]) or record for record in walk(*a)),
    )
    monkeypatch.setattr(
        chunk_reading, "_index_records", lambda *a: searched.append(a) or search(*a)
    )
    writer = begun(tmp_path / "home.mcap", 0, 50)
    columns = read_columns([writer.active_path], ["/mic/gap"])["/mic/gap"]
    writer.abandon()
    assert columns["frames_lost"].tolist() == list(range(50))
    assert walked.count(Opcode.CHUNK) == 50
    assert len(searched) <= 2  # the first chunk, and the last, whose index may not be whole


def test_what_is_written_between_the_search_for_spans_and_the_reading_is_read(
    tmp_path, monkeypatch
):
    writer = begun(tmp_path / "home.mcap", 0, 3)
    search = merged_reading.time_spans

    def search_and_write(*arguments):
        spans = search(*arguments)
        go_on(writer, 3, 2)
        return spans

    monkeypatch.setattr(merged_reading, "time_spans", search_and_write)
    columns = read_columns([writer.active_path])["/mic/gap"]
    writer.abandon()
    assert columns["frames_lost"].tolist() == list(range(5))


def test_of_many_unfinished_logs_few_stay_open_and_none_in_the_end(tmp_path, monkeypatch):
    writers = [begun(tmp_path / f"{n}.mcap", 10 * n, 3) for n in range(40)]
    for writer in writers:
        writer.abandon()
    logs = [writer.active_path for writer in writers]
    before, opened = open_files(), []
    search = merged_reading.time_spans

    def search_and_count(*arguments):
        spans = search(*arguments)
        opened.append(open_files() - before)
        return spans

    monkeypatch.setattr(merged_reading, "time_spans", search_and_count)
    columns = read_columns(logs)["/mic/gap"]
    expected = [10 * n + second for n in range(40) for second in range(3)]
    assert columns["frames_lost"].tolist() == expected
    assert len(read_columns(logs, start=390 * SECOND)["/mic/gap"]) == 3
    with pytest.raises(LogError):
        read_columns([*logs, tmp_path / "none.mcap"])
    assert max(opened) <= 8
    assert open_files() == before


def open_files():
    return len(list(Path("/proc/self/fd").iterdir()))


def test_a_log_that_is_finished_after_its_name_was_found_is_read(tmp_path):
    log = written(tmp_path / "home_20260301T070000Z.mcap", "/mic/label", np.arange(5))
    columns = read_columns([active_path(log)])["/mic/label"]
    assert columns["frame"].tolist() == [0, 1, 2, 3, 4]
    with pytest.raises(LogError, match=r"none\.mcap\.active: cannot be read"):
        read_columns([tmp_path / "none.mcap.active"])


def test_files_that_overlap_and_layers_come_as_one_series_in_the_order_of_time(tmp_path):
    first = written(tmp_path / "a.mcap", "/mic/label", np.arange(0, 40_000, 2))
    second = written(tmp_path / "b.mcap", "/mic/label", np.arange(1, 30_001, 2))
    layer = written(tmp_path / "a.relabel-x.mcap", "/mic/relabel/x/label", np.arange(0, 500, 5))
    seen = {}
    last = -1
    for batch in iterate_columns([second, layer, first]):
        for columns in batch:
            assert (np.diff(columns.log_times) >= 0).all()
            assert columns.log_times[0] >= last
            assert columns["frame"].tolist() == columns.log_times.tolist()
            seen.setdefault(columns.topic, []).extend(columns["frame"].tolist())
        last = max(int(columns.log_times[-1]) for columns in batch)
    assert seen["/mic/label"] == sorted([*range(0, 40_000, 2), *range(1, 30_001, 2)])
    assert seen["/mic/relabel/x/label"] == list(range(0, 500, 5))


def written(path, topic, times, *, label="speech", width=3):
    """Write labels at these times, whose frame numbers are the times."""
    writer = LogWriter(path, [Topic(topic, message_types.LABEL)], {})
    writer.write_columns([TopicBatch(topic, times, label_fields(times, label, width))])
    return writer.finish()


def label_fields(times, label, width):
    rng = np.random.default_rng(len(times))
    probabilities = rng.random((len(times), width), np.float32)
    return {
        "header.stamp": times,
        "header.frame_id": "mic",
        "frame": times,
        "label": label,
        "confidence": probabilities[:, 0],
        "novelty": np.full(len(times), np.nan, np.float32),
        "probabilities": probabilities,
    }


def test_rows_whose_arrays_differ_in_length_come_as_objects(tmp_path):
    first = written(tmp_path / "a.mcap", "/mic/label", np.arange(5))
    second = written(tmp_path / "b.mcap", "/mic/label", np.arange(5, 9), width=4)
    columns = read_columns([first, second])["/mic/label"]
    assert [len(row) for row in columns["probabilities"]] == [3] * 5 + [4] * 4


def test_two_types_on_one_topic_are_told(tmp_path):
    first = written(tmp_path / "a.mcap", "/mic/label", np.arange(5))
    writer = LogWriter(tmp_path / "b.mcap", [Topic("/mic/label", "std_msgs/msg/Float32")], {})
    fields = {"data": np.zeros(3, np.float32)}
    writer.write_columns([TopicBatch("/mic/label", np.arange(3), fields)])
    with pytest.raises(LogError, match="/mic/label: is of type std_msgs/msg/Float32 and of "):
        read_columns([first, writer.finish()])


def test_messages_that_are_no_cdr_are_told(tmp_path):
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("x", "jsonschema", b"{}")
        writer.add_message(writer.register_channel("/x", "json", schema), 5, b"{}", 5)
        writer.finish()
    with pytest.warns(HearthlogWarning, match="holds no ROS 2 messages"):
        assert read_columns([path]) == {}
    assert read_columns([path], ["/y"]) == {}


def test_a_bag_of_rosbags_is_read(tmp_path):
    name = "sensor_msgs/msg/JointState"
    sent = []
    with BagWriter(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        connection = bag.add_connection("/joints", name, typestore=typestore())
        for i in range(50):
            joints = message(
                name,
                header=header(i * SECOND, "arm"),
                name=["a", "b"][: i % 3],
                position=np.arange(i % 3) * 0.5,
                velocity=np.zeros(0),
                effort=np.zeros(2),
            )
            bag.write(connection, i * SECOND, typestore().serialize_cdr(joints, name))
            sent.append(flat(joints))
    (path,) = (tmp_path / "bag").glob("*.mcap")
    assert_same(read_columns([path])["/joints"], [i * SECOND for i in range(50)], sent)


def test_only_the_chunks_that_are_needed_are_read(log, tmp_path):
    data = bytearray(log.read_bytes())
    with LogFile(log) as file:
        chunks = file.chunks
        ids = {c.topic: i for i, c in file.channels.items()}
        until = int(chunks["end"][0]) + 1
        silent = [
            chunk
            for chunk in chunks
            if ids["/mic/info"] not in file.channel_sets[chunk["channels"]]
            and chunk["start"] >= until
        ]
    assert len(silent) > 1
    for chunk in silent:
        middle = int(chunk["offset"] + chunk["length"] // 2)
        data[middle : middle + 50] = bytes(50)
    path = tmp_path / "damaged.mcap"
    path.write_bytes(data)
    assert len(read_columns([path], ["/mic/info"])["/mic/info"]) == 1
    assert len(read_columns([path], ["/mic/features"], end=until)) == 1
    with pytest.raises(LogError, match=r"damaged at byte .* `hearthlog recover` saves the rest"):
        read_columns([path], ["/mic/features"])


@pytest.mark.parametrize("number", [1, 2])
def test_a_damaged_chunk_spoils_only_what_it_alone_defines(number, tmp_path):
    path = tmp_path / "cut.mcap"
    with path.open("xb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE, chunk_size=1)
        writer.start("ros2")
        schema = writer.register_schema("x/msg/Text", "ros2msg", b"string text")
        for topic, times in (("/a", (0, 1)), ("/b", (2, 3))):  # a chunk for each message
            channel = writer.register_channel(topic, "cdr", schema)
            for time in times:
                writer.add_message(channel, time, b"\0\1\0\0" + b"\3\0\0\0hi\0", time)
        writer.finish()
    with LogFile(path) as file:
        offsets, lengths = (file.chunks[name].tolist() for name in ("offset", "length"))
    data = bytearray(path.read_bytes()[: offsets[-1] + lengths[-1]])
    first_length = offsets[number] + 9 + 40 + 1
    data[first_length : first_length + 8] = b"\xff" * 8
    path.write_bytes(data)
    damage = f"damaged at byte {offsets[number]} "
    if number == 1:  # chunk 2 defines /b
        assert read_columns([path], start=3)["/b"]["text"].tolist() == ["hi"]
    else:
        with pytest.raises(LogError, match=damage):
            read_columns([path], start=3)
    with pytest.raises(LogError, match=damage):
        read_columns([path])


def test_an_index_that_does_not_belong_to_its_chunk_is_damage(log, tmp_path):
    for field, step in (("offset", 8), ("offset", 1 << 40), ("time", 1)):
        data = bytearray(log.read_bytes())
        with LogFile(log) as file:
            chunk = file.chunks[3]
        place = int(chunk["offset"] + chunk["length"]) + 15 + (8 if field == "offset" else 0)
        value = int.from_bytes(data[place : place + 8], "little") + step
        data[place : place + 8] = value.to_bytes(8, "little")
        path = tmp_path / f"{field}{step}.mcap"
        path.write_bytes(data)
        with pytest.raises(LogError, match="the index of a chunk does not belong to it"):
            read_columns([path])


def test_no_changed_byte_becomes_another_value_without_a_word(log, tmp_path):
    expected_columns = read_columns([log])
    path = tmp_path / "changed.mcap"
    rng = random.Random(7)
    data = log.read_bytes()
    refused = 0
    for _ in range(150):
        changed = bytearray(data)
        changed[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        path.write_bytes(changed)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", HearthlogWarning)
                columns = read_columns([path])
        except LogError:
            refused += 1
            continue
        for topic, same in expected_columns.items():
            for field, values in same.fields.items():
                np.testing.assert_array_equal(columns[topic][field], values)
    assert 75 < refused < 150


@pytest.mark.filterwarnings("ignore:its index is damaged")
def test_chunks_read_together_are_what_each_of_them_holds(log, tmp_path, monkeypatch):
    rng = random.Random(8)
    data = log.read_bytes()
    with LogFile(log) as file:
        first, chunk = file.chunks[0], file.chunks[3]
    heads = range(int(chunk["offset"]), int(chunk["offset"]) + 60)
    changes = [(place, 1 << rng.randrange(8)) for place in [0, *heads]]
    changes += [(rng.randrange(int(first["offset"]), len(data)), 1) for _ in range(30)]
    path = tmp_path / "changed.mcap"
    for place, bits in changes:
        changed = bytearray(data)
        changed[place] ^= bits if place else 0
        path.write_bytes(changed)
        together = outcome(path)
        with monkeypatch.context() as patch:
            patch.setattr(chunk_reading, "decompress_together", lambda *_: None)
            each = outcome(path)
        assert together == each


def test_an_index_record_that_is_too_short_is_damage(tmp_path):
    path = written(tmp_path / "home_20260301T070000Z.mcap", "/mic/label", np.arange(5))
    with LogFile(path) as file:
        end = int(file.chunks["offset"][0] + file.chunks["length"][0])
    cut = tmp_path / "cut.mcap"
    index = HEAD.pack(Opcode.MESSAGE_INDEX, 1) + b"\0"
    cut.write_bytes(path.read_bytes()[:end] + index + HEAD.pack(0x80, 0))
    with pytest.raises(LogError, match="a message index is cut"):
        read_columns([cut])


def outcome(path):
    """Bytes of the columns of a log, or what is wrong with it."""
    try:
        columns = read_columns([path])
    except LogError as error:
        return str(error)
    return {
        (topic, field): values.tobytes() if values.dtype != object else values.tolist()
        for topic, one in columns.items()
        for field, values in {"": one.log_times, **one.fields}.items()
    }


def test_a_summary_that_is_damaged_is_done_without_and_named(log, tmp_path):
    data = bytearray(log.read_bytes())
    data[-300] ^= 1
    path = tmp_path / "damaged.mcap"
    path.write_bytes(data)
    with pytest.warns(HearthlogWarning, match="its index is damaged") as warned:
        columns = read_columns([path], ["/mic/label"])
    assert {each.message.where for each in warned} == {path}
    assert_same(columns["/mic/label"], *expected([log], "label"))


@pytest.mark.filterwarnings("ignore:its index is damaged")
def test_statistics_that_are_damaged_hide_no_log(log, tmp_path):
    span, data = time_span(log), log.read_bytes()
    path = tmp_path / "damaged.mcap"
    end = len(data) - FOOTER_SIZE
    rest = read_footer(data[end:]).summary_start
    while data[rest] != Opcode.STATISTICS:
        rest += HEAD.size + HEAD.unpack_from(data, rest)[1]
    for place in range(rest, rest + HEAD.size + HEAD.unpack_from(data, rest)[1]):
        changed = bytearray(data)
        changed[place] ^= 1
        path.write_bytes(changed)
        assert time_span(path) == span


def test_a_message_index_that_lists_less_than_it_holds_is_refused(tmp_path):
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start("ros2", "test")
    schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
    channel = writer.register_channel("/s", "cdr", schema)
    for number in range(3):
        writer.add_message(channel, number, b"\0\1\0\0\2\0\0\0a\0", number)
    writer.finish()
    data = stream.getvalue()
    head = b"\x07" + struct.pack("<QHI", 54, channel, 48)
    assert data.count(head) == 1
    path = tmp_path / "less.mcap"
    for size in (0, 16, 32):
        path.write_bytes(data.replace(head, head[:-4] + struct.pack("<I", size)))
        with pytest.raises(LogError, match="here should be a message index"):
            read_columns([path])


def test_iterating_takes_little_memory_however_long_the_log(tmp_path):
    path = tmp_path / "long.mcap"
    writer = LogWriter(path, [Topic("/mic/statistics", message_types.STATISTICS)], {})
    for block in range(20):
        times = np.arange(50_000) + block * 50_000
        fields = {
            "header.stamp": times,
            "header.frame_id": "mic",
            "frame": times,
            "mean": np.tile(times.astype(np.float32)[:, np.newaxis], 21),
            "std": np.ones((len(times), 21), np.float32),
        }
        writer.write_columns([TopicBatch("/mic/statistics", times, fields)])
    writer.finish()
    code = f"""
from pathlib import Path
from hearthlog.schemas.logs.columns import iterate_columns
def peak():
    status = open("/proc/self/status").read()
    return int(status.partition("VmHWM:")[2].split()[0])
before = peak()
rows = sum(len(c) for batch in iterate_columns([Path({str(path)!r})]) for c in batch)
print(rows, (peak() - before) // 1024)
"""
    root = Path(__file__).parents[1]
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=root
    )
    rows, megabytes = map(int, done.stdout.split())
    assert rows == 1_000_000
    assert megabytes < 100


@pytest.mark.parametrize("active", [False, True])
def test_an_empty_log_has_no_columns(tmp_path, active):
    writer = LogWriter(tmp_path / "home.mcap", [Topic("/mic/gap", message_types.GAP)], {})
    if not active:
        assert read_columns([writer.finish()]) == {}
    else:
        assert read_columns([active_path(writer.path)]) == {}
        writer.abandon()


def test_definitions_of_the_file_come_before_those_that_are_known(tmp_path):
    schema = Schema(1, b"int16 frame\nstring extra", "ros2msg", message_types.FEATURES)
    channel = Channel(1, "/mic/features", "cdr", {}, 1)
    assert replace(schema).name != definition(message_types.FEATURES)
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2")
        writer.register_schema(schema.name, schema.encoding, schema.data)
        writer.register_channel(channel.topic, "cdr", 1)
        writer.add_message(1, 5, b"\0\1\0\0" + b"\7\0\0\0" + b"\3\0\0\0hi\0", 5)
        writer.finish()
    columns = read_columns([path])["/mic/features"]
    assert (columns["frame"].tolist(), columns["extra"].tolist()) == ([7], ["hi"])


def test_reading_that_is_given_up_leaves_no_file_open_and_no_thread(log):
    def held():
        return set(Path("/proc/self/fd").iterdir()), threading.active_count()

    before = held()
    for _ in iterate_columns([log]):
        break
    assert held() == before


def test_chunks_that_overlap_in_time_are_one_series(tmp_path):
    topic = Topic("/a", "std_msgs/msg/Header")
    logs = []
    for part in range(2):
        writer = LogWriter(tmp_path / f"{part}.mcap", [topic], {})
        for first in range(0, 100_000, 20_000):
            times = np.arange(first + part, first + 30_000, 2 + part)
            text = {"stamp": times, "frame_id": "x" * 300}
            writer.write_columns([TopicBatch("/a", times, text)])
            writer.flush()
        logs.append(writer.finish())
    expected = sorted(m.log_time for log in logs for m in LogReader(log).messages())
    found = [c.log_times for batch in iterate_columns(logs) for c in batch]
    assert len(found) > 5
    assert np.concatenate(found).tolist() == expected


def test_an_index_that_leads_to_one_message_again_and_again_is_refused(tmp_path):
    path = tmp_path / "1.mcap"
    with path.open("xb") as stream:
        writer = ChunkWriter(stream)
        writer.start("ros2", "test")
        schema = writer.register_schema("std_msgs/msg/Header", "ros2msg", b"string frame_id")
        writer.register_channel("/a", "cdr", schema, {})
        record = struct.pack("<BQHIQQ", 5, 22 + 1000, 1, 0, 7, 7) + bytes(1000)
        entries = {1: struct.pack("<QQ", 7, 0) * 2}
        crc = zlib.crc32(record)
        writer.copy_chunk(StoredChunk(b"", record, len(record), crc, 7, 7, entries))
        writer.finish()
    with pytest.raises(LogError, match="the index of a chunk does not belong to it"):
        read_columns([path])


@pytest.mark.parametrize(
    "claim", [{"uncompressed_size": 0}, {"uncompressed_size": 0, "message_index_length": 200_000}]
)
def test_an_index_that_lists_a_chunk_more_than_once_is_not_used(claim, tmp_path):
    path = tmp_path / "a.mcap"
    record = struct.pack("<BQHIQQ", 5, 22 + (40 << 20), 1, 0, 7, 7) + bytes(40 << 20)
    data = zstandard.compress(record) + bytes(300_000)
    with path.open("wb") as stream:
        writer = ChunkWriter(stream)
        writer.start("", "")
        writer.register_schema("a", "ros2msg", b"")
        writer.register_channel("/a", "cdr", 1, {})
        for _ in range(4):
            entries = {1: struct.pack("<QQ", 7, 0)}
            writer.copy_chunk(StoredChunk(b"zstd", data, len(record), 0, 7, 7, entries))
        index = ChunkIndex.read(ReadDataStream(io.BytesIO(writer._chunk_indexes[9:])))
        writer._chunk_indexes = encode_record(replace(index, **claim)) * 4
        writer.finish()
    with pytest.warns(HearthlogWarning, match="its index is damaged"), LogFile(path) as file:
        assert len(file.chunks) == len(set(file.chunks["offset"].tolist())) == 4
