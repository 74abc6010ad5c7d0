"""What is exported is opened by the tools it is for, and holds what the log holds, bit for bit."""

import csv
import io
import json
import re
import resource
import shutil
import signal
import struct
import subprocess
import time
from contextlib import nullcontext
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import soundfile
from conftest import HEARTHLOG
from log_fixtures import raw_messages, run, small_disk, write_log
from logreader import LogReader
from rosbags import rosbag1, rosbag2
from rosbags.highlevel import AnyReader

from hearthlog import open_logs
from hearthlog.recorder.sources.decoding import read_audio
from hearthlog.schemas.errors import HearthlogWarning, LogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import find_logs
from hearthlog.schemas.logs.writer import LogWriter
from hearthlog.schemas.mcap.chunk_writer import ChunkWriter
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.message_types import header, message, nanoseconds, time_message
from hearthlog.schemas.messages.topics import Topic

KINDS = ("features", "statistics", "label", "segment", "gap", "info")
RATE = 16_000


@pytest.fixture(scope="module")
def sound(household):
    """Some seconds of sound, 16 bits a sample."""
    path = min(household.glob("*/*.flac"))
    samples = np.concatenate(list(read_audio(path)))[: 4 * RATE]
    return (samples * 32767).clip(-32768, 32767).astype("<i2")


@pytest.fixture
def hearthlog(capfd):
    """Run the command and return what came of it."""
    return partial(run, capfd)


@pytest.fixture
def exported(hearthlog, tmp_path):
    """Export what must be exported without a word, and return the output."""

    def export(logs, name, *options):
        output = tmp_path / name
        result = hearthlog("export", logs, "--output", output, *options)
        assert (result.returncode, result.stdout, result.stderr) == (0, f"{output}\n", "")
        assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []
        return output

    return export


@pytest.fixture
def refused(hearthlog, tmp_path):
    """Export what must fail with one line, and return that line."""

    def export(logs, name, *options, status=1):
        before = sorted(tmp_path.rglob("*"))
        result = hearthlog("export", logs, "--output", tmp_path / name, *options)
        assert (result.returncode, result.stdout) == (status, "")
        assert result.stderr.count("\n") == 1
        assert sorted(tmp_path.rglob("*")) == before
        return result.stderr.removeprefix("hearthlog: ").rstrip()

    return export


def items_of(logs, topic):
    return [item for log in find_logs(logs) for item in LogReader(log).messages([topic])]


def bits(value):
    """A value of a message, such that equal ones are the same bit for bit."""
    if hasattr(value, "nanosec"):
        return nanoseconds(value)
    if hasattr(value, "__msgtype__"):
        names = [name for name in value.__dataclass_fields__ if not name.isupper()]
        return {name: bits(getattr(value, name)) for name in names if name != "__msgtype__"}
    if isinstance(value, float):
        return struct.pack("<d", value)
    if isinstance(value, np.ndarray) and value.dtype.kind == "f":
        return value.tobytes()
    if isinstance(value, list | np.ndarray):
        return [bits(part) for part in value]
    return value


def clip(stamp, data, **fields):
    about = {"format": "pcm-s16", "sample_rate": RATE, "number_of_channels": 1} | fields
    content = np.frombuffer(data.tobytes(), np.uint8)
    return message(message_types.RAW_AUDIO, timestamp=time_message(stamp), data=content, **about)


