"""Of a log that is cut or damaged anywhere, all that is whole is saved, and the rest is named."""

import io
import json
import random
import struct
import subprocess
import sys
import zlib
from functools import partial
from itertools import pairwise
from pathlib import Path
from threading import Event
from typing import NamedTuple

import lz4.frame
import numpy as np
import pytest
import soundfile
import zstandard
from log_fixtures import run
from logreader import LogReader
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as RosbagWriter
from rosbags.typesys import Stores, get_typestore

from hearthlog.recorder.config import load_settings
from hearthlog.recorder.recording import record_files
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.schemas.files import LocalFile
from hearthlog.schemas.logs.writer import LogWriter
from hearthlog.schemas.messages.topics import Topic
from hearthlog.schemas.salvage.recover import NothingIntactError, recover_log


@pytest.fixture
def hearthlog(capfd):
    """Run the command in this process and return what came of it."""
    return partial(run, capfd)


HEADER, MESSAGE, CHUNK, INDEX, ATTACHMENT, METADATA, DATA_END = 1, 5, 6, 7, 9, 12, 15
GAPS = "/mic/gap"
MAGIC = b"\x89MCAP0\r\n"


class Record(NamedTuple):
    """A record of a file; `messages` of a chunk are (topic, log time, payload)."""

    start: int
    end: int
    opcode: int
    messages: list[tuple[str, int, bytes]]


def framing(data):
    """Offset, end and opcode of records, one after the other."""
    offset = 0
    while offset < len(data):
        opcode, length = struct.unpack_from("<BQ", data, offset)
        yield offset, offset + 9 + length, opcode
        offset += 9 + length


def structure(data):
    """List the records of a whole file, found by nothing but the specification."""
    found, topics = [], {}
    for start, end, opcode in framing(data[8:-8]):
        record = Record(start + 8, end + 8, opcode, [])
        found.append(record)
        if opcode != CHUNK:
            continue
        size, _, text = struct.unpack_from("<QII", data, record.start + 25)
        first = record.start + 41 + text + 8
        name = data[record.start + 41 : first - 8]
        inner = DECOMPRESS[name](data[first : record.end], size)
        for a, b, kind in framing(inner):
            content = inner[a + 9 : b]
            if kind == 4:
                number, _, length = struct.unpack_from("<HHI", content)
                topics[number] = content[8 : 8 + length].decode()
            elif kind == MESSAGE:
                number, _, time, _ = struct.unpack_from("<HIQQ", content)
                record.messages.append((topics[number], time, content[22:]))
    return found


DECOMPRESS = {
    b"": lambda data, _: data,
    b"lz4": lambda data, _: lz4.frame.decompress(data),
    b"zstd": lambda data, size: zstandard.ZstdDecompressor().decompress(data, size),
}


