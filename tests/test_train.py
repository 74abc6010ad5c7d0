import csv
import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest
import soundfile
from blobs import SOURCES, blobs
from typer import Typer
from typer.testing import CliRunner

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.training import clips as clip_sound
from hearthlog.analyzer.training.clips import clip_frames
from hearthlog.analyzer.training.dataset import SEGMENTS_PER_GROUP, build_dataset
from hearthlog.analyzer.training.manifest import (
    BUILTIN,
    LABELS,
    LabelledClip,
    Scenario,
    read_manifest,
)
from hearthlog.analyzer.training.train import calibration_error, group_folds, train_model
from hearthlog.analyzer.training.window_methods import ROOM
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.features.installed import DEFAULT
from hearthlog.models.modelfile import load_model, model_card
from hearthlog.schemas.errors import ModelError, ignore_progress
from hearthlog.tools.cli.train import print_figures, train
from hearthlog.tools.home.simulate import write_training_set

pytestmark = pytest.mark.fast

RATE = 16_000
TOML = '[classes]\nsilence = ["silence"]\nmusic = ["music"]\nspeech = ["speech"]\n'


def sound(label, seconds, seed=0):
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal(int(seconds * RATE))
    time = np.arange(len(noise)) / RATE
    if label == "silence":
        return 1e-5 * noise
    if label == "music":
        return 0.1 * np.sin(2 * np.pi * rng.uniform(300, 2000) * time) + 1e-3 * noise
    return 0.1 * noise * np.sin(2 * np.pi * 3 * time)


def write(folder, name, samples):
    soundfile.write(folder / name, samples, RATE, subtype="FLOAT")
    return folder / name


def clip(folder, label, samples, group="g"):
    number = len(list(folder.iterdir()))
    return LabelledClip(write(folder, f"{number}.wav", samples), label, group, "", "")


def dataset(*clips):
    labels = sorted({c.label for c in clips})
    scenario = Scenario("test", {label: (label,) for label in labels})
    return build_dataset(clips, scenario, ignore_progress)


@pytest.fixture
def home(tmp_path):
    """A folder of 36 clips, three labels from four sources each."""
    rows = [["path", "label", "source_group", "source", "licence"]]
    for label in ("silence", "music", "speech"):
        for number in range(12):
            name = f"{label}_{number}.wav"
            write(tmp_path, name, sound(label, 3, number))
            rows.append([name, label, f"{label}_{number % 4}", "made up", "CC0"])
    with (tmp_path / "manifest.csv").open("w", newline="") as stream:
        csv.writer(stream).writerows(rows)
    (tmp_path / "home.toml").write_text(TOML)
    return tmp_path


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    """A manifest of two clips of each sound of a simulated home."""
    return write_training_set(tmp_path_factory.mktemp("simulated") / "clips", 2, seed=3)


def run(*arguments):
    app = Typer()
    app.command()(train)
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_segments_are_what_the_recorder_would_see(tmp_path):
    samples = sound("speech", 3).astype(np.float32)
    data = dataset(clip(tmp_path, "music", sound("music", 3)), clip(tmp_path, "speech", samples))
    features = DEFAULT.extractor()(samples.reshape(-1, 800))
    expected = np.stack([features[first : first + 20] for first in (0, 10, 20, 30, 40)])
    assert np.array_equal(data.windows[data.target == data.classes.index("speech")], expected)
    assert [amount.seconds for amount in data.amounts.values()] == [3.0, 3.0]


def test_quiet_stretches_of_a_clip_are_not_its_event_but_all_of_silence_is(tmp_path):
    loud_then_quiet = np.concatenate([sound("speech", 4), 0.05 * sound("speech", 4)])
    data = dataset(
        clip(tmp_path, "speech", loud_then_quiet), clip(tmp_path, "silence", loud_then_quiet)
    )
    segments = np.bincount(data.target)
    assert segments[data.classes.index("silence")] == 15
    assert segments[data.classes.index("speech")] == 8  # 7 in the loud half, 1 across


def test_silence_by_any_name_may_be_silent(tmp_path):
    data = dataset(
        clip(tmp_path, "speech", sound("speech", 3)), clip(tmp_path, "Silence", np.zeros(3 * RATE))
    )
    assert np.bincount(data.target).tolist() == [5, 5]


