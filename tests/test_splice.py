"""Logs are merged and cut message for message, into logs that anyone can open."""

import json
import shutil
import tracemalloc
from functools import partial

import numpy as np
import pytest
from log_fixtures import LOST, raw_messages, run, small_disk, write_log
from logreader import LogReader
from mcap.reader import make_reader
from mcap.writer import Writer
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader

from hearthlog.analyzer.export.merge import merge_logs
from hearthlog.analyzer.logs.selection import select
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.files import find_logs
from hearthlog.schemas.logs.metadata import rosbag2_channel
from hearthlog.schemas.logs.writer import Attachment, LogWriter, TopicBatch
from hearthlog.schemas.mcap.records import LIMIT
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.message_types import message
from hearthlog.schemas.messages.topics import Quality, Topic

INFO = Topic("/mic/info", "std_msgs/msg/String", Quality(depth=1, transient_local=True))
FEATURES = Topic("/mic/features", message_types.FEATURES, array_names={"values": ["a", "b"]})


@pytest.fixture
def hearthlog(capfd):
    """Run the command and return what came of it."""
    return partial(run, capfd)


@pytest.fixture
def refused(hearthlog):
    """Run a command that must fail with one line on stderr, and return that line."""

    def run(*arguments, status=1):
        result = hearthlog(*arguments)
        assert result.returncode == status, result
        assert result.stdout == ""
        assert result.stderr.count("\n") == 1
        return result.stderr.removeprefix("hearthlog: ").rstrip()

    return run


def as_read(path, topics=None):
    """What LogReader gives, in the order of log times."""
    found = [
        (item.topic, item.type, item.log_time, item.data)
        for log in find_logs(path)
        for item in LogReader(log).messages(topics)
    ]
    return sorted(found, key=lambda row: row[2])


def small_log(path, topics, rows=(), info=(), about=({}, ())):
    """A log of some features, of strings on /mic/info, and of what it says of itself."""
    log = LogWriter(path, topics, *about)
    for time, text in info:
        data = message_types.encode(message("std_msgs/msg/String", data=text))
        log.write("/mic/info", time, data)
    times = np.array(rows, np.int64)
    if rows:
        values = times[:, None] * np.ones(len(topics[0].array_names["values"]), np.float32)
        fields = {"header.stamp": times, "header.frame_id": "mic", "frame": times}
        log.write_columns([TopicBatch(topics[0].name, times, fields | {"values": values})])
    return log.finish()


def test_merged_logs_hold_every_message_byte_for_byte_in_the_order_of_time(
    recorded, hearthlog, tmp_path
):
    output = tmp_path / "all.mcap"
    result = hearthlog("merge", recorded, "--output", output)
    assert (result.returncode, result.stdout, result.stderr) == (0, f"{output}\n", "")
    found = [(m.topic, m.type, m.log_time, m.data) for m in LogReader(output).messages()]
    assert found == as_read(recorded)
    assert len({topic for topic, *_ in found}) > 6
    sources = [row for log in find_logs(recorded) for row in raw_messages(log)]
    assert sorted(raw_messages(output)) == sorted(sources)


def test_what_logs_have_twice_is_merged_once_and_counted(recorded, hearthlog, tmp_path):
    first, *_ = find_logs(recorded)
    rows = raw_messages(first)
    times = sorted(row[4] for row in rows)
    hour = tmp_path / "hour.mcap"
    start, end = (f"{np.datetime64(times[len(times) * i // 4], 'ns')}Z" for i in (1, 3))
    hearthlog("cut", first, "--start", start, "--end", end, "--topics", "/mic/features", "-o", hour)
    part = raw_messages(hour)
    output = tmp_path / "both.mcap"
    result = hearthlog("merge", hour, first, "-o", output)
    assert sorted(raw_messages(output)) == sorted(rows)
    line = f"hearthlog: {len(part)} messages left out, which the logs contain twice\n"
    assert (result.returncode, result.stderr) == (0, line)
    assert len(part) > 100


