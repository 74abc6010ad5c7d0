"""Logs that others wrote: what is whole in them is read, and what is left out is named."""

import json
import struct
from functools import partial

import pytest
import zstandard
from bags import INT32, STRING, T0, Bag, definition, int32, string
from log_fixtures import run
from mcap.reader import SeekingReader, make_reader
from mcap.writer import CompressionType, IndexType, Writer

import hearthlog as package
from hearthlog.analyzer.logs.recorder_info import features_of, read_recorder_infos
from hearthlog.models.features.installed import DEFAULT
from hearthlog.schemas.errors import HearthlogWarning, LogError
from hearthlog.schemas.logs.files import find_logs
from hearthlog.schemas.logs.merged_reading import iterate_messages
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.mcap.records import MAGIC
from hearthlog.schemas.messages.type_definitions import message_type

TYPE = "our_msgs/msg/C"
PARTS = ("std_msgs/Header header", "int32 x", "=" * 80, "MSG: std_msgs/Header")
PARTS += ("builtin_interfaces/Time stamp", "string frame_id", "=" * 80)
PARTS += ("MSG: builtin_interfaces/Time", "int32 sec", "uint32 nanosec", "")
PLAIN = "\n".join(PARTS)


@pytest.fixture
def hearthlog(capfd):
    """Run the command and return what came of it."""
    return partial(run, capfd)


@pytest.fixture
def bag(tmp_path):
    """A bag with five texts on `/ok`, and with what a test adds."""
    bag = Bag(tmp_path / "bag.mcap")
    ok = bag.channel("/ok", STRING)
    for i in range(5):
        bag.add(ok, string(f"m{i}"), T0 + i)
    return bag


# What cannot be read of one topic

UNREADABLE = {
    "not defined": (("my_msgs/msg/Secret", "", ""), "the log does not define my_msgs/msg/Secret"),
    "an empty definition": (("my_msgs/msg/S", "", "ros2msg"), "does not define my_msgs/msg/S"),
    "a part not defined": (("a/msg/A", "b/B b\n", "ros2msg"), "builds on b/msg/B, which is not"),
    "contains itself": (("a/msg/A", "A[] children\n", "ros2msg"), "a/msg/A: contains itself"),
    "no definition": (("a/msg/A", "int32\n", "ros2msg"), "definition of a/msg/A cannot be read"),
    "no IDL": (("a/msg/A", "module a {", "ros2idl"), "definition of a/msg/A cannot be read"),
}


@pytest.mark.parametrize("form", ["cat", "csv", "parquet"])
@pytest.mark.parametrize(("channel", "why"), UNREADABLE.values(), ids=UNREADABLE)
def test_a_topic_that_cannot_be_understood_is_named_and_the_others_are_read(
    bag, hearthlog, form, channel, why
):
    bag.add(bag.channel("/odd", *channel), b"\0\1\0\0abcd", T0)
    path = bag.close()
    out = path.with_name("out")
    done = hearthlog(*(["cat", path] if form == "cat" else export(path, out, form)))
    assert done.returncode == 3
    (line,) = done.stderr.splitlines()
    assert line.startswith("hearthlog: /odd: ")
    assert why in line
    assert line.endswith(": left out; --topics chooses others")
    if form == "cat":
        assert [text.split()[-1] for text in done.stdout.splitlines()] == [
            f"data=m{i}" for i in range(5)
        ]
    else:
        assert [file.name for file in out.iterdir()] == [f"ok.{form}"]


def export(path, out, form):
    return ["export", path, "--output", out, "--format", form]


def test_such_a_topic_alone_is_refused(bag, hearthlog):
    bag.add(bag.channel("/odd", "a/msg/A", "", ""), b"\0\1\0\0abcd", T0)
    path = bag.close()
    done = hearthlog("cat", path, "--topics", "/odd")
    assert (done.returncode, done.stderr) == (
        1,
        "hearthlog: /odd: the log does not define a/msg/A\n",
    )
    with pytest.raises(LogError, match="/odd: the log does not define a/msg/A"):
        package.open_logs(path).columns("/odd")