@pytest.fixture(scope="module")
def log(tmp_path_factory, day, model_file):
    """A log of a minute as the recorder wrote it: its bytes and its records."""
    folder = tmp_path_factory.mktemp("minute")
    sound, rate = soundfile.read(day, frames=60 * 16_000)
    soundfile.write(folder / "minute.wav", sound, rate)
    settings = load_settings(
        None, {"output": tmp_path_factory.mktemp("logs"), "model": model_file}, {}
    )
    (path,) = record_files(settings, FileSource([folder / "minute.wav"], 10**18), Event()).logs
    data = path.read_bytes()
    return data, structure(data)


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A log of three small chunks, of which every byte can be tried."""
    path = tmp_path_factory.mktemp("small") / "small.mcap"
    topics = [Topic("/a", "std_msgs/msg/Header"), Topic("/b", "std_msgs/msg/Header")]
    writer = LogWriter(path, topics, {"version": "1"})
    for number in range(9):
        writer.write("/ab"[:1] + "ab"[number % 2], 1000 + number, bytes(range(number, 40)))
        if number % 3 == 2:
            writer.flush()
    writer.finish()
    data = path.read_bytes()
    return data, structure(data)


class Result(NamedTuple):
    """What was saved, and what was said of the rest."""

    recovery: object
    messages: list[tuple[str, int, bytes]]

    @property
    def lost(self):
        return sum(sum(damage.messages.values()) for damage in self.recovery.damages)

    @property
    def exact(self):
        return all(damage.exact for damage in self.recovery.damages)

    @property
    def some_lost(self):
        return self.lost or not self.exact


@pytest.fixture
def recover(tmp_path):
    """Recover bytes, and read what was saved with the official reader and our own."""

    def run(data):
        source, copy = tmp_path / "source.mcap", tmp_path / "copy.mcap"
        source.write_bytes(data)
        try:
            recovery = recover_log(source, copy, "copy.mcap")
        except NothingIntactError:
            return None
        reader = LogReader(copy)
        messages = [(m.topic, m.log_time, m.data) for m in reader.messages()]
        assert reader.complete
        by_topic = {n: t.messages for n, t in recovery.topics.items() if t.messages}
        saved = [message for message in messages if message[0] != GAPS]  # none of the logs has any
        assert by_topic == {n: [m[0] for m in saved].count(n) for n in {m[0] for m in saved}}
        with copy.open("rb") as stream:
            official = make_reader(stream, validate_crcs=True)
            assert sum(1 for _ in official.iter_messages()) == len(messages)
        return Result(recovery, saved)

    return run


def chunks_of(records):
    return [record for record in records if record.opcode == CHUNK]


def unfinished(data, records):
    """The bytes before the end of the data."""
    return data[: next(r.start for r in records if r.opcode == DATA_END)]


def flipped(data, *places, mask=1):
    """The bytes with some bits of each of these places changed."""
    damaged = bytearray(data)
    for place in places:
        damaged[place] ^= mask
    return bytes(damaged)


def messages_of(records, without=-1):
    """Messages of the chunks that do not contain a certain byte."""
    kept = [r for r in records if not r.start <= without < r.end]
    return [message for record in kept for message in record.messages]


@pytest.mark.parametrize("seed", range(10))
def test_of_a_log_cut_anywhere_every_chunk_is_saved(log, recover, seed):
    data, records = log
    rng = random.Random(seed)
    for length in [rng.randrange(len(data)) for _ in range(15)]:
        result = recover(data[:length])
        full = [r for r in records if r.end <= length]
        expected = messages_of(full)
        if result is None:
            assert not any(r.opcode in {CHUNK, METADATA, ATTACHMENT} for r in full)
            continue
        assert result.messages == expected, length
        within_chunk = any(r.opcode == CHUNK and r.start < length < r.end for r in records)
        assert bool(result.some_lost) == within_chunk, length
        # A piece of the index may look like a record of its own; it holds no messages.
        assert all(damage.cut for damage in result.recovery.damages) or not within_chunk


def outcome(data, records, place, mask, recover):
    """Change one byte; assert that what is not lost is saved, and what is lost is counted."""
    result = recover(flipped(data, place, mask=mask))
    everything, others = messages_of(records), messages_of(records, without=place)
    chunks = chunks_of(records)
    first, last = chunks[0], chunks[-1]
    finished = len(data) >= records[-1].end
    if first.start <= place < first.end and not finished:
        others = []  # nothing else says what the messages are
    assert result.messages in (everything, others), (place, mask)
    assert len(result.messages) + result.lost == len(everything), (place, mask)
    unknown = place in {r.start for r in records if r.opcode not in {CHUNK, INDEX}}
    # Behind the last chunk of a log that was cut there may have been more of its index.
    unknown |= last.start <= place < last.end and not finished
    assert result.exact or unknown, (place, mask)


@pytest.mark.parametrize("finished", [True, False], ids=["finished", "unfinished"])
@pytest.mark.parametrize("seed", range(10))
def test_with_any_byte_changed_every_other_chunk_is_saved_and_the_lost_messages_counted(
    log, recover, seed, finished
):
    data, records = log
    if not finished:
        data = unfinished(data, records)
    rng = random.Random(seed)
    for _ in range(8):
        outcome(data, records, rng.randrange(len(data)), rng.randrange(1, 256), recover)


@pytest.mark.parametrize(("finished", "step"), [(True, 17), (False, 7)])
def test_no_byte_of_a_log_is_so_dear_that_its_change_takes_other_chunks_along(
    small, recover, finished, step
):
    data, records = small
    if not finished:
        data = unfinished(data, records)
    for place in range(0, len(data), step):
        outcome(data, records, place, 1 << place % 8, recover)


def test_a_wrong_head_of_a_chunk_loses_nothing(log, recover):
    data, records = log
    chunk = chunks_of(records)[4]
    for place in [0, *range(1, 9), *range(9, 25)]:  # opcode, length, times
        result = recover(flipped(data, chunk.start + place, mask=0x21))
        assert result.messages == messages_of(records), place
        assert [d.start for d in result.recovery.damages] == [chunk.start]
        assert result.recovery.lossless


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("kind", ["zeros", "noise", "removed", "inserted", "repeated"])
def test_pages_that_are_lost_take_no_other_chunk_with_them(log, recover, seed, kind):
    data, records = log
    rng = random.Random(seed)
    start = rng.randrange(3000, len(data) - 40_000)
    length = rng.choice([512, 4096, 65_536])
    end = min(start + length, len(data) - 20_000)
    noise = rng.randbytes(end - start)
    middle = {"zeros": bytes(end - start), "noise": noise, "removed": b""}
    middle |= {"inserted": noise + data[start:end], "repeated": data[start:end] * 2}
    result = recover(data[:start] + middle[kind] + data[end:])
    if kind == "inserted":
        end = start
    untouched = [r for r in records if r.end <= start or r.start >= end]
    saved = set(result.messages)
    assert saved <= set(messages_of(records))
    assert set(messages_of(untouched)) <= saved
    if len(saved) < len(messages_of(records)):
        assert result.some_lost


def test_what_was_lost_is_said_with_its_place_its_times_and_its_topics(log, recover):
    data, records = log
    chunk = chunks_of(records)[3]
    damaged = flipped(data, chunk.end - 100)
    times = [m[1] for m in chunk.messages]
    topics = [m[0] for m in chunk.messages]
    for left in (damaged, unfinished(damaged, records)):
        (damage,) = recover(left).recovery.damages
        assert (damage.start, damage.end) == (chunk.start, chunk.end)
        assert damage.times == (min(times), max(times))
        assert damage.messages == {topic: topics.count(topic) for topic in topics}
        assert damage.exact
        assert not damage.cut
        text = str(damage)
        assert text.startswith(f"damaged at byte {chunk.start} (a chunk ")
        assert f"{topics.count('/mic/features')} of /mic/features" in text


def cut_out(data, records, number, *, indexes):
    """Leave out a chunk, with or without its message indexes; return also what was in it."""
    chunk = chunks_of(records)[number]
    end = chunk.end
    for record in records:
        if indexes and record.start == end and record.opcode == INDEX:
            end = record.end
    return data[: chunk.start] + data[end:], chunk


@pytest.mark.parametrize("indexes", [False, True], ids=["alone", "with indexes"])
@pytest.mark.parametrize("number", [0, 1, 3, -1])
def test_a_chunk_that_is_cut_out_is_missed_by_the_index(log, recover, number, indexes):
    data, records = log
    left, chunk = cut_out(data, records, number, indexes=indexes)
    result = recover(left)
    assert result.messages == messages_of(records, without=chunk.start)
    (damage,) = [d for d in result.recovery.damages if not d.lossless]
    topics, times = ([message[i] for message in chunk.messages] for i in range(2))
    assert damage.messages == {topic: topics.count(topic) for topic in topics}
    assert damage.times == (min(times), max(times))
    assert damage.start <= chunk.start <= damage.end
    assert damage.exact


def test_chunks_that_are_cut_out_are_missed_by_what_is_left_of_an_index(log, recover):
    data, records = log
    uncounted = data[: [r for r in records if r.opcode == METADATA][-1].start]
    left, chunk = cut_out(uncounted, records, 3, indexes=False)
    (damage,) = recover(left).recovery.damages  # the message indexes list its messages
    assert sum(damage.messages.values()) == len(chunk.messages)
    left, chunk = cut_out(unfinished(data, records), records, 3, indexes=True)
    (damage,) = recover(left).recovery.damages  # the record for rosbag2 counts them
    assert sum(damage.messages.values()) == len(chunk.messages)


def test_chunks_that_stand_elsewhere_or_twice_are_no_loss(log, recover):
    data, records = log
    first, second, third = chunks_of(records)[1:4]
    swapped = data[: first.start] + data[second.start : third.start]
    swapped += data[first.start : second.start] + data[third.start :]
    result = recover(swapped)
    assert sorted(result.messages) == sorted(messages_of(records))
    assert result.recovery.lossless
    twice = data[: second.start] + data[first.start : second.start] + data[second.start :]
    result = recover(twice)
    assert len(result.messages) == len(messages_of(records)) + len(first.messages)
    assert result.recovery.lossless


def test_frames_behind_the_end_are_saved_and_said_to_be_out_of_place(log, recover):
    data, records = log
    moved = chunks_of(records)[4]
    result = recover(data[: moved.start] + data[moved.end :] + data[moved.start : moved.end])
    assert sorted(result.messages) == sorted(messages_of(records))
    assert all(damage.lossless for damage in result.recovery.damages)
    assert result.recovery.losses == [
        "frames are missing, or lie elsewhere in the log: see its gaps"
    ]
    assert not result.recovery.lossless


def test_a_chunk_without_a_checksum_whose_times_are_not_those_of_its_head_is_no_proof(recover):
    data, messages = written(CompressionType.NONE, crcs=False)
    _, time, payload = messages[0]
    assert recover(data).recovery.lossless
    times = data.index(struct.pack("<QQ", time, 0) + payload)  # of the first message
    result = recover(data[:times] + bytes(8) + data[times + 8 :])
    assert len(result.messages) == len(messages)
    (loss,) = result.recovery.losses
    assert "the head of a chunk is wrong" in loss


def test_a_metadata_record_or_an_attachment_that_is_cut_out_is_missed(log, recover):
    data, records = log
    for opcode, name in ((METADATA, "the metadata 'hearthlog'"), (ATTACHMENT, "the attachment")):
        record = next(r for r in records if r.opcode == opcode)
        (damage,) = recover(data[: record.start] + data[record.end :]).recovery.damages
        assert damage.others[0].startswith(name)


def test_messages_without_an_index_behind_their_chunk_are_lost_in_unknown_number(log, recover):
    data, records = log
    chunk, behind = next(
        (a, b) for a, b in pairwise(records) if a.opcode == CHUNK and a.start > 50_000
    )
    assert behind.opcode == INDEX
    damaged = flipped(flipped(data, chunk.end - 100), behind.start, mask=0x80)
    result = recover(unfinished(damaged, records))
    assert not result.exact
    text = str(result.recovery.damages[0])
    assert "perhaps more" in text or "unknown number" in text


@pytest.mark.parametrize("left", range(1, 10))
def test_a_damaged_chunk_of_a_file_cut_in_the_head_of_the_next_record(log, recover, left):
    data, records = log
    chunk, behind = chunks_of(records)[1:3]
    result = recover(flipped(data[: behind.start + left], chunk.end - 100))
    assert result.messages == messages_of(records[: records.index(chunk)])
    assert result.some_lost


@pytest.mark.parametrize("left", [9, 26, 30])
def test_a_chunk_of_which_only_a_few_bytes_are_left_is_missed(log, recover, left):
    data, records = log
    chunks = chunks_of(records)
    gone = chunks[len(chunks) // 2]
    behind = next(record.start for record in chunks if record.start > gone.start)
    recovery, _ = recover(data[: gone.start + left] + unfinished(data, records)[behind:])
    # What is left may claim to end within the chunk behind, whose bytes are damaged then, too.
    assert {damage.exact for damage in recovery.damages if not damage.cut} == {False}


def test_messages_whose_channel_nothing_defines_are_counted(log, recover):
    data, records = log
    damaged = flipped(data, chunks_of(records)[0].end - 50)
    result = recover(unfinished(damaged, records))
    assert result.messages == []
    assert result.lost == len(messages_of(records))
    assert any("nothing that is left says what channel" in str(d) for d in result.recovery.damages)


def test_definitions_that_come_too_late_are_used_all_the_same(recover):
    stream = io.BytesIO()
    writer = Writer(stream, chunk_size=50)
    writer.start("ros2", "test")
    schema = writer.register_schema("a/msg/B", "ros2msg", b"int32 a")
    first = writer.register_channel("/first", "cdr", schema)
    for number in range(3):
        writer.add_message(first, number, bytes(40), number)
    second = writer.register_channel("/second", "cdr", schema)
    for number in range(3, 6):
        writer.add_message(second, number, bytes(40), number)
    writer.finish()
    data = stream.getvalue()
    records = structure(data)
    defining = chunks_of(records)[0]
    result = recover(flipped(data, defining.end - 1, -20))  # -20: of the checksum of the index
    assert result.messages == messages_of(records, without=defining.start)


def test_a_file_whose_header_is_lost_is_still_of_ros_2(small, recover, tmp_path):
    data, records = small
    damaged = flipped(data, 10, mask=0xFF)
    for left in (damaged, unfinished(damaged, records)):
        assert recover(left).messages == messages_of(records)
        with (tmp_path / "copy.mcap").open("rb") as stream:
            assert make_reader(stream).get_header().profile == "ros2"


def test_a_log_of_which_the_beginning_is_missing(log, recover):
    data, records = log
    chunk = chunks_of(records)[3]
    result = recover(data[chunk.start + 11 :])
    assert result.messages == messages_of([r for r in records if r.start > chunk.start])


def test_two_logs_in_one_file_are_not_mixed_up(small, recover, tmp_path):
    data, records = small
    writer = LogWriter(tmp_path / "other.mcap", [Topic("/b", "std_msgs/msg/Header")], {})
    writer.write("/b", 5, b"other")
    writer.flush()
    other = writer.finish().read_bytes()
    result = recover(data + other)
    assert set(result.messages) <= {*messages_of(records), ("/b", 5, b"other")}
    assert len(result.messages) + result.lost == len(messages_of(records)) + 1


def test_an_attachment_is_saved_only_if_it_has_its_checksum(small, recover, tmp_path):
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start()
    writer.add_attachment(1, 1, "first", "text/plain", b"one" * 99)
    writer.add_attachment(1, 1, "inner", "application/mcap", small[0])
    writer.add_attachment(1, 1, "third", "text/plain", b"three" * 99)
    writer.finish()
    data = stream.getvalue()
    result = recover(flipped(data, data.index(b"one") + 7, data.index(small[0]) + 40))
    assert result.messages == []  # those of the file that was attached are not ours
    assert [damage.others for damage in result.recovery.damages] == [
        ("the attachment 'first'",),
        ("the attachment 'inner'",),
    ]
    assert LogReader(tmp_path / "copy.mcap").attachments == {"third": b"three" * 99}


def written(compression, *, chunked=True, indexed=True, crcs=True):
    stream = io.BytesIO()
    writer = Writer(
        stream,
        chunk_size=2000,
        compression=compression,
        use_chunking=chunked,
        index_types=IndexType.ALL if indexed else IndexType.NONE,
        enable_crcs=crcs,
    )
    writer.start("", "test")
    schema = writer.register_schema("thing", "jsonschema", b"{}")
    channels = [writer.register_channel(f"/t{n}", "json", schema) for n in range(3)]
    rng = np.random.default_rng(0)
    for number in range(300):
        data = rng.bytes(number % 90) + b"text" * (number % 7)
        writer.add_message(channels[number % 3], 10_000 + number, data, number, number)
    writer.add_metadata("about", {"a": "b"})
    writer.finish()
    data = stream.getvalue()
    stream.seek(0)
    found = make_reader(stream).iter_messages(log_time_order=False)
    return data, [(c.topic, m.log_time, m.data) for _, c, m in found]


FORMS = {
    "lz4": {"compression": CompressionType.LZ4},
    "zstd": {"compression": CompressionType.ZSTD},
    "uncompressed": {"compression": CompressionType.NONE},
    "unindexed": {"compression": CompressionType.ZSTD, "indexed": False},
}


@pytest.mark.parametrize("form", FORMS)
def test_files_of_other_writers_are_recovered_in_the_same_way(recover, form):
    data, everything = written(**FORMS[form])
    records = structure(data)
    assert messages_of(records) == everything
    full = recover(data)
    assert (full.messages, full.recovery.damages) == (everything, [])
    rng = random.Random(form)
    for _ in range(20):
        place = rng.randrange(len(data))
        result = recover(data[:place])
        expected = messages_of([r for r in records if r.end <= place])
        assert (result.messages if result else []) == expected, place
        result = recover(flipped(data, place, mask=1 << rng.randrange(8)))
        kept = messages_of(records, without=place)
        assert result.messages in (kept, everything), place
        assert len(result.messages) == len(everything) or result.some_lost, place


@pytest.mark.parametrize("form", ["lz4", "zstd", "uncompressed"])
def test_a_chunk_behind_an_index_or_metadata_that_lost_bytes_is_saved(recover, form):
    data, everything = written(**FORMS[form])
    records = [r for r in structure(data) if r.opcode in {INDEX, METADATA}]
    rng = random.Random(form)
    for _ in range(25):
        record = rng.choice(records)
        place = rng.randrange(record.start, record.end)
        end = min(place + rng.randrange(1, 40), record.end)
        assert recover(data[:place] + data[end:]).messages == everything, (place, end)


def test_messages_outside_of_chunks_are_saved_up_to_a_wrong_length_and_from_there_on(recover):
    data, everything = written(CompressionType.NONE, chunked=False)
    records = [r for r in structure(data) if r.opcode == MESSAGE]
    assert recover(data).messages == everything
    rng = random.Random(0)
    for _ in range(60):
        number = rng.randrange(len(records))
        place = records[number].start + rng.randrange(9)
        result = recover(flipped(data, place, mask=1 << rng.randrange(8)))
        others = everything[: max(number - 1, 0)] + everything[number + 1 :]
        assert [m for m in result.messages if m in others] == others, number
        assert set(result.messages) <= set(everything), number
        assert len(result.messages) == len(everything) or result.some_lost, number


@pytest.mark.parametrize("mode", ["none", "storage"])
def test_a_bag_of_rosbags(recover, tmp_path, mode):
    store = get_typestore(Stores.ROS2_HUMBLE)
    kind = "std_msgs/msg/Int32"
    writer = RosbagWriter(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP)
    if mode == "storage":
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/number", kind, typestore=store)
        for number in range(500):
            data = store.serialize_cdr(store.types[kind](number), kind)
            writer.write(connection, 1000 + number, bytes(data))
    (path,) = (tmp_path / "bag").glob("*.mcap")
    data = path.read_bytes()
    full = recover(data)
    assert len(full.messages) == 500
    assert full.recovery.damages == []
    assert recover(data[:-300]).messages == full.messages
    if mode == "none":
        assert recover(data[: len(data) // 2]) is None  # it was one chunk


# Files that lie.


def record(opcode, content, length=None):
    return struct.pack("<BQ", opcode, len(content) if length is None else length) + content


def chunk(inner, compression=b"zstd", *, packed=None, size=None, crc=None):
    packed = zstandard.compress(inner) if packed is None else packed
    crc = zlib.crc32(inner) if crc is None else crc
    size = len(inner) if size is None else size
    head = struct.pack("<QQQII", 1, 2, size, crc, len(compression)) + compression
    content = head + struct.pack("<Q", len(packed)) + packed
    return record(CHUNK, content)


def claiming(length, data):
    return data[:1] + struct.pack("<Q", length) + data[9:]


def message(channel=1, time=1, data=b"data"):
    return record(MESSAGE, struct.pack("<HIQQ", channel, 0, time, time) + data)


def text(value):
    return struct.pack("<I", len(value)) + value


DEFINITIONS = record(3, struct.pack("<H", 1) + text(b"n") + text(b"e") + text(b"d")) + record(
    4, struct.pack("<HH", 1, 1) + text(b"/topic") + text(b"cdr") + text(b"")
)
START = MAGIC + record(HEADER, text(b"") + text(b""))
GOOD = chunk(DEFINITIONS + message(data=b"good"))
HUGE = 1 << 63


def bomb(size):
    frame = zstandard.ZstdCompressor().compress(bytes(size))
    return chunk(b"", packed=frame, size=size, crc=1)


LIES = {
    "chunk lengths": lambda: claiming(HUGE, chunk(b"x")) + chunk(b"x", size=HUGE),
    "stored length": lambda: record(
        CHUNK, struct.pack("<QQQII4sQ", 1, 2, 9, 1, 4, b"zstd", HUGE) + b"xx"
    ),
    "chunk that has the file": lambda: record(CHUNK, bytes(40), 10_000_000),
    "metadata": lambda: record(METADATA, text(b"a") + struct.pack("<I", 1 << 31) + b"x"),
    "attachment": lambda: record(ATTACHMENT, bytes(16) + text(b"a") * 2 + struct.pack("<Q", HUGE)),
    "schema": lambda: record(3, b"\1\0" + struct.pack("<I", (1 << 32) - 1) + b"xx" * 20),
    "message index": lambda: record(INDEX, b"\1\0" + struct.pack("<I", (1 << 32) - 16)),
    "zstd bomb": lambda: bomb(90 << 20) * 20,
    "zstd bomb beyond the limit": lambda: bomb(300 << 20),
    "zstd without a size": lambda: chunk(
        b"",
        packed=zstandard.ZstdCompressor(write_content_size=False).compress(bytes(9 << 20)),
        size=50,
    ),
    "zstd that claims more than its chunk": lambda: chunk(
        b"", packed=zstandard.ZstdCompressor().compress(bytes(300 << 20)), size=50
    ),
    "lz4 bomb": lambda: chunk(
        b"", b"lz4", packed=lz4.frame.compress(bytes(300 << 20)), size=60 << 20
    ),
    "lz4 that claims less": lambda: chunk(
        b"", b"lz4", packed=lz4.frame.compress(bytes(90 << 20)), size=9
    ),
    "unknown compression": lambda: chunk(b"x", b"brotli"),
    "records in a chunk": lambda: chunk(record(MESSAGE, b"x", HUGE)) + chunk(record(MESSAGE, b"")),
    "a chunk in a chunk": lambda: chunk(GOOD, b"", packed=GOOD),
    "times": lambda: chunk(message(time=(1 << 64) - 1)),
    "nested chunks": lambda: b"".join(
        claiming(40 + (1 << 20), chunk(b"", b"", packed=bytes(8), size=1 << 20))[:-8]
        for _ in range(20_000)
    ),
    "nested stored chunks": lambda: b"".join(
        record(CHUNK, struct.pack("<QQQIIQ", 1, 2, n := (20_000 - i) * 49, 1, 0, n), 40 + n)
        for i in range(20_000)
    ),
    "messages that are none": lambda: struct.pack("<BQ", MESSAGE, 22) * 50_000,
    "chained messages": lambda: message(channel=9) * 20_000,
    "empty records": lambda: bytes(1 << 20),
    "ones": lambda: b"\1" * (1 << 20),
    "indexes": lambda: record(INDEX, struct.pack("<HI", 1, 0)) * 20_000,
    "channels": lambda: b"".join(
        record(4, struct.pack("<HH", n % 65536, 0) + text(b"/t") + text(b"") * 2)
        for n in range(2, 20_000)
    ),
    "definitions that would not fit": lambda: b"".join(
        chunk(record(3, struct.pack("<H", n) + text(b"n") + text(b"e") + text(bytes(60 << 20))))
        for n in range(2, 6)
    ),
    "many small messages": lambda: chunk(message(data=b"") * 3_000_000) * 3,
    "a large message": lambda: message(data=bytes(90 << 20)),
    "a large attachment": lambda: record(
        ATTACHMENT, bytes(16) + text(b"a") * 2 + struct.pack("<Q", 90 << 20) + bytes((90 << 20) + 4)
    ),
    "a large chunk": lambda: chunk(big := message(data=bytes(99 << 20)), b"", packed=big),
    "footers": lambda: record(2, struct.pack("<QQI", 8, 0, 0)) * 1000,
}
CHECK = """
import os, resource, sys
from pathlib import Path
from hearthlog.schemas.salvage.recover import recover_log
for line in sys.stdin:
    if not os.fork():
        resource.setrlimit(resource.RLIMIT_AS, (1 << 30, 1 << 30))
        recovery = recover_log(*map(Path, line.split()), "copy.mcap")
        most = next(l for l in open("/proc/self/status") if l.startswith("VmHWM")).split()[1]
        print(recovery.messages, int(most) >> 10, flush=True)
        os._exit(0)
    if os.wait()[1]:
        break