def clips(samples, start, size=800):
    """Sound as messages of 50 ms, with their log times."""
    stamps = [start + i * NANOSECONDS // RATE for i in range(0, len(samples), size)]
    parts = [samples[i : i + size] for i in range(0, len(samples), size)]
    return [(stamp, clip(stamp, part)) for stamp, part in zip(stamps, parts, strict=True)]


def test_parquet_has_every_bit_and_says_where_it_is_from(recorded, exported):
    folder = exported(recorded, "tables", "--format", "parquet")
    assert {path.name for path in folder.iterdir()} == {f"mic_{kind}.parquet" for kind in KINDS} | {
        "diagnostics.parquet",
        "rosout.parquet",
    }
    columns = read_columns(find_logs(recorded))
    for topic, expected in columns.items():
        table = pq.read_table(folder / f"{topic[1:].replace('/', '_')}.parquet")
        assert table.num_rows == len(expected)
        assert table["log_time"].type == pa.timestamp("ns", "UTC")
        assert table["log_time"].cast(pa.int64()).to_numpy().tolist() == expected.log_times.tolist()
        assert table["sequence"].to_numpy().tolist() == expected.sequences.tolist()
        assert table.column_names[3:] == list(expected.fields)
        about = {key.decode(): text.decode() for key, text in table.schema.metadata.items()}
        assert about.items() >= expected.metadata.items()
        (made,) = json.loads(about["hearthlog"])
        assert made == LogReader(find_logs(recorded)[0]).metadata["hearthlog"]
    for kind, names in (("features", ["values"]), ("statistics", ["mean", "std"])):
        table = pq.read_table(folder / f"mic_{kind}.parquet")
        for name in names:
            values = table[name].combine_chunks().flatten().to_numpy()
            assert values.dtype == np.float32
            assert values.tobytes() == columns[f"/mic/{kind}"][name].tobytes()
    labels = pq.read_table(folder / "mic_label.parquet").to_pandas()
    assert labels["label"].tolist() == columns["/mic/label"]["label"].tolist()
    assert labels["novelty"].between(0, 1).all()
    gaps = pq.read_table(folder / "mic_gap.parquet").to_pandas()
    assert gaps["header.stamp"].dt.tz is not None
    assert gaps["duration"].tolist() == [pd.Timedelta("350ms"), pd.Timedelta("2s")]
    health = pq.read_table(folder / "diagnostics.parquet")["status"].to_pylist()
    assert health == columns["/diagnostics"]["status"].tolist()


def test_parquet_of_one_topic_and_a_span_is_one_file(recorded, exported):
    times = [item.log_time for item in items_of(recorded, "/mic/label")]
    start, end = (str(np.datetime64(times[i], "ns")) for i in (7, 99))
    options = ("--topics", "/mic/label", "--start", start, "--end", end)
    table = pq.read_table(exported(recorded, "label.parquet", *options))
    assert table["log_time"].cast(pa.int64()).to_pylist() == times[7:99]


def test_csv_is_what_cat_prints_and_pandas_reads_it(recorded, exported, hearthlog):
    folder = exported(recorded, "tables", "--format", "csv")
    for kind in KINDS:
        text = (folder / f"mic_{kind}.csv").read_text()
        assert (
            text == hearthlog("cat", recorded, "--format", "csv", "--topics", f"/mic/{kind}").stdout
        )
    frame = pd.read_csv(folder / "mic_features.csv", parse_dates=["log_time"], dtype={})
    expected = read_columns(find_logs(recorded), {"/mic/features"})["/mic/features"]
    names = json.loads(expected.metadata["values_names"])
    values = frame[[f"values.{name}" for name in names]].to_numpy(np.float32)
    assert values.tobytes() == expected["values"].tobytes()
    stamps = frame["log_time"].dt.tz_localize(None).to_numpy("M8[ns]")
    assert stamps.astype(np.int64).tolist() == expected.log_times.tolist()


def test_npz_is_loaded_without_pickle(recorded, exported):
    folder = exported(recorded, "arrays", "--format", "npz")
    for topic, expected in read_columns(find_logs(recorded)).items():
        with np.load(folder / f"{topic[1:].replace('/', '_')}.npz", allow_pickle=False) as arrays:
            found = dict(arrays)
        assert found["log_time"].astype(np.int64).tolist() == expected.log_times.tolist()
        assert found["log_time"].dtype == np.dtype("M8[ns]")
        for path, values in expected.fields.items():
            if path == "status":
                assert [json.loads(text) for text in found[path]] == values.tolist()
            elif values.dtype == object:
                assert found[path].tolist() == values.tolist()
            else:
                assert found[path].tobytes() == values.tobytes()
            names = f"{path}_names"
            assert (names in found) == (names in expected.metadata)
            if names in found:
                assert found[names].tolist() == json.loads(expected.metadata[names])


def test_npz_of_arrays_of_different_lengths(exported, tmp_path):
    rows = [np.arange(n, dtype=np.uint8) for n in (3, 0, 5)]
    made = [
        message("sensor_msgs/msg/CompressedImage", header=header(i, "x" * i), format="", data=row)
        for i, row in enumerate(rows)
    ]
    log = write_log(tmp_path / "x.mcap", {"/image": list(enumerate(made))})
    with np.load(exported(log, "x.npz"), allow_pickle=False) as arrays:
        assert np.split(arrays["data"], np.cumsum(arrays["data.lengths"]))[2].tolist() == [
            *range(5)
        ]
        assert arrays["header.frame_id"].tolist() == ["", "x", "xx"]


def changing(path, *definitions, topic="/m"):
    """A log of messages of one type, which is defined anew before each of them."""
    with path.open("xb") as stream:
        writer = ChunkWriter(stream)
        writer.start("ros2", "test")
        for time, (name, text, data) in enumerate(definitions):
            schema = writer.register_schema(name, "ros2msg", text.encode())
            channel = writer.register_channel(topic, "cdr", schema, {})
            writer.add_message(channel, time, b"\0\1\0\0" + data, time)
        writer.finish()
    return path


OWN = "my_msgs/msg/M"
INNER = f"{'=' * 80}\nMSG: my_msgs/I\n"
CHANGES = {
    "fields that changed places": (
        [("int32 a\nint32 b\n", struct.pack("<2i", 1, 2)),
         ("int32 b\nint32 a\n", struct.pack("<2i", 2, 1))],
        {"a": [1, 1], "b": [2, 2]},
    ),
    "fields of a message that changed places": (
        [(f"I left\n{INNER}int32 a\nint32 b\n", struct.pack("<2i", 1, 2)),
         (f"I left\n{INNER}int32 b\nint32 a\n", struct.pack("<2i", 2, 1))],
        {"left.a": [1, 1], "left.b": [2, 2]},
    ),
    "another name": (
        [("int32 a\n", struct.pack("<i", 1)), ("int32 b\n", struct.pack("<i", 2))],
        {"a": [1, None], "b": [None, 2]},
    ),
    "an appended field, and a wider one": (
        [("int32 a\n", struct.pack("<i", 1)),
         ("int64 a\nstring s\n", struct.pack("<qI2s", 2**60 + 1, 2, b"x\0"))],
        {"a": [1, 2**60 + 1], "s": [None, "x"]},
    ),
}  # fmt: skip


@pytest.mark.parametrize("change", CHANGES)
def test_a_type_that_changed_gives_one_table_by_the_names_of_its_fields(
    hearthlog, tmp_path, change
):
    definitions, expected = CHANGES[change]
    log = changing(tmp_path / "x.mcap", *((OWN, *each) for each in definitions))
    is_complete = None not in [value for values in expected.values() for value in values]
    outputs = [tmp_path / f"x.{form}" for form in ("parquet", "csv", "npz")]
    for output in outputs:
        result = hearthlog("export", log, "-o", output)
        assert result.returncode == (0 if is_complete else 3)
        assert bool(result.stderr) != is_complete
        for name, values in expected.items():  # what is missing is named
            assert (None in values) == (
                name in result.stderr.strip().partition("others: ")[2].split(", ")
            )
    frame = pd.read_parquet(outputs[0], dtype_backend="pyarrow").iloc[:, 3:]
    assert {name: frame[name].tolist() for name in frame} == {
        name: [pd.NA if value is None else value for value in values]
        for name, values in expected.items()
    }
    with outputs[1].open() as stream:
        rows = [list(row.items())[3:] for row in csv.DictReader(stream)]
    assert rows == [
        [(name, "" if values[i] is None else f"{values[i]}") for name, values in expected.items()]
        for i in range(2)
    ]
    with np.load(outputs[2]) as arrays:
        for name, values in expected.items():
            there = [i for i, value in enumerate(values) if value is not None]
            assert arrays[name].tolist() == [values[i] for i in there]
            if len(there) < len(values):
                assert arrays[f"{name}.rows"].tolist() == there
    context = nullcontext() if is_complete else pytest.warns(HearthlogWarning, match="2 ways")
    with context:
        table, frame = open_logs(log).arrow("/m"), open_logs(log).pandas("/m")
    assert table.select(list(expected)).to_pydict() == expected
    for name, values in expected.items():
        assert [None if pd.isna(value) else value for value in frame[name]] == values


def test_names_of_some_channels_and_long_arrays_of_others_are_in_one_csv(exported, tmp_path):
    with (tmp_path / "x.mcap").open("xb") as stream:
        writer = ChunkWriter(stream)
        writer.start("ros2", "test")
        schema = writer.register_schema(OWN, "ros2msg", b"uint16[] a\n")
        for time, names in enumerate(['["x", "y"]', "", '["x", "y"]']):
            about = {"a_names": names} if names else {}
            channel = writer.register_channel("/m", "cdr", schema, about)
            values = range(2 if names else 5000)
            data = struct.pack(f"<4sI{len(values)}H", b"\0\1\0\0", len(values), *values)
            writer.add_message(channel, time, data, time)
        writer.finish()
    with exported(tmp_path / "x.mcap", "x.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [(row["a.x"], row["a.y"]) for row in rows] == [("0", "1"), ("", ""), ("0", "1")]
    assert [len(json.loads(row["a"] or "[]")) for row in rows] == [0, 5000, 0]


@pytest.mark.parametrize(
    ("second", "why"),
    [
        (("std_msgs/msg/Int32", "int32 data\n", struct.pack("<i", 5)), "has messages of"),
        (
            ("std_msgs/msg/Int64", "string data\n", struct.pack("<I2s", 2, b"x\0")),
            "int64 and string",
        ),
        (("std_msgs/msg/Int64", "float64 data\n", struct.pack("<d", 0.5)), "int64 and float64"),
    ],
)
def test_messages_for_which_there_is_no_one_table_are_in_tables_of_their_own(
    hearthlog, refused, tmp_path, second, why
):
    first = "std_msgs/msg/Int64", "int64 data\n", struct.pack("<q", 2**60 + 1)
    log = changing(tmp_path / "x.mcap", first, second)
    for form in ("parquet", "csv", "npz"):
        message = refused(log, f"x.{form}")
        assert message.startswith("/m: ")
        assert why in message
        assert message.endswith(f"with --format {form}, for a file of each")
        result = hearthlog("export", log, "-o", tmp_path / form, "--format", form)
        assert result.returncode == 3
        assert why in result.stderr
        other = f"m_{second[0].replace('/', '_')}"
        assert {path.stem for path in (tmp_path / form).iterdir()} == {"m", other}
    assert "1152921504606846977" in (tmp_path / "csv" / "m.csv").read_text()
    with pytest.raises(LogError, match="which is no table; choose other logs"):
        open_logs(log).arrow("/m")
    assert "which is no table" in hearthlog("cat", log, "--format", "csv").stderr


def test_rows_of_two_definitions_are_in_the_order_of_time(hearthlog, tmp_path):
    a, b = (OWN, "int32 a\n", struct.pack("<i", 1)), (OWN, "int32 b\n", struct.pack("<i", 2))
    log = changing(tmp_path / "x.mcap", a, b, a, b, b, a)
    for form in ("parquet", "csv", "npz"):
        hearthlog("export", log, "-o", tmp_path / f"x.{form}")
    expected = [1, None, 1, None, None, 1]
    table = pq.read_table(tmp_path / "x.parquet")
    assert table["a"].to_pylist() == expected
    assert table["log_time"].cast(pa.int64()).to_pylist() == [0, 1, 2, 3, 4, 5]
    assert pd.read_csv(tmp_path / "x.csv")["a"].tolist() == pytest.approx(
        [np.nan if value is None else value for value in expected], nan_ok=True
    )
    with np.load(tmp_path / "x.npz") as arrays:
        assert arrays["b.rows"].tolist() == [1, 3, 4]
        assert arrays["log_time"].astype(int).tolist() == [0, 1, 2, 3, 4, 5]


def test_a_topic_that_a_format_has_no_place_for_is_left_out(hearthlog, tmp_path):
    rows = [np.zeros(n) for n in (1, 2)]
    topics = {
        "/x": [(1, message("std_msgs/msg/Bool", data=True))],
        "/y": [
            (i * 10**9, message("std_msgs/msg/Float64MultiArray",
                                layout=message("std_msgs/msg/MultiArrayLayout", dim=[],
                                               data_offset=0), data=row))
            for i, row in enumerate(rows)
        ],
    }  # fmt: skip
    logs = tmp_path / "logs"
    logs.mkdir()
    for number in range(2):  # what is wider comes later
        part = {topic: found[number : number + 1] for topic, found in topics.items()}
        write_log(logs / f"{number}.mcap", {topic: each for topic, each in part.items() if each})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hearthlog.schemas.logs.merged_reading._BATCH", 1)
        result = hearthlog("export", logs, "-o", tmp_path / "csv", "--format", "csv")
    assert result.returncode == 3
    assert "/y: data[1] is not in all messages, which CSV has no column for" in result.stderr
    assert [path.name for path in (tmp_path / "csv").iterdir()] == ["x.csv"]


@pytest.mark.parametrize("form", ["parquet", "csv", "npz"])
def test_thousands_of_topics_need_few_open_files_and_read_the_logs_once(
    hearthlog, tmp_path, form, monkeypatch
):
    flag = message("std_msgs/msg/Bool", data=True)
    log = write_log(tmp_path / "x.mcap", {f"/t{i}": [(i, flag)] for i in range(100)})
    opened = []
    monkeypatch.setattr(LogFile, "__enter__", lambda file: opened.append(file) or file)
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(
        resource.RLIMIT_NOFILE, (len(list(Path("/proc/self/fd").iterdir())) + 30, limits[1])
    )
    try:
        result = hearthlog("export", log, "-o", tmp_path / form, "--format", form)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)
    assert (result.returncode, result.stderr) == (0, "")
    assert len(list((tmp_path / form).iterdir())) == 100
    assert len(opened) < 10


def test_an_export_that_is_killed_leaves_nothing(tmp_path):
    topics = {f"/t{i}": [(i, message("std_msgs/msg/Bool", data=True))] for i in range(1000)}
    log = write_log(tmp_path / "x.mcap", topics)
    command = [*HEARTHLOG, "export", log, "-o", tmp_path / "out", "--format", "csv"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        while not (begun := list(tmp_path.glob(".out.*/t1.csv"))) and process.poll() is None:
            time.sleep(0.01)
        process.send_signal(signal.SIGSTOP)  # so that it cannot come to its end before it is told
        process.terminate()
        process.send_signal(signal.SIGCONT)
        message_text = process.stderr.read()
    assert begun
    assert (process.returncode, message_text) == (128 + signal.SIGTERM, "")
    assert list(tmp_path.iterdir()) == [log]


def test_npz_of_more_than_memory_should_hold_is_read_in_several_passes(
    recorded, exported, monkeypatch
):
    expected = exported(recorded, "once", "--format", "npz")
    monkeypatch.setattr("hearthlog.analyzer.export.npz._MEMORY", 1 << 20)
    found = exported(recorded, "passes", "--format", "npz")
    assert sorted(p.name for p in found.iterdir()) == sorted(p.name for p in expected.iterdir())
    for path in expected.iterdir():
        assert (found / path.name).read_bytes()[100:] == path.read_bytes()[100:]


def test_texts_that_a_spreadsheet_would_run_are_disarmed(exported, hearthlog, tmp_path):
    texts = [
        "=1+1",
        "+1 234",
        "-x",
        "@SUM(A1)",
        "\tx",
        "'=x",
        "\uff1d1",
        "-5",
        "+.5e-3",
        "a=b",
        "'x",
        "",
    ]
    log = write_log(
        tmp_path / "x.mcap",
        {"/x": [(i, message("std_msgs/msg/String", data=text)) for i, text in enumerate(texts)]},
    )
    path = exported(log, "x.csv")
    with path.open() as stream:
        found = [row["data"] for row in csv.DictReader(stream)]
    assert found == ["'=1+1", "'+1 234", "'-x", "'@SUM(A1)", "'\tx", "''=x", "'\uff1d1", *texts[7:]]
    assert hearthlog("cat", log, "--format", "csv").stdout == path.read_text()


def test_an_image_is_one_column(exported, tmp_path):
    image = message(
        "sensor_msgs/msg/Image", header=header(7, ""), height=2, width=4000, encoding="mono8",
        is_bigendian=0, step=4000, data=np.arange(8000, dtype=np.uint8),
    )  # fmt: skip
    depths = message("sensor_msgs/msg/ChannelFloat32", name="", values=np.ones(5000, np.float32))
    log = write_log(tmp_path / "x.mcap", {"/image": [(1, image)], "/depth": [(1, depths)]})
    for topic, path in (("/image", "data"), ("/depth", "values")):
        frame = open_logs(log).pandas(topic)
        assert len(frame.columns) < 10
        assert len(frame[path].iloc[0]) == {"data": 8000, "values": 5000}[path]
    text = exported(log, "x.csv", "--topics", "/depth").read_text()
    assert text.splitlines()[0] == '"log_time","publish_time","sequence","name","values"'


def test_audacity_labels_are_in_seconds_of_the_sound(recorded, exported):
    path = exported(recorded, "labels.txt")
    lines = [line.split("\t") for line in path.read_text().splitlines()]
    items = [item.decode() for item in items_of(recorded, "/mic/segment")]
    first = nanoseconds(items_of(recorded, "/mic/features")[0].decode().header.stamp)
    assert len(lines) == len(items) > 3
    for (start, end, label), item in zip(lines, items, strict=True):
        begin = nanoseconds(item.header.stamp) - first
        assert float(start) == pytest.approx(begin / NANOSECONDS, abs=1e-6)
        length = nanoseconds(item.duration) / NANOSECONDS
        assert float(end) - float(start) == pytest.approx(length, abs=2e-6)
        assert label == item.label


def test_audacity_labels_of_a_part_start_with_it_and_have_one_line_each(exported, tmp_path):
    def segment(start, label):
        return message(
            message_types.SEGMENT,
            header=header(start * NANOSECONDS, "mic"),
            duration=messages_duration(2),
            label=label,
            confidence=1.0,
        )

    def messages_duration(seconds):
        return message("builtin_interfaces/msg/Duration", sec=seconds, nanosec=0)

    frames = [
        message(message_types.FEATURES, header=header(i * NANOSECONDS, "mic"), frame=i,
                values=np.zeros(1, np.float32))
        for i in range(10)
    ]  # fmt: skip
    topics = {
        "/mic/segment": [
            (4 * NANOSECONDS, segment(2, "a\tb\nc")),
            (8 * NANOSECONDS, segment(6, "d")),
        ],
        "/mic/features": [(i * NANOSECONDS, frame) for i, frame in enumerate(frames)],
    }
    log = write_log(tmp_path / "x.mcap", topics)
    text = exported(log, "x.txt", "--start", "1970-01-01T00:00:03").read_text()
    assert text == "0.000000\t1.000000\ta b c\n3.000000\t5.000000\td\n"
    alone = exported(log, "folder", "--format", "txt") / "mic_segment.txt"
    assert alone.read_text() == "2.000000\t4.000000\ta b c\n6.000000\t8.000000\td\n"


def test_clips_are_the_sound_that_was_heard(sound, exported, tmp_path):
    start = 1_772_348_400_250_000_000
    later = start + 7 * NANOSECONDS
    log = write_log(
        tmp_path / "x.mcap", {"/mic/audio": clips(sound, start) + clips(sound[:1000], later)}
    )
    folder = exported(log, "clips", "--format", "wav")
    names = ["mic_audio_20260301T070000.250000Z.wav", "mic_audio_20260301T070007.250000Z.wav"]
    assert sorted(path.name for path in folder.iterdir()) == names
    for name, expected in zip(names, (sound, sound[:1000]), strict=True):
        samples, rate = soundfile.read(folder / name, dtype="int16")
        assert rate == RATE
        assert samples.tobytes() == expected.tobytes()
    one = exported(log, "one.wav", "--end", "2026-03-01T07:00:05")
    assert soundfile.read(one, dtype="int16")[0].tobytes() == sound.tobytes()


def test_a_hole_or_another_format_begins_another_clip(sound, exported, tmp_path):
    def times(*starts, **fields):
        return [(start, clip(start, sound[:800], **fields)) for start in starts]

    ms = 1_000_000
    topics = {
        "/mic/audio": times(0, 50 * ms, 151 * ms) + times(201 * ms, sample_rate=8000),
        "/mic_audio": times(53 * ms, 104 * ms, number_of_channels=2),
    }
    log = write_log(tmp_path / "x.mcap", topics)
    found = {
        path.name: (soundfile.info(path).frames, soundfile.info(path).channels)
        for path in exported(log, "clips", "--format", "wav").iterdir()
    }
    assert found == {
        "mic_audio_19700101T000000.000000Z.wav": (1600, 1),
        "mic_audio_19700101T000000.053000Z.wav": (400, 2),
        "mic_audio_19700101T000000.104000Z.wav": (400, 2),
        "mic_audio_19700101T000000.151000Z.wav": (800, 1),
        "mic_audio_19700101T000000.201000Z.wav": (800, 1),
    }


def test_more_than_one_clip_is_no_wav_file(sound, refused, tmp_path):
    log = write_log(
        tmp_path / "x.mcap", {"/mic/audio": clips(sound[:800], 0) + clips(sound, 10**10)}
    )
    message = refused(log, "one.wav")
    assert message.endswith("there is more than one clip; name a folder, with --format wav")


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"format": "opus"}, "its format is 'opus', not 'pcm-s16'"),
        ({"sample_rate": 0}, "0 samples a second"),
        ({"sample_rate": 2**32 - 1}, "4294967295 samples a second"),
        ({"number_of_channels": 0}, "0 channels"),
        ({"number_of_channels": 2**32 - 1}, "4294967295 channels"),
        ({"number_of_channels": 7}, "1600 bytes are no whole samples of 7 channels"),
    ],
)
def test_clips_that_cannot_be(refused, tmp_path, fields, words):
    samples = np.zeros(800, "<i2")
    log = write_log(
        tmp_path / "x.mcap", {"/a": [(0, clip(0, samples)), (1, clip(1, samples, **fields))]}
    )
    message = refused(log, "clips", "--format", "wav")
    assert message == f"/a: a clip cannot be read ({words})"


