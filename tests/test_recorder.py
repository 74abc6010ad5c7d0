"""Audio files become labelled logs: every frame, in order, and the same every time."""

import itertools
import signal
import subprocess
import time
from datetime import UTC, datetime
from threading import Event

import numpy as np
import pytest
import soundfile
from conftest import HEARTHLOG
from logreader import LogReader
from logs import features, read
from waiting import wait_for

from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.features.installed import DEFAULT
from hearthlog.models.modelfile import load_model
from hearthlog.recorder.events import OK, READING, Frames, Gap, SourceHealth
from hearthlog.recorder.sources.audio_files import FileSource, long_blocks
from hearthlog.recorder.sources.decoding import read_audio
from hearthlog.recorder.stream.pipeline import Pipeline
from hearthlog.schemas.errors import SourceError
from hearthlog.schemas.frames import FRAME_NANOSECONDS, FRAME_SAMPLES
from hearthlog.schemas.logs.metadata import provenance
from hearthlog.schemas.messages.message_types import DIAGNOSTICS, LABEL, decode, nanoseconds

pytestmark = pytest.mark.fast

START = int(datetime(2026, 3, 1, 7, tzinfo=UTC).timestamp()) * 1_000_000_000


def noise(seconds, seed=1):
    return np.random.default_rng(seed).normal(0, 0.1, int(seconds * 16_000)).astype(np.float32)


