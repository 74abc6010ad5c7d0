"""Logs that are damaged, or lie: what is whole in them is read, and one line says what is not."""

import json
import struct
from functools import partial

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import zstandard
from bags import INT32, STRING, T0, Bag, definition, int32, string
from log_fixtures import run
from mcap.reader import SeekingReader, make_reader
from mcap.writer import CompressionType

import hearthlog as package
from hearthlog.analyzer.export import merge
from hearthlog.schemas.errors import HearthlogWarning
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.mcap.records import FOOTER_SIZE, HEAD, MAGIC
from hearthlog.schemas.messages.type_definitions import MessageType

END = struct.pack("<BQQQI", 2, 20, 0, 0, 0) + MAGIC
STEP = 10**9


@pytest.fixture
def hearthlog(capfd):
    """Run the command and return what came of it."""
    return partial(run, capfd)


def record(opcode, content):
    return struct.pack("<BQ", opcode, len(content)) + content


def text(value):
    data = value if isinstance(value, bytes) else value.encode()
    return struct.pack("<I", len(data)) + data


def defined(number, topic, kind=INT32, name=None, metadata=b""):
    """The schema and the channel of a topic, both of one number."""
    schema = struct.pack("<H", number) + text(name or kind) + text("ros2msg")
    schema += text(definition(kind))
    channel = struct.pack("<HH", number, number) + text(topic) + text("cdr")
    return record(3, schema) + record(4, channel + text(metadata))


def message(channel, data, time):
    return record(5, struct.pack("<HIQQ", channel, 0, time, time) + data)


def chunk(content, start, end, stored=None, size=None):
    data = zstandard.compress(content) if stored is None else stored
    head = struct.pack("<QQQI", start, end, len(content) if size is None else size, 0)
    return record(6, head + text("zstd") + struct.pack("<Q", len(data)) + data)


def unindexed(path, *parts):
    """Write a finished file of some records, without an index."""
    head = MAGIC + record(1, text("ros2") + text("x"))
    path.write_bytes(head + b"".join(parts) + record(15, bytes(4)) + END)
    return path


def without_index(path):
    """Take the index of a bag away."""
    data = path.read_bytes()
    (summary,) = struct.unpack_from("<Q", data, len(data) - FOOTER_SIZE + HEAD.size)
    path.write_bytes(data[:summary] + END)
    return path


def numbers(path, **options):
    """Thirty numbers, ten in each chunk, a second apart."""
    bag = Bag(path, chunk_size=400, **options)
    channel = bag.channel("/i", INT32)
    for i in range(30):
        bag.add(channel, int32(i), T0 + i * STEP)
    return bag.close()


def printed(done):
    return [int(line.rpartition("=")[2]) for line in done.stdout.splitlines()]


# Names that are not UTF-8

ODD = "Käse".encode("latin-1")
OTHER = "Küse".encode("latin-1")
NAMED = {
    "topic": defined(2, b"/" + ODD, STRING),
    "type": defined(2, "/x", STRING, b"std_msgs/msg/" + ODD),
    "metadata": defined(2, "/x", STRING, metadata=text("key") + text(ODD)),
}


@pytest.mark.parametrize("inside", [False, True], ids=["beside chunks", "in a chunk"])
@pytest.mark.parametrize("odd", NAMED.values(), ids=NAMED)
def test_of_a_name_that_is_not_utf8_nothing_else_suffers(tmp_path, hearthlog, odd, inside):
    definitions = defined(1, "/i") + odd
    content = b"".join(message(1, int32(i), T0 + i) for i in range(5))
    content += b"".join(message(2, string(f"s{i}"), T0 + i) for i in range(5))
    parts = [b"", definitions] if inside else [definitions, b""]
    path, copy = tmp_path / "odd.mcap", tmp_path / "copy.mcap"
    unindexed(path, parts[0], chunk(parts[1] + content, T0, T0 + 4))
    done = hearthlog("recover", path, "--output", copy)
    first, line = done.stderr.splitlines()
    assert (done.returncode, first) == (0, f"hearthlog: {path}: 10 messages saved")
    assert "bytes that are not UTF-8 become \\xNN in the names or metadata of" in line
    with copy.open("rb") as stream:
        found = [(c.topic, bytes(m.data)) for _, c, m in SeekingReader(stream).iter_messages()]
        stream.seek(0)
        assert len(list(make_reader(stream, validate_crcs=True).iter_messages())) == 10
    topic = "/K\\xe4se" if odd is NAMED["topic"] else "/x"
    assert sorted(found) == sorted(
        [*(("/i", int32(i)) for i in range(5)), *((topic, string(f"s{i}")) for i in range(5))]
    )
    for log in (path, copy):
        read = hearthlog("cat", log, "--topics", topic)
        assert [row.rpartition("=")[2] for row in read.stdout.splitlines()] == [
            f"s{i}" for i in range(5)
        ]


