"""How much speech the recorder would keep is measured on people whom its model never heard."""

import csv
from itertools import chain

import numpy as np
import pytest

pytest.importorskip("hearthlog.tools.lab.bench", reason="the wheel leaves the benchmarks out")

from hearthlog.analyzer.training.clips import clip_frames
from hearthlog.analyzer.training.manifest import LABELS, read_manifest
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.modelfile import load_model
from hearthlog.models.starter import GENERAL, starter_file
from hearthlog.schemas.errors import HearthlogError
from hearthlog.tools.home.clips import SHIPPED
from hearthlog.tools.lab import guard
from hearthlog.tools.lab.guard import (
    FAR,
    NEAR,
    WAYS,
    clip_at_microphone,
    maskers_of,
    measure,
    unheard,
)


@pytest.fixture(scope="module")
def classifier():
    return Classifier(load_model(starter_file(GENERAL)))


@pytest.fixture(scope="module")
def clips():
    """Those of the simulated home, from which the starter model has not learned."""
    return read_manifest(SHIPPED, LABELS)


def of(clips, label):
    return [clip for clip in clips if clip.label == label]


def level(frames):
    return 10 * np.log10(np.mean(np.square(frames, dtype=np.float64)))


@pytest.mark.parametrize("way", WAYS, ids=lambda way: way.name)
def test_speech_is_not_kept_from_afar_nor_over_water_and_music(clips, classifier, way):
    kept = measure(of(clips, "speech"), way, maskers_of(clips, way.over), classifier)
    assert len(kept.loud) == 7
    assert kept.loud.sum() > 700
    assert kept.share < 1


def test_coughing_that_nobody_talks_over_is(clips, classifier):
    kept = measure(of(clips, "coughing"), NEAR, [], classifier)
    assert 20 < kept.share < 60
    assert (kept.kept <= kept.loud).all()


def test_a_clip_is_heard_at_its_level_between_two_seconds_of_the_room(clips):
    (clip, *_) = of(clips, "speech")
    for way, loudest in ((NEAR, -18), (FAR, -38)):
        piece = clip_at_microphone(clip, way, [], np.random.default_rng(0))
        levels = np.array([level(frame) for frame in piece.frames])
        assert levels.max() == pytest.approx(loudest, abs=0.2)
        assert levels[:40].max() < -60
        assert levels[piece.loud].min() > max(-60.5, loudest - 25.5)
        assert len(piece.frames) == 80 + len(clip_frames(clip))


def test_what_it_is_heard_over_is_ten_decibels_below_its_loud_frames(clips):
    (clip, *_) = of(clips, "speech")
    steady = np.random.default_rng(1).standard_normal(16_000)
    over_water = next(way for way in WAYS if "water" in way.name)
    piece = clip_at_microphone(clip, over_water, [steady], np.random.default_rng(0))
    alone = clip_at_microphone(clip, NEAR, [], np.random.default_rng(0))
    assert level(alone.frames[alone.loud]) - level(piece.frames[:40]) == pytest.approx(10, abs=0.3)


def test_sources_that_the_model_has_learned_from_are_left_out(tmp_path, clips):
    learned = tmp_path / "learned.csv"
    with learned.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerows([["path", "source_group"], ["a.wav", "fsdd_theo"]])
    left = unheard([SHIPPED], learned)
    assert {clip.source_group for clip in clips} - {c.source_group for c in left} == {"fsdd_theo"}


def test_a_list_of_what_was_learned_that_cannot_be_used_is_refused(tmp_path):
    there = tmp_path / "there.csv"
    there.write_text("path,source\n")
    for path, what in ((there, "no column source_group"), (tmp_path / "gone.csv", "gone.csv")):
        with pytest.raises(HearthlogError, match=what):
            unheard([SHIPPED], path)


def test_it_is_one_command(tmp_path, clips, capsys):
    manifest = tmp_path / "manifest.csv"
    chosen = chain(of(clips, "speech")[:1], of(clips, "tap_water"), of(clips, "music"))
    rows = [[clip.path, clip.label, clip.source_group, clip.source] for clip in chosen]
    with manifest.open("w", newline="") as file:
        csv.writer(file).writerows([["path", "label", "source_group", "source"], *rows])
    guard.guard([manifest])
    output = capsys.readouterr().out.splitlines()
    assert [line.partition("  ")[0] for line in output[1 : 1 + len(WAYS)]] == [w.name for w in WAYS]
    assert {line.split()[0] for line in output[-2:]} == {"music", "tap_water"}