def test_of_two_definitions_of_a_topic_the_one_that_can_be_understood_is_read(bag, hearthlog):
    bag.add(bag.channel("/two", INT32), int32(7), T0 + 7)
    bag.add(bag.channel("/two", INT32, "int32\n"), int32(8), T0 + 8)
    done = hearthlog("cat", bag.close(), "--topics", "/two")
    assert done.returncode == 3
    assert [line.split()[-1] for line in done.stdout.splitlines()] == ["data=7"]


# What cannot be read of one message


@pytest.fixture
def damaged(bag):
    """A bag with a message on `/i` that is too short, and one text on `/s` in Latin-1."""
    numbers, texts = bag.channel("/i", INT32), bag.channel("/s", STRING)
    for i in range(10):
        bag.add(numbers, int32(i) if i != 5 else int32(i)[:5], T0 + i)
        bag.add(texts, string(f"k{i}" if i != 3 else "Käse".encode("latin-1")), T0 + i)
    return bag.close()


def test_a_message_that_is_too_short_is_named_and_the_others_are_read(damaged, hearthlog):
    done = hearthlog("cat", damaged, "--topics", "/i")
    values = [int(line.rpartition("=")[2]) for line in done.stdout.splitlines()]
    assert values == [0, 1, 2, 3, 4, 6, 7, 8, 9]
    assert done.returncode == 3
    assert done.stderr == (
        "hearthlog: /i at 2023-11-14T22:13:20.000Z: std_msgs/msg/Int32: a message ends before its "
        "field data: such messages of /i are left out; `hearthlog doctor` says more\n"
    )


def test_a_text_in_another_encoding_has_a_mark_where_it_cannot_be_read(damaged, hearthlog):
    done = hearthlog("cat", damaged, "--topics", "/s")
    assert [line.rpartition("=")[2] for line in done.stdout.splitlines()][2:5] == [
        "k2",
        "K\ufffdse",
        "k4",
    ]
    assert done.returncode == 3
    assert done.stderr == (
        "hearthlog: /s: data: a string is not UTF-8: U+FFFD stands for what cannot be read in "
        "texts of /s\n"
    )


def test_a_topic_whose_name_is_in_another_encoding_is_read(tmp_path, hearthlog):
    bag = Bag(tmp_path / "bag.mcap", CompressionType.NONE, enable_crcs=False)
    numbers = bag.channel("/K_se", INT32)
    for i in range(3):
        bag.add(numbers, int32(i), T0 + i)
    bag.writer.add_metadata("K_se", {"K_se": "K_se"})
    path = bag.close()
    path.write_bytes(path.read_bytes().replace(b"K_se", "Käse".encode("latin-1")))
    warning = (
        f"hearthlog: {path}: bytes that are not UTF-8 stand as \\xNN in names of topics, types or "
        "records\n"
    )
    for verb in ("cat", "info"):
        done = hearthlog(verb, path)
        assert (done.returncode, done.stderr, "/K\\xe4se" in done.stdout) == (3, warning, True)


def test_python_reads_what_the_command_reads(damaged):
    logs = package.open_logs(damaged)
    with pytest.warns(HearthlogWarning, match="such messages of /i are left out"):
        assert logs.columns("/i")["data"].tolist() == [0, 1, 2, 3, 4, 6, 7, 8, 9]
    with pytest.warns(HearthlogWarning, match="U\\+FFFD"):
        assert logs.pandas("/s")["data"].iloc[3] == "K\ufffdse"
    with pytest.warns(HearthlogWarning, match="such messages of /i are left out"):
        assert logs.arrow("/i").num_rows == 9