def test_two_names_that_are_not_utf8_stay_two(tmp_path, hearthlog):
    definitions = defined(1, b"/" + ODD) + defined(2, b"/" + OTHER)
    content = message(1, int32(1), T0) + message(2, int32(2), T0 + 1)
    path = unindexed(tmp_path / "odd.mcap", definitions, chunk(content, T0, T0 + 1))
    hearthlog("recover", path, "--output", tmp_path / "copy.mcap")
    logs = package.open_logs(tmp_path / "copy.mcap")
    assert logs.columns("/K\\xe4se")["data"].tolist() == [1]
    assert logs.columns("/K\\xfcse")["data"].tolist() == [2]


def test_recover_keeps_records_whose_names_are_not_utf8(tmp_path, hearthlog):
    entry = text(ODD) + text(ODD)
    attachment = struct.pack("<QQ", T0, T0) + text(ODD) + text("text/plain")
    attachment += struct.pack("<Q", 3) + b"abc" + bytes(4)
    odd = record(12, text(ODD) + text(entry)) + record(9, attachment)
    path = unindexed(tmp_path / "odd.mcap", defined(1, "/i"), odd, message(1, int32(7), T0))
    copy = tmp_path / "copy.mcap"
    assert hearthlog("recover", path, "--output", copy).returncode == 0
    with copy.open("rb") as stream:
        reader = make_reader(stream)
        (kept,) = [r for r in reader.iter_metadata() if r.name == "K\\xe4se"]
        (attached,) = reader.iter_attachments()
    assert kept.metadata == {"K\\xe4se": "K\\xe4se"}
    assert (attached.name, attached.data) == ("K\\xe4se", b"abc")


# Chunks that are too large to be opened


@pytest.fixture(scope="module")
def too_large(tmp_path_factory):
    """A number, a chunk of 1.2 GiB in 100 KB, and a number."""
    blob = bytes(64 << 20)
    head = struct.pack("<BQHIQQ", 5, 22 + len(blob), 2, 0, T0 + 1, T0 + 1)
    packer = zstandard.ZstdCompressor().compressobj()
    stored = b"".join(packer.compress(part) for _ in range(20) for part in (head, blob))
    stored += packer.flush()
    size = 20 * (len(head) + len(blob))
    parts = [defined(1, "/i"), defined(2, "/blob")]
    parts += [chunk(message(1, int32(0), T0), T0, T0), chunk(b"", T0 + 1, T0 + 1, stored, size)]
    parts += [chunk(message(1, int32(2), T0 + 2), T0 + 2, T0 + 2)]
    return unindexed(tmp_path_factory.mktemp("large") / "large.mcap", *parts), stored


@pytest.mark.parametrize("verb", ["cat", "info"])
def test_what_is_beside_a_chunk_that_is_too_large_is_read(too_large, hearthlog, verb):
    done = hearthlog(verb, too_large[0])
    assert (done.returncode, done.stderr.count("\n")) == (3, 1)
    assert "a chunk of 1,280 MiB is larger than hearthlog reads (1,0" in done.stderr
    assert "damaged" not in done.stderr
    if verb == "cat":
        assert printed(done) == [0, 2]


def test_recover_copies_a_chunk_that_it_cannot_open(too_large, hearthlog, tmp_path):
    path, stored = too_large
    done = hearthlog("recover", path, "--output", tmp_path / "copy.mcap")
    assert (done.returncode, "damaged" in done.stderr) == (0, False)
    assert "and is copied unopened, at byte" in done.stderr
    assert stored in (tmp_path / "copy.mcap").read_bytes()
    assert printed(hearthlog("cat", tmp_path / "copy.mcap")) == [0, 2]


