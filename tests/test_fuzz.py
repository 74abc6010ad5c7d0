"""Whatever a file holds, who reads it gets data or one clear error, soon and in little memory."""

import struct
import zlib
from threading import Event as Flag

import lz4.frame
import numpy as np
import pytest
import soundfile
import zstandard
from fuzzing import Victim
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from lossy_source import LossySource
from mcap.opcode import Opcode
from mcap.records import Chunk
from rewriting import HEAD, Raw, as_raw, joined, parsed, split

from hearthlog.recorder.config import Settings
from hearthlog.recorder.recording import record
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.schemas.errors import HearthlogWarning
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import read_columns

START = 1_772_348_400 * NANOSECONDS
NUMBERS = st.one_of(
    st.sampled_from([0, 1, 21, 22, 255, 1 << 16, (1 << 31) - 1, (1 << 32) - 1]),
    st.sampled_from([(1 << 63) - 1, 1 << 63, (1 << 64) - 1]),
    st.integers(0, (1 << 64) - 1),
    st.integers(0, 1 << 20),
)
PLACES = st.integers(0, 1 << 24)  # taken modulo what there is


@pytest.fixture(scope="module")
def log(tmp_path_factory, day, model_file):
    """A real log of 30 seconds with a gap, in four chunks."""
    folder = tmp_path_factory.mktemp("log")
    samples, rate = soundfile.read(day, frames=30 * 16_000, dtype="int16")
    soundfile.write(folder / "sound.wav", samples, rate)
    source = LossySource(FileSource([folder / "sound.wav"], START), {1: 7})
    (path,) = record(Settings(output=folder, model=model_file), source, Flag()).logs
    return path


@pytest.fixture(scope="module")
def victim(tmp_path_factory):
    victim = Victim(tmp_path_factory.mktemp("victim"))
    yield victim
    victim.close()


# Mutations of bytes: of a whole file, or of the content of a chunk.


def flip(data, place, bit):
    data[place % len(data)] ^= 1 << bit


def cut(data, place):
    del data[place % len(data) :]


def leave_out(data, place, length):
    start = place % len(data)
    del data[start : start + length]


def copy_block(data, place, length, to):
    start, to = place % len(data), to % len(data)
    data[to:to] = data[start : start + length]


def overwrite(data, place, length, to):
    start, to = place % len(data), to % len(data)
    block = data[start : start + length]
    data[to : to + len(block)] = block


def put_number(data, place, number, size):
    start = place % len(data)
    data[start : start + size] = (number % (1 << 8 * size)).to_bytes(size, "little")


LENGTHS = st.integers(0, 5000)
BYTES = st.one_of(
    st.tuples(st.just(flip), PLACES, st.integers(0, 7)),
    st.tuples(st.just(cut), PLACES),
    st.tuples(st.just(leave_out), PLACES, LENGTHS),
    st.tuples(st.just(copy_block), PLACES, LENGTHS, PLACES),
    st.tuples(st.just(overwrite), PLACES, LENGTHS, PLACES),
    st.tuples(st.just(put_number), PLACES, NUMBERS, st.sampled_from([1, 2, 4, 8])),
)


def of_bytes(data, mutations):
    for mutation, *arguments in mutations:
        if data:
            mutation(data, *arguments)


# Mutations of records: of the file, or inside a chunk.


def drop(records, place):
    del records[place % len(records)]


def double(records, place, to):
    records.insert(to % len(records), records[place % len(records)])


def swap(records, place, to):
    place, to = place % len(records), to % len(records)
    records[place], records[to] = records[to], records[place]


def change(records, place, mutations):
    """Change the content of a record, and its length with it."""
    raw = records[place % len(records)]
    content = bytearray(raw.content)
    of_bytes(content, mutations)
    records[place % len(records)] = Raw(raw.opcode, bytes(content))


def start_of(records, place, at, number, size):
    """Change a number in the first bytes of a record, where its fields are."""
    change(records, place, [(put_number, at, number, size)])


def rename(records, place, opcode):
    records[place % len(records)] = Raw(opcode, records[place % len(records)].content)


RECORDS = st.one_of(
    st.tuples(st.just(drop), PLACES),
    st.tuples(st.just(double), PLACES, PLACES),
    st.tuples(st.just(swap), PLACES, PLACES),
    st.tuples(st.just(change), PLACES, st.lists(BYTES, min_size=1, max_size=3)),
    st.tuples(
        st.just(start_of), PLACES, st.integers(0, 60), NUMBERS, st.sampled_from([1, 2, 4, 8])
    ),
    st.tuples(st.just(rename), PLACES, st.integers(0, 255)),
)


def of_records(records, mutations):
    for mutation, *arguments in mutations:
        if records:
            mutation(records, *arguments)


# Mutations of what is inside a chunk, which is compressed again with the right checksum.

COMPRESS = {"zstd": zstandard.compress, "lz4": lz4.frame.compress, "": bytes}


def chunk_content(records, place, mutations, compression):
    _in_chunk(records, place, lambda content: of_bytes(content, mutations), compression)


def chunk_records(records, place, mutations, compression):
    def mutate(content):
        inner, start = [], 0
        while start + HEAD.size <= len(content):
            opcode, length = HEAD.unpack_from(content, start)
            inner.append(Raw(opcode, bytes(content[start + HEAD.size :][:length])))
            start += HEAD.size + length
        of_records(inner, mutations)
        content[:] = joined(inner, ends=False)

    _in_chunk(records, place, mutate, compression)