def test_messages_that_differ_in_anything_are_not_the_same(hearthlog, tmp_path):
    one, other = (message("std_msgs/msg/String", data=text) for text in ("one", "two"))
    write_log(tmp_path / "1.mcap", {"/x": [(1, one), (1, other), (2, one)], "/y": [(1, one)]})
    write_log(tmp_path / "2.mcap", {"/x": [(1, other), (3, one)], "/y": [(1, other)]})
    result = hearthlog("merge", tmp_path, "-o", tmp_path / "all.mcap")
    assert (result.returncode, result.stderr) == (0, "")  # their sequences differ
    assert len(raw_messages(tmp_path / "all.mcap")) == 7
    shutil.copy(tmp_path / "1.mcap", tmp_path / "3.mcap")
    result = hearthlog("merge", tmp_path / "1.mcap", tmp_path / "3.mcap", "-o", tmp_path / "4.mcap")
    assert "4 messages left out" in result.stderr
    assert raw_messages(tmp_path / "4.mcap") == raw_messages(tmp_path / "1.mcap")


def equal_messages(path, count=30, **options):
    """A log of equal messages at equal times, as a simulated clock gives them."""
    with path.open("xb") as stream:
        writer = Writer(stream, **options)
        writer.start("ros2", "somebody")
        schema = writer.register_schema("std_msgs/msg/Empty", "ros2msg", b"")
        for _ in range(2):
            channel = writer.register_channel("/trigger", "cdr", schema, {})
            for i in range(count):
                writer.add_message(channel, i // 10 * 10**9, b"\0\1\0\0\0", i // 10 * 10**9)
        writer.finish()
    return path


def test_equal_messages_of_one_log_are_all_kept_and_those_of_its_copy_left_out(hearthlog, tmp_path):
    for number, options in enumerate([{}, {"chunk_size": 1}, {"use_chunking": False}]):
        log = equal_messages(tmp_path / f"{number}.mcap", **options)
        for verb, *form in (("merge",), ("cut",), ("export", "--format", "rosbag2")):
            output = tmp_path / f"{number}{verb}{'' if form else '.mcap'}"
            assert hearthlog(verb, log, "-o", output, *form)[::2] == (0, "")
            written = output / f"{output.name}.mcap" if form else output
            assert len(raw_messages(written)) == 60
        copy = tmp_path / f"{number}merge.mcap"
        more = equal_messages(tmp_path / f"more{number}.mcap", 40)  # 20 of them at a later time
        line = "hearthlog: 120 messages left out, which the logs contain twice\n"
        for verb, *form in (("merge",), ("export", "--format", "rosbag2")):
            together = tmp_path / f"{number}{verb}-together{'' if form else '.mcap'}"
            if not form:
                result = hearthlog(verb, log, copy, more, "-o", together)
                assert len(raw_messages(together)) == 80
            else:
                (folder := tmp_path / f"{number}all").mkdir()
                for path in (log, copy, more):
                    shutil.copy(path, folder)
                result = hearthlog(verb, folder, "-o", together, *form)
            assert (result.returncode, result.stderr) == (0, line)


def test_a_chunk_that_a_log_holds_twice_is_merged_once(hearthlog, tmp_path):
    log = small_log(tmp_path / "1.mcap", [FEATURES], rows=range(1, 50))
    data = log.read_bytes()
    (place,) = chunks_of(log)
    chunk = data[place.chunk_start_offset :][: place.chunk_length + place.message_index_length]
    end = place.chunk_start_offset + len(chunk)
    twice = tmp_path / "2.mcap.active"  # without an index
    twice.write_bytes(data[:end] + chunk)
    result = hearthlog("merge", twice, "-o", tmp_path / "all.mcap")
    assert "hearthlog: 49 messages left out, which the logs contain twice\n" in result.stderr
    assert raw_messages(tmp_path / "all.mcap") == raw_messages(log)


def chunks_of(path):
    with path.open("rb") as stream:
        return make_reader(stream).get_summary().chunk_indexes


def test_what_is_merged_has_chunks_of_ten_seconds_as_a_recorder_writes_them(hearthlog, tmp_path):
    rows = range(NANOSECONDS, 61 * NANOSECONDS, NANOSECONDS // 20)
    log = small_log(tmp_path / "1.mcap", [FEATURES], rows=rows)
    for verb in ("merge", "cut"):
        output = tmp_path / f"{verb}.mcap"
        hearthlog(verb, log, "-o", output)
        spans = [(c.message_start_time, c.message_end_time) for c in chunks_of(output)]
        assert len(spans) == 6
        assert all(end - start < 10 * NANOSECONDS for start, end in spans)
        part = tmp_path / f"{verb}-cut-off.mcap"
        part.write_bytes(output.read_bytes()[: output.stat().st_size // 2])
        assert hearthlog("recover", part, "-o", tmp_path / f"{verb}-saved.mcap").returncode == 3
        saved = raw_messages(tmp_path / f"{verb}-saved.mcap")
        assert 400 <= len(saved) == len(set(saved)) <= 600


def test_what_is_rare_is_merged_into_few_chunks(hearthlog, tmp_path):
    rows = range(NANOSECONDS, 3601 * NANOSECONDS, 60 * NANOSECONDS)
    log = small_log(tmp_path / "1.mcap", [FEATURES], rows=rows)
    hearthlog("cut", log, "-o", tmp_path / "cut.mcap")
    assert len(chunks_of(tmp_path / "cut.mcap")) <= 3
    assert raw_messages(tmp_path / "cut.mcap") == raw_messages(log)


def test_what_a_log_without_messages_carries_is_kept(hearthlog, refused, tmp_path):
    notes = [Attachment("map.pgm", "image/x-portable-graymap", b"map")]
    silent = small_log(tmp_path / "silent.mcap", [FEATURES], about=({"node": "a"}, notes))
    small_log(tmp_path / "spoken.mcap", [FEATURES], rows=[5], about=({"node": "b"}, ()))
    for sources, count in (([tmp_path], 1), ([silent], 0)):
        output = tmp_path / f"{count}" / "all.mcap"
        output.parent.mkdir()
        assert hearthlog("merge", *sources, "-o", output)[::2] == (0, "")
        bag = output.with_name("bag")
        assert not hearthlog("export", *sources, "-o", bag, "--format", "rosbag2").returncode
        for path in (output, bag / "bag.mcap"):
            assert LogReader(path).attachments == {"map.pgm": b"map"}
            with path.open("rb") as stream:
                nodes = {r.metadata.get("node") for r in make_reader(stream).iter_metadata()}
            assert nodes >= ({"a", "b"} if count else {"a"})
            assert len(raw_messages(path)) == count
        with Reader(bag) as reader:
            assert reader.message_count == count
    message = refused("cut", silent, "-o", tmp_path / "x.mcap", "--end", "1999-01-01")
    assert message.startswith("no message in this span of time")
    with (tmp_path / "nothing.mcap").open("xb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.finish()
    message = refused("merge", tmp_path / "nothing.mcap", "-o", tmp_path / "x.mcap")
    assert message.startswith("no message in these logs")


def test_a_merged_log_is_opened_by_rosbags_and_says_what_it_holds(recorded, hearthlog, tmp_path):
    output = tmp_path / "all.mcap"
    hearthlog("merge", *find_logs(recorded), "-o", output)
    (text,) = LogReader(output).metadata["rosbag2"].values()
    (tmp_path / "metadata.yaml").write_text(f"rosbag2_bagfile_information: {text}")
    expected = as_read(recorded)
    with Reader(tmp_path) as bag, AnyReader([output]) as reader:
        counts = {c.topic: c.msgcount for c in bag.connections}
        assert counts == {topic: sum(row[0] == topic for row in expected) for topic in counts}
        assert bag.message_count == len(expected) == len(list(bag.messages()))
        assert (bag.start_time, bag.end_time - 1) == (expected[0][2], expected[-1][2])
        gaps = [
            reader.deserialize(d, c.msgtype) for c, _, d in reader.messages() if "gap" in c.topic
        ]
    assert [gap.frames_lost for gap in gaps] == list(LOST.values())


def test_a_merged_log_has_the_records_of_its_sources_once(recorded, hearthlog, tmp_path):
    output = tmp_path / "all.mcap"
    hearthlog("merge", recorded, "-o", output)
    source, merged = LogReader(find_logs(recorded)[0]), LogReader(output)
    assert merged.metadata["hearthlog"] == source.metadata["hearthlog"]
    assert merged.attachments == source.attachments
    with output.open("rb") as stream:
        reader = make_reader(stream)
        assert [record.name for record in reader.iter_metadata()] == [
            "hearthlog",
            "rosbag2",
            "hearthlog_contents",
        ]
        assert reader.get_header().profile == "ros2"
        topics = [channel.topic for channel in reader.get_summary().channels.values()]
    assert len(topics) == len(set(topics))


@pytest.mark.parametrize("limit", [LIMIT, 1])
def test_records_that_differ_are_all_kept(hearthlog, tmp_path, monkeypatch, limit):
    monkeypatch.setattr("hearthlog.analyzer.export.merge.LIMIT", limit)  # of what is read at once
    for node, text in (("one", b"x"), ("two", b"y"), ("three", b"x")):
        notes = [Attachment("notes.txt", "text/plain", text), Attachment("raw", "", b"1")]
        small_log(tmp_path / f"{node}.mcap", [FEATURES], [1], about=({"node": node}, notes))
    output = tmp_path / "all.mcap"
    hearthlog("merge", tmp_path, "-o", output)
    with output.open("rb") as stream:
        records = [r.metadata for r in make_reader(stream).iter_metadata() if r.name == "hearthlog"]
    assert sorted(record["node"] for record in records) == ["one", "three", "two"]
    found = LogReader(output).attachments
    assert found.keys() == {"notes.txt", "notes-2.txt", "raw"}
    assert {found["notes.txt"], found["notes-2.txt"]} == {b"x", b"y"}
    assert "attachment" not in hearthlog("doctor", output).stdout


def test_channels_that_say_the_same_become_one_and_others_stay_apart(hearthlog, tmp_path):
    other = Topic(FEATURES.name, message_types.FEATURES, array_names={"values": ["a", "c", "d"]})
    small_log(tmp_path / "1.mcap", [FEATURES, INFO], rows=[10, 30])
    small_log(tmp_path / "2.mcap", [FEATURES, INFO], rows=[20])
    small_log(tmp_path / "3.mcap", [other, INFO], rows=[25])
    output = tmp_path / "all.mcap"
    hearthlog("merge", tmp_path, "-o", output)
    with output.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    names = [
        (c.topic, json.loads(c.metadata.get("values_names", "[]")))
        for c in summary.channels.values()
    ]
    assert sorted(names) == [
        ("/mic/features", ["a", "b"]),
        ("/mic/features", ["a", "c", "d"]),
        ("/mic/info", []),  # on which nothing was said
    ]
    assert len(summary.schemas) == 2
    assert [row[4] for row in raw_messages(output)] == [10, 20, 25, 30]


def test_two_types_on_one_topic_stay_two_channels(hearthlog, tmp_path):
    text = message("std_msgs/msg/String", data="x")
    number = message("std_msgs/msg/Int8", data=1)
    write_log(tmp_path / "1.mcap", {"/x": [(1, text)]})
    write_log(tmp_path / "2.mcap", {"/x": [(2, number)]})
    assert hearthlog("merge", tmp_path, "-o", tmp_path / "all.mcap").returncode == 0
    found = [(row[0], row[1]) for row in raw_messages(tmp_path / "all.mcap")]
    assert found == [("/x", "std_msgs/msg/String"), ("/x", "std_msgs/msg/Int8")]
    assert "rosbag2" not in LogReader(tmp_path / "all.mcap").metadata


def test_pieces_of_a_cut_log_merged_again_are_the_log(recorded, hearthlog, tmp_path):
    rows = as_read(recorded)
    middle = rows[len(rows) // 2][2]
    text = str(np.datetime64(middle, "ns"))
    first, second = tmp_path / "first.mcap", tmp_path / "second.mcap"
    assert hearthlog("cut", recorded, "-o", first, "--end", text).returncode == 0
    assert hearthlog("cut", recorded, "-o", second, "--start", text + "Z").returncode == 0
    assert as_read(first) == [row for row in rows if row[2] < middle]
    assert as_read(second)[1:] == [row for row in rows if row[2] >= middle]
    hearthlog("merge", first, second, "-o", tmp_path / "again.mcap")
    again = as_read(tmp_path / "again.mcap")
    assert len(again) == len(rows) + 1  # what the second piece begins with
    assert set(again) - set(rows) == {as_read(second)[0]}


def test_a_cut_log_begins_with_what_describes_its_stream(recorded, hearthlog, tmp_path):
    log = find_logs(recorded)[-1]
    info = next(row for row in raw_messages(log) if row[0] == "/mic/info")
    start = next(row[4] for row in raw_messages(log) if row[4] > info[4] + 10**9)
    output = tmp_path / "cut.mcap"
    span = [str(np.datetime64(time, "ns")) for time in (start, start + 10**9)]
    hearthlog("cut", recorded, "-o", output, "--start", span[0], "--end", span[1])
    first, *others = raw_messages(output)
    assert first == (*info[:4], start, *info[5:])
    assert others == [row for row in raw_messages(log) if start <= row[4] < start + 10**9]
    assert LogReader(output).attachments == LogReader(log).attachments


def test_what_describes_a_stream_is_searched_for_in_earlier_logs(hearthlog, tmp_path):
    small_log(tmp_path / "1.mcap", [FEATURES, INFO], rows=[1], info=[(2, "old"), (3, "new")])
    small_log(tmp_path / "2.mcap", [FEATURES], rows=[10])
    small_log(tmp_path / "3.mcap", [FEATURES, INFO], rows=[20, 30], info=[(40, "late")])
    hearthlog(
        "cut", tmp_path, "-o", tmp_path / "cut.mcap", "--start", "1970-01-01T00:00:00.000000015"
    )
    found = [(row[0], row[4], row[5], row[7][8:11]) for row in raw_messages(tmp_path / "cut.mcap")]
    assert found[0] == ("/mic/info", 20, 3, b"new")
    assert [row[1] for row in found] == [20, 20, 30, 40]


def test_it_is_not_repeated_where_it_is_said_at_the_start_or_is_not_wanted(hearthlog, tmp_path):
    small_log(tmp_path / "1.mcap", [FEATURES, INFO], rows=[1], info=[(1, "old")])
    small_log(tmp_path / "2.mcap", [FEATURES, INFO], rows=[10], info=[(10, "new")])
    start = ("--start", "1970-01-01T00:00:00.000000005")
    hearthlog("cut", tmp_path, "-o", tmp_path / "a.mcap", *start)
    assert [row[4] for row in raw_messages(tmp_path / "a.mcap")] == [10, 10]
    hearthlog("cut", tmp_path / "1.mcap", tmp_path / "2.mcap", "-o", tmp_path / "b.mcap",
              *start, "--topics", "/mic/f*")  # fmt: skip
    assert [row[0] for row in raw_messages(tmp_path / "b.mcap")] == ["/mic/features"]


def profile(history, depth, durability="transient_local"):
    quality = json.loads(rosbag2_channel("", Quality())["offered_qos_profiles"])[0]
    return quality | {"history": history, "depth": depth, "durability": durability}


@pytest.mark.parametrize(
    ("publishers", "held"),
    [
        ([[("keep_last", 10)]], [0, 1, 2, 3, 4, 5]),
        ([[("keep_last", 2)]], [4, 5]),
        ([[("keep_last", 1)] * 3], [3, 4, 5]),  # rosbag2 has one channel for them
        ([[("keep_last", 1)], [("keep_last", 1)], [("keep_last", 1)]], [3, 4, 5]),
        ([[("keep_all", 0)], [("keep_last", 1)]], [0, 2, 4, 5]),
        ([[("keep_last", 3, "volatile")], [("keep_last", 2)]], [3, 5]),
        ([[("unknown", 0)]], [0, 1, 2, 3, 4, 5]),
        ([[("keep_last", None)]], [0, 1, 2, 3, 4, 5]),
        ([[("keep_last", "2")]], [0, 1, 2, 3, 4, 5]),
        ([[("keep_all", 0), ("keep_last", 10**400)]], [0, 1, 2, 3, 4, 5]),
        ([[("keep_last", 5, "volatile")]], []),
    ],
)
def test_a_cut_log_begins_with_all_that_a_late_subscriber_receives(
    hearthlog, tmp_path, publishers, held
):
    for number, rows in enumerate(([0, 1, 2], [3, 4, 5], [])):
        with (tmp_path / f"{number}.mcap").open("xb") as stream:
            writer = Writer(stream)
            writer.start("ros2", "somebody")
            schema = writer.register_schema("std_msgs/msg/Byte", "ros2msg", b"byte data\n")
            qos = [json.dumps([profile(*each) for each in own]) for own in publishers]
            channels = [
                writer.register_channel("/tf", "cdr", schema, {"offered_qos_profiles": text})
                for text in qos
            ]
            other = writer.register_channel("/other", "cdr", schema, {})
            for row in rows:
                data = bytes([0, 1, 0, 0, row])
                writer.add_message(channels[row % len(channels)], 10 + row, data, 10 + row)
            writer.add_message(other, 30 + number, b"\0\1\0\0\0", 30 + number)
            writer.finish()
    start = "1970-01-01T00:00:00.000000032"
    hearthlog("cut", tmp_path, "-o", tmp_path / "cut.mcap", "--start", start)
    found = [(row[4], row[5] - 10) for row in raw_messages(tmp_path / "cut.mcap")]
    assert found == [*((32, row) for row in held), (32, 22)]


def test_copies_of_logs_do_not_count_for_what_a_late_subscriber_receives(hearthlog, tmp_path):
    info = Topic("/mic/info", "std_msgs/msg/String", Quality(depth=3, transient_local=True))
    small_log(tmp_path / "1.mcap", [FEATURES, info], rows=[1], info=[(2, "a"), (3, "b")])
    small_log(tmp_path / "2.mcap", [FEATURES, info], rows=[10], info=[(11, "c")])
    small_log(tmp_path / "3.mcap", [FEATURES, info], rows=[20], info=[(20, "d")])
    for number in (2, 3):
        shutil.copy(tmp_path / f"{number}.mcap", tmp_path / f"{number}-copy.mcap")
    hearthlog("cut", tmp_path, "-o", tmp_path / "cut.mcap", "--start",
              "1970-01-01T00:00:00.000000015")  # fmt: skip
    rows = [row for row in raw_messages(tmp_path / "cut.mcap") if row[0] == "/mic/info"]
    assert [row[7][8:9] for row in rows] == [b"b", b"c", b"d"]


def test_messages_that_expire_are_not_repeated(hearthlog, tmp_path):
    rosout = Topic("/mic/info", "std_msgs/msg/String", Quality(1000, True, 10))
    small_log(tmp_path / "1.mcap", [FEATURES, rosout], rows=[1, 10], info=[(1, "old")])
    hearthlog("cut", tmp_path, "-o", tmp_path / "cut.mcap", "--start",
              "1970-01-01T00:00:00.000000005")  # fmt: skip
    assert [row[0] for row in raw_messages(tmp_path / "cut.mcap")] == ["/mic/features"]


def test_an_unfinished_log_is_cut_and_merged_as_far_as_it_is_there(recorded, hearthlog, tmp_path):
    unfinished = recorded.parent / "unfinished.mcap.active"
    for verb in ("merge", "cut"):
        output = tmp_path / f"{verb}.mcap"
        result = hearthlog(verb, unfinished, "-o", output)
        assert result.returncode == 3
        assert result.stdout == f"{output}\n"
        assert result.stderr.count("\n") == 1
        assert str(unfinished) in result.stderr
        assert LogReader(output).complete
        assert as_read(output) == as_read(unfinished)


def test_an_output_that_exists_is_left_alone(recorded, refused, tmp_path):
    output = tmp_path / "mine.mcap"
    output.write_text("mine")
    for verb in ("merge", "cut"):
        assert refused(verb, recorded, "-o", output).startswith(f"{output}: exists already")
    assert output.read_text() == "mine"
    assert list(tmp_path.iterdir()) == [output]


def test_nothing_is_made_of_nothing(recorded, refused, tmp_path):
    output = tmp_path / "x.mcap"
    message = refused("cut", recorded, "-o", output, "--start", "2031-01-01")
    assert message.startswith("no message in this span of time")
    message = refused("cut", recorded, "-o", output, "--topics", "/nothing")
    assert message.startswith("no topic /nothing; there are /diagnostics, /mic/features")
    assert refused("merge", tmp_path / "none", "-o", output) == f"{tmp_path / 'none'}: no such log"
    assert list(tmp_path.iterdir()) == []


def test_a_log_is_named_mcap(recorded, refused, tmp_path):
    for verb in ("merge", "cut"):
        message = refused(verb, recorded, "-o", tmp_path / "x.bag", status=2)
        assert message == f"--output {tmp_path / 'x.bag'}: a log is named *.mcap"


@pytest.mark.parametrize("verb", ["merge", "cut"])
def test_what_stands_outside_of_a_damaged_chunk_is_copied(recorded, hearthlog, tmp_path, verb):
    full = find_logs(recorded)[0]
    data = bytearray(full.read_bytes())
    data[len(data) // 2] ^= 0xFF
    damaged, saved, copy = (tmp_path / f"{name}.mcap" for name in ("damaged", "saved", "copy"))
    damaged.write_bytes(data)
    done = hearthlog(verb, damaged, "-o", copy)
    assert (done.returncode, done.stderr.count("\n")) == (3, 1)
    assert done.stderr.startswith(f"hearthlog: {damaged}: damaged at byte ")
    hearthlog("recover", damaged, "-o", saved)
    kept = raw_messages(copy)
    assert len(raw_messages(full)) > len(kept) > 0
    assert [m for m in raw_messages(saved) if not m[0].endswith("/gap")] == [
        m for m in kept if not m[0].endswith("/gap")
    ]


def test_a_full_disk_leaves_no_output(recorded, refused, tmp_path):
    with small_disk(tmp_path / "disk", "200k") as disk:
        output = disk / "x.mcap"
        message = refused("merge", recorded, "-o", output)
        assert message == f"{output}: cannot be written (No space left on device); make room"
        assert list(disk.iterdir()) == []


def test_messages_of_one_time_keep_the_order_of_their_log(tmp_path):
    topics = {f"/t{i}": [(5, message("std_msgs/msg/Int8", data=i))] * 3 for i in range(9, 0, -1)}
    log = write_log(tmp_path / "1.mcap", topics)
    merge_logs(select([log]), tmp_path / "2.mcap")
    found = [(m.topic, m.data) for m in LogReader(tmp_path / "2.mcap").messages()]
    assert found == [(m.topic, m.data) for m in LogReader(log).messages()]


def test_logs_of_any_size_are_merged_in_little_memory(tmp_path):
    names = [f"v{i}" for i in range(21)]
    topic = Topic("/mic/features", message_types.FEATURES, array_names={"values": names})
    logs = []
    for part in range(2):
        log = LogWriter(tmp_path / f"{part}.mcap", [topic], {})
        for first in range(0, 300_000, 50_000):
            times = np.arange(first, first + 50_000) * 2 + part
            values = np.random.default_rng(part).random((50_000, 21), np.float32)
            fields = {"header.stamp": times, "header.frame_id": "mic", "frame": times}
            log.write_columns([TopicBatch(topic.name, times, fields | {"values": values})])
        logs.append(log.finish())
    tracemalloc.start()
    merge_logs(select(logs), tmp_path / "all.mcap")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert (tmp_path / "all.mcap").stat().st_size > 40_000_000
    assert peak < 75_000_000  # decompressed they are 90 MB
    assert len(LogReader(tmp_path / "all.mcap").channels) in (0, 1)
