"""Clips in noise, in rooms and by other microphones: the same segments, changed as was asked."""

import json

import numpy as np
import pytest
from log_fixtures import run_function
from scipy.signal import welch

from hearthlog.analyzer.evaluation.model_scores import evaluate_model
from hearthlog.analyzer.training.manifest import read_manifest, scenario_of
from hearthlog.models.features.installed import DEFAULT
from hearthlog.models.modelfile import load_model
from hearthlog.schemas.errors import ignore_progress
from hearthlog.schemas.frames import FRAME_SAMPLES, SAMPLE_RATE
from hearthlog.tools.lab import robustness as evaluation
from hearthlog.tools.lab.command import run
from hearthlog.tools.lab.robustness import CONDITIONS, Condition, robustness


def measured(capfd, *words):
    return run_function(capfd, lambda: run(evaluation.main), *words)


@pytest.fixture(scope="module")
def recorded(model_file, training_set):
    """A model, some of the clips that it knows, and its scenario."""
    model = load_model(model_file)
    scenario = scenario_of(model)
    return model, read_manifest(training_set, scenario.labels)[::2], scenario


def test_unchanged_clips_are_scored_as_by_evaluate_model(recorded):
    found = robustness(*recorded, ignore_progress, [])
    plain = evaluate_model(*recorded, ignore_progress)
    assert found.unchanged == plain.scores
    assert found.skipped == plain.skipped
    assert found.sources_learned == plain.sources_learned > 0
    assert found.changed == {}


def test_a_gain_of_nothing_changes_nothing(recorded):
    found = robustness(*recorded, ignore_progress, [Condition("nothing", gain=0.0)])
    scores, difference = found.changed["nothing"]
    assert scores == found.unchanged
    assert (difference.macro_f1, *difference.interval) == (0.0, 0.0, 0.0)


def test_the_more_noise_the_worse_on_the_same_segments(recorded):
    steps = [Condition(str(below), noise=below) for below in (30.0, 0.0, -20.0)]
    found = robustness(*recorded, ignore_progress, steps)
    every = [found.unchanged, *(one.scores for one in found.changed.values())]
    assert len({one.segments for one in every}) == 1
    assert {tuple(np.sum(one.confusion, axis=1)) for one in every} == {
        tuple(np.sum(found.unchanged.confusion, axis=1))
    }
    macro = [one.macro_f1 for one in every]
    assert macro[0] > macro[2] + 0.1 > macro[3] + 0.2
    for scores, difference in found.changed.values():
        change = scores.macro_f1 - found.unchanged.macro_f1
        assert difference.macro_f1 == pytest.approx(change)


def test_the_same_clips_give_the_same_scores_however_they_are_divided(recorded, monkeypatch):
    reported = []
    requested = [CONDITIONS[3], CONDITIONS[-1]]
    first = robustness(*recorded, reported.append, requested)
    monkeypatch.setattr(evaluation, "_CLIPS_AT_ONCE", 1)
    assert robustness(*recorded, ignore_progress, requested) == first
    assert reported == sorted(reported)
    assert reported[-1] == 1.0


def tone_bursts(level=-20.0):
    """Frames of noise that comes and goes."""
    count = 4 * SAMPLE_RATE
    sound = np.random.default_rng(1).standard_normal(count)
    sound *= np.abs(np.sin(2 * np.pi * np.arange(count) / SAMPLE_RATE))
    sound *= 10 ** (level / 20) / np.sqrt(np.mean(sound**2))
    return sound.astype(np.float32).reshape(-1, FRAME_SAMPLES)


@pytest.fixture
def captured(monkeypatch):
    """The sounds whose features were asked for."""
    sounds = []
    for module in (evaluation, evaluation.in_noise.__globals__):
        names = vars(module) if module is evaluation else module
        inner = names["captured"]

        def keep(sound, features, inner=inner):
            sounds.append(sound)
            return inner(sound, features)

        monkeypatch.setitem(names, "captured", keep)
    return sounds


def changed(condition, *, silence=False):
    rng = np.random.default_rng(2)
    return evaluation._copy(tone_bursts(), condition, DEFAULT, rng, silence=silence)


def decibels(power):
    return 10 * np.log10(power)


@pytest.mark.fast
@pytest.mark.parametrize("below", [30.0, 10.0, 5.0])
def test_noise_is_as_far_below_the_clip_as_was_asked_for_and_is_the_floor(captured, below):
    copy = changed(Condition("noise", noise=below))
    noisy, noise = captured
    assert decibels(np.mean(noise**2)) == pytest.approx(-20 - below, abs=0.01)
    np.testing.assert_allclose(noisy - noise, tone_bursts().ravel(), atol=1e-12)
    assert decibels(copy.floor[-1]) == pytest.approx(-20 - below, abs=6)


