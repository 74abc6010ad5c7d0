"""Sound is kept only where it was asked for, never of what is private, and not for ever."""

import itertools
import json
import os
import shutil
import subprocess
import time
import wave
from dataclasses import replace
from threading import Event as Flag

import numpy as np
import pytest
import soundfile
from conftest import HEARTHLOG
from hypothesis import given, settings
from hypothesis import strategies as st
from log_fixtures import raw_messages, small_disk
from logreader import LogReader
from logs import read
from lossy_source import LossySource
from model_folders import put_by_hand
from waiting import wait_for

from hearthlog.analyzer.training.dataset import build_dataset
from hearthlog.analyzer.training.manifest import load_scenario, read_manifest
from hearthlog.analyzer.training.train import train_model
from hearthlog.models.classifiers.model import Description
from hearthlog.models.features.auros21 import WINDOW_FRAMES
from hearthlog.models.features.infrasound import InfrasoundFilter
from hearthlog.models.labels.labeller import FrameLabels
from hearthlog.models.modelfile import load_model, save_model
from hearthlog.models.registry import override_judgement
from hearthlog.recorder.config import Settings, load_settings
from hearthlog.recorder.events import Frames, Gap
from hearthlog.recorder.labelling.model_watch import ReloadRequests
from hearthlog.recorder.log.clips import ClipFinder, ClipRetention, ClipWriter, KeptSound
from hearthlog.recorder.recording import record, record_files
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.recorder.sources.decoding import read_audio
from hearthlog.recorder.stream.privacy_filter import PRIVATE_LIMIT
from hearthlog.recorder.stream.privacy_filter import PRIVATE_LIMIT_ELSEWHERE as ELSEWHERE
from hearthlog.schemas.errors import ConfigurationError
from hearthlog.schemas.frames import FRAME_NANOSECONDS, FRAME_SAMPLES
from hearthlog.schemas.logs.files import audio_path, find_logs, is_layer, log_path
from hearthlog.schemas.logs.metadata import provenance
from hearthlog.schemas.messages.message_types import nanoseconds

SECOND = 1_000_000_000
HOUR, DAY = 3600 * SECOND, 86_400 * SECOND
INFO, WARN = 20, 30  # levels of rcl_interfaces/msg/Log
BEHIND = 12  # frames; with the window before them a second
START = 1_772_348_400 * SECOND  # 2026-03-01T07:00:00Z
CLASSES = ("silence", "speech", "music")


# Which frames are kept: sound whose samples are the numbers of their frames


def push(finder, first, private, unlabelled=0, blocks=(7, 20, 1)):
    """Push frames, one for each probability of speech, and return the numbers of those kept."""
    kept = []
    sizes = itertools.cycle(blocks)
    start = 0
    while start < len(private):
        numbers = np.arange(start, min(start + next(sizes), len(private)))
        samples = np.repeat((first + numbers[:, np.newaxis]) / 32768, FRAME_SAMPLES, axis=1)
        stamps = START + (first + numbers) * FRAME_NANOSECONDS
        output = np.asarray(private, np.float32)[numbers[numbers >= unlabelled]]
        rest = 1 - output
        probabilities = np.stack([rest / 4, output, rest * 3 / 4], axis=1)
        labelled = labels_of(probabilities, np.zeros(len(output), np.float32))
        frames = Frames(first + start, samples.astype(np.float32), stamps)
        kept += finder.push(frames, labelled if len(output) else None)
        start = int(numbers[-1]) + 1
    return numbers_of(kept)


def labels_of(probabilities, novelty, *, elsewhere=False):
    frames = np.arange(len(novelty))
    stamps = START + frames * FRAME_NANOSECONDS
    return FrameLabels(
        CLASSES, frames, stamps, stamps, probabilities, probabilities, novelty, elsewhere
    )


def numbers_of(sounds):
    for sound in sounds:
        assert (sound.samples == sound.samples[:, :1]).all()
        np.testing.assert_array_equal(
            sound.stamps, START + sound.samples[:, 0].astype(np.int64) * FRAME_NANOSECONDS
        )
    return [number for sound in sounds for number in sound.samples[:, 0].tolist()]


