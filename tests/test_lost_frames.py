"""A recovered log has a gap where frames could not be saved, and the doctor finds it sound."""

import random
from itertools import pairwise
from threading import Event as Flag

import numpy as np
import pytest
import soundfile
from logreader import LogReader
from logs import features, read
from lossy_source import LossySource
from mcap.opcode import Opcode
from mcap.writer import Writer
from rewriting import HEAD, Chunked, Log, split

from hearthlog.analyzer.doctor.examination import examine
from hearthlog.models.features.installed import DEFAULT
from hearthlog.recorder.config import Settings
from hearthlog.recorder.events import Frames
from hearthlog.recorder.log.recovery import end_of_sound, recover_active
from hearthlog.recorder.recording import record
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.recorder.stream.pipeline import Pipeline
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS
from hearthlog.schemas.logs.files import find_logs
from hearthlog.schemas.logs.writer import LogWriter
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.message_types import LOG_DAMAGED, encode_gap, nanoseconds
from hearthlog.schemas.messages.topics import Topic, topics_of
from hearthlog.schemas.salvage.recover import NothingIntactError, recover_in_place, recover_log

START = 1_772_348_400 * NANOSECONDS  # a full hour
NAME = "home_20260301T070000Z.mcap"
FEATURES, LABELS = (
    Topic("/mic/features", message_types.FEATURES),
    Topic("/mic/label", message_types.LABEL),
)
FOUND = {("warning", "gap")}
BLOCK = 40  # frames of a chunk


class ShortBlocks:
    """A source in blocks as short as a microphone's, so that a log has many chunks."""

    def __init__(self, source):
        self.device = source.device
        self._source = source

    def events(self, stop):
        for event in self._source.events(stop):
            if not isinstance(event, Frames):
                yield event
                continue
            for first in range(0, len(event.stamps), BLOCK):
                part = slice(first, first + BLOCK)
                yield Frames(event.first + first, event.samples[part], event.stamps[part])


class Minute(FileSource):
    """A minute with 27 frames lost in its middle; what is read from files keeps its chunks."""

    def __init__(self, sound):
        super().__init__([sound], START)
        self._lossy = LossySource(ShortBlocks(FileSource([sound], START)), {15: 27})

    def events(self, stop):
        return self._lossy.events(stop)


@pytest.fixture(scope="module")
def sound(tmp_path_factory, day):
    path = tmp_path_factory.mktemp("sound") / "minute.wav"
    samples, rate = soundfile.read(day, frames=60 * 16_000, dtype="int16")
    soundfile.write(path, samples, rate)
    return path


def recorded(sound, folder, model, **settings):
    settings = Settings(output=folder, model=model, **settings)
    return record(settings, Minute(sound), Flag()).logs


@pytest.fixture(scope="module")
def log(tmp_path_factory, sound, model_file):
    (path,) = recorded(sound, tmp_path_factory.mktemp("logs"), model_file)
    return path


def places(data, opcode=Opcode.CHUNK):
    """Where the records of a kind begin and end."""
    records = split(data)
    edges = np.cumsum([8, *(HEAD.size + len(raw.content) for raw in records)]).tolist()
    return [
        edge for edge, raw in zip(pairwise(edges), records, strict=True) if raw.opcode == opcode
    ]


def broken(data, *chunks):
    """Change a byte of some chunks."""
    damaged, found = bytearray(data), places(data)
    for chunk in chunks:
        damaged[found[chunk][1] - 20] ^= 1
    return bytes(damaged)


@pytest.fixture
def recover(tmp_path):
    def run(data):
        source, copy = tmp_path / "source", tmp_path / NAME
        source.write_bytes(data)
        recover_log(source, copy, NAME)
        return copy

    return run


def found(path):
    return {kind for findings in examine(path) for kind in findings.counts}


def gaps(path, kind="gap"):
    """Start, end, lost frames and reason of the gaps."""
    rows = []
    for gap in read(path, kind):
        start = nanoseconds(gap.header.stamp)
        rows.append((start, start + nanoseconds(gap.duration), gap.frames_lost, gap.reason))
    return rows


def unexplained(path):
    """Frames that neither features nor gaps account for."""
    frames, _, _ = features(path)
    return frames[-1] + 1 - len(frames) - sum(lost for _, _, lost, _ in gaps(path))


def excerpt(log, path, topics, every=100):
    """Copy some topics of a log, in chunks of so many messages."""
    writer, names = LogWriter(path, topics, {}), {topic.name for topic in topics}
    chosen = [item for item in LogReader(log).messages() if item.topic in names]
    for number, item in enumerate(chosen, 1):
        writer.write(item.topic, item.log_time, item.data)
        if number % every == 0:
            writer.flush()
    writer.finish()
    return path.read_bytes()