def test_a_rosbag2_folder_is_opened_by_rosbags(recorded, exported):
    folder = exported(recorded, "bag", "--format", "rosbag2")
    assert sorted(path.name for path in folder.iterdir()) == ["bag.mcap", "metadata.yaml"]
    expected = sorted(row for log in find_logs(recorded) for row in raw_messages(log))
    assert sorted(raw_messages(folder / "bag.mcap")) == expected
    with rosbag2.Reader(folder) as bag:
        assert bag.message_count == len(expected) == len(list(bag.messages()))
        assert all(c.digest.startswith("RIHS01_") for c in bag.connections)
        times = [row[4] for row in expected]
        assert (bag.start_time, bag.end_time - 1) == (min(times), max(times))
    items = iter(sorted((i.log_time, i.data) for i in items_of(recorded, "/mic/label")))
    with AnyReader([folder]) as reader:
        labels = [c for c in reader.connections if c.topic == "/mic/label"]
        for connection, time, data in reader.messages(labels):
            assert (time, data) == next(items)
            assert reader.deserialize(data, connection.msgtype).label
    assert next(items, None) is None


def test_a_folder_of_logs_is_a_bag_as_it_lies(recorded, hearthlog, tmp_path):
    logs = tmp_path / "logs"
    shutil.copytree(recorded, logs)
    full = find_logs(logs)
    cut = full[0].with_name("home_20300101T000000Z.mcap.active")
    cut.write_bytes(full[0].read_bytes()[:-1000])
    result = hearthlog("export", logs, "--format", "rosbag2", "--in-place")
    assert (result.returncode, result.stdout) == (3, f"{logs / 'metadata.yaml'}\n")
    assert result.stderr == f"hearthlog: not in the bag, because it is unfinished: {cut}\n"
    (day,) = {log.parent for log in full}
    cut.unlink()
    assert not hearthlog("export", day, "--format", "rosbag2", "--in-place").returncode
    expected = sorted(row for log in full for row in raw_messages(log))
    with rosbag2.Reader(day) as bag:
        assert bag.message_count == len(expected) == len(list(bag.messages()))
    text = (logs / "metadata.yaml").read_text()
    bag = json.loads(text.removeprefix("rosbag2_bagfile_information: "))
    assert [logs / name for name in bag["relative_file_paths"]] == full
    assert bag["message_count"] == sum(file["message_count"] for file in bag["files"])