probabilities = st.lists(
    st.sampled_from([0.0, 0.019, 0.0199, float(np.float32(PRIVATE_LIMIT)), 0.021, 0.5, np.nan])
    | st.floats(0, 1),
    max_size=120,
)
sparse = st.builds(
    lambda count, loud, likely: [likely if number in loud else 0.0 for number in range(count)],
    st.integers(0, 160),
    st.sets(st.integers(0, 159), max_size=3),
    st.sampled_from([0.5, float(np.float32(PRIVATE_LIMIT))]),
)


@given(
    runs=st.lists(probabilities | sparse, min_size=1, max_size=3),
    keep=st.sampled_from(["events", "unsure", "always"]),
    pre_roll=st.integers(0, 50),
    blocks=st.lists(st.integers(1, 40), min_size=1, max_size=4),
)
@settings(max_examples=300, deadline=None)
def test_no_frame_is_kept_within_a_second_of_a_window_that_is_private(runs, keep, pre_roll, blocks):
    finder = ClipFinder(keep, ["speech"], pre_roll, 20)
    kept, allowed = [], []
    first = 0
    for run in runs:
        private = np.asarray(run, np.float32)
        kept += push(finder, first, private, WINDOW_FRAMES - 1, blocks)
        kept += numbers_of(finder.close())
        allowed += [
            first + frame
            for frame in range(WINDOW_FRAMES - 1 + BEHIND, len(run) - WINDOW_FRAMES + 1)
            if all(private[frame - BEHIND : frame + WINDOW_FRAMES] < PRIVATE_LIMIT)
        ]
        first += len(run) + 5
    assert set(kept) <= set(allowed)
    assert kept == sorted(set(kept))
    if keep == "always":
        assert kept == allowed


def test_frames_before_lost_ones_are_not_of_the_windows_behind():
    finder = ClipFinder("always", ["speech"], 0, 20)
    kept = push(finder, 0, [0.0] * 60, 19)
    kept += push(finder, 61, [0.0] * 60)
    assert kept == [*range(31, 41), *range(73, 102)]


def test_with_nothing_private_every_frame_is_kept_with_or_without_labels():
    for unlabelled in (0, 19, 100):
        finder = ClipFinder("always", [], 0, 20)
        kept = push(finder, 0, [0.9] * 100, unlabelled)
        assert kept + numbers_of(finder.close()) == list(range(100))


def loud(count, start, end):
    """Return labels of silence, but music from one frame to another."""
    probabilities = np.zeros((count, 3), np.float32)
    probabilities[:, 0] = 1
    probabilities[start:end] = [0, 0, 1]
    return probabilities


def kept_of(finder, probabilities, novelty):
    count = len(novelty)
    samples = np.repeat(np.arange(count)[:, np.newaxis] / 32768, FRAME_SAMPLES, axis=1)
    stamps = START + np.arange(count) * FRAME_NANOSECONDS
    frames = Frames(0, samples.astype(np.float32), stamps)
    kept = finder.push(frames, labels_of(probabilities, novelty))
    return numbers_of([*kept, *finder.close()])


def test_events_are_kept_with_the_second_that_was_labelled_what_is_before_and_what_is_behind():
    finder = ClipFinder("events", ["speech"], 30, 20)
    kept = kept_of(finder, loud(300, 150, 160), np.zeros(300, np.float32))
    assert kept == list(range(150 - 19 - 30, 160 + 20))


def test_a_model_whose_probabilities_hold_for_strangers_has_another_limit():
    for private, elsewhere, count in ((0.03, False, 0), (0.03, True, 1), (0.05, True, 0)):
        finder = ClipFinder("always", ["speech"], 0, 20)
        probabilities = np.tile(np.float32([0.5, private, 0.5 - private]), (100, 1))
        labels = labels_of(probabilities, np.zeros(100, np.float32), elsewhere=elsewhere)
        samples = np.zeros((100, FRAME_SAMPLES), np.float32)
        assert len(finder.push(Frames(0, samples, labels.stamps), labels)) == count


def test_what_the_model_is_unsure_of_or_has_not_learned_is_kept():
    for confidence, novelty, count in ((0.49, 0.1, 1), (0.51, 0.1, 0), (0.9, 0.71, 1)):
        probabilities = loud(200, 0, 0)
        probabilities[100] = [confidence, 0, 1 - confidence]
        probabilities[100, 2] /= 2 if confidence < 0.5 else 1
        unlike = np.zeros(200, np.float32)
        unlike[100] = novelty
        kept = kept_of(ClipFinder("unsure", ["speech"], 0, 20), probabilities, unlike)
        assert kept == list(range(81, 121)) * count


