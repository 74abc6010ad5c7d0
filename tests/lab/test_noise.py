"""Noise is removed by what was heard so far, and what that changes is measured fairly."""

import numpy as np
import pytest
from blobs import blobs
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("hearthlog.tools.lab.bench", reason="the wheel leaves the benchmarks out")

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.training.clips import clip_frames, level_of, steady_noise
from hearthlog.analyzer.training.manifest import BUILTIN, LABELS, read_manifest
from hearthlog.analyzer.training.scores import F1Difference
from hearthlog.analyzer.training.window_methods import PAPER
from hearthlog.schemas.frames import SAMPLE_RATE
from hearthlog.tools.home.simulate import write_training_set
from hearthlog.tools.lab import noise as bench
from hearthlog.tools.lab.noise import Outcome, compare, outcomes_of, won_back
from hearthlog.tools.lab.noise_removers import WINDOW, Remover, SpectralSubtraction, Wiener
from hearthlog.tools.lab.noise_sounds import (
    CONDITIONS,
    NOISES,
    QUIET,
    Condition,
    Sounds,
    in_condition,
    is_steady,
    made_noise,
    read_sounds,
)

GAINS = pytest.mark.parametrize("gain", [SpectralSubtraction, Wiener])
LEAD = 4 * SAMPLE_RATE


def white(seconds, level, seed=0):
    """Noise of one stream, shape (1, n)."""
    noise = np.random.default_rng(seed).standard_normal((1, int(seconds * SAMPLE_RATE)))
    return (noise * 10.0 ** (level / 20.0)).astype(np.float32)


def tone(seconds, level):
    time = np.arange(int(seconds * SAMPLE_RATE)) / SAMPLE_RATE
    return np.sqrt(2.0) * 10.0 ** (level / 20.0) * np.sin(2 * np.pi * 700.0 * time)


@GAINS
@pytest.mark.parametrize("memory", [1.5, 8.0])
def test_steady_noise_is_lowered_by_more_than_ten_decibels_from_the_first_second_on(gain, memory):
    noise = white(4, -30.0)
    kept = Remover(gain, memory)(noise)
    for second in range(4):
        part = slice(second * SAMPLE_RATE, (second + 1) * SAMPLE_RATE)
        assert level_of(kept[0, part]) < level_of(noise[0, part]) - 10.0


@GAINS
def test_a_sound_above_the_noise_stays_and_stands_out_more(gain):
    noise, place = white(4, -40.0), slice(3 * SAMPLE_RATE, 3 * SAMPLE_RATE + 8000)
    sound = noise.copy()
    sound[0, place] += tone(0.5, -25.0).astype(np.float32)
    kept = Remover(gain, 1.5)(sound)[0]
    before = level_of(sound[0, place]) - level_of(sound[0, : 2 * SAMPLE_RATE])
    after = level_of(kept[place]) - level_of(kept[SAMPLE_RATE : 2 * SAMPLE_RATE])
    assert after > before + 8.0
    assert level_of(kept[place]) > -27.0


@GAINS
@given(cut=st.integers(WINDOW, SAMPLE_RATE), later=st.floats(-80.0, 0.0))
@settings(max_examples=15, deadline=None)
def test_what_comes_later_does_not_change_what_was_kept(gain, cut, later):
    sound = white(1.2, -30.0)
    other = sound.copy()
    other[:, cut:] = white(1.2, later, seed=1)[:, cut:]
    remover = Remover(gain, 1.5)
    labelled = cut - WINDOW
    assert np.array_equal(remover(sound)[:, :labelled], remover(other)[:, :labelled])


@GAINS
def test_streams_that_are_cleaned_together_do_not_touch_each_other(gain):
    sounds = np.concatenate([white(1, -20.0, 1), white(1, -50.0, 2), np.zeros((1, SAMPLE_RATE))])
    remover = Remover(gain, 1.5)
    together = remover(sounds.astype(np.float32))
    for row, one in zip(together, sounds.astype(np.float32), strict=True):
        np.testing.assert_allclose(row, remover(one[np.newaxis])[0], atol=1e-7)
    assert not together[2].any()


def test_noise_is_as_far_below_a_clip_as_asked_and_begins_four_seconds_before_it(sounds):
    number = next(n for n, clip in enumerate(sounds.clips) if clip.label == "speech")
    clip = sounds.frames[number].ravel()
    for name in NOISES:
        laid = in_condition(sounds, number, Condition(name, 10.0), len(clip))
        assert len(laid) == LEAD + len(clip)
        noise = laid[LEAD:] - clip
        assert level_of(clip) - level_of(noise) == pytest.approx(10.0, abs=0.7)
        assert level_of(laid[:LEAD]) == pytest.approx(level_of(noise), abs=1.5)