def test_what_ros2_bag_record_wrote_is_a_bag_with_its_quality_of_service(hearthlog, tmp_path):
    (tmp_path / "bags").mkdir()
    block = "- history: unknown\n  depth: 0\n  reliability: reliable\n"
    block += "  durability: transient_local\n"
    block += "".join(
        f"  {name}:\n    sec: 9223372036\n    nsec: 854775807\n"
        for name in ("deadline", "lifespan", "liveliness_lease_duration")
    )
    block += "  liveliness: automatic\n  avoid_ros_namespace_conventions: false"
    with (tmp_path / "bags" / "run_0.mcap").open("xb") as stream:
        writer = ChunkWriter(stream)
        writer.start("ros2", "test")
        schema = writer.register_schema("my_msgs/msg/Own", "ros2msg", b"uint32 a\n")
        metadata = {"offered_qos_profiles": block, "topic_type_hash": ""}
        channel = writer.register_channel("/own", "cdr", schema, metadata)
        writer.add_message(channel, 1, struct.pack("<4sI", b"\0\1\0\0", 7), 1)
        writer.finish()
    result = hearthlog("export", tmp_path / "bags", "--format", "rosbag2", "--in-place")
    assert (result.returncode, result.stderr) == (0, "")
    with rosbag2.Reader(tmp_path / "bags") as bag:
        ((connection, time, _),) = bag.messages()
    (offered,) = connection.ext.offered_qos_profiles
    assert (connection.topic, time, offered.durability.name) == ("/own", 1, "TRANSIENT_LOCAL")


