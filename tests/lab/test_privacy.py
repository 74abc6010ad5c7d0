"""How much of speech can be made of what a log holds is measured, beside a control."""

import csv
from functools import partial

import numpy as np
import pytest

pytest.importorskip("hearthlog.tools.lab.bench", reason="the wheel leaves the benchmarks out")
pytest.importorskip("pocketsphinx")
pytest.importorskip("pystoi")

from hearthlog.analyzer.training.clips import clip_frames
from hearthlog.analyzer.training.manifest import LABELS, read_manifest
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.features.auros21 import AUROS21
from hearthlog.models.features.home33 import HOME33
from hearthlog.models.modelfile import load_model
from hearthlog.models.starter import GENERAL, starter_file
from hearthlog.recorder.events import Frames
from hearthlog.recorder.stream.pipeline import Pipeline
from hearthlog.schemas.frames import FRAME_NANOSECONDS, FRAME_SAMPLES
from hearthlog.schemas.messages.message_types import FEATURES, decode
from hearthlog.tools.home.clips import SHIPPED
from hearthlog.tools.lab import privacy
from hearthlog.tools.lab.privacy import Spoken, guessed
from hearthlog.tools.lab.recogniser import Recogniser, intelligibility, word_errors
from hearthlog.tools.lab.vocoder import Logged, logged, sound_of

SECOND = 16_000


@pytest.fixture(scope="module")
def sentences():
    clips = [clip for clip in read_manifest(SHIPPED, LABELS) if "allison" in clip.source_group]
    return [clip_frames(clip).ravel().astype(np.float64) for clip in clips[:2]]


def made_of(sentences, features, rate, *, voiced=True):
    rng = np.random.default_rng(0)
    return [
        sound_of(logged(sound, features, rate), len(sound), rng, voiced=voiced)
        for sound in sentences
    ]


@pytest.mark.parametrize("features", [AUROS21, HOME33], ids=lambda features: features.name)
def test_what_is_made_of_features_is_the_less_intelligible_the_longer_their_frames(
    sentences, features
):
    scores = [
        intelligibility(sentences, made_of(sentences, features, rate))
        for rate in (10, 50, 250, 1000)
    ]
    assert scores[0] > 0.6
    assert scores[-1] < 0.1
    assert scores == sorted(scores, reverse=True)
    assert intelligibility(sentences, sentences) == pytest.approx(1.0)


def test_what_is_made_has_the_power_and_the_spectrum_of_the_sound(sentences):
    for voiced in (False, True):
        for sound, made in zip(
            sentences, made_of(sentences, HOME33, 50, voiced=voiced), strict=True
        ):
            assert len(made) == len(sound)
            assert 10 * np.log10(np.mean(made**2) / np.mean(sound**2)) == pytest.approx(0, abs=4)
            before, after = (np.abs(np.fft.rfft(x)) ** 2 for x in (sound, made))
            share = [power[: len(power) // 8].sum() / power.sum() for power in (before, after)]
            assert share[0] == pytest.approx(share[1], abs=0.15)


def test_features_of_a_log_are_those_of_the_recorder(sentences):
    frames = sentences[0].astype(np.float32).reshape(-1, 800)
    times, values = logged(sentences[0], HOME33, 50)
    np.testing.assert_array_equal(values, HOME33.extractor()(frames))
    np.testing.assert_allclose(times[:2], [0.025, 0.075])
    coarse = logged(sentences[0], HOME33, 100)
    np.testing.assert_allclose(coarse.values[0], values[:2].mean(axis=0))
    np.testing.assert_allclose(coarse.times[0], 0.05)


def test_words_that_are_wrong_missing_or_too_many_are_errors():
    assert word_errors(["one two three"], ["one two three"]) == 0
    assert word_errors(["one two three"], ["one three"]) == pytest.approx(1 / 3)
    assert word_errors(["one two", "four"], ["one six two", "five"]) == pytest.approx(2 / 3)
    assert word_errors(["one"], [""]) == 1


def test_a_recogniser_hears_sentences_and_of_digits_only_digits(sentences):
    assert len(Recogniser(digits=False).recognise(sentences[0]).split()) > 5
    assert Recogniser(digits=True).recognise(sentences[0]) in {"", *privacy.DIGITS}


def spoken_as(text, pitch, speaker):
    """Make a tone for a digit."""
    time = np.arange(SECOND // 2) / SECOND
    return Spoken(np.sin(2 * np.pi * pitch * time), text, speaker)


def test_digits_are_guessed_from_features_by_who_knows_other_speakers():
    words = privacy.DIGITS
    alike = [spoken_as(w, 300 + 300 * i, s) for s in "abc" for i, w in enumerate(words)]
    describe = partial(privacy._row, features=AUROS21, rate=50)
    assert guessed(alike, describe) < 0.1
    order = np.random.default_rng(0).permutation(30) % 10
    chance = [each._replace(text=words[i]) for each, i in zip(alike, order, strict=True)]
    assert guessed(chance, describe) > 0.6
    assert guessed(alike, describe, who=True) > 0.5  # a tone does not say who made it


def test_it_is_one_command(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(privacy, "_RATES", (10,))
    clips = [clip for clip in read_manifest(SHIPPED, LABELS) if clip.label == "speech"]
    who = [("a", "one"), ("a", "two"), ("b", "two"), ("b", "one"), ("c", "")]
    rows = [[clip.path, "speech", *each] for clip, each in zip(clips, who, strict=False)]
    manifest = tmp_path / "manifest.csv"
    with manifest.open("w", newline="") as file:
        csv.writer(file).writerows([["path", "label", "source_group", "text"], *rows])
    privacy.privacy(manifest, 1)
    output = capsys.readouterr().out.splitlines()
    assert output[0].startswith("4 digits of 2 speakers, 1 sentences of 1 with ")
    begin = next(number for number, line in enumerate(output) if line.startswith("original"))
    first = [line.split()[0] for line in output[begin:]]
    assert first == ["original", *3 * ["auros21"], *3 * ["home33"]]
    assert float(output[begin].split()[1]) == 1


def logged_by_a_recorder(sound, private):
    """Return what the features in a log say of a sound, with two seconds of the room around it."""
    classifier = Classifier(load_model(starter_file(GENERAL)))
    room = np.random.default_rng(0).standard_normal(len(sound) + 4 * SECOND) * 5e-4
    room[2 * SECOND : -2 * SECOND] += sound
    frames = room.astype(np.float32).reshape(-1, FRAME_SAMPLES)
    stamps = np.arange(len(frames)) * FRAME_NANOSECONDS
    pipeline = Pipeline("mic", HOME33, classifier, private=private)
    messages = [*pipeline.push(Frames(0, frames, stamps)), *pipeline.finish()]
    rows = [decode(m.data, FEATURES) for m in messages if m.topic == "/mic/features"]
    values = np.array([row.values for row in rows], np.float64)
    return Logged(stamps / 1e9 + 0.025, values), room


def test_of_a_log_that_is_private_nothing_intelligible_is_made(sentences):
    for private, most, least in (([], 1.0, 0.4), (["speech"], 0.1, 0.0)):
        features, room = logged_by_a_recorder(sentences[0], private)
        made = sound_of(features, len(room), np.random.default_rng(0), voiced=True)
        assert least <= max(intelligibility([room], [made]), 0.0) < most