def test_the_frames_of_a_lost_chunk_are_a_gap_and_all_other_chunks_are_copied(log, recover):
    data = log.read_bytes()
    path = recover(broken(data, 9))
    frames, stamps, _ = features(log)
    first = 8 * BLOCK  # the first chunk tells what is recorded
    expected = (stamps[first], stamps[first + BLOCK], BLOCK, LOG_DAMAGED)
    (gap,) = set(gaps(path)) - set(gaps(log))
    assert gap == expected
    assert set(frames) - set(features(path)[0]) == set(range(first, first + BLOCK))
    assert found(path) == FOUND
    chunks = [data[start:end] for start, end in places(data)]
    copied = path.read_bytes()
    assert [chunk in copied for chunk in chunks] == [i != 9 for i in range(len(chunks))]


def test_a_gap_stands_where_its_log_time_belongs_and_comes_in_the_topics_own_channel(log, recover):
    path = recover(broken(log.read_bytes(), 5, 6, 20))
    times = [item.log_time for item in LogReader(path).messages()]
    assert times == sorted(times)
    with LogFile(path) as file:
        assert [c.topic for c in file.channels.values()].count("/mic/gap") == 1
    assert [lost for _, _, lost, reason in gaps(path) if reason == LOG_DAMAGED] == [
        2 * BLOCK,
        BLOCK,
    ]


def test_only_behind_a_gap_that_says_so_does_the_doctor_expect_labels_to_go_on(log, recover):
    path = recover(broken(log.read_bytes(), 9))
    rewritten = Log(path)
    rewritten.change(rewritten.messages("/mic/gap")[0], reason="the sound card lost samples")
    assert ("error", "label-frames") in found(rewritten.write(path))


@pytest.mark.parametrize(
    "chunks", [(15,), (17,), (14, 15), (17, 18), (15, 17), (16,), (15, 16, 17)]
)
def test_frames_lost_beside_a_gap_that_was_saved_are_counted_but_once(log, recover, chunks):
    data = log.read_bytes()
    path = recover(broken(data, *chunks))
    assert unexplained(path) == 0
    assert found(path) == FOUND


def test_frames_lost_at_both_ends_are_stated_as_the_index_counts_them(log, recover):
    data = log.read_bytes()
    last = len(places(data)) - 2  # only the last segments come behind it
    path = recover(broken(data, 1, last))
    _, stamps, _ = features(log)
    beginning, _, end = gaps(path)
    assert beginning == (START, stamps[BLOCK], BLOCK, LOG_DAMAGED)
    assert end == (stamps[-BLOCK], stamps[-1] + FRAME_NANOSECONDS, BLOCK, LOG_DAMAGED)
    assert found(path) == FOUND


def test_frames_before_which_nothing_was_saved_are_stated_by_the_index_alone(log, recover):
    path = recover(broken(log.read_bytes(), 0, 1))
    _, stamps, _ = features(log)
    assert gaps(path)[0] == (START, stamps[BLOCK], BLOCK, LOG_DAMAGED)
    assert {rule for level, rule in found(path) if level == "error"} == {"info-first", "name"}


def test_a_segment_that_was_saved_tells_of_frames_lost_at_the_end(log, recover):
    data = log.read_bytes()
    chunks = places(data)
    (_, end), (closing, _) = chunks[-2:]
    data = data[:end] + bytes(closing - end) + data[closing : places(data, Opcode.DATA_END)[0][0]]
    path = recover(data[: end - 20] + bytes(20) + data[end:])
    _, stamps, _ = features(log)
    assert gaps(path)[-1] == (stamps[-BLOCK], stamps[-1] + FRAME_NANOSECONDS, BLOCK, LOG_DAMAGED)
    assert found(path) == FOUND


def test_a_lost_end_of_which_nothing_tells_is_no_gap(log, recover):
    data = log.read_bytes()
    path = recover(data[: places(data)[20][0] + 100])
    assert gaps(path) == gaps(log)[: len(gaps(path))]


@pytest.mark.parametrize("topic", [FEATURES, LABELS], ids=["features", "labels"])
def test_of_a_log_without_gaps_only_what_was_damaged_becomes_one(log, recover, tmp_path, topic):
    data = excerpt(log, tmp_path / "excerpt.mcap", [topic])
    chunk = 4
    path = recover(broken(data, chunk))
    ((start, end, lost, reason),) = gaps(path)
    assert (lost, reason) == (100, LOG_DAMAGED)
    frames = read(tmp_path / "excerpt.mcap", topic.name.rpartition("/")[2])[400:501]
    assert (start, end) == tuple(nanoseconds(frames[i].header.stamp) for i in (0, 100))
    assert "cdr" not in {rule for _, rule in found(path)}