def test_logs_of_the_same_time_are_said_to_be_played_one_after_the_other(
    recorded, hearthlog, tmp_path
):
    log = find_logs(recorded)[0]
    for name in (log.name, f"other_{log.name}"):
        shutil.copy(log, tmp_path / name)
    result = hearthlog("export", tmp_path, "--format", "rosbag2", "--in-place")
    assert result.returncode == 3
    late = tmp_path / f"other_{log.name}"
    assert result.stderr.startswith(f"hearthlog: {late} begins before another log ends")
    assert result.stdout == f"{tmp_path / 'metadata.yaml'}\n"


def test_topics_that_differ_between_logs_are_no_bag(hearthlog, tmp_path):
    for number, kind in enumerate((message_types.FEATURES, message_types.LABEL)):
        writer = LogWriter(tmp_path / f"home_{number}.mcap", [Topic("/mic/a", kind)], {})
        writer.write("/mic/a", 5, b"")
        writer.finish()
    result = hearthlog("export", tmp_path, "--format", "rosbag2", "--in-place")
    assert result.returncode == 1
    assert "/mic/a is of different types or qualities of service in home_0.mcap" in result.stderr
    assert not (tmp_path / "metadata.yaml").exists()


def test_a_ros_1_bag_holds_the_same_values(recorded, exported):
    path = exported(recorded, "all.bag")
    expected = {}
    for log in find_logs(recorded):
        for item in LogReader(log).messages():
            expected.setdefault(item.topic, []).append((item.log_time, bits(item.decode())))
    found = {}
    with AnyReader([path]) as reader:
        times = []
        for connection, time, data in reader.messages():
            content = bits(reader.deserialize(data, connection.msgtype))
            if "header" in content:
                assert content["header"].pop("seq") == 0
            found.setdefault(connection.topic, []).append((time, content))
            times.append(time)
        assert times == sorted(times)
    assert found == expected
    with rosbag1.Reader(path) as bag:
        latched = {c.topic for c in bag.connections if c.ext.latching}
        assert bag.message_count == len(times)
    assert latched == {"/mic/info"}