def test_the_doctor_names_each_message_and_does_not_mind_texts(damaged, hearthlog):
    done = hearthlog("doctor", damaged)
    assert "error: " in done.stdout
    assert "/i: std_msgs/msg/Int32: a message ends before its field data [cdr]" in done.stdout
    assert "data: a string is not UTF-8 [text]" in done.stdout


def test_where_no_message_of_a_topic_can_be_read_the_others_are(bag, hearthlog, tmp_path):
    numbers = bag.channel("/i", INT32)
    for i in range(3):
        bag.add(numbers, b"", T0 + i)
    path, out = bag.close(), tmp_path / "out"
    assert hearthlog(*export(path, out, "csv")).returncode == 3
    assert [file.name for file in out.iterdir()] == ["ok.csv"]
    with pytest.warns(HearthlogWarning):
        assert len(package.open_logs(path).columns("/i")) == 0


# How definitions are written

SPELLINGS = {
    "CRLF": PLAIN.replace("\n", "\r\n").encode(),
    "CR": PLAIN.replace("\n", "\r").encode(),
    "CRLF at separators": PLAIN.replace("=\n", "=\r\n").encode(),
    "40 signs": PLAIN.replace("=" * 80, "=" * 40).encode(),
    "81 signs": PLAIN.replace("=" * 80, "=" * 81).encode(),
    "blanks behind a separator": PLAIN.replace("=\n", "=  \t\n").encode(),
    "blanks around a name": PLAIN.replace(
        "MSG: std_msgs/Header", "MSG:\tstd_msgs/Header "
    ).encode(),
    "a comment in Latin-1": PLAIN.replace("int32 x", "int32 x  # Käse").encode("latin-1"),
    "a separator in a comment": PLAIN.replace("int32 x", f"int32 x\n# {'=' * 80}").encode(),
    "odd ends of lines in a comment": PLAIN.replace("int32 x", "int32 x # a\x0cb\u2028c").encode(),
    "a byte order mark": b"\xef\xbb\xbf" + PLAIN.encode(),
}


@pytest.mark.parametrize("text", SPELLINGS.values(), ids=SPELLINGS)
def test_a_definition_is_understood_however_it_is_written(text):
    assert (
        message_type(TYPE, "ros2msg", text).types
        == message_type(TYPE, "ros2msg", PLAIN.encode()).types
    )


@pytest.mark.parametrize("name", ["our_msgs/C", "our_msgs/srv/C_Request"])
def test_a_type_is_understood_whatever_form_its_name_has(bag, name):
    bag.add(bag.channel("/c", name, "int32 x\n"), int32(7), T0)
    columns = package.open_logs(bag.close()).columns("/c")
    assert (columns.type, columns["x"].tolist()) == (name, [7])


def test_an_empty_definition_of_a_known_type_is_that_type(bag):
    bag.add(bag.channel("/i", INT32, ""), int32(7), T0)
    assert package.open_logs(bag.close()).columns("/i")["data"].tolist() == [7]


# Times that no calendar has

LATE = [2**63 - 1, 2**63, 2**64 - 1]
FORMS = {
    "chunks with an index": {},
    "small chunks": {"chunk_size": 1},
    "chunks without an index": {"index_types": IndexType.NONE, "use_statistics": False},
    "no chunks": {"use_chunking": False},
    "nothing but records": {
        "use_chunking": False,
        "use_statistics": False,
        "index_types": IndexType.NONE,
    },
}


def late_bag(path, options, times):
    """Numbers 0 to 3 at their times, and 99 at others."""
    bag = Bag(path, **options)
    numbers = bag.channel("/i", INT32)
    for i in range(4):
        if i == 2:
            for time in times:
                bag.add(numbers, int32(99), time)
        bag.add(numbers, int32(i), T0 + i)
    bag.writer.add_attachment(2**64 - 1, 2**64 - 1, "note", "text/plain", b"abc")
    return bag.close()