def as_frames(samples):
    return samples[: len(samples) // FRAME_SAMPLES * FRAME_SAMPLES].reshape(-1, FRAME_SAMPLES)


@pytest.fixture
def recorded(hearthlog, tmp_path):
    """Record files, see that it went well, and return the folder."""

    def run(*arguments, env=None):
        logs = tmp_path / f"logs{len(list(tmp_path.iterdir()))}"
        if "--start" not in arguments:
            arguments += ("--start", "2026-03-01T07:00:00")
        result = hearthlog("record", *arguments, "-o", logs, env=env)
        assert (result.returncode, result.stderr) == (0, "")
        return logs

    return run


def test_a_file_gives_features_at_every_frame_and_labels_where_there_is_a_window(
    day, model_file, recorded
):
    logs = recorded(day, "--model", model_file, "--start", "2026-03-01T07:00:00")
    frames, stamps, values = features(logs)
    samples = np.concatenate(list(read_audio(day)))
    np.testing.assert_array_equal(values, DEFAULT.extractor()(as_frames(samples)))
    np.testing.assert_array_equal(frames, np.arange(len(values)))
    np.testing.assert_array_equal(stamps, START + frames * FRAME_NANOSECONDS)
    labels = list(LogReader(next(logs.rglob("*.mcap"))).messages(["/mic/label"]))
    output = [item.decode() for item in labels]
    assert [m.frame for m in output] == frames[7 + 7 - 3 : -3].tolist()
    assert [nanoseconds(m.header.stamp) for m in output] == stamps[11:-3].tolist()
    assert [item.log_time for item in labels] == stamps[14:].tolist()


def test_a_label_is_the_class_of_the_highest_probability(day, model_file, recorded):
    logs = recorded(day, "--model", model_file)
    (info,) = read(logs, "info")
    labels = read(logs, "label")
    assert len({m.label for m in labels}) > 3
    for message in labels:
        best = int(np.argmax(message.probabilities))
        assert message.label == info.labels[best]
        assert message.confidence == message.probabilities[best]
        assert 0 <= message.novelty < 1
        steps = len(message.probabilities) / 2**17  # half a step each
        assert message.probabilities.sum() == pytest.approx(1, abs=steps)


def test_segments_are_the_successive_equal_labels(day, model_file, recorded):
    logs = recorded(day, "--model", model_file)
    labels = read(logs, "label")
    runs = [list(run) for _, run in itertools.groupby(labels, key=lambda m: m.label)]
    segments = read(logs, "segment")
    assert [s.label for s in segments] == [run[0].label for run in runs]
    for segment, run in zip(segments, runs, strict=True):
        assert nanoseconds(segment.header.stamp) == nanoseconds(run[0].header.stamp)
        behind = 3 if run is runs[-1] else 0  # the last frames, which are too late for a window
        assert nanoseconds(segment.duration) == (len(run) + behind) * FRAME_NANOSECONDS
        assert segment.confidence == pytest.approx(np.mean([m.confidence for m in run]), rel=1e-6)


def test_the_same_input_gives_the_same_bytes(day, model_file, recorded):
    options = (day, "--model", model_file, "--start", "2026-03-01T07:59:00")
    first, second = recorded(*options), recorded(*options, env={"OPENBLAS_NUM_THREADS": "2"})
    paths = [sorted(folder.rglob("*.mcap")) for folder in (first, second)]
    assert len(paths[0]) == 2
    for one, other in zip(*paths, strict=True):
        assert one.relative_to(first) == other.relative_to(second)
        assert one.read_bytes() == other.read_bytes()


def test_files_begin_at_the_full_hour_and_each_says_what_it_is(day, model_file, recorded):
    logs = recorded(day, "--model", model_file, "--start", "2026-03-01T06:59:00+00:00")
    early, late = sorted(logs.rglob("*.mcap"))
    assert early.relative_to(logs).as_posix() == "2026/03/01/home_20260301T065900Z.mcap"
    assert late.relative_to(logs).as_posix() == "2026/03/01/home_20260301T070000Z.mcap"
    assert features(early)[1].max() < START
    assert features(late)[1].min() == START
    np.testing.assert_array_equal(features(logs)[0], np.arange(3 * 60 * 20))
    for log in (early, late):
        reader = LogReader(log)
        assert next(reader.messages()).topic == "/mic/info"
        assert reader.metadata["hearthlog"]["model_sha256"] == load_model(model_file).sha256
        assert provenance("home").items() <= reader.metadata["hearthlog"].items()
        assert set(reader.attachments) == {"configuration.json", "model.json", "model_card.md"}


def test_several_files_in_a_row_are_one_sound(tmp_path, recorded):
    sound = noise(5.33)
    for number, part in enumerate(np.split(sound, [7_001, 30_000])):
        soundfile.write(tmp_path / f"{number}.wav", part, 16_000, subtype="FLOAT")
    logs = recorded(*(tmp_path / f"{number}.wav" for number in range(3)))
    np.testing.assert_array_equal(features(logs)[2], DEFAULT.extractor()(as_frames(sound)))


@pytest.mark.parametrize(("rate", "channels"), [(8_000, 1), (44_100, 2), (192_000, 8)])
def test_any_rate_and_channel_count_is_heard_as_16_khz_mono(tmp_path, recorded, rate, channels):
    tone = 0.5 * np.sin(2 * np.pi * 1000 * np.arange(3 * rate) / rate)
    soundfile.write(tmp_path / "tone.wav", np.stack([tone] * channels, axis=1), rate)
    _, _, values = features(recorded(tmp_path / "tone.wav"))
    assert len(values) in (59, 60)
    np.testing.assert_allclose(values[5:-5, 0], 0.125, rtol=1e-3)
    np.testing.assert_allclose(values[5:-5, 7], 1000 / 8000, atol=1e-6)


def test_statistics_are_of_the_seconds_that_follow_each_other(tmp_path, recorded):
    soundfile.write(tmp_path / "noise.wav", noise(3.05), 16_000)
    logs = recorded(tmp_path / "noise.wav")
    _, _, values = features(logs)
    first, *others = read(logs, "statistics")
    np.testing.assert_array_equal(first.mean, values[0])
    assert [m.frame for m in others] == [20, 40, 60]
    for second, found in zip(np.split(values[1:], 3), others, strict=True):
        np.testing.assert_allclose(found.mean, second.mean(axis=0), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("every", [1, 7])
def test_statistics_are_logged_as_often_as_asked(tmp_path, recorded, every):
    soundfile.write(tmp_path / "noise.wav", noise(3), 16_000)
    logs = recorded(tmp_path / "noise.wav", env={"HEARTHLOG_STATISTICS_EVERY": str(every)})
    assert [m.frame for m in read(logs, "statistics")] == list(range(0, 60, every))


def test_diagnostics_come_at_least_every_ten_seconds(day, recorded):
    stamps = [nanoseconds(m.header.stamp) for m in read(recorded(day), "diagnostics")]
    assert len(stamps) == 18
    assert np.diff(stamps).max() <= 10_000_000_000


@pytest.mark.parametrize("private", [(), ("speech",)])
def test_messages_of_long_blocks_are_those_of_short_ones(tmp_path, model_file, private):
    sound = 0.05 * noise(75)
    sound[31 * 16_000 : 33 * 16_000] = 1.0  # clips
    sound[38 * 16_000 : 52 * 16_000] = 0.25  # stuck, and moving again when a report comes
    soundfile.write(tmp_path / "noise.wav", sound, 16_000)
    source = FileSource([tmp_path / "noise.wav"], START)

    def messages(events):
        pipeline = Pipeline("mic", DEFAULT, Classifier(load_model(model_file)), 20, private=private)
        pushed = [m for event in events for m in pipeline.push(event)] + pipeline.finish()
        assert [m.log_time for m in pushed] == sorted(m.log_time for m in pushed)
        return sorted(pushed, key=lambda m: (m.log_time, m.topic))

    short = messages(source.events(Event()))
    joined = list(long_blocks(FileSource([tmp_path / "noise.wav"], START).events(Event())))
    assert lengths(joined) == [1200, 300]
    assert messages(joined) == short
    reports = [decode(m.data, DIAGNOSTICS) for m in short if m.topic == "/diagnostics"]
    assert [report.status[0].level for report in reports] == [0, 0, 0, 0, 1, 1, 1, 1]


def test_long_blocks_end_at_gaps_and_where_the_source_fails():
    class Source:
        device = "a source"

        def events(self, stop):
            del stop
            frames = np.zeros((200, FRAME_SAMPLES), np.float32)
            for number in range(9):
                stamps = START + (200 * number + np.arange(200)) * FRAME_NANOSECONDS
                yield SourceHealth(int(stamps[0]), OK, READING)
                yield Frames(200 * number, frames, stamps)
                if number == 1:
                    end = int(stamps[-1]) + FRAME_NANOSECONDS
                    yield Gap(end, end, "a gap", 0)
            raise SourceError("the file is damaged")

    events = long_blocks(Source().events(Event()))
    assert lengths(itertools.islice(events, 7)) == [400, 1200, 200]
    with pytest.raises(SourceError, match="damaged"):
        next(events)


def lengths(events):
    return [len(event.stamps) for event in events if isinstance(event, Frames)]


def test_labels_from_logged_features_are_those_of_the_log_bit_for_bit(day, model_file, recorded):
    logs = recorded(day, "--model", model_file)
    frames, stamps, values = features(logs)
    pipeline = Pipeline("mic", DEFAULT, Classifier(load_model(model_file)))
    again = []
    for start in range(0, len(frames), 33):
        block = slice(start, start + 33)
        again += pipeline.push_features(values[block], int(frames[start]), stamps[block])
    again += pipeline.finish()
    (log,) = logs.rglob("*.mcap")
    for topic in ("/mic/statistics", "/mic/label", "/mic/segment", "/rosout"):
        recorded_bytes = [item.data for item in LogReader(log).messages([topic])]
        if topic == "/rosout":
            del recorded_bytes[0]  # it says what the file is
        assert [record.data for record in again if record.topic == topic] == recorded_bytes


def test_a_gap_closes_the_segment_and_the_next_label_waits_for_a_floor_and_a_window(model_file):
    pipeline = Pipeline("mic", DEFAULT, Classifier(load_model(model_file)), statistics_every=1)
    frames = as_frames(noise(2))
    stamps = START + np.arange(40) * FRAME_NANOSECONDS
    before = pipeline.push(Frames(0, frames, stamps))
    end = int(stamps[-1]) + FRAME_NANOSECONDS
    gap = Gap(end, end + 7 * FRAME_NANOSECONDS, "test", 7)
    closing = pipeline.push(gap)
    after = pipeline.push(Frames(47, frames, stamps + 47 * FRAME_NANOSECONDS))
    topics = ["/mic/segment", "/rosout", "/mic/gap", "/rosout"]
    assert [record.topic for record in closing] == topics
    assert [record.log_time for record in closing] == [gap.start] * 2 + [gap.end] * 2
    labels = [[r for r in records if r.topic == "/mic/label"] for records in (before, after)]
    frames = [[decode(r.data, LABEL).frame for r in found] for found in labels]
    # Blocks end with frames 7 and 55, the first windows behind them with 14 and 62.
    assert frames == [[*range(14 - 3, 40 - 3)], [*range(62 - 3, 87 - 3)]]
    decided_at = [START + frame * FRAME_NANOSECONDS for frame in (14, 62)]
    assert [found[0].log_time for found in labels] == decided_at
    statistics = [[r.data[20:] for r in x if r.topic == "/mic/statistics"] for x in (before, after)]
    payload = [[data[12:] for data in found] for found in statistics]
    assert payload[0] == payload[1]


def test_progress_goes_from_nothing_to_all(day):
    shares = []
    for _ in FileSource([day, day], START, progress=shares.append).events(Event()):
        pass
    assert shares == sorted(shares)
    assert shares[0] == pytest.approx(10 / 360)
    assert shares[-1] == pytest.approx(1)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_completes_the_log(tmp_path, number):
    soundfile.write(tmp_path / "noise.wav", noise(60), 16_000)
    logs = tmp_path / "logs"
    process = start_realtime(tmp_path / "noise.wav", logs)
    wait_for_log(logs, 1.5)
    process.send_signal(number)
    assert process.wait(timeout=10) == 0
    (log,) = logs.rglob("*.mcap*")
    reader = LogReader(log)
    assert sum(m.topic == "/mic/features" for m in reader.messages()) >= 20
    assert reader.complete


@pytest.mark.parametrize("seconds", [0.3, 1.7, 2.9, 4.1])
def test_killed_at_any_moment_at_most_a_second_is_lost_and_the_next_start_completes_the_log(
    tmp_path, hearthlog, seconds
):
    sound = noise(60)
    soundfile.write(tmp_path / "noise.wav", sound, 16_000, subtype="FLOAT")
    logs = tmp_path / "logs"
    process = start_realtime(tmp_path / "noise.wav", logs)
    began = wait_for_log(logs, seconds)
    process.kill()
    labelled = time.time() - began
    process.wait()
    (left,) = logs.rglob("*.mcap.active")
    kept = features(left)[2]
    assert len(kept) * 0.05 > labelled - 1.0
    content = [(m.topic, m.log_time, m.data) for m in LogReader(left).messages()]
    other = tmp_path / "other.wav"
    soundfile.write(other, noise(2), 16_000)
    assert hearthlog("record", other, "-o", logs, "--start", "2030-01-01").returncode == 0
    assert not left.exists()
    reader = LogReader(left.with_suffix(""))
    assert [(m.topic, m.log_time, m.data) for m in reader.messages()] == content
    assert reader.complete
    np.testing.assert_array_equal(kept, DEFAULT.extractor()(as_frames(sound))[: len(kept)])


def start_realtime(file, logs):
    options = ["-o", str(logs), "--realtime", "--start", "2026-03-01T07:00:00"]
    return subprocess.Popen([*HEARTHLOG, "record", str(file), *options])


def wait_for_log(logs, seconds):
    """Wait until the log is open, and so many seconds more; return when it was opened."""
    wait_for(lambda: list(logs.rglob("*.active")))
    began = time.time()
    time.sleep(seconds)
    return began


def test_a_damaged_log_of_an_earlier_recorder_is_reported_with_status_3(
    day, tmp_path, hearthlog, recorded
):
    (log,) = recorded(day).rglob("*.mcap")
    data = bytearray(log.read_bytes())
    data[len(data) // 2] ^= 0xFF
    left = tmp_path / "logs" / "home_20260301T000000Z.mcap.active"
    left.parent.mkdir()
    left.write_bytes(data)
    soundfile.write(tmp_path / "noise.wav", noise(2), 16_000)
    start = ("--start", "2030-01-01")
    result = hearthlog("record", tmp_path / "noise.wav", "-o", left.parent, *start)
    assert result.returncode == 3
    completed, damage = result.stderr.splitlines()
    assert completed == f"hearthlog: completed {left.with_suffix('')}, which was left unfinished"
    assert "damaged at byte" in damage