# What is written


def requested(folder, model=None, **others):
    return Settings(output=folder, model=model, timezone="UTC", **others)


def keep(paths, about, start=START):
    """Record files as the settings want it; return the layers of sound."""
    result = record(about, FileSource(paths, start), Flag())
    return [path for path in map(audio_path, result.logs) if path.exists()]


def clips(layer):
    """Read the times and samples of the messages of a layer."""
    found = []
    for item in LogReader(layer).messages():
        audio = item.decode()
        assert (item.topic, item.type) == ("/mic/audio", "foxglove_msgs/msg/RawAudio")
        assert item.log_time == nanoseconds(audio.timestamp)
        assert (audio.format, audio.sample_rate, audio.number_of_channels) == ("pcm-s16", 16_000, 1)
        samples = np.frombuffer(bytes(audio.data), "<i2").reshape(-1, FRAME_SAMPLES)
        assert 0 < len(samples) <= 20
        found.append((item.log_time, samples))
    return found


def frames_of(layers):
    """Return the samples of the frames in some layers, by their times."""
    return {
        start + number * FRAME_NANOSECONDS: frame
        for layer in layers
        for start, samples in clips(layer)
        for number, frame in enumerate(samples)
    }


@pytest.fixture
def noise(tmp_path):
    """Write seconds of noise."""

    def write(seconds):
        path = tmp_path / f"noise{seconds}.wav"
        samples = np.random.default_rng(0).integers(-3000, 3000, seconds * 16_000)
        soundfile.write(path, samples.astype(np.int16), 16_000)
        return path

    return write


def output(logs, about="clips"):
    lines = (line for item in read(logs, "rosout") for line in [item.msg] if about in line)
    return list(lines)


@pytest.mark.parametrize("mode", ["events", "unsure", "always"])
def test_what_is_kept_is_the_sound_itself_and_no_window_of_it_is_like_speech(
    sounds, model_file, tmp_path, mode
):
    about = requested(tmp_path, model_file, keep_audio=mode, max_bag_duration=60)
    source = LossySource(FileSource(sounds, START), {3: 7})
    logs = record(about, source, Flag()).logs
    layers = [path for path in map(audio_path, logs) if path.exists()]
    stamps = [nanoseconds(m.header.stamp) for m in read(tmp_path, "features")]
    original, infrasound = {}, InfrasoundFilter()
    for event in LossySource(FileSource(sounds, START), {3: 7}).events(Flag()):
        if isinstance(event, Gap):
            infrasound.restart()
        elif isinstance(event, Frames):
            recorded = np.rint(infrasound(event.samples) * 32768)
            original |= dict(zip(event.stamps.tolist(), recorded, strict=True))
    assert stamps == [*original]
    model = load_model(model_file)
    speech = model.classes.index("speech")
    limit = ELSEWHERE if model.description.elsewhere else PRIVATE_LIMIT
    labels = {  # by the last frame of the window
        item.log_time: item.decode().probabilities[speech]
        for log in find_logs(tmp_path)
        for item in LogReader(log).messages(["/mic/label"])
    }
    kept = frames_of(layers)
    assert 100 < len(kept) < len(stamps)
    for stamp, frame in kept.items():
        np.testing.assert_array_equal(frame, np.clip(original[stamp], -32768, 32767))
        around = range(-BEHIND, WINDOW_FRAMES)
        windows = [labels[stamp + later * FRAME_NANOSECONDS] for later in around]
        assert max(windows) < limit
    for layer in layers:
        time_of_log = min(nanoseconds(m.header.stamp) for m in read(_log(layer), "features"))
        assert all(0 <= t - time_of_log < 60 * SECOND for t in frames_of([layer]))


def _log(layer):
    return layer.with_name(layer.name.replace(".audio", ""))


