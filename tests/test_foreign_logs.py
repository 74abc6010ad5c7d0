"""Logs that others wrote: what is whole in them is read, and what is left out is named."""

from functools import partial

import pytest
from bags import INT32, STRING, T0, Bag, int32, string
from spliced import run

import hearthlog as package
from hearthlog.schemas.errors import HearthlogWarning, LogError
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