def test_sound_below_the_floor_teaches_nothing(tmp_path):
    whisper = clip(tmp_path, "speech", 1e-3 * sound("speech", 3))
    talk = clip(tmp_path, "speech", sound("speech", 3))
    data = dataset(whisper, talk, clip(tmp_path, "music", sound("music", 3)))
    assert data.skipped == {"nowhere above -60 dBFS": 1}


def test_a_source_gives_at_most_its_share_evenly_spaced(tmp_path):
    clips = [clip(tmp_path, "speech", sound("speech", 10, seed)) for seed in range(3)]
    data = dataset(*clips, clip(tmp_path, "music", sound("music", 60), "other"))
    assert np.bincount(data.target).tolist() == [SEGMENTS_PER_GROUP, SEGMENTS_PER_GROUP]
    each = [dataset(c, clip(tmp_path, "music", sound("music", 3))) for c in clips]
    full = np.concatenate([one.windows[one.target == 1] for one in each])
    place = [int((full == row).all(axis=(1, 2)).argmax()) for row in data.windows[data.target == 1]]
    assert (place[0], place[-1]) == (0, len(full) - 1)
    assert set(np.diff(place)) == {2, 3}


def test_clips_too_short_and_of_other_labels_are_counted(tmp_path):
    clips = [
        clip(tmp_path, "speech", sound("speech", 2)),
        clip(tmp_path, "speech", sound("speech", 0.99)),
        clip(tmp_path, "speech", sound("speech", 0.01)),
        clip(tmp_path, "silence", sound("silence", 1)),
        clip(tmp_path, "shower", sound("speech", 2)),
    ]
    two = Scenario("two", {"speech": ("speech",), "quiet": ("silence",)})
    data = build_dataset(clips, two, ignore_progress)
    assert data.skipped == {"label shower is not in the scenario": 1, "shorter than 1 s": 2}
    assert [amount.seconds for amount in data.amounts.values()] == [2.0, 1.0]


def test_a_class_nobody_recorded_is_named(tmp_path):
    clips = [clip(tmp_path, "speech", sound("speech", 2))]
    with pytest.raises(DataError, match=r"class silence .* labelled silence"):
        build_dataset(clips, BUILTIN["general"], ignore_progress)


def test_clips_that_cannot_be_read_are_left_out_and_named(tmp_path, monkeypatch):
    text, empty, cut = tmp_path / "x.wav", tmp_path / "empty.wav", tmp_path / "cut.flac"
    text.write_text("no sound")
    empty.touch()
    soundfile.write(tmp_path / "whole.flac", sound("speech", 6), RATE)
    cut.write_bytes((tmp_path / "whole.flac").read_bytes()[:50_000])
    long = clip(tmp_path, "speech", sound("speech", 5))
    bad = [LabelledClip(path, "speech", "g", "", "") for path in (text, empty, cut)]
    monkeypatch.setattr(clip_sound, "MOST_SECONDS", 4.0)
    good = clip(tmp_path, "speech", sound("speech", 3)), clip(tmp_path, "music", sound("music", 3))
    data = dataset(*bad, good[0], long, good[1])
    assert data.skipped == {"cannot be read, or not all of it": 4}
    assert [str(one.clip).split(":")[0] for one in data.left_out] == [
        *map(str, (text, empty, cut, long.path))
    ]
    reasons = "cannot be read as audio", "the file is empty", "cut short", "longer than an hour"
    assert all(reason in one.clip for reason, one in zip(reasons, data.left_out, strict=True))
    assert data.digest == dataset(*good).digest
    part = dataclasses.replace(bad[2], end=1.0)
    assert len(clip_frames(part)) == 20, "the part is there"
    with pytest.raises(DataError, match=r"class speech has no segments.*x\.wav"):
        dataset(bad[0], good[1])


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_clip_with_samples_that_are_no_numbers_is_learned_from_around_them(tmp_path, value):
    full = sound("speech", 6)
    broken = full.astype(np.float32)
    broken[int(2.5 * RATE) : 3 * RATE] = value
    broken[-1] = value  # and so the last frame
    path = tmp_path / "broken.wav"
    soundfile.write(path, broken, RATE, subtype="FLOAT")
    holed = LabelledClip(path, "speech", "g", "", "")
    parts = [dataclasses.replace(holed, end=2.5), dataclasses.replace(holed, start=3.0, end=5.95)]
    music = clip(tmp_path, "music", sound("music", 3), "other")
    data = dataset(holed, music)
    np.testing.assert_array_equal(data.windows, dataset(*parts, music).windows)
    assert np.isfinite(data.windows).all()
    assert not data.skipped
    (left,) = data.left_out
    assert left.clip == f"0.55 s of {path}"
    assert left.reason == "parts of clips, in which samples are not finite (NaN or infinity)"
    broken[::RATE] = value
    soundfile.write(path, broken, RATE, subtype="FLOAT")
    with pytest.raises(DataError, match=r"class speech has no segments.*0\.85 s of .*broken\.wav"):
        dataset(holed, music)