def test_a_ros_1_bag_of_types_that_only_the_file_knows(exported, tmp_path):
    data = struct.pack("<4sIii", b"\0\1\0\0", 7, -5, 3)
    big = struct.pack(">4sIii", b"\0\0\0\0", 7, -5, 3)
    with (tmp_path / "x.mcap").open("xb") as stream:
        writer = ChunkWriter(stream)
        writer.start("ros2", "test")
        schema = writer.register_schema("my_msgs/msg/Own", "ros2msg", b"uint32 a\nint32[2] b\n")
        channel = writer.register_channel("/own", "cdr", schema, {})
        writer.add_message(channel, 1, data, 1)
        writer.add_message(channel, 2, big, 2)
        writer.finish()
    with AnyReader([exported(tmp_path / "x.mcap", "x.bag")]) as reader:
        for connection, _, raw in reader.messages():
            content = reader.deserialize(raw, connection.msgtype)
            assert (content.a, content.b.tolist()) == (7, [-5, 3])
        assert reader.message_count == 2


def test_what_differs_in_comments_bounds_and_constants_is_one_ros_1_connection(exported, tmp_path):
    texts = ("int32 x\n", "# metres\nint32 x # later\n", "int32 MOST=5\nint32 x\n")
    log = changing(tmp_path / "x.mcap", *((OWN, text, struct.pack("<i", 7)) for text in texts))
    bounded = [
        (OWN, f"{kind} x\n", struct.pack("<I2s", 2, b"a\0")) for kind in ("string", "string<=5")
    ]
    for source in (log, changing(tmp_path / "y.mcap", *bounded)):
        path = exported(source, f"{source.stem}.bag")
        with AnyReader([path]) as reader:
            assert len(reader.connections) == 1
            found = [reader.deserialize(data, c.msgtype).x for c, _, data in reader.messages()]
        assert found == ([7, 7, 7] if source == log else ["a", "a"])