@pytest.mark.parametrize("options", FORMS.values(), ids=FORMS)
@pytest.mark.parametrize("times", [LATE[:1], LATE[1:2], LATE])
def test_of_a_clock_that_ran_below_zero_all_else_is_read(tmp_path, hearthlog, options, times):
    path = late_bag(tmp_path / "late.mcap", options, times)
    done = hearthlog("cat", path)
    assert [line.rpartition("=")[2] for line in done.stdout.splitlines()] == list("0123")
    assert done.returncode == 3
    assert done.stderr == (
        f"hearthlog: {path}: messages are left out whose log times are after the year 2262, as of "
        "a clock below zero\n"
    )
    assert hearthlog("cat", path, "--end", "2024-01-01").stdout == done.stdout
    info = hearthlog("info", path, "--json")
    about = json.loads(info.stdout)
    assert about["topics"]["/i"]["messages"] == 4
    assert about["end"].startswith("2023-11-14")


def test_a_log_ends_with_its_last_message_whatever_follows_it(tmp_path):
    path = late_bag(tmp_path / "late.mcap", FORMS["nothing but records"], LATE)
    with pytest.warns(HearthlogWarning, match="2262"), LogFile(path) as file:
        assert file.span == (T0, T0 + 3)


@pytest.mark.parametrize("options", FORMS.values(), ids=FORMS)
def test_recover_loses_the_messages_of_such_a_time_alone(tmp_path, hearthlog, options):
    path = late_bag(tmp_path / "late.mcap", options, LATE)
    done = hearthlog("recover", path, "--output", tmp_path / "new.mcap")
    assert done.returncode == 3
    assert "4 " in done.stderr.splitlines()[0]
    assert "log times after the year 2262 at byte" in done.stderr
    assert "damaged" not in done.stderr
    columns = package.open_logs(tmp_path / "new.mcap").columns("/i")
    assert columns["data"].tolist() == [0, 1, 2, 3]
    assert hearthlog("doctor", tmp_path / "new.mcap").returncode in {0, 3}
    assert "[late]" in hearthlog("doctor", path).stdout


def test_a_publish_time_that_no_calendar_has_is_told(bag, hearthlog):
    bag.add(bag.channel("/i", INT32), int32(7), T0, publish_time=2**64 - 1)
    done = hearthlog("cat", bag.close(), "--topics", "/i", "--format", "ndjson")
    assert '"publish_time":9223372036.854775806' in done.stdout
    assert (done.returncode, "2262-04-11 stands for them" in done.stderr) == (3, True)


# What the index does not list, and what MCAP leaves to others


def record(opcode, content):
    return bytes([opcode]) + struct.pack("<Q", len(content)) + content


def text(value):
    return struct.pack("<I", len(value)) + value.encode()


def loose(channel, value, time):
    return record(5, struct.pack("<HIQQ", channel, 0, time, time) + int32(value))


def defined(number, topic):
    """The schema and the channel of a topic of numbers, both of one number."""
    schema = struct.pack("<H", number) + text(INT32) + text("ros2msg") + text(definition(INT32))
    channel = struct.pack("<HH", number, number) + text(topic) + text("cdr") + text("")
    return record(3, schema) + record(4, channel)


def with_inserted(path, inserted, messages=0, indexed=b""):
    """Put records before the Data End of a bag and into its index, and count messages there."""
    data = path.read_bytes()
    summary, offsets, _ = struct.unpack("<QQI", data[-28:-8])
    end = data.rfind(record(15, b"")[:1] + struct.pack("<Q", 4), 0, summary)
    index = bytearray(data[summary:offsets])
    place = index.find(b"\x0b" + struct.pack("<Q", 56)) + 9
    (count,) = struct.unpack_from("<Q", index, place)
    struct.pack_into("<Q", index, place, count + messages)
    head = data[:end] + inserted + record(15, bytes(4))
    footer = record(2, struct.pack("<QQI", len(head), 0, 0))
    path.write_bytes(head + index + indexed + footer + data[:8])
    return path