def test_a_chunk_that_says_two_things_of_its_size_is_damaged(tmp_path, hearthlog):
    wrong = chunk(message(1, int32(1), T0), T0, T0, size=1 << 40)
    path = unindexed(tmp_path / "x.mcap", defined(1, "/i"), message(1, int32(0), T0), wrong)
    done = hearthlog("recover", path, "--output", tmp_path / "copy.mcap")
    assert (done.returncode, "damaged at byte" in done.stderr) == (3, True)


# Damage, without an index and with one


def hurt(path, number):
    """Change a byte in the middle of a chunk."""
    with LogFile(path) as file:
        row = file.chunks[number]
    data = bytearray(path.read_bytes())
    data[int(row["offset"] + row["length"] // 2)] ^= 0xFF
    path.write_bytes(data)
    return path


@pytest.mark.parametrize(
    ("number", "indexed"), [(0, True), (1, True), (1, False), (2, False)]
)  # without an index, the first chunk alone defines the topic
def test_a_damaged_chunk_costs_what_is_in_it_and_one_line(tmp_path, hearthlog, number, indexed):
    path = hurt(numbers(tmp_path / "x.mcap"), number)
    if not indexed:
        without_index(path)
    left = hearthlog("cat", path)
    kept = printed(left)
    assert 0 < len(kept) < 30
    lost = sorted(set(range(30)) - set(kept))
    assert lost == list(range(lost[0], lost[-1] + 1))
    assert (left.returncode, left.stderr.count("\n")) == (3, 1)
    assert ": left out up to byte " in left.stderr
    for verb, name in (("export", "x.csv"), ("export", "x.bag"), ("merge", "m.mcap")):
        done = hearthlog(verb, path, "--output", tmp_path / name)
        assert (done.returncode, done.stderr) == (3, left.stderr)
    assert len((tmp_path / "x.csv").read_text().splitlines()) == 1 + len(kept)
    with pytest.warns(HearthlogWarning, match="left out up to byte"):
        assert package.open_logs(path).columns("/i")["data"].tolist() == kept
    if not indexed:
        about = hearthlog("info", path, "--json")
        assert (about.returncode, about.stderr) == (3, left.stderr)
        assert json.loads(about.stdout)["topics"]["/i"]["messages"] == len(kept)


def test_many_damaged_chunks_are_counted(tmp_path, hearthlog):
    bag = Bag(tmp_path / "x.mcap", chunk_size=1)
    channel = bag.channel("/i", INT32)
    for i in range(30):
        bag.add(channel, int32(i), T0 + i)
    path = bag.close()
    for number in range(20):
        hurt(path, number)
    done = hearthlog("cat", path)
    assert printed(done) == list(range(20, 30))
    *named, last = done.stderr.splitlines()
    assert (len(named), "17 more chunks are damaged and left out" in last) == (3, True)


def test_behind_a_record_with_a_wrong_length_the_next_chunk_is_read(tmp_path, hearthlog):
    path = without_index(numbers(tmp_path / "x.mcap"))
    with LogFile(path) as file:
        start = int(file.chunks["offset"][1])
    data = bytearray(path.read_bytes())
    for length in (2**63, 2**40, 3):
        struct.pack_into("<Q", data, start + 1, length)
        path.write_bytes(data)
        done = hearthlog("cat", path)
        assert (done.returncode, done.stderr.count("\n")) == (3, 1)
        assert f"damaged at byte {start} (a record" in done.stderr
        assert "bytes left out; `hearthlog recover` saves the rest" in done.stderr
        assert set(printed(done)) > {0, 29}


def of_three_topics(path):
    """Sixty numbers of three topics in turn, some in each chunk."""
    bag = Bag(path, chunk_size=400)
    channels = [bag.channel(topic, INT32) for topic in ("/a", "/b", "/c")]
    for i in range(60):
        bag.add(channels[i % 3], int32(i), T0 + i * STEP)
    return bag.close()


def test_a_log_that_is_damaged_while_it_is_written_is_read_as_far_as_it_goes(tmp_path, hearthlog):
    path = without_index(numbers(tmp_path / "x.mcap"))
    with LogFile(path) as file:
        start = int(file.chunks["offset"][1])
    data = bytearray(path.read_bytes()[: -len(END)])
    struct.pack_into("<Q", data, start + 1, 2**40)
    unfinished = tmp_path / "y.mcap.active"
    unfinished.write_bytes(data)
    done = hearthlog("cat", unfinished)
    assert (done.returncode, set(printed(done)) > {0, 29}) == (3, True)
    assert f"damaged at byte {start} (a record" in done.stderr


def test_a_damaged_index_of_messages_costs_none_of_the_chunk_before_it(tmp_path, hearthlog):
    path = without_index(of_three_topics(tmp_path / "x.mcap"))
    with LogFile(path) as file:
        row = file.chunks[1]
    data = bytearray(path.read_bytes())
    first = int(row["offset"] + row["length"])
    (length,) = struct.unpack_from("<Q", data, first + 1)
    struct.pack_into("<Q", data, first + HEAD.size + length + 1, 2**40)
    path.write_bytes(data)
    done = hearthlog("cat", path)
    assert (done.returncode, sorted(printed(done))) == (3, list(range(60)))


def test_a_damaged_summary_makes_no_channel_doubtful(tmp_path, hearthlog):
    path = of_three_topics(tmp_path / "x.mcap")
    data = bytearray(path.read_bytes())
    (summary,) = struct.unpack_from("<Q", data, len(data) - FOOTER_SIZE + HEAD.size)
    place = data.index(text("/b"), summary) - 4  # its number
    data[place : place + 2] = struct.pack("<H", 1)
    path.write_bytes(data)
    done = hearthlog("cat", path)
    assert (done.returncode, sorted(printed(done))) == (3, list(range(60)))


def test_a_message_index_that_lies_is_not_used(tmp_path, hearthlog):
    path = numbers(tmp_path / "x.mcap")
    with LogFile(path) as file:
        row = file.chunks[1]
    data = bytearray(path.read_bytes())
    place = int(row["offset"] + row["length"]) + HEAD.size + 6 + 8  # offset of its first message
    data[place : place + 8] = struct.pack("<Q", 2**63)
    path.write_bytes(data)
    done = hearthlog("cat", path)
    assert (done.returncode, printed(done)) == (3, list(range(30)))
    assert "message indexes that do not belong to their chunks are not used" in done.stderr


def test_a_message_index_that_lists_a_message_in_the_place_of_another_is_not_used(
    tmp_path, hearthlog
):
    path = numbers(tmp_path / "x.mcap")
    with LogFile(path) as file:
        row = file.chunks[1]
    data = bytearray(path.read_bytes())
    first = int(row["offset"] + row["length"]) + HEAD.size + 6
    data[first + 32 : first + 64] = data[first : first + 32]  # entries 0 and 1, for 2 and 3
    path.write_bytes(data)
    done = hearthlog("cat", path)
    assert (done.returncode, printed(done)) == (3, list(range(30)))
    assert "message indexes that do not belong to their chunks are not used" in done.stderr


def test_a_chunk_that_the_index_puts_into_another_time_is_read_in_its_own(tmp_path, hearthlog):
    path = numbers(tmp_path / "x.mcap", enable_crcs=False)
    data = bytearray(path.read_bytes())
    (summary,) = struct.unpack_from("<Q", data, len(data) - FOOTER_SIZE + HEAD.size)
    place = data.index(bytes([8]), summary)
    while struct.unpack_from("<Q", data, place + HEAD.size) != (T0,):
        place = data.index(bytes([8]), place + 1)
    struct.pack_into("<QQ", data, place + HEAD.size, 5, 5)
    path.write_bytes(data)
    done = hearthlog("cat", path, "--start", "2023-11-14T22:13:20Z")
    assert (done.returncode, printed(done)) == (3, list(range(30)))


def test_messages_of_a_number_with_two_meanings_are_left_out(tmp_path, hearthlog):
    parts = [defined(1, "/i"), defined(2, "/j"), message(1, int32(1), T0)]
    parts += [message(2, int32(2), T0), defined(1, "/other", STRING), message(1, string("x"), T0)]
    path = unindexed(tmp_path / "x.mcap", *parts)
    done = hearthlog("cat", path)
    assert (done.returncode, printed(done)) == (3, [2])
    assert "messages of channels that the file defines in two ways are left out" in done.stderr


def test_a_chunk_in_a_chunk_is_named(tmp_path, hearthlog):
    inner = chunk(message(1, int32(1), T0), T0, T0)
    path = unindexed(tmp_path / "x.mcap", defined(1, "/i"), chunk(inner, T0, T0))
    done = hearthlog("cat", path)
    assert (done.returncode, "the records of a chunk are damaged" in done.stderr) == (3, True)


def test_where_no_message_can_be_read_cat_says_so(tmp_path, hearthlog):
    bag = Bag(tmp_path / "x.mcap")
    bag.add(bag.channel("/i", INT32), b"", T0)
    done = hearthlog("cat", bag.close())
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (3, "", 1)


# The doctor, where all is wrong


@pytest.mark.parametrize("payload", [b"\0\1\0\0", b"\0\1\0\0\4\0\0\0abcd"], ids=["short", "no end"])
def test_the_doctor_looks_once_at_faults_that_are_alike(tmp_path, hearthlog, monkeypatch, payload):
    bag = Bag(tmp_path / "x.mcap")
    channel = bag.channel("/s", STRING)
    for i in range(20_000):
        bag.add(channel, payload, T0 + i)
    calls = []
    original = MessageType.layout_of
    monkeypatch.setattr(
        MessageType, "layout_of", lambda *given: calls.append(1) or original(*given)
    )
    done = hearthlog("doctor", bag.close())
    assert "19995 more of this kind [cdr]" in done.stdout
    assert len(calls) < 100


def test_the_doctor_passes_over_a_topic_of_countless_faults(tmp_path, hearthlog, monkeypatch):
    monkeypatch.setattr("hearthlog.analyzer.doctor.examination._MOST_WRONG", 100)
    bag = Bag(tmp_path / "x.mcap", CompressionType.NONE)
    channel, full = bag.channel("/s", STRING), bag.channel("/i", INT32)
    for i in range(1000):
        bag.add(channel, b"\0\1\0\0" + struct.pack("<I", 1000 + i), T0 + i)
    bag.add(full, int32(1)[:5], T0 + 1000)
    done = hearthlog("doctor", bag.close())
    assert "messages of /s cannot be read, each for another reason" in done.stdout
    assert "996 more of this kind [cdr]" in done.stdout


# Bytes in Arrow


def test_arrays_of_bytes_are_binary(tmp_path, hearthlog):
    parts = ("uint8[] data", "byte[3] three", "int8[] signed", "a/Part[] parts", "a/No[] none")
    parts += ("=" * 80, "MSG: a/Part", "uint8[] data", "=" * 80, "MSG: a/No", "")
    bag = Bag(tmp_path / "x.mcap")
    channel = bag.channel("/img", "a/msg/Img", "\n".join(parts))
    for count in (4, 0, 8):
        data = b"\0\1\0\0" + struct.pack("<I", count) + bytes(range(count)) + b"abc\0"
        data += struct.pack("<I", 4) + b"\xff" * 4
        data += struct.pack("<II", 1, 4) + b"wxyz" + struct.pack("<I", 0)
        bag.add(channel, data, T0 + count)
    path = bag.close()
    table = package.open_logs(path).arrow("/img")
    assert [str(table.schema.field(name).type) for name in ("data", "three", "signed")] == [
        "binary",
        "fixed_size_binary[3]",
        "list<item: int8>",
    ]
    row = table.to_pylist()[2]
    assert (row["data"], row["three"], row["signed"]) == (bytes(range(8)), b"abc", [-1] * 4)
    assert (row["parts"], row["none"]) == ([{"data": b"wxyz"}], [])
    assert table["data"].type == pa.binary()
    done = hearthlog("export", path, "--output", tmp_path / "x.parquet")
    assert done.returncode == 0
    assert pq.read_table(tmp_path / "x.parquet").to_pylist() == table.to_pylist()


def test_a_large_image_becomes_bytes_without_an_object_for_each(tmp_path):
    pixels = np.random.default_rng(1).integers(0, 256, 5 << 20, np.uint8).tobytes()
    bag = Bag(tmp_path / "x.mcap")
    channel = bag.channel("/img", "a/msg/Img", "uint8[] data\n")
    bag.add(channel, b"\0\1\0\0" + struct.pack("<I", len(pixels)) + pixels, T0)
    (row,) = package.open_logs(bag.close()).arrow("/img")["data"].to_pylist()
    assert row == pixels


# Folders, and texts that never end


def test_compressed_logs_beside_others_are_named_once(tmp_path, hearthlog):
    numbers(tmp_path / "a.mcap")
    for name in ("b.mcap.zstd", "c.mcap.lz4", "notes.zst"):
        (tmp_path / name).write_bytes(b"\x28\xb5\x2f\xfd" + bytes(10))
    warning = (
        f"hearthlog: {tmp_path}: compressed as a whole, and left out: b.mcap.zstd, c.mcap.lz4; "
        "unpack first\n"
    )
    for verb in ("cat", "info"):
        done = hearthlog(verb, tmp_path)
        assert (done.returncode, done.stderr) == (3, warning)


ENDLESS = {
    "aliases": "- &a [x]\n" + "".join(f"- &a{i} [*a, *a, *a]\n" for i in range(100)),
    "braces": "{" * 50_000,
    "brackets": "[" * 50_000,
    "digits": f"- depth: {'9' * 1_000_000}\n",
    "letters": f"- history: {'x' * 1_000_000}\n",
}


@pytest.mark.parametrize("qos", ENDLESS.values(), ids=ENDLESS)
def test_a_quality_of_service_without_end_is_none(tmp_path, hearthlog, monkeypatch, qos):
    given = []
    monkeypatch.setattr(merge, "parse_qos", lambda text: given.append(text) or [])
    metadata = text("offered_qos_profiles") + text(qos)
    parts = [defined(1, "/i", metadata=metadata), message(1, int32(1), T0)]
    path = unindexed(tmp_path / "x.mcap", *parts)
    for verb in ("merge", "cut"):
        done = hearthlog(verb, path, "--output", tmp_path / f"{verb}.mcap")
        assert (done.returncode, done.stderr) == (0, "")
    assert given == []


def test_statistics_that_lie_are_not_printed(tmp_path, hearthlog):
    path = numbers(tmp_path / "x.mcap", enable_crcs=False)
    data = bytearray(path.read_bytes())
    place = data.rindex(struct.pack("<BQ", 11, 56)) + HEAD.size
    for count in (2**40, 7):
        struct.pack_into("<Q", data, place, count)
        struct.pack_into("<Q", data, place + 48, count)
        path.write_bytes(data)
        about = json.loads(hearthlog("info", path, "--json").stdout)
        assert about["topics"]["/i"]["messages"] == 30


def test_a_chunk_that_the_index_lists_twice_is_read_once(tmp_path, hearthlog):
    path = numbers(tmp_path / "x.mcap", enable_crcs=False)
    data = path.read_bytes()
    (summary,) = struct.unpack_from("<Q", data, len(data) - FOOTER_SIZE + HEAD.size)
    with path.open("rb") as stream:
        first = make_reader(stream).get_summary().chunk_indexes[0]
    place = data.index(struct.pack("<QQQ", *_times_and_place(first)), summary) - HEAD.size
    length = HEAD.size + struct.unpack_from("<Q", data, place + 1)[0]
    again = data[place : place + length]
    footer = struct.pack("<BQQQI", 2, 20, summary, 0, 0) + MAGIC
    path.write_bytes(data[:place] + again * 3 + data[place + length : -FOOTER_SIZE] + footer)
    done = hearthlog("cat", path)
    assert (done.returncode, printed(done)) == (3, list(range(30)))


def _times_and_place(index):
    return index.message_start_time, index.message_end_time, index.chunk_start_offset


def test_a_thousand_topics_and_more_are_listed(tmp_path, hearthlog):
    parts = [defined(n, f"/t{n}") + message(n, int32(n), T0 + n) for n in range(1, 1500)]
    path = unindexed(tmp_path / "x.mcap", *parts)
    lines = hearthlog("info", path).stdout.splitlines()
    head = next(number for number, line in enumerate(lines) if line.startswith("topic "))
    assert len(lines) == head + 1 + 1499
    assert len({line.index("std_msgs") for line in lines[head + 1 :]}) == 1


def test_a_topic_with_an_endless_name_is_one_line(tmp_path, hearthlog):
    path = unindexed(tmp_path / "x.mcap", defined(1, "/" + "a" * 70_000), message(1, int32(1), T0))
    done = hearthlog("cat", path, "--topics", "/none")
    assert (done.returncode, len(done.stderr) < 300) == (1, True)