@pytest.mark.fast
def test_clips_have_no_floor_without_noise_but_silence_is_its_own():
    assert not changed(Condition("gain", gain=-10.0)).floor.any()
    assert decibels(changed(Condition("gain", gain=-10.0), silence=True).floor[-1]) < -30.0
    assert changed(Condition("as it is"), silence=True).floor[-1] > 0.0


@pytest.mark.fast
def test_a_telephone_hears_300_to_3400_hertz_and_a_tilt_is_one(captured):
    changed(Condition("telephone", limits=(300.0, 3400.0)))
    changed(Condition("tilt", tilt=3.0))
    flat, (telephone, tilted) = tone_bursts().ravel(), captured
    frequencies, before = welch(flat, SAMPLE_RATE, nperseg=1024)
    limited, tilt = (decibels(welch(x, SAMPLE_RATE, nperseg=1024)[1] / before) for x in captured)
    inside = (frequencies > 400) & (frequencies < 2800)
    assert np.ptp(limited[inside]) < 1.0
    assert limited[frequencies > 6000].max() < limited[inside].min() - 12
    assert limited[(frequencies > 1) & (frequencies < 150)].max() < limited[inside].min() - 12
    octaves = np.log2(frequencies[(frequencies > 100) & (frequencies < 7000)])
    slope = np.polyfit(octaves, tilt[(frequencies > 100) & (frequencies < 7000)], 1)[0]
    assert slope == pytest.approx(3.0, abs=0.1)
    for sound in (telephone, tilted):
        assert np.mean(sound**2) == pytest.approx(np.mean(flat**2), rel=1e-3)


@pytest.mark.fast
def test_rooms_ring_the_longer_the_longer_they_were_asked_for(captured):
    sound = np.zeros(2 * SAMPLE_RATE)
    sound[:100] = 0.5
    frames = sound.astype(np.float32).reshape(-1, FRAME_SAMPLES)
    for seconds in (0.2, 0.4, 0.6):
        condition = Condition("room", reverberation=seconds)
        evaluation._copy(frames, condition, DEFAULT, np.random.default_rng(2), silence=False)
    ends = [np.flatnonzero(np.abs(one) > 1e-5).max() / SAMPLE_RATE for one in captured]
    assert ends == pytest.approx([0.2, 0.4, 0.6], abs=0.05)


@pytest.fixture
def some(training_set, tmp_path):
    """A manifest of every fourth clip."""
    head, *rows = training_set.read_text().splitlines()
    (tmp_path / "clips").symlink_to(training_set.parent)
    manifest = tmp_path / "some.csv"
    manifest.write_text("\n".join([head, *(f"clips/{row}" for row in rows[::4])]) + "\n")
    return manifest


def test_the_command_prints_a_table_and_makes_a_picture(model_file, some, tmp_path, capfd):
    words, picture = (model_file, "--data", some), tmp_path / "map.png"
    table = measured(capfd, *words, "--plot", picture)
    assert table.returncode == 3
    assert "the model was trained on 1" in table.stderr
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert max(map(len, table.stdout.splitlines())) <= 100
    result = measured(capfd, *words, "--json")
    found = json.loads(result.stdout)
    assert list(found["changed"]) == [condition.name for condition in CONDITIONS]
    for name, one in found["changed"].items():
        assert f"{name} " in table.stdout
        assert f"{one['macro_f1']:.3f}" in table.stdout
        assert one["difference"]["macro_f1"] < 0.1
        assert set(one["per_class"]) == set(found["unchanged"]["classes"])


def test_bad_input_is_one_line(model_file, training_set, tmp_path, capfd):
    (tmp_path / "there.png").touch()
    rows = training_set.read_text().splitlines()
    silent = training_set.with_name("others.csv")
    silent.write_text("\n".join([rows[0], *(row for row in rows if "shower" in row)]) + "\n")
    cases = (
        ((silent,), 1, "no clip has a segment to test on"),
        ((training_set, "--scenario", "bathroom"), 1, "the model lacks flushing_water"),
        ((training_set, "--plot", tmp_path / "there.png"), 1, "exists already"),
        ((tmp_path / "no.csv",), 1, "no.csv"),
    )
    for (data, *options), status, output in cases:
        result = measured(capfd, model_file, "--data", data, *options)
        assert result.returncode == status
        assert output in result.stderr
        assert len([x for x in result.stderr.splitlines() if "listening" not in x]) == 1
