"""Features of what is private are logged as the averages of seconds; all else is as it was."""

import itertools
from operator import attrgetter
from threading import Event as Flag

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from logreader import LogReader
from logs import read
from lossy_source import LossySource

from hearthlog.analyzer.training.home_recordings import read_sound_of
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.labels.labeller import FrameLabels
from hearthlog.models.modelfile import load_model
from hearthlog.recorder.config import Settings
from hearthlog.recorder.events import ERROR, OK, Frames, SourceHealth
from hearthlog.recorder.recording import record
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.recorder.stream.pipeline import Pipeline
from hearthlog.recorder.stream.privacy_filter import (
    PRIVATE_LIMIT,
    PRIVATE_LIMIT_ELSEWHERE,
    PrivacyFilter,
)
from hearthlog.schemas.errors import ConfigurationError
from hearthlog.schemas.frames import FRAME_NANOSECONDS, FRAME_SAMPLES
from hearthlog.schemas.logs.files import find_logs
from hearthlog.schemas.messages.message_types import nanoseconds

START = 1_772_348_400_000_000_000  # 2026-03-01T07:00:00Z
CLASSES = ("silence", "speech")
WINDOW, BEHIND = 20, 12


def labels_of(output):
    probabilities = np.stack([1 - output, output], axis=1)
    times = np.arange(len(output))
    return FrameLabels(
        CLASSES, times, times, times, probabilities, probabilities, times * 0.0, False
    )


def veiled(first, output, features, blocks):
    """Push frames, one for each probability of speech; return what is logged of them."""
    veil, sizes, parts, start = PrivacyFilter(["speech"], 2, WINDOW), itertools.cycle(blocks), [], 0
    while start < len(output):
        end = min(start + next(sizes), len(output))
        stamps = START + np.arange(first + start, first + end) * FRAME_NANOSECONDS
        part = features[start:end], first + start, stamps, labels_of(output[start:end])
        parts.append(veil.push(*part))
        start = end
    return [*parts, veil.close()]


@given(
    first=st.integers(0, 70),
    loud=st.sets(st.integers(0, 199), max_size=3),
    count=st.integers(1, 200),
    blocks=st.lists(st.integers(1, 50), min_size=1, max_size=4),
)
@settings(max_examples=200, deadline=None)
def test_frames_near_speech_have_the_mean_of_their_second_and_all_others_their_own(
    first, loud, count, blocks
):
    output = np.float32([0.5 if frame in loud else 0.0 for frame in range(count)])
    features = np.random.default_rng(0).standard_normal((count, 2)).astype(np.float32)
    parts = veiled(first, output, features, blocks)
    np.testing.assert_array_equal(
        np.concatenate([part.stamps for part in parts]),
        START + np.arange(first, first + count) * FRAME_NANOSECONDS,
    )
    shown = np.concatenate([part.features for part in parts])
    padded = np.concatenate([np.ones(BEHIND), output, np.ones(WINDOW - 1)])  # beside: unlabelled
    private = np.array(
        [(padded[frame : frame + BEHIND + WINDOW] >= PRIVATE_LIMIT).any() for frame in range(count)]
    )
    np.testing.assert_array_equal(shown[~private], features[~private])
    seconds = (first + np.arange(count)) // 20
    for second in set(seconds[private]):
        rows = private & (seconds == second)
        mean = np.broadcast_to(features[rows].mean(axis=0), shown[rows].shape)
        np.testing.assert_allclose(shown[rows], mean, atol=1e-6)
    assert all(
        len(part.stamps) == 0 or part.first == first + before
        for part, before in zip(
            parts, np.cumsum([0, *(len(part.stamps) for part in parts)])[:-1], strict=True
        )
    )


def test_of_a_model_that_does_not_know_it_everything_is_private():
    veil = PrivacyFilter(["crying"], 2, WINDOW)
    assert veil.unknown(CLASSES) == ["crying"]
    features = np.arange(200, dtype=np.float32).reshape(100, 2)
    stamps = START + np.arange(100) * FRAME_NANOSECONDS
    shown = veil.push(features, 0, stamps, labels_of(np.zeros(100, np.float32))).features
    assert len(shown) == 80
    assert len(np.unique(shown, axis=0)) == 4


@pytest.fixture(scope="module")
def two_logs(sounds, model_file, tmp_path_factory):
    """The same sound, of which some frames are lost, with and without privacy."""
    folders = []
    for private in ([], ["speech"]):
        folder = tmp_path_factory.mktemp("logs")
        about = Settings(
            output=folder, model=model_file, timezone="UTC", privacy=private, max_bag_duration=60
        )
        record(about, LossySource(FileSource(sounds, START), {3: 7}), Flag())
        folders.append(folder)
    return folders