"""


@pytest.fixture(scope="module")
def checker():
    """A process that recovers in forks of itself, so that each has memory of its own."""
    environment = {"OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": str(Path(__file__).parents[1])}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", CHECK], env=environment, **pipes) as process:
        yield process
        process.stdin.close()


@pytest.mark.parametrize("lie", LIES)
def test_whatever_a_file_claims_memory_is_bounded_and_what_follows_is_saved(tmp_path, checker, lie):
    source, copy = tmp_path / "source.mcap", tmp_path / "copy.mcap"
    last = chunk(message(data=b"last") * 2)
    source.write_bytes(START + GOOD + LIES[lie]() + last)
    checker.stdin.write(f"{source} {copy}\n")
    checker.stdin.flush()
    messages, megabytes = map(int, checker.stdout.readline().split())
    assert messages >= 3
    assert megabytes < 500


def test_a_file_of_beginnings_is_not_read_again_and_again(tmp_path, monkeypatch):
    source = tmp_path / "source.mcap"
    source.write_bytes(START * 4000)
    passed, read = 0, LocalFile.read

    def count(file, offset, length):
        nonlocal passed
        data = read(file, offset, length)
        passed += len(data)
        return data

    monkeypatch.setattr(LocalFile, "read", count)
    with pytest.raises(NothingIntactError):
        recover_log(source, tmp_path / "copy.mcap", "copy.mcap")
    assert passed < 100 * source.stat().st_size


# The command.


def test_the_command_writes_a_log_beside_the_damaged_one_and_says_what_is_lost(
    log, hearthlog, tmp_path
):
    data, records = log
    lost = chunks_of(records)[2]
    damaged = flipped(data, lost.end - 9)
    path = tmp_path / "a.mcap"
    path.write_bytes(damaged)
    result = hearthlog("recover", path)
    new = tmp_path / "a.recovered.mcap"
    assert (result.returncode, result.stdout) == (3, f"{new}\n")
    saved, loss = result.stderr.splitlines()
    total = len(messages_of(records))
    assert saved == f"hearthlog: {path}: {total - len(lost.messages)} of {total} messages saved"
    assert loss.startswith(f"hearthlog: {path}: damaged at byte {lost.start} (")
    assert path.read_bytes() == damaged
    about = hearthlog("info", new)
    assert (about.returncode, about.stderr) == (3, "")  # it has a gap
    again = hearthlog("recover", path)
    assert again.returncode == 1
    assert again.stderr.startswith(f"hearthlog: {new}: exists already")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.mcap", "a.recovered.mcap"]


def test_the_command_prints_json(log, hearthlog, tmp_path):
    data, records = log
    cut = chunks_of(records)[5].start + 1000
    path = tmp_path / "a.mcap.active"
    path.write_bytes(data[:cut])
    result = hearthlog("recover", path, "--json", "-o", tmp_path / "b.mcap")
    assert result.returncode == 3
    (report,) = json.loads(result.stdout)
    assert report["recovered"] == str(tmp_path / "b.mcap")
    assert report["topics"]["/mic/features"]["messages"] == sum(
        m[0] == "/mic/features" for m in messages_of([r for r in records if r.end <= cut])
    )
    (damage,) = report["damages"]
    assert damage["cut"]
    assert not damage["exact"]
    assert (damage["start_byte"], damage["end_byte"]) == (cut - 1000, cut)


def test_a_log_that_only_lacks_its_end_loses_nothing(log, hearthlog, tmp_path):
    data, records = log
    path = tmp_path / "a.mcap"
    path.write_bytes(data[: len(unfinished(data, records)) + 40])
    result = hearthlog("recover", path, "--in-place")
    assert (result.returncode, result.stdout) == (0, f"{path}\n")
    assert "the log had no end" in result.stderr
    assert (tmp_path / "a.mcap.damaged").stat().st_size < path.stat().st_size
    assert hearthlog("recover", path, "--in-place").returncode == 1  # there is an original


def test_a_whole_log_is_recovered_to_the_same_messages_and_records(log, recover, tmp_path):
    data, records = log
    result = recover(data)
    assert result.recovery.damages == []
    copy = (tmp_path / "copy.mcap").read_bytes()
    chunks = [
        [d[r.start : r.end] for r in f if r.opcode in {CHUNK, INDEX}]
        for d, f in ((data, records), (copy, structure(copy)))
    ]
    assert chunks[0] == chunks[1]
    original = LogReader(tmp_path / "source.mcap")
    again = LogReader(tmp_path / "copy.mcap")
    assert again.attachments == original.attachments
    about = [json.loads(r.metadata["rosbag2"]["serialized_metadata"]) for r in (original, again)]
    assert about[0]["topics_with_message_count"] == about[1]["topics_with_message_count"]
    assert about[1]["relative_file_paths"] == ["copy.mcap"]


@pytest.mark.parametrize("content", [b"", b"RIFF", b"x" * 9999, MAGIC, bytes(5000)])
def test_what_is_no_log_is_refused_and_nothing_is_written(hearthlog, tmp_path, content):
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    for option in ([], ["--in-place"]):
        result = hearthlog("recover", path, *option)
        assert (result.returncode, result.stdout) == (1, "")
        assert result.stderr.startswith(f"hearthlog: {path}: ")
        assert result.stderr.count("\n") == 1
        assert [p.name for p in tmp_path.iterdir()] == ["a.mcap"]


def test_of_several_logs_each_is_recovered_on_its_own(small, hearthlog, tmp_path):
    (tmp_path / "a.mcap").write_bytes(small[0])
    (tmp_path / "b.mcap").write_bytes(b"none")
    (tmp_path / "c.mcap").write_bytes(small[0][:-100])
    paths = [tmp_path / f"{name}.mcap" for name in "abc"]
    result = hearthlog("recover", *paths)
    assert result.returncode == 1
    assert f"{paths[1]}: is not an MCAP file" in result.stderr
    assert len(result.stdout.splitlines()) == 2
    assert hearthlog("recover", *paths, "-o", tmp_path / "x.mcap").returncode == 2


def test_a_log_that_is_being_written_keeps_its_place(hearthlog, tmp_path):
    writer = LogWriter(tmp_path / "a.mcap", [Topic("/a", "std_msgs/msg/Header")], {})
    writer.write("/a", 1, b"data")
    writer.flush()
    result = hearthlog("recover", writer.active_path, "--in-place")
    assert result.returncode == 1
    assert "is being written" in result.stderr
    assert hearthlog("recover", writer.active_path).returncode == 0
    writer.finish()


def test_an_abandoned_log_gets_its_name_in_place(small, hearthlog, tmp_path):
    path = tmp_path / "a.mcap.active"
    path.write_bytes(small[0][:-200])
    assert hearthlog("recover", path, "--in-place").stdout == f"{tmp_path / 'a.mcap'}\n"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.mcap", "a.mcap.damaged"]


def test_a_length_that_swallows_the_records_behind_it_is_no_padding(small, recover):
    data, records = small
    swallowed = 0
    for record, *behind in zip(records, records[1:], records[2:], records[3:], strict=False):
        if record.opcode == CHUNK or record.start > max(r.start for r in records if r.messages):
            continue
        for end in [r.end for r in behind]:
            damaged = bytearray(data)
            struct.pack_into("<Q", damaged, record.start + 1, end - record.start - 9)
            for ending in (bytes(damaged), bytes(damaged[: records[-3].start])):  # and unfinished
                assert recover(ending).messages == messages_of(records), (record, end)
            swallowed += 1
    assert swallowed > 10
