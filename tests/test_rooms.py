"""Sounds in other rooms: as noisy as asked for, the same each time, and noise alone is silence."""

from dataclasses import replace

import numpy as np
import pytest
import soundfile
from scipy.signal import welch

from hearthlog.analyzer.training import clips as rooms
from hearthlog.analyzer.training.clips import empty_room, in_room, reverberated, steady_noise
from hearthlog.analyzer.training.dataset import build_dataset, clip_recordings, cut_recordings
from hearthlog.analyzer.training.manifest import (
    LABELS,
    LabelledClip,
    Scenario,
    load_scenario,
    read_manifest,
)
from hearthlog.analyzer.training.method import prepare
from hearthlog.analyzer.training.train import train_model
from hearthlog.analyzer.training.window_methods import ROOM, spread_over_classes
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.features.floor import FloorTracker
from hearthlog.models.features.installed import DEFAULT
from hearthlog.models.labels.labeller import Labeller
from hearthlog.schemas.errors import ignore_progress
from hearthlog.schemas.frames import FRAME_NANOSECONDS, FRAME_SAMPLES, SAMPLE_RATE
from hearthlog.tools.home.simulate import write_training_set

pytestmark = pytest.mark.fast


def level_of(powers):
    return 10 * np.log10(np.mean(powers))


def speech_like(seconds, level, seed=0):
    """Frames of a sound that comes and goes, at a level in dBFS."""
    rng = np.random.default_rng(seed)
    count = seconds * SAMPLE_RATE
    sound = rng.standard_normal(count) * np.abs(np.sin(2 * np.pi * np.arange(count) / 8000)) ** 2
    sound *= 10 ** (level / 20) / np.sqrt(np.mean(sound**2))
    return sound.astype(np.float32).reshape(-1, FRAME_SAMPLES)


@pytest.fixture
def plain(monkeypatch):
    """Rooms without echoes, microphones that are even, and floors that are known exactly."""
    monkeypatch.setattr(rooms, "_COPIED_SHARE", 0.0)
    monkeypatch.setattr(rooms, "_FLOOR_ERROR_DB", 0.0)


def requested(monkeypatch, **values):
    for name, value in values.items():
        monkeypatch.setattr(rooms, name, (value, value))


@pytest.mark.parametrize("level", [-85.0, -60.0, -32.0])
@pytest.mark.parametrize("seed", range(4))
def test_steady_noise_has_the_level_that_was_asked_for(level, seed):
    noise = steady_noise(SAMPLE_RATE * 3, level, np.random.default_rng(seed))
    assert level_of(noise**2) == pytest.approx(level, abs=1e-9)


@pytest.mark.parametrize(("slope", "decibels"), [(0.0, 0.0), (0.5, -3.01), (1.0, -6.02)])
def test_its_spectrum_falls_by_some_decibels_an_octave(monkeypatch, slope, decibels):
    monkeypatch.setattr(rooms, "_SLOPES", (slope,))
    noise = steady_noise(SAMPLE_RATE * 60, -30.0, np.random.default_rng(0))
    frequencies, density = welch(noise, SAMPLE_RATE, nperseg=2048)
    inside = (frequencies > 100) & (frequencies < 6000)
    octaves, levels = np.log2(frequencies[inside]), 10 * np.log10(density[inside])
    assert np.polyfit(octaves, levels, 1)[0] == pytest.approx(decibels, abs=0.1)


@pytest.mark.usefixtures("plain")
@pytest.mark.parametrize("ratio", [5.0, 15.0, 30.0])
def test_a_copy_in_a_room_has_the_noise_that_was_asked_for(monkeypatch, ratio):
    requested(monkeypatch, _SIGNAL_TO_NOISE_DB=ratio, _GAIN_DB=0.0)
    frames = speech_like(5, -25.0)
    features, floor = in_room(frames, DEFAULT, np.random.default_rng(0), silence=False)
    assert features.shape == (len(frames), DEFAULT.width)
    assert 10 * np.log10(floor[-1]) == pytest.approx(-25 - ratio, abs=0.1)
    noisy = 10 ** (-25 / 10) * (1 + 10 ** (-ratio / 10))
    assert level_of(DEFAULT.power(features)) == pytest.approx(10 * np.log10(noisy), abs=0.5)


