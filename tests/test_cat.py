"""Messages are printed as text that people read, and as JSON and CSV that lose nothing."""

import base64
import csv
import io
import json
import os
import shutil
import subprocess
from decimal import Decimal
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import typer
from conftest import HEARTHLOG
from hypothesis import given
from hypothesis import strategies as st
from log_fixtures import run, write_log
from logreader import LogReader
from mcap.writer import Writer

from hearthlog.analyzer.export.text import _moments, in_order, json_lines, quoted, text_lines
from hearthlog.analyzer.logs.selection import decode_all
from hearthlog.models.features.installed import DEFAULT
from hearthlog.schemas.frames import NANOSECONDS, millisecond_text
from hearthlog.schemas.logs.files import find_logs
from hearthlog.schemas.logs.merged_reading import iterate_messages
from hearthlog.schemas.logs.writer import LogWriter, TopicBatch
from hearthlog.schemas.mcap.chunk_writer import ChunkWriter
from hearthlog.schemas.messages.message_types import (
    FEATURES,
    decode,
    definition,
    duration_message,
    header,
    message,
    nanoseconds,
    time_message,
)
from hearthlog.schemas.messages.topics import Topic
from hearthlog.tools.cli.options import parse_time


@pytest.fixture
def hearthlog(capfd):
    """Run the command and return what came of it."""
    return partial(run, capfd)