@pytest.fixture(scope="module")
def kept_of_people_not_learned_from(all_household, tmp_path_factory):
    """Shares of the frames of speech and of yelling that are kept."""
    tmp_path = tmp_path_factory.mktemp("people")
    scenario = load_scenario("general")
    clips = read_manifest(all_household / "manifest.csv", scenario.labels)
    unseen = "devi-harikaa/scream-detector-project"
    others = [clip for clip in clips if clip.source != unseen]
    data = build_dataset(others[::4], scenario, lambda *_: None)
    model = tmp_path / "model.safetensors"
    save_model(train_model(data, scenario, lambda *_: None), model)
    share = {}
    for label in ("speech", "yelling"):
        paths = [c.path for c in clips if (c.source, c.label) == (unseen, label)]
        layers = keep(paths, requested(tmp_path / label, model, keep_audio="always"))
        share[label] = len(frames_of(layers)) / len(read(tmp_path / label, "features"))
    return share


def test_speech_of_people_not_learned_from_is_not_kept(kept_of_people_not_learned_from):
    assert kept_of_people_not_learned_from["speech"] < 0.005


def test_but_yelling_of_such_people_is(kept_of_people_not_learned_from):
    assert kept_of_people_not_learned_from["yelling"] > 0.03


def test_no_sound_is_kept_unless_it_is_asked_for_and_the_log_is_the_same_either_way(
    day, model_file, tmp_path
):
    assert keep([day], requested(tmp_path / "off", model_file)) == []
    assert len(list((tmp_path / "off").rglob("*.mcap*"))) == 1
    (layer,) = keep([day], requested(tmp_path / "on", model_file, keep_audio="always"))
    assert is_layer(layer)
    off, on = (
        raw_messages(next(log for log in find_logs(tmp_path / x) if not is_layer(log)))
        for x in ("off", "on")
    )
    assert off == on


def test_a_layer_says_what_it_is_and_is_only_made_when_there_is_sound(noise, model_file, tmp_path):
    (layer,) = keep([noise(3)], requested(tmp_path / "a", keep_audio="always", never_keep=[]))
    about = LogReader(layer).metadata["hearthlog"]
    assert about["log"] == "home_20260301T070000Z.mcap"
    assert layer.name == "home_20260301T070000Z.audio.mcap"
    assert (about["node"], about["keep_audio"]) == ("home", "always")
    limits = float(about["limit"]), float(about["limit_elsewhere"])
    assert (json.loads(about["never_keep"]), limits) == ([], (PRIVATE_LIMIT, ELSEWHERE))
    assert provenance("home").items() <= about.items()
    never = list(load_model(model_file).classes)  # one of them is always likely
    about = requested(tmp_path / "b", model_file, keep_audio="always", never_keep=never)
    assert keep([noise(3)], about) == []
    assert len(list((tmp_path / "b").rglob("*.mcap*"))) == 1


