"""Scenes have the truth that they say; what a model hears in them is scored as it is."""

import json
import random
from dataclasses import replace

import numpy as np
import pytest
import soundfile
from log_fixtures import run

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.evaluation.scenes import (
    SceneOptions,
    _labelling,
    _moved,
    _Recorder,
    background,
    compose,
    compose_single,
    evaluate_scenes,
    loudest,
)
from hearthlog.analyzer.training.manifest import read_manifest, scenario_of
from hearthlog.models.modelfile import load_model, save_model
from hearthlog.schemas.errors import ignore_progress
from hearthlog.schemas.frames import SAMPLE_RATE
from hearthlog.tools.home.simulate import write_training_set

SECONDS = 60
OPTIONS = SceneOptions(scenes=2, seconds=120.0)


def made_up_clips(count=4):
    """Clips of 1 to 14 s of three labels, as samples."""
    rng = np.random.default_rng(5)
    return {
        label: [
            (0.1 * rng.standard_normal(int(rng.uniform(1, 14) * SAMPLE_RATE))).astype(np.float32)
            for _ in range(count)
        ]
        for label in ("speech", "coughing", "music")
    }


def protocol(clips, seed, level, power, *, single=0):
    """The scene as it was first described, step by step in double precision."""
    rng, seconds = random.Random(seed), SECONDS
    count = seconds * SAMPLE_RATE
    spectrum = np.fft.rfft(np.random.default_rng(seed).standard_normal(count))
    spectrum /= np.maximum(np.fft.rfftfreq(count, 1 / SAMPLE_RATE), 20.0) ** power
    noise = np.fft.irfft(spectrum, count)
    out = (noise / np.sqrt(np.mean(noise**2)) * 10 ** (level / 20)).astype(np.float32)
    labels, t = [], 2.0
    while t < seconds - 12 and (not single or len(labels) < single):
        label = rng.choice(sorted(clips))
        x = rng.choice(clips[label])
        x = loudest(x, 0.3) if single else x[: int(rng.uniform(3, 10) * SAMPLE_RATE)]
        start = int(t * SAMPLE_RATE)
        out[start : start + len(x)] += x
        labels.append((t, t + len(x) / SAMPLE_RATE, label))
        t += len(x) / SAMPLE_RATE + (rng.uniform(2, 8) if single else rng.choice((0.5, 2, 6)))
    return np.clip(out[: int((t + 5) * SAMPLE_RATE)], -1, 1), labels


@pytest.mark.fast
@pytest.mark.parametrize(("colour", "power"), [("white", 0.0), ("pink", 0.5), ("brown", 1.0)])
@pytest.mark.parametrize("seed", [0, 10])
def test_a_scene_is_that_of_the_protocol(colour, power, seed):
    clips = made_up_clips()
    samples, labels = protocol(clips, seed, -40.0, power)
    scene = compose(clips, lambda clip: clip, background(SECONDS, -40.0, colour, seed), seed)
    assert [tuple(span) for span in scene.sounds] == labels
    np.testing.assert_allclose(scene.samples, samples, atol=1e-6)


@pytest.mark.fast
def test_single_sounds_are_those_of_the_protocol():
    clips = {"coughing": made_up_clips()["coughing"]}
    samples, labels = protocol(clips, 3, -70.0, 0.0, single=120)
    noise = background(SECONDS, -70.0, "white", 3)
    scene = compose_single("coughing", clips["coughing"], lambda clip: clip, noise, 3)
    assert [tuple(span) for span in scene.sounds] == labels
    np.testing.assert_allclose(scene.samples, samples, atol=1e-6)
    assert {round(span.end - span.start, 3) for span in scene.sounds} == {0.3}


