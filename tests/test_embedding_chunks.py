"""In a finished log embeddings lie in chunks of their own, and are found in the order of time."""

import shutil

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from hearthlog.analyzer.doctor.examination import examine
from hearthlog.models.features.installed import DEFAULT
from hearthlog.recorder.config import Settings
from hearthlog.recorder.events import Frames
from hearthlog.recorder.log.description import describe_log
from hearthlog.recorder.log.recovery import LogFinisher, finish_log
from hearthlog.recorder.log.rolling_log import RollingLog
from hearthlog.recorder.stream import stream_info
from hearthlog.recorder.stream.pipeline import Pipeline
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import SUFFIX, stem
from hearthlog.schemas.logs.merged_reading import iterate_messages
from hearthlog.schemas.logs.writer import LogWriter
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import EmbeddingSource, Topic
from hearthlog.schemas.salvage.recover import STEPS, thin_log

START = 1_772_348_400 * NANOSECONDS  # a full hour
TOPIC = "/mic/embedding"
SOURCE = EmbeddingSource("yamnet", "a" * 64, "b" * 64, ("one", "two"), (0.25, 0.5))
FRAMES = 3200


class Loudness:
    """An embedder that needs no network."""

    source = SOURCE

    def __call__(self, window):
        return np.rint(100 * np.array([window.min(), window.max()])).astype(np.int8)


@pytest.fixture(scope="module")
def active(tmp_path_factory, real_frames):
    """More than two minutes of sound as the recorder writes them, complete but not named."""
    settings = Settings(output=tmp_path_factory.mktemp("logs"), model="none")
    info = stream_info("mic", "test", DEFAULT, None)
    held = []

    class Held(LogFinisher):
        def add(self, active):
            held.extend(active)

    description = describe_log(settings, info, DEFAULT, None, embedding=SOURCE)
    log = RollingLog(description, 3600, 1.0, 5.0, finisher=Held())
    pipeline = Pipeline("mic", DEFAULT, embedder=Loudness())
    for first in range(0, FRAMES, 10):
        stamps = START + np.arange(first, first + 10) * FRAME_NANOSECONDS
        frames = real_frames[first % len(real_frames) :][:10]
        log.write(pipeline.push(Frames(first, frames, stamps[: len(frames)])))
        log.flush()
    log.finish(pipeline.finish())
    return held[0]


@pytest.fixture(scope="module")
def finished(active, tmp_path_factory):
    """The same by its final name."""
    copy = tmp_path_factory.mktemp("finished") / active.name
    shutil.copy(active, copy)
    finish_log(copy)
    return copy.with_name(stem(copy) + SUFFIX)


def messages(path):
    with path.open("rb") as stream:
        found = make_reader(stream).iter_messages()
        return [(channel.topic, one.log_time, one.data) for _, channel, one in found]


def by_topic(found):
    topics = {topic for topic, _, _ in found}
    return {topic: [one for one in found if one[0] == topic] for topic in topics}


def chunks_with(path):
    """Seconds that chunks span, of those with embeddings and of the others; and their topics."""
    own, others, topics = [], [], []
    with LogFile(path) as file:
        for chunk in file.chunks:
            numbers = file.channel_sets[int(chunk["channels"])]
            names = {file.channels[number].topic for number in numbers}
            seconds = int(chunk["end"] - chunk["start"]) / NANOSECONDS
            (own if TOPIC in names else others).append(seconds)
            topics += [names] if TOPIC in names else []
    return own, others, topics


def test_embeddings_of_a_minute_have_a_chunk_of_their_own(active, finished):
    own, others, topics = chunks_with(finished)
    assert topics == [{TOPIC}] * 3
    assert 45 < max(own) <= 60
    assert max(others) <= 10
    assert max(chunks_with(active)[0]) < 1  # a killed recorder loses no more of them than of others