def test_of_a_log_that_is_not_damaged_nothing_is_said_to_be(recover, tmp_path):
    topics = topics_of("mic", list(DEFAULT.feature_names), None)
    writer, pipeline = LogWriter(tmp_path / "hole.mcap", topics, {}), Pipeline("mic", DEFAULT)
    for first in (0, 100):
        stamps = START + (first + np.arange(BLOCK)) * FRAME_NANOSECONDS
        values = np.zeros((BLOCK, DEFAULT.width), np.float32)
        for message in pipeline.push_features(values, first, stamps):
            writer.write(message.topic, message.log_time, message.data)
        writer.flush()
    writer.finish()
    assert gaps(recover((tmp_path / "hole.mcap").read_bytes())) == []


def test_whole_chunks_that_are_missing_from_an_unfinished_log_leave_a_gap(log, recover):
    data = log.read_bytes()
    (start, _), (end, _) = places(data)[6], places(data)[8]
    path = recover(data[:start] + data[end : places(data, Opcode.DATA_END)[0][0]])
    assert [lost for _, _, lost, reason in gaps(path) if reason == LOG_DAMAGED] == [2 * BLOCK]
    assert found(path) == FOUND


@pytest.mark.parametrize("field", ["string frame", "std_msgs/Header[] frame", "uint64 number", "?"])
def test_features_of_another_definition_are_saved_without_being_understood(tmp_path, field):
    path = tmp_path / "other.mcap"
    header = f"{'=' * 80}\nMSG: std_msgs/Header\nstring stamp\nstring frame_id\n"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2", "another")
        text = f"std_msgs/Header header\n{field}\n{header}".encode()
        schema = writer.register_schema(message_types.FEATURES, "ros2msg", text)
        channel = writer.register_channel("/mic/features", "cdr", schema)
        for time in range(5):
            writer.add_message(channel, time, b"\0\1\0\0" + bytes(16), time)
        writer.finish()
    assert recover_log(path, tmp_path / "copy.mcap", NAME).messages == 5


def test_a_chunk_that_is_there_twice_loses_nothing(log, recover):
    data = log.read_bytes()
    (start, end), (behind, _) = places(data)[6], places(data)[9]
    assert gaps(recover(data[:behind] + data[start:end] + data[behind:])) == gaps(log)


def test_each_microphone_has_its_own_gaps_in_the_order_of_log_time(recover, tmp_path):
    names = ["kitchen", "hall"]
    topics = {t.name: t for n in names for t in topics_of(n, list(DEFAULT.feature_names), None)}
    pipelines = [Pipeline(name, DEFAULT) for name in names]
    values = np.random.default_rng(0).random((BLOCK, DEFAULT.width)).astype(np.float32)
    writer = LogWriter(tmp_path / "two.mcap", list(topics.values()), {})
    for block in range(6):
        first = block * BLOCK
        stamps = START + (first + np.arange(BLOCK)) * FRAME_NANOSECONDS
        messages = [
            message
            for number, pipeline in enumerate(pipelines)
            for message in pipeline.push_features(values, first, stamps + number * 20_000_000)
        ]
        for message in sorted(messages, key=lambda message: message.log_time):
            writer.write(message.topic, message.log_time, message.data)
        writer.flush()
    writer.finish()
    path = recover(broken((tmp_path / "two.mcap").read_bytes(), 2, 3))
    labelled = [(item.topic, item.log_time) for item in LogReader(path).messages()]
    assert [time for _, time in labelled] == sorted(time for _, time in labelled)
    lost = START + 2 * BLOCK * FRAME_NANOSECONDS, START + 4 * BLOCK * FRAME_NANOSECONDS
    assert gaps(path) == [
        (lost[0] + late, lost[1] + late, 2 * BLOCK, LOG_DAMAGED) for late in (0, 20_000_000)
    ]
    assert [topic for topic, _ in labelled if topic.endswith("/gap")] == [
        "/kitchen/gap",
        "/hall/gap",
    ]


def test_of_another_recording_in_the_same_file_no_frames_are_missing(log, recover, tmp_path):
    topics = topics_of("mic", list(DEFAULT.feature_names), None)
    writer = LogWriter(tmp_path / "merged.mcap", topics, {})
    items = [i for i in LogReader(log).messages() if i.topic in {"/mic/info", "/mic/features"}]
    info, frames = items[0], items[1:]
    for part in (frames[:200], frames[700:]):
        writer.write(info.topic, part[0].log_time, info.data)
        for item in part:
            writer.write(item.topic, item.log_time, item.data)
        writer.flush()
    writer.finish()
    assert gaps(recover((tmp_path / "merged.mcap").read_bytes())) == []