def test_a_ros_1_bag_that_would_need_two_definitions_leaves_one_out(hearthlog, tmp_path):
    own = (OWN, "int32 a\n", struct.pack("<i", 1)), (OWN, "int32 b\n", struct.pack("<i", 2))
    nested = "my_msgs/msg/N", f"M m\n{'=' * 80}\nMSG: my_msgs/M\nint64 a\n", struct.pack("<q", 3)
    wide = "my_msgs/msg/W", "wstring w\n", struct.pack("<I", 0)
    for number, other in enumerate((own[1], nested, wide)):
        log = changing(tmp_path / f"{number}.mcap", own[0], other)
        result = hearthlog("export", log, "-o", tmp_path / f"{number}.bag")
        assert result.returncode == 3
        assert result.stderr.count("\n") == 1
        assert ": left out" in result.stderr
        with AnyReader([tmp_path / f"{number}.bag"]) as reader:
            ((connection, time, data),) = reader.messages()
            assert (time, reader.deserialize(data, connection.msgtype).a) == (0, 1)


def test_one_bad_topic_or_message_is_left_out_of_every_format(hearthlog, tmp_path):
    good = "std_msgs/msg/Int32", "int32 data\n", struct.pack("<i", 5)
    full = changing(tmp_path / "1.mcap", good, (*good[:2], b"\5"), topic="/good")
    bad = changing(tmp_path / "2.mcap", ("my_msgs/msg/Secret", "", b"abcd"), topic="/bad")
    for form in ("parquet", "csv", "npz", "bag"):
        output = tmp_path / (f"x.{form}" if form == "bag" else form)
        options = () if form == "bag" else ("--format", form)
        (logs := tmp_path / f"logs-{form}").mkdir()
        for log in (full, bad):
            shutil.copy(log, logs)
        result = hearthlog("export", logs, "-o", output, *options)
        assert (result.returncode, result.stderr.count("\n")) == (3, 2)
        assert "my_msgs/msg/Secret: left out" in result.stderr
        assert "such messages of /good are left out" in result.stderr
        if form == "bag":
            with AnyReader([output]) as reader:
                assert [time for _, time, _ in reader.messages()] == [0]
        else:
            assert [path.name for path in output.iterdir()] == [f"good.{form}"]
    with np.load(tmp_path / "npz" / "good.npz") as arrays:
        assert arrays["data"].tolist() == [5]


def test_a_type_of_two_definitions_is_named_for_readers_of_rosbag2(hearthlog, tmp_path):
    own = (OWN, "int32 a\n", struct.pack("<i", 1)), (OWN, "int32 b\n", struct.pack("<i", 2))
    log = changing(tmp_path / "x.mcap", *own)
    result = hearthlog("export", log, "-o", tmp_path / "bag", "--format", "rosbag2")
    assert result.returncode == 3
    assert f"{OWN} is defined in two ways, of which readers of rosbag2 take one" in result.stderr
    assert len(raw_messages(tmp_path / "bag" / "bag.mcap")) == 2


def test_texts_that_are_not_utf_8_are_readable_in_a_ros_1_bag(hearthlog, tmp_path):
    texts = b"caf\xe9", b"caf\xc3\xa9"
    payloads = [struct.pack("<I", len(text) + 1) + text + b"\0" for text in texts]
    rows = [("std_msgs/msg/String", "string data\n", payload) for payload in payloads]
    log = changing(tmp_path / "x.mcap", *rows)
    result = hearthlog("export", log, "-o", tmp_path / "x.bag")
    assert result.returncode == 3
    assert "? stands for what cannot be read in texts of /m" in result.stderr
    with AnyReader([tmp_path / "x.bag"]) as reader:
        found = [reader.deserialize(data, c.msgtype).data for c, _, data in reader.messages()]
    assert found == ["caf?", "café"]


def test_a_topic_that_rosbag2_cannot_describe_is_left_out_unless_there_is_no_other(
    hearthlog, tmp_path
):
    one, other = (
        (f"std_msgs/msg/{kind}", f"{kind.lower()} data\n", b"\1") for kind in ("Int8", "Byte")
    )
    two = changing(tmp_path / "two.mcap", one, other)
    changing(tmp_path / "good.mcap", one, topic="/good")
    assert hearthlog("export", two, "-o", tmp_path / "a", "--format", "rosbag2").returncode == 1
    result = hearthlog("export", tmp_path, "-o", tmp_path / "b", "--format", "rosbag2")
    assert (result.returncode, result.stderr.count("\n")) == (3, 1)
    assert result.stderr.startswith("hearthlog: /m: channels of different types")
    with rosbag2.Reader(tmp_path / "b") as bag:
        assert [connection.topic for connection, _, _ in bag.messages()] == ["/good"]