def test_a_training_goes_on_without_what_it_cannot_read_and_says_so(home):
    manifest = home / "manifest.csv"
    (home / "bad.wav").write_text("no sound")
    rows = "bad.wav,music,a,,\nnone.wav,music,a,,\nspeech_1.wav,spech,a,,\nspeech_2.wav,music\n"
    clean = run("--data", manifest, "--scenario", home / "home.toml", "-o", home / "a.safetensors")
    manifest.write_text(manifest.read_text() + rows)
    options = "--data", manifest, "--scenario", home / "home.toml"
    done = run(*options, "-o", home / "b.safetensors")
    assert (clean.exit_code, done.exit_code) == (0, 3)
    assert (home / "a.safetensors").read_bytes() == (home / "b.safetensors").read_bytes()
    reported = [line for line in done.stderr.splitlines() if "left out" in line]
    expected = (
        f"no such file: {manifest}:39: 'none.wav'",
        f"a label that the scenario does not know: {manifest}:40: 'spech'",
        f"a line that is not complete: {manifest}:41: has 2 fields",
        f"cannot be read, or not all of it: {home}/bad.wav: cannot be read as audio",
    )
    assert len(reported) == len(expected)
    for line, words in zip(reported, expected, strict=True):
        assert line.startswith(f"hearthlog: left out: 1, {words}")
    as_json = json.loads(run(*options, "-o", home / "c.safetensors", "--json").stdout)
    assert len(as_json["left_out"]) == 4
    manifest.write_text("path,label,source_group\n" + "none.wav,music,a\n" * 3)
    done = run(*options, "-o", home / "d.safetensors")
    assert "lists no clip that can be used" in str(done.exception)


@pytest.mark.parametrize("rate", [RATE, 44_100])
@pytest.mark.parametrize("suffix", ["wav", "ogg"])
def test_a_part_of_a_long_file_is_heard_alone(tmp_path, rate, suffix):
    silent, loud = np.zeros(25 * rate), 0.7 * np.sin(np.arange(3 * rate) * 880 * np.pi / rate)
    path = tmp_path / f"long.{suffix}"
    with soundfile.SoundFile(path, "w", rate, 1) as file:
        for second in np.concatenate([silent, loud, silent]).reshape(-1, rate):
            file.write(second)
    part = LabelledClip(path, "speech", "g", "", "", 24.0, 29.0)
    frames = clip_frames(part)
    level = np.abs(frames).mean(axis=1)
    assert len(frames) == 100
    assert (level[[2, 17, 82, 97]] < 0.1).all()
    assert (level[22:78] > 0.4).all()
    assert len(clip_frames(dataclasses.replace(part, end=np.inf))) == 29 * 20
    assert len(clip_frames(dataclasses.replace(part, start=53.0, end=60.0))) == 0


def test_parts_of_one_file_have_classes_of_their_own(tmp_path):
    path = write(tmp_path, "day.wav", np.concatenate([sound("speech", 3), sound("silence", 2)]))
    about = {"source_group": "g", "source": "", "licence": ""}
    data = dataset(
        LabelledClip(path, "speech", **about, end=3.0),
        LabelledClip(path, "silence", **about, start=3.0),
        LabelledClip(path, "speech", **about, start=9.0),
    )
    assert {name: amount.seconds for name, amount in data.amounts.items()} == {
        "silence": 2.0,
        "speech": 3.0,
    }
    assert data.skipped == {"shorter than 1 s": 1}


def test_folds_never_split_a_source_and_test_every_segment_once():
    data, _ = blobs(4, 30)
    folds = group_folds(data)
    assert len(folds) == 5
    assert sorted(np.concatenate([unseen for _, unseen in folds])) == list(range(120))
    for seen, unseen in folds:
        assert not set(data.group[seen]) & set(data.group[unseen])
        assert set(data.target[seen]) == set(range(4))