@pytest.fixture(scope="module")
def foreign(tmp_path_factory):
    """Messages of other people's types: nested, of any length, with what hurts terminals."""
    stamp = time_message(1_700_000_000_987_654_321)
    transforms = [
        message(
            "geometry_msgs/msg/TransformStamped",
            header=header(5 * NANOSECONDS + 1, "a"),
            child_frame_id='quo"te\n\x1b[2J\x9b',
            transform=message(
                "geometry_msgs/msg/Transform",
                translation=message("geometry_msgs/msg/Vector3", x=0.1, y=-0.0, z=np.inf),
                rotation=message("geometry_msgs/msg/Quaternion", x=np.nan, y=1e-300, z=1.0, w=2.0),
            ),
        )
    ]
    point = message(
        "trajectory_msgs/msg/JointTrajectoryPoint",
        positions=np.array([0.1, np.nan]),
        velocities=np.array([]),
        accelerations=np.array([]),
        effort=np.array([1 / 3]),
        time_from_start=duration_message(-1),
    )
    image = ("sensor_msgs/msg/CompressedImage", {"header": header(7, ""), "format": "100 % sure"})
    topics = {
        "/tf": [message("tf2_msgs/msg/TFMessage", transforms=transforms * n) for n in (1, 0, 2)],
        "/joints%s": [
            message(
                "trajectory_msgs/msg/JointTrajectory",
                header=header(9, "ü"),
                joint_names=["left", "", "a b"][: n + 1],
                points=[point] * n,
            )
            for n in range(3)
        ],
        "/image": [
            message(image[0], **image[1], data=np.arange(n, dtype=np.uint8)) for n in (3, 3, 255)
        ],
        "/flag": [message("std_msgs/msg/Bool", data=bool(n)) for n in range(3)],
        "/nothing": [message("std_msgs/msg/Empty") for _ in range(3)],
        "/time": [message("builtin_interfaces/msg/Time", sec=-1, nanosec=5)] * 3,
        "/floats": [
            message(
                "sensor_msgs/msg/ChannelFloat32",
                name="",
                values=np.array([-0.0, 1 / 3, value, -1e-30, -10], np.float32),
            )
            for value in (0.0, np.nan, -np.inf)
        ],
        "/stamps": [
            message("rosgraph_msgs/msg/Clock", clock=stamp),
        ],
        "/range": [message("std_msgs/msg/UInt64", data=2**64 - 1 - n) for n in range(3)],
        "/matrix": [
            message(
                "sensor_msgs/msg/Imu",
                header=header(1, ""),
                orientation=message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
                orientation_covariance=np.arange(9) / 7,
                angular_velocity=message("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0),
                angular_velocity_covariance=np.full(9, -np.inf),
                linear_acceleration=message("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=9.81),
                linear_acceleration_covariance=np.zeros(9),
            )
        ],
    }
    timed = {t: [(100 * i + 1, m) for i, m in enumerate(found)] for t, found in topics.items()}
    return write_log(tmp_path_factory.mktemp("foreign") / "foreign.mcap", timed)


def write_features(path, names, times):
    topic = Topic("/mic/features", FEATURES, array_names={"values": list(names)})
    log = LogWriter(path, [topic], {})
    fields = {"header.stamp": times, "header.frame_id": "mic", "frame": times}
    values = np.repeat(times, len(names)).reshape(-1, len(names)).astype(np.float32)
    log.write_columns([TopicBatch("/mic/features", times, fields | {"values": values})])
    return log.finish()


@pytest.fixture(scope="module")
def long(tmp_path_factory):
    """More than a pipe holds."""
    return write_features(tmp_path_factory.mktemp("long") / "x.mcap", "abc", np.arange(20_000))


def lines_of(path, lines):
    return [
        line for batch in iterate_messages([path]) for line in in_order(decode_all(batch), lines)
    ]


def plain(value):
    """What JSON must say of a message, numbers as they are."""
    if hasattr(value, "__msgtype__"):
        if value.__msgtype__ in ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration"):
            return Decimal(value.sec) + Decimal(value.nanosec) / NANOSECONDS
        names = [name for name in value.__dataclass_fields__ if name != "__msgtype__"]
        fields = [name for name in names if not name.isupper()]  # the others are constants
        return {name: plain(getattr(value, name)) for name in fields}
    if isinstance(value, np.ndarray) and value.dtype == np.uint8:
        return base64.b64encode(value.tobytes()).decode()
    if isinstance(value, list | np.ndarray):
        return [plain(part) for part in value]
    if isinstance(value, float | np.floating):
        return value if np.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value


def same(found, expected):
    """Compare parsed JSON, numbers bit for bit in the type that the message has."""
    if isinstance(expected, dict):
        return found.keys() == expected.keys() and all(
            same(found[name], part) for name, part in expected.items()
        )
    if isinstance(expected, list):
        return len(found) == len(expected) and all(map(same, found, expected))
    if isinstance(expected, float | np.floating):
        kind = np.float32 if np.float32(expected) == expected else np.float64
        return kind(found).tobytes() == kind(expected).tobytes()
    return type(found) is type(expected) and found == expected


def parsed(line):
    return json.loads(line, parse_float=Decimal, parse_constant=pytest.fail)


def check_json(lines, path):
    """Compare lines with all messages of a log or a folder of logs."""
    expected = {}
    for log in find_logs(path):
        for item in LogReader(log).messages():
            expected.setdefault(item.topic, []).append(item)
    rows = [parsed(line) for line in lines]
    assert len(rows) == sum(map(len, expected.values())) > 0
    times = [row["log_time"] for row in rows]
    assert times == sorted(times)
    for row in rows:
        assert list(row) == ["topic", "sequence", "log_time", "publish_time", "data"]
        item = expected[row["topic"]].pop(0)
        assert row["log_time"] * NANOSECONDS == item.log_time
        content = decode(item.data, item.type)
        if hasattr(content, "structure_needs_at_least_one_member"):
            continue
        if item.type.startswith("builtin_interfaces"):
            assert row["data"] == {"sec": content.sec, "nanosec": content.nanosec}
        else:
            assert same(row["data"], plain(content)), row


def test_json_has_every_message_with_all_its_bits(recorded, hearthlog):
    result = hearthlog("cat", recorded, "--format", "ndjson")
    assert (result.returncode, result.stderr) == (0, "")
    check_json(result.stdout.splitlines(), recorded)


def test_json_is_what_mcap_cat_prints(recorded):
    line = lines_of(find_logs(recorded)[0], json_lines)[-1]
    assert line.startswith('{"topic":"/')
    time = parsed(line)["log_time"]
    assert (
        f'"sequence":0,"log_time":{time:.9f},"publish_time":{time:.9f},"data":{{"header":' in line
    )


def test_json_of_types_that_others_define(foreign):
    lines = lines_of(foreign, json_lines)
    check_json(lines, foreign)
    rows = [parsed(line) for line in lines]
    (_, second, _) = (row["data"]["points"] for row in rows if row["topic"] == "/joints%s")
    assert second[0]["time_from_start"] == Decimal("-0.000000001")
    assert rows[0]["publish_time"] == Decimal("0.000000006")
    assert [row["sequence"] for row in rows] == list(range(len(rows)))


def test_text_has_a_short_line_for_every_message(recorded, hearthlog):
    result = hearthlog("cat", recorded)
    assert result.returncode == 0
    lines = result.stdout.splitlines()
    items = [item for log in find_logs(recorded) for item in LogReader(log).messages()]
    assert len(lines) == len(items)
    assert max(map(len, lines)) < 1000
    (gap, *_) = (line for line in lines if " /mic/gap " in line)
    assert gap.startswith("2026-03-01T07:00:20.473Z /mic/gap stamp=2026-03-01T07:00:20.123Z ")
    assert gap.endswith("duration=0.350s reason=overrun frames_lost=7")
    (features, *_) = (line for line in lines if " /mic/features " in line)
    assert features.endswith(f" … {DEFAULT.width}]")


def test_text_leaves_the_terminal_alone(foreign):
    lines = lines_of(foreign, text_lines)
    assert len(lines) == len(list(LogReader(foreign).messages()))
    assert all(line.isprintable() for line in lines)


@given(st.text())
def test_printable_texts_are_printable_and_one_word_or_quoted(text):
    shown = quoted(text)
    assert shown.isprintable()
    assert shown
    assert shown == text or json.loads(shown) == text


@pytest.mark.parametrize("kind", ["features", "statistics", "label", "segment", "gap"])
def test_csv_has_a_column_for_every_number(recorded, hearthlog, kind):
    result = hearthlog("cat", recorded, "--format", "csv", "--topics", f"/mic/{kind}")
    assert (result.returncode, result.stderr) == (0, "")
    rows = list(csv.DictReader(io.StringIO(result.stdout)))
    items = [i for log in find_logs(recorded) for i in LogReader(log).messages([f"/mic/{kind}"])]
    assert len(rows) == len(items)
    names = {"values": [], "mean": [], "std": [], "probabilities": []}
    reader = LogReader(find_logs(recorded)[0])
    next(reader.messages())
    for key, text in reader.channels[f"/mic/{kind}"].metadata.items():
        if key.endswith("_names"):
            names[key.removesuffix("_names")] = json.loads(text)
    for row, item in zip(rows, items, strict=True):
        content = item.decode()
        assert np.datetime64(row["log_time"].rstrip("Z"), "ns").astype(int) == item.log_time
        assert row["header.frame_id"] == "mic"
        for field, elements in names.items():
            values = np.array([row[f"{field}.{name}"] for name in elements], np.float32)
            assert values.tobytes() == getattr(content, field, values).tobytes()
        for field in ("label", "reason"):
            assert row.get(field) == getattr(content, field, None)
        if kind == "gap":
            assert float(row["duration"]) == nanoseconds(content.duration) / NANOSECONDS


def test_csv_of_arrays_without_names_and_of_messages_in_messages(foreign, hearthlog):
    def table(topic):
        result = hearthlog("cat", foreign, "--format", "csv", "--topics", topic)
        assert result.returncode == 0, result.stderr
        return list(csv.DictReader(io.StringIO(result.stdout)))

    (row,) = table("/matrix")
    assert [float(row[f"orientation_covariance[{i}]"]) for i in range(9)] == [
        i / 7 for i in range(9)
    ]
    assert row["linear_acceleration.z"] == "9.81"
    joints = table("/joints*")
    assert [row["joint_names[2]"] for row in joints] == ["", "", "a b"]
    assert [len(json.loads(row["points"])) for row in joints] == [0, 1, 2]
    assert base64.b64decode(table("/image")[0]["data"]) == b"\0\1\2"


def test_csv_is_for_one_topic(recorded, hearthlog):
    result = hearthlog(
        "cat", recorded, "--format", "csv", "--topics", "/mic/*el", "--topics", "/mic/g*"
    )
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr == (
        "hearthlog: csv is for one topic: choose one with --topics (/mic/gap, /mic/label)\n"
    )


def test_logs_of_two_models_share_a_table(tmp_path, hearthlog):
    for number, names in ((1, "ab"), (2, "bcd"), (3, "ab")):
        write_features(tmp_path / f"{number}.mcap", names, np.array([number]))
    result = hearthlog("cat", tmp_path, "--format", "csv")
    rows = list(csv.DictReader(io.StringIO(result.stdout)))
    found = [[row[f"values.{name}"] for name in "abcd"] for row in rows]
    assert sorted(found) == [["", "2", "2", "2"], ["1", "1", "", ""], ["3", "3", "", ""]]


def test_topics_are_chosen_by_name_and_by_pattern(recorded, hearthlog):
    result = hearthlog("cat", recorded, "--topics", "/mic/gap", "--topics", "/mic/s*m*t")
    topics = {line.split()[1] for line in result.stdout.splitlines()}
    assert topics == {"/mic/gap", "/mic/segment"}


def test_a_topic_that_is_not_there(recorded, hearthlog):
    result = hearthlog("cat", recorded, "--topics", "/mic/lable")
    assert (result.returncode, result.stdout) == (1, "")
    assert result.stderr.startswith("hearthlog: no topic /mic/lable; there are /diagnostics, ")
    assert result.stderr.count("\n") == 1


def test_a_span_begins_with_its_start_and_ends_before_its_end(recorded, hearthlog):
    times = [i.log_time for log in find_logs(recorded) for i in LogReader(log).messages()]
    start, end = times[len(times) // 3], times[len(times) // 2]
    span = (f"{np.datetime64(start, 'ns')}Z", str(np.datetime64(end, "ns")))
    result = hearthlog("cat", recorded, "--start", span[0], "--end", span[1], "--format", "ndjson")
    found = [int(parsed(line)["log_time"] * NANOSECONDS) for line in result.stdout.splitlines()]
    assert found == [time for time in sorted(times) if start <= time < end]
    assert hearthlog("cat", recorded, "--end", "1990-01-01").stdout == ""


@pytest.mark.parametrize(
    ("text", "nanoseconds"),
    [
        ("1970-01-01", 0),
        ("1970-01-01T00:00:01", NANOSECONDS),
        ("1970-01-01T01:00:01.5+01:00", 1_500_000_000),
        ("1970-01-01T00:00:00.123456789Z", 123_456_789),
        ("2026-03-01T07:00:00.000000001", 1_772_348_400_000_000_001),
        ("2026-03-01 07:00:00.1234567+00:00", 1_772_348_400_123_456_700),
    ],
)
def test_times(text, nanoseconds):
    assert parse_time(text, "--start") == nanoseconds


@pytest.mark.parametrize("time", [0, -1, 1_772_348_400_123_999_999, -(1 << 62), (1 << 63) - 1])
def test_a_time_is_written_in_a_column_as_it_is_alone(time):
    assert _moments(np.array([time])) == [millisecond_text(time)]


@pytest.mark.parametrize("text", ["", "yesterday", "2026-13-01", "1772348400", "07:00"])
def test_what_is_no_time(capsys, text):
    with pytest.raises(typer.Exit):
        parse_time(text, "--end")
    assert capsys.readouterr().err.startswith(f"hearthlog: --end {text}: not a time")


def test_wrong_use(recorded, hearthlog):
    for options in (
        ("--start", "yesterday"),
        ("--start", "2026-03-02", "--end", "2026-03-01"),
        ("--format", "xml"),
    ):
        assert hearthlog("cat", recorded, *options).returncode == 2


def test_a_log_that_is_named_twice_is_read_once(recorded, hearthlog):
    log = find_logs(recorded)[0]
    once = hearthlog("cat", log).stdout
    assert hearthlog("cat", log, log.parent / "." / log.name, log).stdout == once


def test_an_unfinished_log_is_printed_as_far_as_it_is_there(recorded, hearthlog):
    unfinished = recorded.parent / "unfinished.mcap.active"
    result = hearthlog("cat", unfinished, "--format", "ndjson")
    assert result.returncode == 3
    check_json(result.stdout.splitlines(), unfinished)
    assert result.stderr == (
        f"hearthlog: unfinished, read up to the last whole chunk: {unfinished}\n"
    )
    # Its topics are known although it has no index.
    assert "there are /diagnostics" in hearthlog("cat", unfinished, "--topics", "x").stderr


def test_an_unfinished_log_without_a_message_is_named(recorded, hearthlog, tmp_path):
    (tmp_path / "cut.mcap").write_bytes(find_logs(recorded)[0].read_bytes()[:100])
    for paths in ([tmp_path], [tmp_path, recorded]):
        result = hearthlog("cat", *paths, "--topics", "/mic/info")
        assert result.returncode == 3
        assert str(tmp_path / "cut.mcap") in result.stderr


def test_a_reader_who_has_seen_enough_ends_it_quietly(long):
    for form in ("text", "ndjson", "csv"):
        command = [*HEARTHLOG, "cat", str(long), "--format", form]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
            assert process.stdout.readline()
            process.stdout.close()
            assert process.stderr.read() == b""
            assert process.wait(60) == 0


def test_of_many_logs_the_damaged_ones_are_named_and_the_rest_is_printed(
    recorded, hearthlog, tmp_path
):
    logs = [tmp_path / log.name for log in find_logs(recorded)]
    for log in find_logs(recorded):
        shutil.copy(log, tmp_path)
    full = hearthlog("cat", tmp_path).stdout.splitlines()
    first, last = (hearthlog("cat", log).stdout.splitlines() for log in (logs[0], logs[-1]))
    data = bytearray(logs[0].read_bytes())
    data[len(data) // 2] ^= 1
    logs[0].write_bytes(data)  # in a chunk
    data = logs[-1].read_bytes()
    logs[-1].write_bytes(b"\0" + data[1:])  # no log any more

    done = hearthlog("cat", tmp_path)
    assert done.returncode == 3
    reported = sorted(done.stderr.splitlines())
    assert len(reported) == 2
    assert reported[0].startswith(f"hearthlog: {logs[0]}: damaged at byte ")
    assert reported[1] == f"hearthlog: {logs[-1]}: is not an MCAP file"
    printed = done.stdout.splitlines()
    others = set(full) - set(first) - set(last)
    assert others <= set(printed) <= set(full) - set(last)
    assert len(first) // 2 < len(set(first) & set(printed)) < len(first)

    alone = hearthlog("cat", logs[-1])
    assert (alone.returncode, alone.stderr) == (1, f"hearthlog: {logs[-1]}: is not an MCAP file\n")


def test_of_many_logs_with_the_same_fault_the_first_are_named_and_the_others_counted(
    recorded, hearthlog, tmp_path
):
    data = bytearray(find_logs(recorded)[0].read_bytes())
    data[-300] ^= 1  # in the index
    for second in range(13):
        (tmp_path / f"home_20260301T0700{second:02}Z.mcap").write_bytes(data)
    done = hearthlog("cat", tmp_path, "--topics", "/mic/info")
    assert done.returncode == 3
    *reported, rest = done.stderr.splitlines()
    text = "its index is damaged, and messages may be missing; `hearthlog recover` says which"
    named = [line.removeprefix("hearthlog: ").removesuffix(f": {text}") for line in reported]
    assert len(set(named)) == 10
    assert set(named) <= {str(log) for log in find_logs(tmp_path)}
    assert rest == f"hearthlog: and 3 more: {text}"


def test_messages_that_are_not_of_ros_2_are_refused(hearthlog, tmp_path):
    with (tmp_path / "x.mcap").open("xb") as stream:
        writer = ChunkWriter(stream)
        writer.start("", "test")
        writer.add_message(writer.register_channel("/x", "json", 0, {}), 1, b"{}", 1)
        writer.finish()
    result = hearthlog("cat", tmp_path / "x.mcap")
    assert (result.returncode, result.stdout) == (1, "")
    assert result.stderr == "hearthlog: /x: holds no ROS 2 messages ('json')\n"


def test_printing_needs_nothing_but_the_recorder(long):
    code = "import sys\nsys.modules['pyarrow'] = None\n"
    code += "from hearthlog.tools.cli.main import main\nmain()"
    for form in ("text", "ndjson"):
        command = [HEARTHLOG[0], "-c", code, "cat", str(long), "--format", form]
        result = subprocess.run(command, capture_output=True, check=True, env=os.environ)
        assert result.stdout


@pytest.fixture
def mixed(tmp_path) -> Path:
    """A log with messages of ROS 2, and some as JSON."""
    path = tmp_path / "mixed.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        json_schema = writer.register_schema("state", "jsonschema", b"{}")
        header = writer.register_schema(
            "std_msgs/msg/Header", "ros2msg", definition("std_msgs/msg/Header").encode()
        )
        state = writer.register_channel("/state", "json", json_schema)
        place = writer.register_channel("/place", "cdr", header)
        writer.add_message(state, 1, b"{}", 1)
        writer.add_message(place, 2, b"\0\1\0\0" + bytes(8) + b"\4\0\0\0mic\0", 2)
        writer.finish()
    return path


def test_messages_of_other_encodings_are_left_out_and_named(hearthlog, mixed, tmp_path):
    done = hearthlog("cat", mixed)
    assert done.returncode == 3
    assert done.stdout.splitlines() == [
        "1970-01-01T00:00:00.000Z /place stamp=1970-01-01T00:00:00.000Z frame_id=mic"
    ]
    warning = "hearthlog: /state: holds no ROS 2 messages ('json')"
    assert done.stderr == f"{warning}: left out; --topics chooses others\n"

    done = hearthlog("export", mixed, "--output", tmp_path / "tables", "--format", "csv")
    assert (done.returncode, done.stderr) == (3, f"{warning}: left out; --topics chooses others\n")
    assert [path.name for path in (tmp_path / "tables").iterdir()] == ["place.csv"]

    done = hearthlog("cat", mixed, "--topics", "/state")
    assert (done.returncode, done.stderr) == (1, f"{warning}\n")