def test_a_gap_in_which_the_clock_was_set_is_as_long_as_the_stamps_say(recover, tmp_path):
    topics = topics_of("mic", list(DEFAULT.feature_names), None)
    writer, pipeline = LogWriter(tmp_path / "set.mcap", topics, {}), Pipeline("mic", DEFAULT)
    values = np.zeros((BLOCK, DEFAULT.width), np.float32)
    for block in range(5):
        first, late = block * BLOCK, 7 * NANOSECONDS * (block >= 2)
        stamps = START + (first + np.arange(BLOCK)) * FRAME_NANOSECONDS + late
        if block == 2:
            end = int(stamps[0])
            gap = encode_gap("mic", end - late, end, "the clock was set by 7.000 s", 0)
            writer.write("/mic/gap", end, gap)
        for message in pipeline.push_features(values, first, stamps):
            writer.write(message.topic, message.log_time, message.data)
        writer.flush()
    writer.finish()
    ((start, end, lost, _),) = gaps(recover(broken((tmp_path / "set.mcap").read_bytes(), 2)))
    assert (end - start, lost) == (BLOCK * FRAME_NANOSECONDS + 7 * NANOSECONDS, BLOCK)


def test_what_was_lost_at_the_end_is_not_said_again_when_the_recorder_starts(log, tmp_path):
    data = log.read_bytes()
    active = tmp_path / (NAME + ".active")
    active.write_bytes(broken(data, 15)[: places(data)[17][0]])  # with the gap behind it
    recover_active(tmp_path, "home")
    until = end_of_sound(tmp_path, "home", "mic", START + 3600 * NANOSECONDS)
    assert until == gaps(tmp_path / NAME)[-1][1]
    assert found(tmp_path / NAME) == FOUND


def test_a_log_that_has_lost_its_end_goes_on_with_the_next_one(sound, model_file, tmp_path):
    first, *_ = recorded(sound, tmp_path, model_file, max_bag_duration=20)
    data = first.read_bytes()
    first.write_bytes(broken(data, len(places(data)) - 1))
    recover_in_place(first)
    first.with_name(first.name + ".damaged").unlink()
    assert len(find_logs(tmp_path)) == 4
    assert found(tmp_path) == FOUND


@pytest.mark.parametrize("size", [97, 98, 99, 100, 101])
def test_a_chunk_may_end_between_the_messages_of_one_frame(log, recover, tmp_path, size):
    other = Log(log)
    chunks = other.chunks()
    records = [record for chunk in chunks[1:] for record in chunk.records]
    parts = [Chunked(records[i : i + size]) for i in range(0, len(records), size)]
    place = other.items.index(chunks[0]) + 1
    rest = [item for item in other.items[place:] if not isinstance(item, Chunked)]
    other.items = [*other.items[:place], *parts, *rest]
    data = other.write(tmp_path / "whole.mcap").read_bytes()
    path = recover(broken(data, 4, 9))
    assert unexplained(path) == 0
    assert found(path) == FOUND


# Anything may be damaged.


def damage(data, rng):
    """Change, remove or zero pieces of a log that is finished or not."""
    data = bytearray(data)
    if rng.random() < 0.4:
        del data[places(data, Opcode.DATA_END)[0][0] :]
    if rng.random() < 0.2:
        del data[rng.randrange(len(data) // 4, len(data)) :]
    for _ in range(rng.choice([1, 1, 2, 4])):
        start = rng.randrange(len(data))
        end = min(start + rng.choice([1, 100, 4096, 30_000]), len(data))
        kind = rng.choice(["changed", "removed", "zeros"])
        if kind == "changed":
            data[start] ^= rng.randrange(1, 256)
        else:
            data[start:end] = bytes(end - start) if kind == "zeros" else b""
    return bytes(data)


def lost_for_good(path):
    """Rules that what stands once in a log can break, when it is lost."""
    reader = LogReader(path)
    rules = set()
    if not read(path, "info"):
        rules |= {"info-first", "name"}
    if "hearthlog" not in reader.metadata:
        rules |= {"metadata"}
    if set(reader.attachments) < {"configuration.json", "model.json", "model_card.md"}:
        rules |= {"attachments"}
    return rules


@pytest.mark.parametrize("seed", range(8))
def test_whatever_was_damaged_the_doctor_finds_no_error_in_what_was_recovered(log, recover, seed):
    rng = random.Random(seed)
    for _ in range(5):
        try:
            path = recover(damage(log.read_bytes(), rng))
        except NothingIntactError:
            continue
        if not len(features(path)[0]):
            continue
        errors = {rule for level, rule in found(path) if level == "error"}
        assert errors <= lost_for_good(path)
        assert unexplained_between(path) == 0


def unexplained_between(path):
    """Frames between the first and the last that neither features nor gaps account for."""
    frames, stamps, _ = features(path)
    lost = sum(n for start, _, n, _ in gaps(path) if stamps[0] <= start < stamps[-1])
    return frames[-1] - frames[0] + 1 - len(frames) - lost