@pytest.mark.fast
def test_no_more_than_120_single_sounds_are_laid():
    sound = np.full(SAMPLE_RATE // 10, 0.1, np.float32)
    noise = np.zeros(1200 * SAMPLE_RATE, np.float32)
    scene = compose_single("coughing", [sound], lambda clip: clip, noise, 1)
    assert len(scene.sounds) == 120
    assert len(scene.samples) < len(noise)


@pytest.mark.fast
def test_the_truth_lies_where_the_sound_is():
    clips = {"speech": [np.full(4 * SAMPLE_RATE, 0.1, np.float32)]}
    noise = background(SECONDS, -100.0, "white", 1)
    scene = compose(clips, lambda clip: clip, noise, 1, gain=-6.0206)
    loud = np.abs(scene.samples) > 0.01
    assert np.median(np.abs(scene.samples[loud])) == pytest.approx(0.05, abs=1e-3)
    true = np.zeros(len(loud), bool)
    for start, end, _ in scene.sounds:
        true[int(start * SAMPLE_RATE) : int(end * SAMPLE_RATE)] = True
    assert (loud != true).sum() <= 2 * len(scene.sounds)  # a sample at each border
    times = [scene.truth[0].start, *(span.end for span in scene.truth)]
    assert times == [0.0, *(span.start for span in scene.truth[1:]), len(loud) / SAMPLE_RATE]
    assert [span.label for span in scene.truth[::2]] == ["silence"] * (len(scene.sounds) + 1)


@pytest.mark.fast
@pytest.mark.parametrize("colour", ["white", "pink", "brown"])
def test_the_noise_has_the_level_that_was_asked_for(colour):
    noise = background(10, -55.0, colour, 2)
    assert 10 * np.log10(np.mean(noise.astype(float) ** 2)) == pytest.approx(-55.0, abs=1e-3)
    assert np.array_equal(noise, background(10, -55.0, colour, 2))
    assert not np.array_equal(noise, background(10, -55.0, colour, 3))


@pytest.mark.fast
def test_a_scene_without_time_for_a_sound_is_refused():
    with pytest.raises(DataError, match="scene of 13 s has no time for a sound"):
        compose(made_up_clips(), lambda clip: clip, background(13, -70.0, "white", 1), 1)


@pytest.fixture(scope="module")
def captured(model_file, training_set):
    """A model, and the clips that it knows."""
    model = load_model(model_file)
    scenario = scenario_of(model)
    labels = scenario.labels
    return model_file, model, read_manifest(training_set, labels), scenario


def test_a_model_is_good_on_clips_that_it_knows(captured):
    found = evaluate_scenes(*captured, OPTIONS, ignore_progress)
    assert found.scores.macro_f1 > 0.8
    assert [one.seed for one in found.scenes] == [10, 11]
    assert found.coughs.found > 0.8
    assert found.coughs.coughs > 20
    assert found.lacking == ()
    assert found.scores.macro_f1 == pytest.approx(
        np.mean([one.macro_f1 for one in found.scenes]), abs=0.05
    )
    every = sum(found.detections.false_alarms_per_day.values()) / 24
    assert every == pytest.approx(np.mean([o.false_alarms_per_hour for o in found.scenes]), rel=0.1)


def test_labels_beside_their_sounds_lose(captured, tmp_path):
    model_file, model, clips, scenario = captured
    early = replace(model, description=model.description.model_copy(update={"label_frame": 0}))
    save_model(early, tmp_path / "early.safetensors")
    right, wrong = (
        evaluate_scenes(path, load_model(path), clips, scenario, OPTIONS, ignore_progress)
        for path in (model_file, tmp_path / "early.safetensors")
    )
    assert wrong.scores.macro_f1 < right.scores.macro_f1 - 0.015
    assert wrong.detections.event_based.macro_f1 < right.detections.event_based.macro_f1 - 0.1


def labelled(monkeypatch, captured, change):
    """Score labels that are made of the truth."""

    def record(self, scene):
        del self
        return scene.truth, change(_labelling(scene.truth))

    monkeypatch.setattr(_Recorder, "record", record)
    return evaluate_scenes(*captured, OPTIONS, ignore_progress)


def test_labels_that_are_the_truth_are_perfect(monkeypatch, captured):
    found = labelled(monkeypatch, captured, lambda truth: truth)
    assert found.scores.macro_f1 == found.detections.event_based.f1 == 1.0
    assert {one.macro_f1 for one in found.scenes} == {1.0}
    assert {one.false_alarms_per_hour for one in found.scenes} == {0.0}
    assert found.coughs.found == 1.0
    assert (found.coughs.median_seconds, found.coughs.others) == (pytest.approx(0.3), 0.0)
    assert list(found.truth.labels) == list(found.found.labels)


def test_what_is_recorded_is_what_was_composed(monkeypatch, captured, training_set):
    recorded = []

    def record(self, scene):
        del self
        recorded.append(scene)
        return scene.truth, _labelling(scene.truth)

    monkeypatch.setattr(_Recorder, "record", record)
    options = replace(OPTIONS, colour="pink", floor=-50.0, gain=-3.0)
    evaluate_scenes(*captured, options, ignore_progress)
    clips = {}
    for clip in captured[2]:
        if clip.label in captured[1].classes[1:]:
            clips.setdefault(clip.label, []).append(clip.path)
    assert training_set.parent in clips["music"][0].parents

    def read(path):
        return soundfile.read(path, dtype="float32")[0]

    for seed, scene, single in zip((10, 11), recorded[::2], recorded[1::2], strict=True):
        noises = [background(120.0, -50.0, "pink", seed) for _ in range(2)]
        expected = compose(clips, read, noises[0], seed, -3.0)
        coughs = compose_single("coughing", clips["coughing"], read, noises[1], seed, -3.0)
        assert (scene.truth, single.truth) == (expected.truth, coughs.truth)
        assert np.array_equal(scene.samples, expected.samples)
        assert np.array_equal(single.samples, coughs.samples)


def test_a_cough_of_two_labels_is_found_once(monkeypatch, captured):
    def halved(truth):
        middle = (truth.starts + truth.ends) // 2
        starts = np.stack([truth.starts, middle], axis=1).ravel()
        ends = np.stack([middle, truth.ends], axis=1).ravel()
        return replace(truth, starts=starts, ends=ends, labels=np.repeat(truth.labels, 2))

    found = labelled(monkeypatch, captured, halved)
    assert found.coughs.found == 1.0
    assert found.coughs.median_seconds == pytest.approx(0.15)


def test_late_labels_and_wrong_ones_are_not(monkeypatch, captured):
    late = labelled(monkeypatch, captured, lambda truth: _moved(truth, 10**9))
    assert late.scores.macro_f1 < 0.85
    assert late.detections.event_based.macro_f1 < 0.2
    assert late.coughs.found == 0.0
    assert late.coughs.median_seconds is None

    def wrong(truth):
        names = ["music" if name == "coughing" else name for name in truth.labels]
        return replace(truth, labels=np.array(names, object))

    found = labelled(monkeypatch, captured, wrong)
    assert found.scores.per_class["coughing"].f1 == 0.0
    assert found.detections.false_alarms_per_day["music"] > 0.0
    assert (found.coughs.found, found.coughs.others) == (0.0, 1.0)


@pytest.fixture(scope="module")
def new_clips(tmp_path_factory):
    """Clips that the model has not learned from."""
    return write_training_set(tmp_path_factory.mktemp("new"), clips_per_class=2, seed=12)


def translation_for(model, data, *more):
    return "evaluate", "scenes", model, "--data", data, "--scenes", 1, "--minutes", 1, *more


def test_the_same_seed_gives_the_same_scores_and_another_one_others(
    model_file, new_clips, tmp_path, capfd
):
    first, again, other = (
        run(capfd, *translation_for(model_file, new_clips, "--json", "--seed", seed))
        for seed in (4, 4, 5)
    )
    assert first.returncode == 0, first.stderr
    assert first.stdout == again.stdout != other.stdout
    found = json.loads(first.stdout)
    assert found["frames"] == np.sum(found["confusion"])
    assert found["evaluated_seconds"] == pytest.approx(found["frames"] / 20, abs=0.1)
    assert found["coughs"]["coughs"] > 5
    assert [one["seed"] for one in found["scenes"]] == [4]
    picture = tmp_path / "scenes.png"
    options = ("--plot", picture, "--seed", 4, "--colour", "pink", "--floor", -60, "--gain", -6)
    table = run(capfd, *translation_for(model_file, new_clips, *options))
    assert table.returncode == 0, table.stderr
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert max(map(len, table.stdout.splitlines())) <= 100
    assert "1 scene of 1 min over pink noise at -60 dBFS" in table.stdout
    assert "alarms/h" in table.stdout
    assert "single coughs of 0.3 s" in table.stdout


def test_what_the_model_has_learned_from_is_counted(captured, training_set, new_clips, capfd):
    model_file, model, _, scenario = captured
    known = evaluate_scenes(*captured, replace(OPTIONS, scenes=1), ignore_progress)
    assert known.sources_learned == known.sources == known.clips == 8 * 5
    others = read_manifest(new_clips, scenario.labels)
    new = evaluate_scenes(model_file, model, others, scenario, OPTIONS, ignore_progress)
    assert new.sources_learned == 0
    result = run(capfd, *translation_for(model_file, training_set))
    assert result.returncode == 3
    assert f"was trained on {known.sources} of the {known.sources} sources" in result.stderr


def test_a_model_of_simulated_sounds_is_said_to_be_one_once(second_file, new_clips, capfd):
    result = run(capfd, *translation_for(second_file, new_clips, "--scenes", 2))
    assert result.returncode == 0, result.stderr
    assert result.stderr.count("simulated sounds only") == 1


def test_a_clip_may_be_a_part_of_a_file(model_file, tmp_path, capfd):
    data = manifest_of(tmp_path / "parts", ("speech", 9.0))
    (data / "manifest.csv").write_text(
        "path,label,source_group,start,end\n0.wav,speech,a,1,1.5\n0.wav,music,a,3,3.01\n"
    )
    result = run(capfd, *translation_for(model_file, data, "--json"))
    found = json.loads(result.stdout)
    assert (found["clips"], found["skipped"]) == (1, {"shorter than a frame of 50 ms": 1})
    seconds = found["per_class"]["speech"]["support"] / 20
    assert seconds == pytest.approx(0.5 * found["sounds"], abs=0.05 * found["sounds"])


def manifest_of(folder, *rows):
    """Write clips of (label, seconds), and their manifest."""
    folder.mkdir()
    lines = ["path,label,source_group"]
    for number, (label, seconds) in enumerate(rows):
        tone = 0.3 * np.sin(np.arange(int(seconds * SAMPLE_RATE)))
        soundfile.write(folder / f"{number}.wav", tone, SAMPLE_RATE)
        lines.append(f"{number}.wav,{label},{number}")
    (folder / "manifest.csv").write_text("\n".join(lines) + "\n")
    return folder


def test_a_class_without_a_clip_is_said(model_file, tmp_path, capfd):
    data = manifest_of(tmp_path / "two", ("speech", 2.0), ("Cough", 1.0), ("music", 0.01))
    result = run(capfd, *translation_for(model_file, data))
    assert result.returncode == 3
    assert "has no clip of music, phone_ring, crying" in result.stderr
    assert "speech" not in result.stderr
    assert "1  shorter than a frame of 50 ms" in result.stdout


def test_bad_input_is_one_line_that_says_what_to_do(model_file, training_set, tmp_path, capfd):
    silent = manifest_of(tmp_path / "silent", ("silence", 2.0), ("shower", 2.0))
    short = manifest_of(tmp_path / "short", ("speech", 0.01), ("music", 0.02))
    empty = manifest_of(tmp_path / "empty", ("speech", 0.0))
    (tmp_path / "there.png").touch()
    cases = (
        ((silent,), 1, "give clips of speech, music"),
        ((short,), 1, "2: shorter than a frame"),
        ((empty,), 1, "holds no audio"),
        ((training_set, "--minutes", 0.2), 2, "--minutes"),
        ((training_set, "--minutes", "nan"), 2, "--minutes"),
        ((training_set, "--floor", "-inf"), 2, "--floor"),
        ((training_set, "--minutes", 61), 2, "--minutes"),
        ((training_set, "--scenes", 0), 2, "--scenes"),
        ((training_set, "--colour", "blue"), 2, "--colour"),
        ((training_set, "--scenario", "bathroom"), 1, "the model lacks flushing_water"),
        ((training_set, "--plot", tmp_path / "there.png"), 1, "exists already"),
        ((training_set, "--plot", "p.pdf"), 2, "*.png"),
    )
    for (data, *options), status, output in cases:
        result = run(capfd, *translation_for(model_file, data, *options))
        assert result.returncode == status, options
        assert output in result.stderr
        lines = [line for line in result.stderr.splitlines() if "recording 1 scene" not in line]
        assert len(lines) == 1
        assert result.stdout == ""
    missing = run(capfd, *translation_for(tmp_path / "no.safetensors", training_set))
    assert (missing.returncode, missing.stderr.count("\n")) == (1, 1)
    assert "no such model file" in missing.stderr