def with_sources(data, index, count):
    group = data.group.copy()
    group[data.target == index] = index * SOURCES + np.arange((data.target == index).sum()) % count
    return dataclasses.replace(data, group=group)


@pytest.mark.parametrize("count", [2, 3])
def test_a_class_of_few_sources_means_fewer_folds(count):
    data, scenario = blobs(3, 30)
    few = with_sources(data, 1, count)
    assert len(group_folds(few)) == count
    assert train_model(few, scenario, ignore_progress).description.metrics.folds == count


def test_a_class_of_one_source_is_refused_with_its_name_and_number():
    data, scenario = blobs(3, 30)
    with pytest.raises(DataError, match="class class_1 has 1 source group"):
        train_model(with_sources(data, 1, 1), scenario, ignore_progress)


def test_sources_shared_so_that_nothing_is_left_to_learn_from_are_refused():
    data, scenario = blobs(3, 30)
    # Two folds of three sources keep two together, and some class has just these two.
    group = (data.target + np.arange(len(data.target)) % 2) % 3
    with pytest.raises(DataError, match="no division into folds"):
        train_model(dataclasses.replace(data, group=group), scenario, ignore_progress)


def test_the_mean_of_f1_says_of_which_class_it_is_not(capsys):
    general = load_model(Path("general"))
    print_figures(general)
    rows = re.findall(
        r"^(\w[\w ]*?)  .* (\d\.\d+)$", capsys.readouterr().out.partition("\n\n")[0], re.MULTILINE
    )
    known = [float(f1) for name, f1 in rows if name != "Not recognised"]
    assert len(known) == len(general.classes) - 1
    printed = f"macro F1 without unknown: {np.mean(known):.3f}"
    assert printed in model_card(general)
    print_figures(general)
    assert f"macro F1 {np.mean(known):.3f} without 'Not recognised', " in capsys.readouterr().out


def test_metrics_agree_with_each_other_and_with_the_data():
    data, scenario = blobs(4, 30, spread=3.0)
    about = train_model(data, scenario, ignore_progress).description
    confusion = np.array(about.metrics.confusion)
    right = np.diag(confusion)
    f1 = 2 * right / (confusion.sum(axis=0) + confusion.sum(axis=1))
    assert confusion.sum(axis=1).tolist() == [30] * 4
    assert 0.3 < about.metrics.macro_f1 < 0.95
    assert about.metrics.macro_f1 == pytest.approx(f1.mean())
    assert [m.f1 for m in about.metrics.classes.values()] == pytest.approx(f1.tolist())
    assert [a.sources for a in about.training_data.classes.values()] == [SOURCES] * 4


def test_labels_without_meaning_are_recognised_at_chance():
    data, scenario = blobs(2, 60)
    noise = np.random.default_rng(2).random(data.windows.shape, np.float32)
    noise = dataclasses.replace(data, windows=noise)
    costly = ROOM.with_parameters({"cost": 4.0})
    model = train_model(noise, scenario, ignore_progress, costly)
    assert model.description.metrics.macro_f1 < 0.62
    assert model.description.smoothing.weight == 10.0  # so unsure that it is bounded


def test_calibration_error_is_the_gap_of_confidence_and_truth():
    sure = np.array([[0.9, 0.1]] * 10)
    assert calibration_error(sure, np.array([0] * 9 + [1])) == pytest.approx(0.0)
    assert calibration_error(sure, np.ones(10, np.intp)) == pytest.approx(0.9)


def test_the_command_makes_a_model_that_knows_its_sounds(home):
    output = home / "home.safetensors"
    result = run("--data", home, "--scenario", home / "home.toml", "--output", output)
    assert result.exit_code == 0, result.output
    assert float(re.search(r"macro F1 (\d\.\d+)", result.stdout)[1]) > 0.98
    assert "listening to 36 clips" in result.stderr
    model = load_model(output)
    assert model.classes == ("silence", "music", "speech")
    for label in model.classes:
        samples = sound(label, 1, seed=99).astype(np.float32)
        features = DEFAULT.extractor()(samples.reshape(-1, 800))
        classifier = Classifier(model)
        inputs = classifier.inputs.stream()(features, np.zeros((len(features), DEFAULT.bands)))
        best = classifier.probabilities(inputs).mean(axis=0).argmax()
        assert model.classes[best] == label