@pytest.fixture
def numbers(tmp_path):
    """A bag of 50 numbers in five chunks."""
    bag = Bag(tmp_path / "numbers.mcap", chunk_size=500)
    channel = bag.channel("/i", INT32)
    for i in range(50):
        bag.add(channel, int32(i), T0 + i)
    return bag.close()


def test_messages_outside_of_chunks_are_read_where_the_index_does_not_list_them(numbers, hearthlog):
    path = with_inserted(numbers, loose(1, 50, T0 + 50), 1)
    done = hearthlog("cat", path)
    assert done.returncode == 0
    assert [line.rpartition("=")[2] for line in done.stdout.splitlines()] == [
        str(i) for i in range(51)
    ]
    assert len(package.open_logs(path).columns("/i")) == 51


def test_a_topic_of_messages_outside_of_chunks_alone_is_listed_and_read(numbers, hearthlog):
    path = with_inserted(numbers, defined(9, "/loose") + loose(9, 7, T0 + 7), 1)
    logs = package.open_logs(path)
    assert logs.topics == {"/i": INT32, "/loose": INT32}
    assert logs.columns("/loose")["data"].tolist() == [7]
    assert "/loose" in hearthlog("info", path).stdout


@pytest.mark.parametrize("place", [(2**63, 9), (8, 2**62), (8, 300)])
def test_an_index_that_leads_nowhere_is_named_where_its_records_are_wanted(
    numbers, hearthlog, monkeypatch, place
):
    index = record(10, struct.pack("<5Q", *place, 0, 0, 0) + text("film") + text(""))
    path = with_inserted(numbers, loose(1, 50, T0 + 50), 1, index)
    done = hearthlog("cat", path)
    assert (done.returncode, len(done.stdout.splitlines())) == (0, 51)
    monkeypatch.setattr("hearthlog.analyzer.export.merge.LIMIT", 100)
    done = hearthlog("merge", path, "--output", path.with_name("merged.mcap"))
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert f"damaged at byte {place[0]} " in done.stderr


PRIVATE = record(0xC1, b"x" * 20)


@pytest.mark.parametrize(
    "between",
    [
        PRIVATE,
        PRIVATE * 40,
        record(0xFF, b""),
        record(0x20, b"later"),
        record(0xC1, bytes(17 << 20)),
    ],
    ids=["one", "many", "empty", "of a later version", "large"],
)
@pytest.mark.parametrize("ending", ["", "end"])
def test_recover_keeps_what_stands_beside_records_that_are_not_known(
    tmp_path, hearthlog, between, ending
):
    parts = [
        defined(1, "/a"),
        loose(1, 1, T0),
        between,
        loose(1, 2, T0 + 1),
        between * bool(ending),
    ]
    path = tmp_path / "private.mcap"
    head = MAGIC + record(1, text("ros2") + text("x"))
    end = record(15, bytes(4)) + record(2, bytes(20)) + MAGIC
    path.write_bytes(head + b"".join(parts) + end)
    done = hearthlog("recover", path, "--output", tmp_path / "new.mcap")
    assert (done.returncode, done.stderr) == (0, f"hearthlog: {path}: 2 messages saved\n")
    new = tmp_path / "new.mcap"
    assert package.open_logs(new).columns("/a")["data"].tolist() == [1, 2]
    assert between in new.read_bytes()


def test_recover_keeps_a_chunk_with_records_that_are_not_known(tmp_path, hearthlog):
    content = defined(1, "/a") + loose(1, 1, T0) + PRIVATE + loose(1, 2, T0 + 1)
    chunk = struct.pack("<QQQIIQ", T0, T0 + 1, len(content), 0, 0, len(content)) + content
    path = tmp_path / "private.mcap"
    head = MAGIC + record(1, text("ros2") + text("x")) + PRIVATE
    path.write_bytes(
        head + record(6, chunk) + PRIVATE + record(15, bytes(4)) + record(2, bytes(20)) + MAGIC
    )
    done = hearthlog("recover", path, "--output", tmp_path / "new.mcap")
    assert (done.returncode, done.stderr) == (0, f"hearthlog: {path}: 2 messages saved\n")