def _in_chunk(records, place, mutate, compression):
    chunks = [i for i, raw in enumerate(records) if raw.opcode == Opcode.CHUNK]
    if not chunks:
        return
    number = chunks[place % len(chunks)]
    try:
        chunk = parsed(records[number], Chunk)
        content = bytearray(zstandard.decompress(chunk.data, max_output_size=1 << 22))
    except Exception:  # noqa: BLE001 - another mutation has been here before
        return
    mutate(content)
    chunk.data = COMPRESS[compression](bytes(content))
    chunk.compression = compression
    chunk.uncompressed_size = len(content)
    chunk.uncompressed_crc = zlib.crc32(content)
    records[number] = as_raw(chunk)


COMPRESSIONS = st.sampled_from([*COMPRESS])
CHUNKS = st.one_of(
    st.tuples(
        st.just(chunk_content), PLACES, st.lists(BYTES, min_size=1, max_size=3), COMPRESSIONS
    ),
    st.tuples(
        st.just(chunk_records), PLACES, st.lists(RECORDS, min_size=1, max_size=3), COMPRESSIONS
    ),
)

DAMAGED_END = b"\0\0\0\1\x89MCAP0\r\n"  # another checksum of the summary
NAMES = st.sampled_from(["home_20260301T070000Z.mcap", "home_20260301T070000Z.mcap.active"])
FEW = settings(
    max_examples=40,
    deadline=None,
    database=None,
    print_blob=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


@FEW
@given(mutations=st.lists(BYTES, min_size=1, max_size=5), name=NAMES)
def test_a_file_whose_bytes_were_changed(log, victim, mutations, name):
    data = bytearray(log.read_bytes())
    of_bytes(data, mutations)
    assert not victim.read(bytes(data), name)


@FEW
@given(mutations=st.lists(RECORDS, min_size=1, max_size=5), name=NAMES)
def test_a_file_whose_records_were_changed(log, victim, mutations, name):
    records = split(log.read_bytes())
    of_records(records, mutations)
    assert not victim.read(_written(records), name)


@example(
    mutations=[(chunk_records, 0, [(double, 16, 0)], "zstd")], name="home_20260301T070000Z.mcap"
)
@FEW
@given(mutations=st.lists(CHUNKS, min_size=1, max_size=3), name=NAMES)
def test_a_file_whose_chunks_were_changed_and_have_the_right_checksum(log, victim, mutations, name):
    records = split(log.read_bytes())
    of_records(records, mutations)
    assert not victim.read(_written(records), name)


@FEW
@given(place=PLACES, length=NUMBERS, name=NAMES)
def test_a_file_with_a_record_that_lies_about_its_length(log, victim, place, length, name):
    records, data = split(log.read_bytes()), bytearray(log.read_bytes())
    start = 8
    for raw in records[: place % len(records)]:
        start += HEAD.size + len(raw.content)
    struct.pack_into("<Q", data, start + 1, length)
    assert not victim.read(bytes(data), name)


@FEW
@given(tail=st.lists(BYTES, max_size=2), content=st.binary(max_size=300), name=NAMES)
def test_a_file_that_consists_of_anything(log, victim, tail, content, name):
    data = log.read_bytes()
    data = bytearray(data[:8] + content + data[-3000:])
    of_bytes(data, tail)
    assert not victim.read(bytes(data), name)


# What such mutations have brought to light, one by one.


def test_the_name_of_a_compression_that_is_no_text(log, victim):
    records = split(log.read_bytes())
    for raw in records:
        if raw.opcode == Opcode.CHUNK:
            content = bytearray(raw.content)
            content[content.index(b"zstd") + 2] = 0xFF
            raw.content = bytes(content)
            break
    assert not victim.read(joined(records), log.name)


@pytest.mark.parametrize("written", [joined, lambda records: joined(records)[:-12] + DAMAGED_END])
def test_a_size_in_the_index_that_is_too_large_for_a_number(log, victim, tmp_path, written):
    records = split(log.read_bytes())
    for raw in records:
        if raw.opcode == Opcode.CHUNK_INDEX:
            raw.content = raw.content[:-1] + b"\xff"
    data = written(records)
    assert not victim.read(data, log.name)
    damaged = tmp_path / log.name
    damaged.write_bytes(data)
    with pytest.warns(HearthlogWarning, match="its index is damaged"):
        read = read_columns([damaged])
    for topic, columns in read_columns([log]).items():
        np.testing.assert_array_equal(read[topic].log_times, columns.log_times)


@pytest.mark.parametrize("length", [(1 << 63) - 1, 1 << 63, (1 << 64) - 1])
def test_a_message_that_claims_to_be_longer_than_a_number_can_say(log, victim, length):
    def mutate(content):
        start = 0
        while content[start] != Opcode.MESSAGE:
            start += HEAD.size + HEAD.unpack_from(content, start)[1]
        struct.pack_into("<Q", content, start + 1, length)

    records = split(log.read_bytes())
    _in_chunk(records, 1, mutate, "zstd")
    assert not victim.read(joined(records), log.name)


def test_a_group_of_the_summary_that_holds_other_records_with_bad_texts(log, victim):
    records = split(log.read_bytes())
    offsets = {raw.content[0]: raw for raw in records if raw.opcode == Opcode.SUMMARY_OFFSET}
    channels, statistics = offsets[Opcode.CHANNEL], offsets[Opcode.STATISTICS]
    statistics.content = statistics.content[:1] + channels.content[1:]
    last = [raw for raw in records if raw.opcode == Opcode.CHANNEL][-1]
    last.content = last.content[:8] + b"\xff" + last.content[9:]
    assert not victim.read(_written(records), log.name)


def _written(records):
    """Put records together; the footer keeps its checksum only where it can be made anew."""
    try:
        return joined(records)
    except (struct.error, IndexError):  # there is no footer any more, or only a part of one
        body = b"".join(HEAD.pack(raw.opcode, len(raw.content)) + raw.content for raw in records)
        return b"\x89MCAP0\r\n" + body + b"\x89MCAP0\r\n"