@pytest.mark.usefixtures("plain")
@pytest.mark.parametrize("gain", [-20.0, 0.0, 12.0])
def test_and_the_gain(monkeypatch, gain):
    requested(monkeypatch, _SIGNAL_TO_NOISE_DB=30.0, _GAIN_DB=gain)
    features, _ = in_room(speech_like(5, -40.0), DEFAULT, np.random.default_rng(0), silence=False)
    assert level_of(DEFAULT.power(features)) == pytest.approx(-40 + gain, abs=0.2)


@pytest.mark.usefixtures("plain")
def test_what_is_too_loud_for_a_microphone_is_cut_off(monkeypatch):
    requested(monkeypatch, _GAIN_DB=20.0)
    features, _ = in_room(speech_like(2, -3.0), DEFAULT, np.random.default_rng(0), silence=False)
    assert DEFAULT.power(features).max() <= 1.0


@pytest.mark.usefixtures("plain")
@pytest.mark.parametrize("noise", [-85.0, -60.0, -40.0])
def test_silence_has_noise_of_any_level_and_is_its_own_floor(monkeypatch, noise):
    requested(monkeypatch, _SILENCE_DBFS=noise, _GAIN_DB=0.0)
    frames = np.zeros((100, FRAME_SAMPLES), np.float32)
    features, floor = in_room(frames, DEFAULT, np.random.default_rng(0), silence=True)
    assert level_of(DEFAULT.power(features)) == pytest.approx(noise, abs=0.3)
    assert 10 * np.log10(floor[-1]) == pytest.approx(noise, abs=0.5)


@pytest.mark.usefixtures("plain")
def test_an_empty_room_is_its_own_floor():
    rng = np.random.default_rng(0)
    copies = [empty_room(DEFAULT, rng) for _ in range(30)]
    levels = np.array([level_of(DEFAULT.power(copy.features)) for copy in copies])
    floors = 10 * np.log10([copy.floor[-1] for copy in copies])
    np.testing.assert_allclose(floors, levels, atol=1.5)
    assert levels.min() < -75
    assert levels.max() > -45


def test_a_reverberant_room_is_as_loud_and_rings_on():
    click = np.zeros(SAMPLE_RATE)
    click[100] = 1.0
    for seed, seconds in enumerate([0.1, 0.2, 0.3, 0.45, 0.6]):
        sound = reverberated(click, seconds, 3.0, np.random.default_rng(seed))
        assert np.mean(sound**2) == pytest.approx(np.mean(click**2))
        assert not np.abs(sound[:100]).max() > 1e-9
        assert not np.abs(sound[101:148]).max() > 1e-9  # 3 ms without an echo
        assert np.abs(sound[200:1500]).max() > 1e-3
        assert np.abs(sound[12_000:]).max() < 1e-3


def clips_in(folder, count=6):
    clips = []
    for number in range(count):
        label = ("silence", "speech")[number % 2]
        frames = speech_like(3, -70.0 if label == "silence" else -25.0, number)
        path = folder / f"{number}.wav"
        soundfile.write(path, frames.ravel(), SAMPLE_RATE, subtype="FLOAT")
        clips.append(LabelledClip(path, label, str(number), "made up", "CC0"))
    return clips


SCENARIO = Scenario("rooms", {"silence": ("silence",), "speech": ("speech",)})


def test_the_same_clips_give_the_same_copies_and_no_two_are_alike(tmp_path):
    clips = clips_in(tmp_path)
    first, second = (build_dataset(clips, SCENARIO, ignore_progress, rooms=3) for _ in range(2))
    assert first.copies.shape == (3, *first.windows.shape)
    assert first.copy_floor.shape == (3, len(first), DEFAULT.bands)
    for name in ("windows", "copies", "floor", "copy_floor"):
        assert np.array_equal(getattr(first, name), getattr(second, name))
    every = [first.windows, *first.copies]
    assert all((every[i] != every[j]).any(axis=(1, 2)).all() for i in range(4) for j in range(i))
    assert first.digest == build_dataset(clips, SCENARIO, ignore_progress).digest


def test_a_clip_has_the_same_copies_whatever_comes_behind_it(tmp_path):
    clips = clips_in(tmp_path)
    full = list(clip_recordings(clips, SCENARIO, ignore_progress, rooms=2))
    part = list(clip_recordings(clips[:3], SCENARIO, ignore_progress, rooms=2))
    for one, other in zip(full, part, strict=False):
        for copy, again in zip(one.copies, other.copies, strict=True):
            assert np.array_equal(copy.features, again.features)
            assert np.array_equal(copy.floor, again.floor)