def test_readers_find_all_messages_in_the_order_of_time(active, finished):
    before, after = messages(active), messages(finished)
    assert by_topic(before) == by_topic(after)
    assert [time for _, time, _ in after] == sorted(time for _, time, _ in after)
    times = [
        int(time)
        for batch in iterate_messages([finished])
        for time in sorted(time for each in batch for time in each.log_times.tolist())
    ]
    assert times == [time for _, time, _ in after]
    columns = (read_columns([path], [TOPIC])[TOPIC] for path in (active, finished))
    np.testing.assert_array_equal(*(each["values"] for each in columns))


@settings(deadline=None, max_examples=40)
@given(st.lists(st.lists(st.integers(0, 200), min_size=1, max_size=5), max_size=30))
def test_none_is_lost_whatever_the_times_are(tmp_path_factory, blocks):
    path = tmp_path_factory.mktemp("log") / "home_20260301T070000Z.mcap"
    topics = [Topic("/mic/gap", message_types.GAP), Topic(TOPIC, message_types.EMBEDDING)]
    writer = LogWriter(path, topics, {"node": "home"})
    for number, seconds in enumerate([[0], *blocks]):
        for place, second in enumerate(seconds):
            data = np.random.default_rng([number, place]).bytes(40)
            topic = topics[(number + place) % 2].name
            writer.write(topic, START + second * NANOSECONDS, data)
        writer.flush()
    writer.complete()
    before = messages(writer.active_path)
    finish_log(writer.active_path)
    assert by_topic(messages(path)) == by_topic(before)


def test_the_doctor_finds_nothing_wrong(finished):
    assert not [findings.counts for findings in examine(finished.parent) if findings.counts]


@pytest.mark.parametrize("step", range(len(STEPS)))
def test_a_log_that_is_thinned_keeps_its_embeddings_or_drops_all(finished, tmp_path, step):
    copy = tmp_path / finished.name
    thin_log(finished, copy, step)
    before, after = by_topic(messages(finished)), by_topic(messages(copy))
    assert (TOPIC in after) == (step < STEPS.index("statistics and features"))
    assert all(before[topic] == found for topic, found in after.items())
    assert not [findings.counts for findings in examine(tmp_path) if findings.counts]


def test_logs_that_are_merged_or_cut_have_them_in_the_order_of_time(finished, hearthlog, tmp_path):
    merged = tmp_path / "merged.mcap"
    assert hearthlog("merge", finished, "-o", merged).returncode == 0
    assert by_topic(messages(merged)) == by_topic(messages(finished))
    cut = tmp_path / "cut.mcap"
    part = "--start", "2026-03-01T07:00:50", "--end", "2026-03-01T07:01:20"
    assert hearthlog("cut", finished, *part, "-o", cut).returncode == 0
    kept = by_topic(messages(cut))[TOPIC]
    first, last = START + 50 * NANOSECONDS, START + 80 * NANOSECONDS
    expected = [one for one in by_topic(messages(finished))[TOPIC] if first <= one[1] < last]
    assert kept == expected


def test_embeddings_of_a_log_that_is_damaged_are_saved_with_the_rest(finished, hearthlog, tmp_path):
    copy = tmp_path / finished.name
    data = bytearray(finished.read_bytes())
    with LogFile(finished) as file:
        chunk = file.chunks[len(file.chunks) // 2]
        place = int(chunk["offset"] + chunk["length"] // 2)
    data[place : place + 8] = bytes(8)
    copy.write_bytes(data)
    assert hearthlog("recover", copy, "-o", tmp_path / "saved.mcap").returncode == 3
    saved, before = (by_topic(messages(path)) for path in (tmp_path / "saved.mcap", finished))
    lost = [topic for topic in before if saved.get(topic) != before[topic]]
    assert (TOPIC in lost) != ("/mic/features" in lost)
    rules = {rule for findings in examine(tmp_path / "saved.mcap") for _, rule in findings.counts}
    assert rules <= {"gap"}