def test_labels_segments_and_gaps_are_the_same_with_privacy(two_logs):
    for kind in ("label", "segment", "gap"):
        open_, private = (read(folder, kind) for folder in two_logs)
        assert len(open_) > 0
        assert list(map(str, open_)) == list(map(str, private))


def test_no_feature_near_speech_is_that_of_its_frame(two_logs, model_file):
    before, after = (
        {m.frame: np.array(m.values) for m in read(folder, "features")} for folder in two_logs
    )
    assert before.keys() == after.keys()
    model = load_model(model_file)
    speech = model.classes.index("speech")
    limit = PRIVATE_LIMIT_ELSEWHERE if model.description.elsewhere else PRIVATE_LIMIT
    stamps = {nanoseconds(m.header.stamp): m.frame for m in read(two_logs[0], "features")}
    likely = {
        stamps[item.log_time]
        for log in find_logs(two_logs[0])
        for item in LogReader(log).messages(["/mic/label"])
        if item.decode().probabilities[speech] >= limit
    }
    near = {frame for frame in before if likely & set(range(frame - BEHIND, frame + WINDOW))}
    assert 50 < len(near) < len(before) - 50
    second = {}
    for frame in near:
        second.setdefault(frame // 20, set()).add(frame)
    for frames in second.values():
        assert len({after[frame].tobytes() for frame in frames}) == 1
    assert sum(np.array_equal(before[frame], after[frame]) for frame in before) > 50


def test_log_time_never_runs_backwards_and_the_doctor_finds_nothing(two_logs, hearthlog):
    for log in find_logs(two_logs[1]):
        times = [item.log_time for item in LogReader(log).messages()]
        assert times == sorted(times)
    assert "0 errors" in hearthlog("doctor", two_logs[1]).stdout


def test_what_is_held_goes_into_the_log_of_the_model_before(model_file):
    model = load_model(model_file)
    classifier = Classifier(model)
    pipeline = Pipeline("mic", classifier.feature_set, classifier, private=["speech"])
    samples = np.random.default_rng(0).standard_normal((200, FRAME_SAMPLES)).astype(np.float32)
    stamps = START + np.arange(200) * FRAME_NANOSECONDS
    first = pipeline.push(Frames(0, samples[:90], stamps[:90]))
    assert features_in(first) == stamps[:60].tolist()
    assert not any(message.log_time >= stamps[60] for message in first)
    closing, opening = pipeline.change_model(model, classifier, 90, int(stamps[90]))
    assert features_in(closing) == stamps[60:90].tolist()
    assert len(opening) == 2
    rest = [*pipeline.push(Frames(90, samples[90:], stamps[90:])), *pipeline.finish()]
    assert features_in(rest) == stamps[90:].tolist()
    messages = [*first, *closing, *opening, *rest]
    assert messages == sorted(messages, key=attrgetter("log_time"))


def features_in(messages):
    return [message.log_time for message in messages if message.topic == "/mic/features"]


def test_reports_wait_for_the_features_before_them_unless_there_is_no_sound(model_file):
    classifier = Classifier(load_model(model_file))
    pipeline = Pipeline("mic", classifier.feature_set, classifier, private=["speech"])
    stamps = START + np.arange(45) * FRAME_NANOSECONDS
    pipeline.push(Frames(0, np.zeros((45, FRAME_SAMPLES), np.float32), stamps))
    now = int(stamps[-1])
    assert pipeline.push(SourceHealth(now, OK, "reading")) == []
    later = pipeline.push(SourceHealth(now + 3 * 10**9, ERROR, "no sound"))
    assert features_in(later) == stamps[20:].tolist()
    assert [m.topic for m in later].count("/diagnostics") == 2
    assert [m.topic for m in later][-2:] == ["/diagnostics", "/rosout"]


def test_a_model_that_does_not_know_what_is_private_is_refused(tmp_path, sounds, model_file):
    for model, private, what in (
        (None, "speech", "there is none"),
        (model_file, "x", "this one has"),
    ):
        about = Settings(output=tmp_path / "logs", model=model, privacy=[private], timezone="UTC")
        with pytest.raises(
            ConfigurationError, match=f"needs a model with the class '{private}' .*{what}"
        ):
            record(about, FileSource(sounds, START), Flag())
    assert not (tmp_path / "logs").exists()


def test_nothing_is_learned_from_coarse_features(two_logs, model_file):
    features = Classifier(load_model(model_file)).feature_set
    before, after = (
        {
            frame: values.tobytes()
            for log in find_logs(folder)
            for sound in read_sound_of(log, features, ["mic"], (START, START + 3600 * 10**9))
            for frame, values in zip(sound.frames.tolist(), sound.values, strict=True)
            if values[0] > 0  # the others are no sound
        }
        for folder in two_logs
    )
    assert 50 < len(after) < len(before) - 50
    assert after.items() <= before.items()