def test_the_same_clips_give_the_same_bytes(home):
    options = ("--data", home / "manifest.csv", "--scenario", home / "home.toml", "--json")
    first = run(*options, "--output", home / "a.safetensors")
    second = run(*options, "--output", home / "b.safetensors")
    assert (home / "a.safetensors").read_bytes() == (home / "b.safetensors").read_bytes()
    a, b = json.loads(first.stdout), json.loads(second.stdout)
    assert a["sha256"] == b["sha256"]
    assert a["metrics"]["macro_f1"] > 0.98
    assert a["training_data"]["collections"] == [{"name": "made up", "licence": "CC0", "clips": 36}]


def test_another_seed_draws_other_rooms_and_the_model_says_which(home):
    options = ("--data", home / "manifest.csv", "--scenario", home / "home.toml", "--json")
    files = [home / f"{name}.safetensors" for name in ("none", "first", "other", "again")]
    seeds = [(), ("--seed", 0), ("--seed", 1), ("--seed", 1)]
    results = [
        run(*options, *seed, "--output", file) for file, seed in zip(files, seeds, strict=True)
    ]
    none, first, other, again = (file.read_bytes() for file in files)
    assert none == first
    assert other == again
    landmarks = [load_model(file).arrays["landmarks"] for file in files[1:3]]
    assert not np.array_equal(*landmarks)
    assert [json.loads(result.stdout).get("seed") for result in results] == [None, None, 1, 1]


@pytest.mark.parametrize(
    ("scenario", "names"),
    [
        ("general", {"speech": "Speech", "crying": "Crying, sobbing", "yelling": "shout"}),
        ("general", {"phone_ring": "Ringtone", "coughing": "cough", "laughing": "laughter"}),
        ("bathroom", {"flushing_water": "Toilet flush", "tap_water": "water_tap_faucet"}),
        ("bathroom", {"silence": "Silence", "crying": "Crying_and_sobbing"}),
    ],
)
def test_a_manifest_of_other_names_teaches_the_same_model(simulated, tmp_path, scenario, names):
    renamed = simulated.with_name(f"{tmp_path.name}.csv")
    with simulated.open(newline="") as stream:
        rows = list(csv.reader(stream))
    with renamed.open("w", newline="") as stream:
        csv.writer(stream).writerows(
            [path, names.get(label, label), *rest] for path, label, *rest in rows
        )
    files = [tmp_path / f"{path.stem}.safetensors" for path in (simulated, renamed)]
    for path, file in zip((simulated, renamed), files, strict=True):
        result = run("--data", path, "--scenario", scenario, "--output", file, "--method", "paper")
        assert result.exit_code == 0, result.output
    assert files[0].read_bytes() == files[1].read_bytes()


def test_an_output_that_exists_is_refused_before_anything_is_read(tmp_path):
    output = tmp_path / "a.safetensors"
    output.touch()
    result = run("--data", tmp_path / "nowhere", "--scenario", "general", "--output", output)
    assert isinstance(result.exception, ModelError)
    assert "exists already" in str(result.exception)


@pytest.mark.parametrize(
    "words",
    [
        (),
        ("--data", "x"),
        ("--base", "x"),
        ("--base", "x", "--home", "y", "--data", "z"),
        ("--base", "x", "--home", "y", "--seed", "1"),
    ],
)
def test_wrong_use_of_the_command_is_one_line(tmp_path, words):
    result = run(*words, "--output", tmp_path / "a.safetensors")
    assert result.exit_code == 2
    assert result.stderr.startswith("hearthlog: ")
    assert result.stderr.count("\n") == 1


def test_household_sounds_are_told_apart_across_sources(all_household):
    per_group: dict[tuple[str, str], int] = {}
    labels = ("silence", "coughing", "crying", "yelling", "objects_activity")
    chosen = []
    for item in read_manifest(all_household / "manifest.csv", LABELS):
        key = (item.label, item.source_group)
        per_group[key] = per_group.get(key, 0) + 1
        groups = len({group for label, group in per_group if label == item.label})
        if item.label in labels and per_group[key] <= 2 and groups <= 30:
            chosen.append(item)
    scenario = Scenario("five", {label: (label,) for label in labels})
    data = build_dataset(chosen, scenario, ignore_progress)
    metrics = train_model(data, scenario, ignore_progress).description.metrics
    assert metrics.macro_f1 > 0.65
    assert metrics.expected_calibration_error < 0.08