# Files that are not MCAP, but could be

OTHERS = {
    "bag.mcap.zstd": (b"\x28\xb5\x2f\xfd", "compressed as a whole: `zstd -d"),
    "bag.mcap.lz4": (b"\x04\x22\x4d\x18", "compressed as a whole: `lz4 -d"),
    "bag.mcap.gz": (b"\x1f\x8b", "compressed as a whole: `gzip -d"),
    "bag.db3": (b"SQLite format 3\0", "a bag in SQLite, no MCAP: `ros2 bag convert`"),
    "old.bag": (b"#ROSBAG V2.0\n", "a bag of ROS 1, no MCAP: `rosbags-convert`"),
}


@pytest.mark.parametrize(
    ("name", "start", "what"), [(k, *v) for k, v in OTHERS.items()], ids=OTHERS
)
def test_what_else_a_bag_may_be_is_named(tmp_path, hearthlog, name, start, what):
    path = tmp_path / "bag" / name
    path.parent.mkdir()
    path.write_bytes(start + bytes(100))
    for verb in ("info", "cat", "recover"):
        done = hearthlog(verb, path)
        assert (done.returncode, what in done.stderr) == (1, True)
    assert what in hearthlog("doctor", path).stdout
    assert what in hearthlog("info", path.parent).stderr


# Features without the record that names their set


def test_features_that_were_copied_alone_are_of_the_set_whose_names_they_have(recorded, tmp_path):
    (log, *_), path = find_logs(recorded), tmp_path / "features.mcap"
    with log.open("rb") as source, path.open("wb") as target:
        writer = Writer(target)
        writer.start("ros2", "mcap go")
        number = None
        for schema, channel, message in make_reader(source).iter_messages(["/mic/features"]):
            if number is None:
                kind = writer.register_schema(schema.name, schema.encoding, schema.data)
                number = writer.register_channel(channel.topic, "cdr", kind, channel.metadata)
            writer.add_message(number, message.log_time, message.data, message.publish_time)
        writer.finish()
    (info,) = read_recorder_infos(path, "features")
    assert features_of(info).name == DEFAULT.name


# What is larger than fits into the memory

LARGE = 101 << 20  # bytes