def test_a_clip_is_without_a_room_but_silence_is_one(tmp_path):
    data = build_dataset(clips_in(tmp_path), SCENARIO, ignore_progress)
    of_silence = data.target == 0
    assert not data.floor[~of_silence].any()
    np.testing.assert_allclose(10 * np.log10(data.floor[of_silence, -1]), -71, atol=5)


def test_a_segment_without_copies_is_learned_from_as_it_is(tmp_path):
    """A home has no sound, so that its marks have no copies."""
    recordings = list(clip_recordings(clips_in(tmp_path), SCENARIO, ignore_progress, rooms=2))
    recordings[1] = recordings[1]._replace(copies=())
    data = cut_recordings(recordings, SCENARIO)
    alone = data.group == 1
    assert np.isnan(data.copies[:, alone]).all()
    assert not np.isnan(data.copies[:, ~alone]).any()
    examples = prepare(ROOM, data)
    assert np.isfinite(examples.inputs).all()
    assert not examples.usable[1:, alone].any()
    assert examples.usable[0, alone].any()


@pytest.fixture(scope="module")
def household_model(all_household):
    """A model of a fifth of the clips of silence, and of about six of each other class."""
    scenario = load_scenario("general")
    clips = read_manifest(all_household / "manifest.csv", scenario.labels)
    by_label = {label: [c for c in clips if c.label == label] for label in scenario.labels}
    chosen = by_label.pop("silence")[::5]
    for own in by_label.values():
        chosen += own[:: max(len(own) // 6, 1)]
    data = build_dataset(chosen, scenario, ignore_progress, rooms=ROOM.rooms)
    return train_model(data, scenario, ignore_progress, ROOM)


QUIET = [-80, -70]  # of a steep slope, 16 bits have the lowest bands only: it needs the gate


@pytest.mark.parametrize(
    ("level", "slope", "gate"),
    [
        (level, slope, gate)
        for level in [*QUIET, -60, -50, -40]
        for slope in [0.0, 0.5, 1.0]
        for gate in [True, False]
        if gate or slope < 1.0 or level not in QUIET
    ],
)
def test_steady_noise_is_silence(household_model, monkeypatch, level, slope, gate):
    monkeypatch.setattr(rooms, "_SLOPES", (slope,))
    noise = steady_noise(30 * SAMPLE_RATE, level, np.random.default_rng(level % 7))
    samples = (np.rint(noise * 32768) / 32768).astype(np.float32).reshape(-1, FRAME_SAMPLES)
    model = household_model
    if not gate:
        model = replace(model, description=model.description.model_copy(update={"gate": 0.0}))
    labeller, features = Labeller(Classifier(model)), DEFAULT.extractor()(samples)
    floors = FloorTracker()(DEFAULT.band_powers(features), 0)
    stamps = np.arange(len(features)) * FRAME_NANOSECONDS
    labels, segments = labeller.push(features, floors, 0, stamps)
    segments += labeller.close(len(features) * FRAME_NANOSECONDS)
    silence = model.classes.index("silence")
    share = (labels.probabilities.argmax(axis=1) == silence).mean()
    assert share > (0.99 if gate else 0.9)
    assert [segment.label for segment in segments] == [silence]


def test_of_more_windows_than_can_be_learned_from_small_classes_are_kept_whole(tmp_path):
    scenario = Scenario("two", {"speech": ("speech",), "music": ("music",)})
    manifest = write_training_set(tmp_path / "clips", clips_per_class=3, seed=5)
    clips = read_manifest(manifest, LABELS)
    clips = [c for c in clips if c.label == "speech" or c.path.name == "music_001.flac"]
    data = build_dataset(clips, scenario, ignore_progress, features=ROOM.features, rooms=ROOM.rooms)
    examples = prepare(ROOM, data)
    few = np.bincount(examples.windows(slice(None))[1])[1]
    counts = np.bincount(chosen_classes(examples, 2 * few + 10))
    assert counts.tolist() == [few + 10, few]


def chosen_classes(examples, most):
    _, target, weight = examples.windows(slice(None))
    return target[spread_over_classes(target, weight, most, 0)]