def test_a_type_whose_name_is_code_is_refused(refused, tmp_path):
    with (tmp_path / "x.mcap").open("xb") as stream:
        writer = ChunkWriter(stream)
        writer.start("ros2", "test")
        name = "a/msg/B:\n    open('owned', 'w')\nclass C"
        schema = writer.register_schema(name, "ros2msg", b"uint32 a\n")
        writer.add_message(writer.register_channel("/own", "cdr", schema, {}), 1, bytes(8), 1)
        writer.finish()
    assert refused(tmp_path / "x.mcap", "x.bag").endswith(" cannot be read")


def test_one_file_is_for_one_topic(recorded, refused):
    for suffix in ("parquet", "csv", "npz"):
        message = refused(recorded, f"x.{suffix}", "--topics", "/mic/*t*", status=2)
        assert message.endswith(
            f"x.{suffix} is for one topic: choose one with --topics "
            "(/mic/features, /mic/segment, /mic/statistics)"
        )


def test_wrong_use_is_one_line(recorded, refused):
    assert "choose one of parquet, csv" in refused(recorded, "x.xml", status=2)
    assert "is not --format csv" in refused(recorded, "x.npz", "--format", "csv", status=2)
    assert "a bag is one file" in refused(recorded, "folder", "--format", "bag", status=2)


def test_an_output_that_exists_is_left_alone(recorded, refused, tmp_path):
    (tmp_path / "mine.npz").write_text("mine")
    (tmp_path / "folder").mkdir()
    message = refused(recorded, "mine.npz", "--topics", "/mic/info")
    assert message.startswith(f"{tmp_path / 'mine.npz'}: exists already")
    message = refused(recorded, "folder", "--format", "rosbag2")
    assert message.startswith(f"{tmp_path / 'folder'}: exists already")
    assert (tmp_path / "mine.npz").read_text() == "mine"


@pytest.mark.parametrize("form", ["parquet", "csv", "npz", "txt", "rosbag2"])
def test_nothing_is_made_of_nothing(recorded, refused, form):
    message = refused(recorded, "folder", "--format", form, "--start", "2031-01-01")
    assert message.startswith("no message")
    assert refused(recorded, "x.bag", "--end", "1999-01-01").startswith("no message in this span")


def test_a_topic_that_is_not_there(recorded, refused):
    message = refused(recorded, "x.csv", "--topics", "/mic/lable")
    assert message.startswith("no topic /mic/lable; there are /diagnostics, ")
    message = refused(recorded, "x.wav")
    assert message.startswith("no topic of type foxglove_msgs/msg/RawAudio; there are /")


@pytest.mark.parametrize("form", ["parquet", "csv", "npz", "txt", "rosbag2", "bag"])
def test_what_stands_outside_of_a_damaged_chunk_is_exported(recorded, hearthlog, tmp_path, form):
    data = bytearray(find_logs(recorded)[0].read_bytes())
    data[len(data) // 2] ^= 0xFF
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(data)
    options = ("--output", tmp_path / ("x.bag" if form == "bag" else "x"), "--format", form)
    result = hearthlog("export", damaged, *options)
    assert result.returncode == 3
    (line,) = (line for line in result.stderr.splitlines() if "damaged" in line)
    assert re.fullmatch(
        f"hearthlog: {damaged}: damaged at byte \\d+ \\(.*\\): left out up to byte \\d+, "
        r"\S+Z to \S+Z; `hearthlog recover` saves the rest",
        line,
    )
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize("form", ["parquet", "csv", "npz", "txt", "rosbag2", "bag", "wav"])
def test_a_full_disk_leaves_no_output(recorded, sound, hearthlog, tmp_path, form):
    logs = recorded
    if form == "wav":
        logs = write_log(tmp_path / "x.mcap", {"/mic/audio": clips(sound, 0)})
    with small_disk(tmp_path / "disk", "100k") as disk:
        (disk / "full").write_bytes(bytes(100 << 10 if form == "txt" else 0))  # labels are short
        output = disk / ("x.bag" if form == "bag" else "x")
        result = hearthlog("export", logs, "--output", output, "--format", form)
        assert (result.returncode, result.stdout) == (1, "")
        assert (
            result.stderr
            == f"hearthlog: {output}: cannot be written (No space left on device); make room\n"
        )
        assert list(disk.iterdir()) == [disk / "full"]


@pytest.mark.parametrize("form", ["parquet", "csv", "npz", "txt", "rosbag2", "bag"])
def test_an_unfinished_log_is_exported_as_far_as_it_is_there(recorded, hearthlog, tmp_path, form):
    unfinished = recorded.parent / "unfinished.mcap.active"
    output = tmp_path / ("x.bag" if form == "bag" else "x")
    result = hearthlog("export", unfinished, "--output", output, "--format", form)
    assert (result.returncode, result.stdout) == (3, f"{output}\n")
    assert result.stderr.count("\n") == 1
    assert str(unfinished) in result.stderr
    if form == "parquet":
        rows = pq.read_table(output / "mic_features.parquet").num_rows
        assert rows == len(items_of(unfinished, "/mic/features")) > 0


def test_names_of_files_are_harmless_and_differ(exported, tmp_path):
    text = message("std_msgs/msg/Bool", data=True)
    topics = {name: [(1, text)] for name in ("/../../x", "/x", "x", "/" + "y" * 500, "/ü", "")}
    folder = exported(write_log(tmp_path / "x.mcap", topics), "tables", "--format", "csv")
    names = sorted(path.name for path in folder.iterdir())
    assert names == ["topic-2.csv", "topic.csv", "x-2.csv", "x-3.csv", "x.csv", "y" * 100 + ".csv"]
    for path in folder.iterdir():
        assert next(csv.DictReader(io.StringIO(path.read_text())))["data"] == "true"
