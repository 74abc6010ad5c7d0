"""An offset, a drift or a rumble below hearing hides no sound, and other sound stays as it is."""

from datetime import UTC, datetime
from pathlib import Path
from threading import Event as Flag

import numpy as np
import pytest
import soundfile
from logs import read

from hearthlog import classify, extract_features
from hearthlog.analyzer.training.clips import clip_frames
from hearthlog.analyzer.training.manifest import LabelledClip
from hearthlog.models.features.infrasound import InfrasoundFilter
from hearthlog.models.features.installed import DEFAULT
from hearthlog.models.modelfile import load_model
from hearthlog.recorder.config import Settings
from hearthlog.recorder.recording import record_files
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.recorder.sources.decoding import read_audio
from hearthlog.recorder.stream.sound_watch import OFFSET, RUMBLE, problem_of_file
from hearthlog.schemas.frames import FRAME_SAMPLES

pytestmark = pytest.mark.fast

RATE = 16_000
START = int(datetime(2026, 3, 1, 7, tzinfo=UTC).timestamp()) * 1_000_000_000
LABELS = ("coughing", "crying", "objects_activity", "coughing")


@pytest.fixture(scope="module")
def scene(household):
    """Sounds of four classes in a quiet room, which peak at half of full scale."""
    sound = np.random.default_rng(1).normal(0, 3e-4, 31 * RATE)
    for number, label in enumerate(LABELS):
        clip = sorted(household.glob(f"{label}/*.flac"))[number // 3]
        samples = np.concatenate([*read_audio(clip)])[: 4 * RATE].astype(np.float64)
        at = (3 + 7 * number) * RATE
        sound[at : at + len(samples)] += samples / np.abs(samples).max() * 0.5
    return sound


@pytest.fixture(scope="module")
def model():
    return load_model(Path("general"))


def as_int16(sound):
    return np.clip(np.rint(sound * 32768), -32768, 32767).astype(np.int16)


def as_frames(sound):
    samples = as_int16(sound).astype(np.float32) / np.float32(32768)
    return samples[: len(samples) // FRAME_SAMPLES * FRAME_SAMPLES].reshape(-1, FRAME_SAMPLES)


def time_of(sound):
    return np.arange(len(sound)) / RATE


def rumble(sound, frequency, level=0.04):
    return level * np.sin(2 * np.pi * frequency * time_of(sound))


FAULTS = {
    "an offset of 0.5 %": lambda _: 0.005,
    "an offset of -3 %": lambda _: -0.03,
    "an offset of 20 %": lambda _: 0.2,
    "an offset that grows": lambda sound: 0.1 * time_of(sound) / 31,
    "a step": lambda sound: 0.02 * (time_of(sound) > 15.02),
    "an offset that comes and goes": lambda sound: 0.02 * (time_of(sound) % 14 < 7),
    "a drift": lambda sound: rumble(sound, 0.3, 0.02),
    "a rumble of 5 Hz": lambda sound: rumble(sound, 5),
    "a rumble of 10 Hz": lambda sound: rumble(sound, 10),
    "a rumble of 12 Hz": lambda sound: rumble(sound, 12),
    "both": lambda sound: 0.01 + rumble(sound, 5, 0.01),
}


@pytest.mark.parametrize("gain", [1.0, 0.1])
@pytest.mark.parametrize("fault", FAULTS)
def test_what_is_below_hearing_hides_no_sound(scene, model, fault, gain):
    sound = scene * gain
    plain = classify(model, as_int16(sound), RATE)
    recorded = classify(model, as_int16(sound + FAULTS[fault](sound)), RATE)
    is_sound = plain.labels != "silence"
    assert 0.2 < is_sound.mean() < 0.6
    same = recorded.labels == plain.labels
    assert same[is_sound].mean() > 0.85
    assert same[~is_sound].mean() > 0.95


def test_sound_in_which_nothing_stands_out_below_hearing_stays_as_it_is(scene, real_frames):
    quiet = as_frames(scene + 3 / 32768)
    assert InfrasoundFilter()(quiet) is quiet
    hum = as_frames(scene + sum(rumble(scene, f, 0.01) for f in (50, 100, 150)))
    assert InfrasoundFilter()(hum) is hum
    thumps = scene.copy()
    thumps[:: 2 * RATE] += 0.3
    thump = 0.3 * np.hanning(RATE // 5)
    for start in range(RATE, len(thumps) - RATE, 3 * RATE):
        thumps[start : start + len(thump)] += thump
    thumps = as_frames(thumps)
    assert InfrasoundFilter()(thumps) is thumps
    changed = (InfrasoundFilter()(real_frames) != real_frames).any(axis=1)
    assert changed.mean() < 0.2  # of recordings, some of which have wind in them


@pytest.mark.parametrize("size", [1, 7, 64])
def test_blocks_of_any_size_give_the_same_bits(scene, size):
    frames = as_frames(scene + FAULTS["an offset that comes and goes"](scene))
    frames[200:400] += as_frames(rumble(scene, 5))[200:400]
    at_once, filter_ = InfrasoundFilter()(frames), InfrasoundFilter()
    assert not np.array_equal(at_once, frames)
    blocks = [filter_(frames[first : first + size]) for first in range(0, len(frames), size)]
    np.testing.assert_array_equal(np.concatenate(blocks), at_once)
    filter_.restart()
    np.testing.assert_array_equal(filter_(frames), at_once)


@pytest.mark.parametrize("level", [1.0, 0.05, 1e-3, 1e30])
def test_frames_that_need_no_closer_look_are_those_in_which_nothing_stands_out(
    scene, real_frames, monkeypatch, level
):
    edge = 3e-4 * np.sin(2 * np.pi * time_of(scene) / 7) * rumble(scene, 9, 4.0)  # the least power
    faulty = [as_frames(scene + fault(scene)) for fault in FAULTS.values()]
    frames = np.concatenate([*faulty, as_frames(scene + edge), real_frames]) * np.float32(level)
    quick = InfrasoundFilter()(frames)
    monkeypatch.setattr(
        InfrasoundFilter, "_may_stand_out", lambda _, frames: np.ones(len(frames), bool)
    )
    np.testing.assert_array_equal(InfrasoundFilter()(frames), quick)


def test_samples_of_16_bits_remain_such_and_are_left_alone_the_second_time(scene):
    frames = as_frames(scene + 0.01 + rumble(scene, 5))
    filtered = InfrasoundFilter()(frames)
    np.testing.assert_array_equal(np.rint(filtered * 32768), filtered * 32768)
    assert InfrasoundFilter()(filtered) is filtered


@pytest.mark.parametrize(
    ("fault", "problem"), [("an offset of -3 %", OFFSET), ("a rumble of 5 Hz", RUMBLE)]
)
def test_a_recording_a_clip_and_the_api_agree_and_the_fault_is_told(
    scene, tmp_path, fault, problem
):
    path = tmp_path / "sound.wav"
    sound = as_int16(scene + FAULTS[fault](scene))
    soundfile.write(path, sound, RATE)
    about = Settings(output=tmp_path / "logs", model=Path("none"), timezone="UTC")
    record_files(about, FileSource([path], START), Flag())
    logged = np.array([m.values for m in read(tmp_path / "logs", "features")], np.float32)
    np.testing.assert_array_equal(logged, extract_features(sound, RATE).values)
    clip = LabelledClip(path, "music", "a", "b", "c")
    np.testing.assert_array_equal(logged, DEFAULT.extractor()(clip_frames(clip)))
    plain = extract_features(as_int16(scene), RATE).values
    assert np.median(np.abs(logged[:, 0] - plain[:, 0])) < 1e-7
    states = [status for m in read(tmp_path / "logs", "diagnostics") for status in m.status]
    assert [status.message for status in states] == ["reading"] * 2 + [problem_of_file(problem)] * 2


def test_a_faint_offset_is_left_out_without_a_word(scene, tmp_path):
    soundfile.write(tmp_path / "sound.wav", as_int16(scene + 0.001), RATE)
    about = Settings(output=tmp_path / "logs", model=Path("none"), timezone="UTC")
    record_files(about, FileSource([tmp_path / "sound.wav"], START), Flag())
    states = [status for m in read(tmp_path / "logs", "diagnostics") for status in m.status]
    assert {status.message for status in states} == {"reading"}
    logged = np.array([m.values[0] for m in read(tmp_path / "logs", "features")])
    assert np.median(logged) < 2e-7