def test_layers_roll_with_their_logs(noise, tmp_path):
    about = requested(tmp_path, keep_audio="always", never_keep=[], max_bag_duration=3)
    layers = keep([noise(10)], about, START + SECOND // 2)
    assert [len(frames_of([layer])) for layer in layers] == [50, 60, 60, 30]
    for layer in layers:
        start = min(frames_of([layer]))
        assert start == read(_log(layer), "info")[0].header.stamp.sec * SECOND + start % SECOND


def test_a_layer_is_complete_soon_after_its_log_though_no_sound_follows(tmp_path):
    names = [tmp_path / f"home_20260301T07000{second}Z.mcap" for second in (0, 5)]
    rolls = START + 5 * SECOND
    log = ClipWriter(
        requested(tmp_path, keep_audio="always"),
        ["mic"],
        lambda stamp: (names[0], rolls) if stamp < rolls else (names[1], rolls + DAY),
    )
    log.write(
        "mic", [KeptSound(START + np.arange(9) * FRAME_NANOSECONDS, np.zeros((9, 800), np.int16))]
    )
    layer = audio_path(names[0])
    for after in (4, 6, 60):
        log.tick(START + after * SECOND)
        assert not layer.exists()  # sound of it may still be held back
    log.tick(START + 67 * SECOND)
    assert len(frames_of([layer])) == 9


def test_when_the_clock_is_set_back_sound_stays_beside_its_own_log(noise, tmp_path):
    class SetBack:
        device = "test"

        def events(self, stop):
            del stop
            samples = next(read_audio(noise(5)))[: 80 * FRAME_SAMPLES].reshape(-1, FRAME_SAMPLES)
            stamps = START + np.arange(80) * FRAME_NANOSECONDS
            yield Frames(0, samples, stamps)
            yield Gap(int(stamps[-1]), START - HOUR, "the clock was set", 1)
            yield Frames(81, samples, stamps - HOUR)

    about = requested(tmp_path, keep_audio="always", never_keep=[])
    logs = record(about, SetBack(), Flag()).logs
    kept = [frames_of([audio_path(log)]) for log in logs]
    assert [len(frames) for frames in kept] == [80, 80]
    assert min(kept[0]) == START
    assert min(kept[1]) == START - HOUR


def test_clips_become_wav_files_and_doctor_finds_no_fault(noise, tmp_path, hearthlog):
    keep([noise(5)], requested(tmp_path / "logs", keep_audio="always", never_keep=[]))
    result = hearthlog("doctor", tmp_path / "logs")
    assert (result.returncode, result.stdout) == (0, "2 files: 0 errors, 0 warnings\n")
    result = hearthlog("export", tmp_path / "logs", "--format", "wav", "-o", tmp_path / "wav")
    assert result.returncode == 0, result
    (file,) = (tmp_path / "wav").iterdir()
    with wave.open(str(file)) as sound:
        data = sound.readframes(sound.getnframes())
    np.testing.assert_array_equal(
        np.frombuffer(data, "<i2"), soundfile.read(noise(5), dtype="int16")[0]
    )


def test_relabelling_passes_over_clips(noise, model_file, tmp_path, hearthlog):
    (layer,) = keep([noise(5)], requested(tmp_path / "logs", keep_audio="always", never_keep=[]))
    result = hearthlog("relabel", tmp_path / "logs", "--model", model_file)
    assert result.returncode == 0, result
    assert len(list(layer.parent.iterdir())) == 3
    result = hearthlog("relabel", layer, "--model", model_file)
    assert (result.returncode, "is a layer" in result.stderr) == (1, True)


# Limits


def test_only_so_many_minutes_are_kept_a_day_also_when_the_recorder_starts_again(noise, tmp_path):
    about = requested(tmp_path, keep_audio="always", never_keep=[], clip_minutes_a_day=1)
    (layer,) = keep([noise(50)], about)
    assert len(frames_of([layer])) == 1000
    (layer,) = keep([noise(50)], about, START + HOUR)
    kept = len(frames_of([layer]))
    assert 160 < kept <= 200  # what frames a message takes place, too
    assert keep([noise(50)], about, START + 2 * HOUR) == []
    assert output(tmp_path) == ["no clips: 1 minutes of this day are kept already"] * 2
    assert {item.level for item in read(tmp_path, "rosout") if "no clips" in item.msg} == {INFO}
    (layer,) = keep([noise(50)], about, START + DAY)
    assert len(frames_of([layer])) == 1000


def test_the_day_is_the_homes(noise, tmp_path):
    midnight = START - 7 * HOUR + 10 * HOUR  # in Honolulu
    about = requested(tmp_path, keep_audio="always", never_keep=[], clip_minutes_a_day=1)
    about = about.model_copy(update={"timezone": "Pacific/Honolulu"})
    kept = frames_of(keep([noise(190)], about, midnight - 90 * SECOND))
    assert 1180 < sum(time < midnight for time in kept) <= 1200
    assert 1180 < sum(time >= midnight for time in kept) <= 1200
    texts = output(tmp_path)
    assert texts[1] == "clips are kept again"
    assert len(texts) == 3


@pytest.fixture
def old(noise, tmp_path):
    """Record a log with clips, and put others beside it which are not to be touched."""
    about = requested(tmp_path / "logs", keep_audio="always", never_keep=[])
    (layer,) = keep([noise(3)], about)
    others = [
        layer.with_name("home_2_20260301T070000Z.audio.mcap"),
        layer.with_name("other_20260301T070000Z.audio.mcap"),
        layer.with_name("home_20260301T070000Z.relabel-x.audio.mcap"),
        layer.with_name("home_20260301T070000Z.review.mcap"),
        layer.with_name("home_20269901T070000Z.audio.mcap"),
        tmp_path / "elsewhere" / "2026" / layer.name,
    ]
    others[-1].parent.mkdir(parents=True)
    for path in others:
        shutil.copy(layer, path)
    (tmp_path / "logs" / "2025").symlink_to(others[-1].parent)
    return layer, [_log(layer), *others]


def recorded_later(layer, days):
    """Put a log on each of the days after that of a layer."""
    for day in range(1, days + 1):
        path = log_path(layer.parents[3], "home", START + day * DAY)
        path.parent.mkdir(parents=True)
        shutil.copy(_log(layer), path)


@pytest.mark.parametrize("mode", ["off", "always"])
def test_old_clips_are_deleted_and_nothing_else(old, noise, tmp_path, mode):
    layer, others = old
    about = requested(tmp_path / "logs", keep_audio=mode, never_keep=[], clip_retention_days=30)
    recorded_later(layer, 28)
    keep([noise(3)], about, START + 29 * DAY - HOUR)
    assert layer.exists()
    keep([noise(4)], about, START + 30 * DAY + HOUR)
    assert not layer.exists()
    assert all(path.exists() for path in others)
    assert output(tmp_path / "logs") == ["clips of 1 logs deleted: they were 30 days old"]


def test_old_clips_are_looked_for_every_hour(old, tmp_path):
    layer, _ = old
    retention = ClipRetention(tmp_path / "logs", "home", 1)
    assert retention.tick(START + DAY - 60 * SECOND) == []
    recorded_later(layer, 1)
    assert retention.tick(START + DAY + 3000 * SECOND) == []
    assert layer.exists()
    assert len(retention.tick(START + DAY + 3600 * SECOND)) == 1
    assert not layer.exists()


def test_a_clock_far_ahead_deletes_no_clips(old, noise, tmp_path):
    layer, _ = old
    about = requested(tmp_path / "logs", keep_audio="off", clip_retention_days=2)
    keep([noise(3)], about, START + 60 * DAY)
    assert layer.exists()


def test_what_recovery_kept_of_damaged_clips_is_deleted_too(old, tmp_path):
    layer, _ = old
    damaged = layer.with_name(layer.name + ".damaged")
    layer.rename(damaged)
    recorded_later(layer, 1)
    assert len(ClipRetention(tmp_path / "logs", "home", 1).tick(START + 2 * DAY)) == 1
    assert not damaged.exists()


def test_clips_that_cannot_be_deleted_are_said_and_the_others_go(old, tmp_path):
    layer, _ = old
    recorded_later(layer, 1)
    folder = tmp_path / "logs" / "2026" / "01"
    folder.mkdir()
    with small_disk(folder / "01", "1M") as disk:
        stuck = [disk / f"home_20260101T0{hour}0000Z.audio.mcap" for hour in range(2)]
        for path in stuck:
            path.write_bytes(b"sound")
        subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
        (deleted, failed) = ClipRetention(tmp_path / "logs", "home", 1).tick(START + 9 * DAY)
        assert all(path.exists() for path in stuck)
    assert not layer.exists()
    assert deleted == (0, "clips of 1 logs deleted: they were 1 days old")
    level, text = failed
    assert level == 1
    assert text.startswith(f"clips cannot be listed or deleted: {stuck[0].parent}/home_")
    assert text.endswith(": Read-only file system, and 1 more")


def test_where_space_runs_out_clips_stop_and_the_log_goes_on(noise, tmp_path):
    with small_disk(tmp_path / "disk", "6M") as disk:
        about = requested(disk, keep_audio="always", never_keep=[], clip_min_free_space=4)
        (layer,) = keep([noise(190)], about)
        assert 300 < len(frames_of([layer])) < 2000
        assert len(read(_log(layer), "features")) == 3800
        assert output(_log(layer)) == ["no clips: less than 4 MB are free on the disk"]
        assert [i.level for i in read(_log(layer), "rosout") if "no clips" in i.msg] == [WARN]


def test_a_layer_that_the_disk_refuses_is_given_up_and_the_next_one_is_written(tmp_path):
    rng = np.random.default_rng(0)
    stamps = START + np.arange(1200) * FRAME_NANOSECONDS
    sound = KeptSound(stamps, rng.integers(-3000, 3000, (1200, FRAME_SAMPLES)).astype(np.int16))
    with small_disk(tmp_path / "disk", "300k") as disk:
        full, good = disk / "home_20260301T070000Z.mcap", tmp_path / "home_20260301T070030Z.mcap"
        rolls = START + 30 * SECOND
        log = ClipWriter(
            requested(tmp_path, keep_audio="always"),
            ["mic"],
            lambda stamp: (full, rolls) if stamp < rolls else (good, rolls + DAY),
        )
        refused, again = log.write("mic", [sound])
        log.finish()
        assert 0 < len(frames_of(disk.iterdir())) < 300
    expected = f"no clips: {audio_path(full)} cannot be written (No space left on device)"
    assert (refused, again) == ((1, expected), (0, "clips are kept again"))
    assert len(frames_of([audio_path(good)])) == 600


def test_a_name_that_is_taken_stops_the_clips_of_one_log(noise, tmp_path):
    about = requested(tmp_path, keep_audio="always", never_keep=[], max_bag_duration=5)
    taken = audio_path(tmp_path / "2026/03/01/home_20260301T070000Z.mcap")
    taken.mkdir(parents=True)
    layers = keep([noise(12)], about)
    assert [layer.name[14:20] for layer in layers] == ["070000", "070005", "070010"]
    assert sum(len(frames_of([layer])) for layer in layers[1:]) == 140
    first, again = output(_log(layers[1]))
    assert (first.startswith(f"no clips: {taken}"), again) == (True, "clips are kept again")


# A recorder that is killed


def test_a_killed_recorder_leaves_clips_that_the_next_one_completes(noise, tmp_path):
    logs = tmp_path / "logs"
    environment = {"HEARTHLOG_NEVER_KEEP": "[]", "HEARTHLOG_KEEP_AUDIO": "always"}
    command = [*HEARTHLOG, "record", str(noise(60)), "-o", str(logs), "--realtime"]
    process = subprocess.Popen(
        [*command, "--start", "2026-03-01T07:00:00"], env={**os.environ, **environment}
    )
    wait_for(lambda: _heard(logs, 60))
    process.kill()
    process.wait()
    (active,) = logs.rglob("*.audio.mcap.active")
    recorded, kept = len(read(_log(active), "features")), frames_of([active])
    assert recorded - 20 - 19 <= len(kept)
    record_files(requested(logs), FileSource([noise(3)], START + HOUR), Flag())
    assert not active.exists()
    complete = active.with_name(active.name.removesuffix(".active"))
    assert LogReader(complete).complete
    assert frames_of([complete]).keys() == kept.keys()


def _heard(logs, count):
    found = [p for p in logs.rglob("*.active") if "audio" not in p.name] if logs.exists() else []
    return bool(found) and len(read(found[0], "features")) > count


def _leave(noise, folder, change):
    """Leave a layer of sound as a recorder that was killed does, and start the next one."""
    (layer,) = keep([noise(5)], requested(folder, keep_audio="always", never_keep=[]))
    active = layer.with_name(layer.name + ".active")
    active.write_bytes(change(bytearray(layer.read_bytes())))
    layer.unlink()
    result = record_files(requested(folder), FileSource([noise(3)], START + HOUR), Flag())
    return layer, active, result.recovered


def _damaged(data):
    data[len(data) // 2] ^= 0xFF
    return bytes(data)


def test_of_damaged_clips_what_is_whole_is_left_and_nothing_besides(noise, tmp_path):
    layer, active, [recovered] = _leave(noise, tmp_path, _damaged)
    assert 0 < len(frames_of([layer])) < 100
    assert recovered.completed
    assert "damaged" in recovered.damage
    assert recovered.damage.endswith("this sound is deleted")
    assert sorted(path.name for path in layer.parent.glob("*T070000Z*")) == sorted(
        [layer.name, _log(layer).name]
    )
    assert not active.exists()


@pytest.mark.parametrize("size", [0, 100])
def test_clips_of_which_nothing_is_whole_are_deleted(noise, tmp_path, size):
    layer, active, recovered = _leave(noise, tmp_path, lambda data: bytes(data[:size]))
    assert len(recovered) == (size == 0)  # an empty file is named
    assert not active.exists()
    assert not layer.exists()


# Models


def test_sound_is_not_kept_without_a_model_that_knows_what_is_private(noise, model_file, tmp_path):
    about = requested(tmp_path / "logs", keep_audio="events")
    for reason, others in {
        "keep_audio = \"always\" needs a model with the class 'speech', which is never kept "
        "(there is none); use such a model, or set never_keep = [] to keep that too": {
            "keep_audio": "always"
        },
        'keep_audio = "events" needs a model to select the sound; name one, or use keep_audio = '
        "always": {"keep_audio": "events", "never_keep": []},
    }.items():
        about = requested(tmp_path / "logs", **others)
        with pytest.raises(ConfigurationError) as error:
            keep([noise(3)], about)
        assert str(error.value) == reason
    about = requested(tmp_path / "logs", model_file, keep_audio="unsure", never_keep=["speach"])
    with pytest.raises(ConfigurationError, match=r"with the class 'speach'.*this one has "):
        keep([noise(3)], about)
    assert not (tmp_path / "logs").exists()


class Swapped:
    """A day's sound, over and over, with another model put in place before each."""

    device = "test"

    def __init__(self, folder, logs, names, requested, path):
        samples = np.concatenate(list(read_audio(path)))
        self._blocks = samples[: len(samples) // 16_000 * 16_000].reshape(-1, 20, FRAME_SAMPLES)
        self._folder, self._logs, self._names, self._asked = folder, logs, names, requested
        self._first = 0
        self.unfinished = []  # layers at the end of each day

    def events(self, stop):
        del stop
        yield from self._day()
        for count, name in enumerate(self._names, 2):
            put_by_hand(self._folder, name)
            self._asked.request()
            deadline = time.monotonic() + 120
            while len([p for p in self._logs.rglob("*.mcap*") if not is_layer(p)]) < count:
                assert time.monotonic() < deadline
                yield self._block(0)
                time.sleep(0.02)
            yield from self._day()

    def _day(self):
        yield from map(self._block, range(len(self._blocks)))
        self.unfinished.append(len(list(self._logs.rglob("*.audio.mcap.active"))))

    def _block(self, number):
        stamps = START + np.arange(self._first, self._first + 20) * FRAME_NANOSECONDS
        found = Frames(self._first, self._blocks[number], stamps)
        self._first += 20
        return found


def test_clips_stop_while_a_model_speaks_that_does_not_know_what_is_private(
    day, model_file, tmp_path
):
    folder, logs = tmp_path / "models", tmp_path / "logs"
    folder.mkdir()
    one = load_model(model_file)
    about = one.description.model_dump_json().replace('"speech"', '"talk"')
    other = replace(one, description=Description.model_validate_json(about))
    save_model(one, folder / "one.safetensors")
    save_model(other, folder / "other.safetensors")
    for name in ("one", "other"):
        override_judgement(folder, load_model(folder / f"{name}.safetensors").sha256)
    (folder / "champion.safetensors").symlink_to("one.safetensors")
    requests = ReloadRequests()
    names = ["other.safetensors", "one.safetensors"]
    source = Swapped(folder, logs, names, requests, day)
    about = requested(
        logs, folder / "champion.safetensors", keep_audio="always", max_bag_duration=86_400
    )
    paths = record(about, source, Flag(), reload_requests=requests).logs
    assert [audio_path(path).exists() for path in paths] == [True, False, True]
    assert source.unfinished == [1, 0, 1]
    assert output(paths[0]) == []
    (text,) = output(paths[1])
    assert text.startswith(
        "no clips: keep_audio = \"always\" needs a model with the class 'speech'"
    )
    assert output(paths[2]) == ["clips are kept again"]


# Settings


def test_the_settings_of_clips_are_in_the_file_or_the_environment(tmp_path, monkeypatch):
    assert load_settings(None, {}, {}).keep_audio == "off"
    file = tmp_path / "hearthlog.toml"
    file.write_text('keep_audio = "unsure"\nnever_keep = ["speech", "crying"]\n')
    monkeypatch.setenv("HEARTHLOG_CLIP_RETENTION_DAYS", "7")
    found = load_settings(file, {}, {})
    assert (found.keep_audio, found.never_keep) == ("unsure", ["speech", "crying"])
    assert (found.clip_retention_days, found.clip_minutes_a_day) == (7, 30)
    assert load_settings(file, {"keep_audio": "events"}, {}).keep_audio == "events"
    with pytest.raises(ConfigurationError, match=r'keep_audio: .* is not one of "off", "events"'):
        load_settings(file, {"keep_audio": "yes"}, {})


def test_the_option_of_record_keeps_sound(day, model_file, tmp_path, hearthlog):
    options = ["--model", model_file, "--keep-audio", "always", "-o", tmp_path]
    result = hearthlog("record", day, *options)
    assert result.returncode == 0, result
    assert len(list(tmp_path.rglob("*.audio.mcap"))) == 1
    assert ".audio" not in result.stdout