@pytest.fixture(scope="module", params=[CompressionType.ZSTD, CompressionType.LZ4], ids=str)
def large_chunk(request, tmp_path_factory):
    """A bag with one chunk of 101 MiB: a text a second, and a number with every tenth of them."""
    path = tmp_path_factory.mktemp("large") / "large.mcap"
    bag = Bag(path, request.param, chunk_size=1 << 30)
    texts, numbers = bag.channel("/s", STRING), bag.channel("/i", INT32)
    for i in range(110):
        bag.add(texts, string("x" * (LARGE // 109)), T0 + i * 10**9)
        if i % 10 == 0:
            bag.add(numbers, int32(i), T0 + i * 10**9 + 1)
    return bag.close()


def test_a_chunk_above_the_limit_is_read_in_parts(large_chunk, hearthlog):
    logs = package.open_logs(large_chunk)
    assert logs.columns("/i")["data"].tolist() == list(range(0, 110, 10))
    pieces = [part for batch in iterate_messages([large_chunk], ["/s"]) for part in batch]
    assert sum(map(len, pieces)) == 110
    assert max(len(part.buffer) for part in pieces) < 16 << 20
    assert hearthlog("doctor", large_chunk).returncode == 3


def test_a_chunk_above_the_limit_is_recovered_as_it_is(large_chunk, hearthlog, tmp_path):
    copy = tmp_path / "copy.mcap"
    done = hearthlog("recover", large_chunk, "--output", copy)
    assert (done.returncode, done.stderr) == (
        0,
        f"hearthlog: {large_chunk}: 121 of 121 messages saved\n",
    )
    assert package.open_logs(copy).columns("/i")["data"].tolist() == list(range(0, 110, 10))


def test_topics_that_a_large_chunk_alone_defines_are_read_from_the_chunks_behind_it(
    tmp_path, hearthlog
):
    bag = Bag(tmp_path / "cut.mcap.active", chunk_size=LARGE - (1 << 19))
    texts = bag.channel("/s", STRING)
    for i in range(11):
        bag.add(texts, string("x" * (LARGE // 10)), T0 + i)
    bag.writer.flush()
    end = bag.path.stat().st_size
    bag.add(texts, string("last"), T0 + 10**9)
    path = bag.close()
    assert 0 < end < 1 << 20
    data = path.read_bytes()
    summary, _, _ = struct.unpack("<QQI", data[-28:-8])
    path.write_bytes(data[:summary])
    done = hearthlog("cat", path, "--start", "2023-11-14T22:13:20.5Z")
    assert [line.rpartition("=")[2] for line in done.stdout.splitlines()] == ["last"]


@pytest.mark.parametrize("options", [{}, {"use_chunking": False}], ids=["chunk", "no chunk"])
def test_a_message_above_the_limit_is_left_out_and_recovered(tmp_path, hearthlog, options):
    path, copy = tmp_path / "image.mcap", tmp_path / "copy.mcap"
    bag = Bag(path, **options)
    texts, images = bag.channel("/s", STRING), bag.channel("/image", "std_msgs/msg/UInt8MultiArray")
    bag.add(texts, string("first"), T0)
    bag.add(images, bytes(LARGE), T0 + 1)
    bag.add(texts, string("last"), T0 + 2)
    bag.writer.add_attachment(T0, T0, "film", "video/mp4", bytes(LARGE))
    bag.close()
    done = hearthlog("cat", path)
    assert [line.rpartition("=")[2] for line in done.stdout.splitlines()] == ["first", "last"]
    assert done.returncode == 3
    assert done.stderr == (
        f"hearthlog: {path}: /image: messages of more than 100 MiB are left out: larger than "
        "hearthlog reads\n"
    )
    assert hearthlog("cat", path, "--topics", "/s").returncode == 0
    done = hearthlog("recover", path, "--output", copy)
    assert (done.returncode, done.stderr) == (0, f"hearthlog: {path}: 3 of 3 messages saved\n")
    merged = tmp_path / "merged.mcap"
    assert hearthlog("merge", path, "--output", merged).returncode == 3
    assert merged.stat().st_size > LARGE  # the film is in it
    with copy.open("rb") as stream:
        reader = SeekingReader(stream, record_size_limit=1 << 30)
        sizes = [len(message.data) for _, _, message in reader.iter_messages()]
        assert [len(each.data) for each in reader.iter_attachments()] == [LARGE]
    assert sorted(sizes) == sorted([len(string("first")), LARGE, len(string("last"))])


def test_a_chunk_that_claims_to_be_large_and_is_not_is_damaged(tmp_path, hearthlog):
    path = tmp_path / "claim.mcap"
    head = MAGIC + record(1, text("ros2") + text("x")) + defined(1, "/i") + loose(1, 7, T0)
    content = zstandard.compress(bytes(LARGE))
    chunk = struct.pack("<QQQII", T0, T0, LARGE, 0, 4) + b"zstd"
    chunk += struct.pack("<Q", len(content)) + content
    path.write_bytes(head + record(6, chunk) + record(15, bytes(4)) + record(2, bytes(20)) + MAGIC)
    done = hearthlog("cat", path)
    assert (done.returncode, "damaged at byte" in done.stderr) == (3, True)
    assert hearthlog("recover", path, "--output", tmp_path / "copy.mcap").returncode == 3