def test_noise_in_silence_is_as_loud_as_in_other_clips_and_its_room_is_heard_before(sounds):
    number = next(n for n, clip in enumerate(sounds.clips) if clip.label == "silence")
    clip = sounds.frames[number].ravel()
    quiet = in_condition(sounds, number, Condition(None), len(clip))
    assert level_of(quiet[:LEAD]) == pytest.approx(level_of(quiet[LEAD:]), abs=1.0)
    loud = in_condition(sounds, number, Condition("fan", 10.0), len(clip))
    assert level_of(loud[LEAD:]) == pytest.approx(sounds.level - 10.0, abs=0.7)


@pytest.mark.parametrize("name", ["fan", "refrigerator"])
def test_made_noise_is_steady_and_a_clap_and_a_short_noise_are_not(name):
    noise = 0.1 * made_noise(name, np.random.default_rng(0))
    assert is_steady(noise)
    assert not is_steady(noise[: 3 * SAMPLE_RATE])
    clapping = noise.copy()
    clapping[::8000] = 1.0
    clapping[: len(noise) // 2] *= 0.05
    assert not is_steady(clapping)
    assert not is_steady(np.zeros_like(noise))


def test_clips_without_a_recording_that_is_noise_are_refused(tmp_path):
    manifest = write_training_set(tmp_path, clips_per_class=1, seed=2)
    rows = manifest.read_text().splitlines()
    manifest.write_text("\n".join(row for row in rows if "other_negative" not in row))
    with pytest.raises(DataError, match="no recording of another label"):
        read_sounds(manifest, BUILTIN["general"])


def test_won_back_is_the_share_of_what_noise_cost():
    class Macro:
        def __init__(self, macro_f1):
            self.macro_f1 = macro_f1

    quiet = Outcome(Macro(0.8), Macro(0.7), F1Difference(-0.1, None))
    noisy = Outcome(Macro(0.4), Macro(0.5), F1Difference(0.1, None))
    assert won_back({QUIET: quiet, "fan 5 dB": noisy}, "fan 5 dB") == pytest.approx(0.25)


@pytest.fixture(scope="module")
def sounds(tmp_path_factory):
    """Two clips of each class of the general scenario, of a second and a half, and a noise."""
    manifest = write_training_set(tmp_path_factory.mktemp("clips"), clips_per_class=2, seed=4)
    scenario = BUILTIN["general"]
    clips = [clip for clip in read_manifest(manifest, LABELS) if scenario.find(clip.label)]
    frames = [clip_frames(clip)[:30] for clip in clips]
    rng = np.random.default_rng(0)
    recorded = [steady_noise(5 * SAMPLE_RATE, -30.0, rng).astype(np.float32)]
    noises = {name: [made_noise(name, rng)] for name in ("fan", "refrigerator")}
    return Sounds(clips, frames, noises | {"recorded": recorded}, -25.0)


def test_a_remover_that_does_nothing_changes_nothing(sounds, monkeypatch):
    monkeypatch.setattr(bench, "CONDITIONS", (Condition(None), Condition("recorded", 5.0)))
    nothing, everything = (lambda sound: sound), np.zeros_like
    removers = {"nothing": nothing, "everything": everything}
    found = list(compare(sounds, BUILTIN["general"], PAPER, removers, ["source"]))
    assert [(remover, way) for _, remover, way, _ in found] == [
        (remover, way) for remover in removers for way in ("as always", "with it")
    ]
    for *_, outcomes in found:
        assert list(outcomes) == [QUIET, "recorded 5 dB", "all 5 dB"]
        assert outcomes["all 5 dB"] == outcomes["recorded 5 dB"]
        assert outcomes["recorded 5 dB"].before.macro_f1 < outcomes[QUIET].before.macro_f1
    changes = [[one.change.macro_f1 for one in outcomes.values()] for *_, outcomes in found]
    assert changes[:2] == [[0.0, 0.0, 0.0]] * 2
    assert changes[2][0] < -0.5


def test_all_noises_of_a_level_are_scored_together_and_others_apart():
    data, _ = blobs(2, 6)
    wrong = 1 - data.target
    before = [data.target if one.noise is None else wrong for one in CONDITIONS]
    after = [data.target if one.noise in {None, "fan"} else wrong for one in CONDITIONS]
    outcomes = outcomes_of(data, before, after)
    assert [name for name in outcomes if name.startswith("all")] == [
        "all 20 dB", "all 10 dB", "all 5 dB",
    ]  # fmt: skip
    assert outcomes["all 10 dB"].before.segments == len(NOISES) * len(data)
    assert won_back(outcomes, "fan 10 dB") == pytest.approx(1.0)
    assert won_back(outcomes, "recorded 10 dB") == pytest.approx(0.0)
    assert won_back(outcomes, "all 10 dB") == pytest.approx(1 / len(NOISES))
