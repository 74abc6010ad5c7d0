"""Smoothing gives Viterbi's path some frames after the sound, and segments that can be replayed."""

from dataclasses import replace
from itertools import pairwise
from threading import Event as Flag

import numpy as np
import pytest
from logreader import LogReader
from lossy_source import LossySource
from rewriting import Log

from hearthlog.analyzer.doctor.examination import examine
from hearthlog.analyzer.relabel.player import ReplayOptions
from hearthlog.analyzer.relabel.replay import LogSet
from hearthlog.analyzer.relabel.replay import replay as replay_logs
from hearthlog.analyzer.training.hidden_markov import viterbi
from hearthlog.analyzer.training.train import (
    FRAME_SECONDS,
    LAG_SECONDS,
    default_transitions,
)
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.model import Smoothing
from hearthlog.models.features.floor import FloorTracker
from hearthlog.models.features.installed import DEFAULT
from hearthlog.models.labels import Segmenter, SegmenterInput
from hearthlog.models.labels.smoothing import (
    ClassesApart,
    FixedLagSmoother,
    log_likelihoods,
)
from hearthlog.models.modelfile import load_model, save_model
from hearthlog.recorder.config import Settings
from hearthlog.recorder.events import Frames
from hearthlog.recorder.recording import record
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.recorder.sources.decoding import read_audio
from hearthlog.recorder.stream.pipeline import Pipeline
from hearthlog.schemas.errors import ModelError
from hearthlog.schemas.frames import FRAME_NANOSECONDS, FRAME_SAMPLES
from hearthlog.schemas.logs.files import find_logs
from hearthlog.schemas.messages.message_types import (
    LOG,
    SEGMENT,
    decode,
    duration_message,
    nanoseconds,
    time_message,
)

SECOND = 1_000_000_000
START = 1_772_350_200 * SECOND
CLASSES = ["silence", "speech", "music", "coughing", "shower"]
LAG = round(LAG_SECONDS / FRAME_SECONDS)
DECIDED_AFTER = LAG + 2 * 6 + 4 + 3  # the reach of borders, the shortest state, the window


def made_up(seed, frames=1500, classes=5):
    """Probabilities that stay alike for some frames, as those of overlapping windows do."""
    rng = np.random.default_rng(seed)
    sounds = np.repeat(rng.dirichlet(np.full(classes, 0.3), frames // 10), 10, axis=0)
    mixed = 0.7 * sounds + 0.3 * rng.dirichlet(np.full(classes, 0.3), len(sounds))
    return mixed.astype(np.float32)


def decided(smoother, probabilities, size):
    """All states, from blocks of some size."""
    blocks = [probabilities[i : i + size] for i in range(0, len(probabilities), size)]
    return np.concatenate([*map(smoother.push, blocks), smoother.close()])


def of_sounds(model_file, frames):
    """Probabilities of a model's classes in real sound."""
    classifier = Classifier(load_model(model_file))
    features = DEFAULT.extractor()(frames)
    floors = FloorTracker()(DEFAULT.band_powers(features), 0).powers
    inputs = classifier.inputs.stream()(features[len(features) - len(floors) :], floors)
    return classifier.probabilities(inputs), default_transitions(classifier.classes)


@pytest.mark.parametrize("seed", range(5))
def test_a_lag_over_the_whole_gives_the_path_of_viterbi(seed):
    rng = np.random.default_rng(seed)
    probabilities, transitions = made_up(seed), rng.dirichlet(np.ones(5), 5) + 3 * np.eye(5)
    transitions /= transitions.sum(axis=1, keepdims=True)
    path = viterbi(probabilities, transitions)
    assert len(set(path.tolist())) == 5
    states = decided(FixedLagSmoother(transitions, len(path)), probabilities, 100)
    assert states.tolist() == path.tolist()


def test_so_does_a_lag_that_covers_the_decisions_in_real_sound(real_frames, model_file):
    probabilities, transitions = of_sounds(model_file, real_frames)
    path = viterbi(probabilities, transitions)
    assert np.count_nonzero(np.diff(path)) > 50
    for lag in (200, len(path)):
        states = decided(FixedLagSmoother(transitions, lag), probabilities, 1000)
        assert states.tolist() == path.tolist()
    states = decided(FixedLagSmoother(transitions, LAG), probabilities, 1000)
    assert (states == path).mean() > 0.99


@pytest.mark.parametrize("lag", [0, 1, 7, LAG])
def test_blocks_of_any_size_give_the_same_states(lag):
    probabilities = made_up(6)
    smoother = FixedLagSmoother(default_transitions(CLASSES), lag)
    full = decided(smoother, probabilities, len(probabilities))
    assert len(full) == len(probabilities)
    for size in (1, 13, 1024):
        assert decided(smoother, probabilities, size).tolist() == full.tolist()


def test_a_state_is_decided_after_the_lag_and_what_comes_later_does_not_change_it():
    transitions = default_transitions(CLASSES)
    probabilities = made_up(7)
    states = FixedLagSmoother(transitions, 30).push(probabilities)
    assert len(states) == len(probabilities) - 30
    for end in (10, 30, 31, 200):
        seen = FixedLagSmoother(transitions, 30).push(probabilities[:end])
        assert seen.tolist() == states[: max(end - 30, 0)].tolist()


def test_without_a_lag_it_is_the_best_state_of_what_was_heard():
    probabilities, transitions = made_up(8, 300), default_transitions(CLASSES)
    states = FixedLagSmoother(transitions, 0).push(probabilities)
    for end in (1, 2, 50, 299):
        assert states[end - 1] == viterbi(probabilities[:end], transitions)[-1]


def test_probabilities_of_zero_and_impossible_transitions_give_a_path():
    probabilities = made_up(9)
    probabilities[::3, 1] = 0.0
    probabilities[100:200] = [0, 0, 0, 0, 1]
    transitions = default_transitions(CLASSES)
    transitions[:, 4] = 0.0  # nothing leads there, and from there on
    transitions[4] = [1, 0, 0, 0, 0]
    transitions /= transitions.sum(axis=1, keepdims=True)
    states = decided(FixedLagSmoother(transitions, 2000), probabilities, 100)
    assert states.tolist() == viterbi(probabilities, transitions).tolist()
    assert 4 not in states[1:]
    assert np.isfinite(log_likelihoods(probabilities, 1.0)).all()


def test_a_class_that_is_never_left_is_the_rest_of_the_path():
    transitions = default_transitions(CLASSES)
    transitions[2] = [0, 0, 1, 0, 0]
    probabilities = made_up(10)
    states = decided(FixedLagSmoother(transitions, 5000), probabilities, 64)
    assert states.tolist() == viterbi(probabilities, transitions).tolist()


@pytest.mark.parametrize("seed", range(8))
def test_once_converged_no_other_past_gives_other_states(seed):
    rng = np.random.default_rng(seed)
    probabilities, transitions = made_up(seed, 400), default_transitions(CLASSES)
    started_late = FixedLagSmoother(transitions, 1000)
    started_late.push(probabilities)
    converged = started_late.converged_after
    assert converged is not None
    states = started_late.close()[converged - 1 :]
    for _ in range(5):
        past = rng.dirichlet(np.full(5, 0.1), rng.integers(1, 50)).astype(np.float32)
        labelled = np.concatenate([past, probabilities])
        full = decided(FixedLagSmoother(transitions, 1000), labelled, 100)
        assert full[len(past) + converged - 1 :].tolist() == states.tolist()


def test_sounds_go_on_for_as_long_as_expected_and_end_in_silence():
    transitions = default_transitions(["silence", "coughing", "music", "kettle"])
    np.testing.assert_allclose(transitions.sum(axis=1), 1.0)
    np.testing.assert_allclose(0.05 / (1 - transitions.diagonal()), [2.5, 1.0, 20.0, 10.0])
    assert transitions[0, 1] == transitions[0, 2] == transitions[0, 3]
    others = np.array([transitions[1, 2:].sum(), transitions[2, 1], transitions[3, 1]])
    assert (transitions[1:, 0] > 20 * others).all()


def test_without_a_class_of_silence_all_other_classes_are_as_likely_to_follow():
    transitions = default_transitions(["music", "kettle", "speech"])
    assert transitions[0, 1] == transitions[0, 2] == pytest.approx(0.05 / 20.0 / 2)


def test_a_single_cough_survives_and_a_flicker_does_not():
    probabilities = np.full((400, 5), 0.01, np.float32)
    probabilities[:, 0] = 0.96
    probabilities[100:120] = [0.1, 0.1, 0.05, 0.7, 0.05]  # the windows that hear one cough
    probabilities[300] = [0.4, 0.0, 0.0, 0.6, 0.0]
    smoothing = Smoothing(method="hmm", lag_seconds=LAG_SECONDS)
    segmenter = Segmenter(CLASSES, smoothing, default_transitions(CLASSES))
    stamps = np.arange(400) * FRAME_NANOSECONDS
    frames = SegmenterInput(probabilities, np.zeros(400), stamps, stamps)
    segments = segmenter.push(frames) + segmenter.close(400 * FRAME_NANOSECONDS)
    assert [CLASSES[segment.label] for segment in segments] == ["silence", "coughing", "silence"]
    _, cough, last = segments
    assert (cough.start, cough.end) == (stamps[100], stamps[120])
    assert cough.confidence == pytest.approx(0.7)
    assert cough.decided_at == stamps[120 + LAG]
    assert (last.end, last.decided_at) == (400 * FRAME_NANOSECONDS, 400 * FRAME_NANOSECONDS)


def made_up_frames(seed, count):
    """Frames of sounds that differ in level."""
    probabilities = made_up(seed, count)
    levels = np.random.default_rng(seed).uniform(-60, -20, count // 10).repeat(10)
    stamps = START + np.arange(count) * FRAME_NANOSECONDS
    return SegmenterInput(probabilities, 10 ** (levels / 10), stamps, stamps)


SMOOTHINGS = [
    Smoothing(method="hmm", lag_seconds=0.0),
    Smoothing(method="hmm", lag_seconds=LAG_SECONDS),
    Smoothing(method="hmm", lag_seconds=0.5, weight=0.5, reach_seconds=0.3, shortest_seconds=0.25),
    Smoothing(method="merge", reach_seconds=0.15, shortest_seconds=0.2),
]


@pytest.mark.parametrize("smoothing", SMOOTHINGS)
@pytest.mark.parametrize("size", [1, 7, 300])
def test_blocks_of_any_size_give_the_same_segments(smoothing, size):
    transitions, frames = default_transitions(CLASSES), made_up_frames(3, 1500)
    full = Segmenter(CLASSES, smoothing, transitions).push(frames)
    segmenter, segments = Segmenter(CLASSES, smoothing, transitions), []
    for start in range(0, 1500, size):
        segments += segmenter.push(frames.part(slice(start, start + size)))
    assert segments == full
    assert len(full) > 20


def parts(smoothing, ready):
    """Begin in the middle; yield the part once it is ready, what it then says, and the whole."""
    transitions = default_transitions(CLASSES)
    for seed in range(8):
        frames = made_up_frames(seed, 1800)
        full = Segmenter(CLASSES, smoothing, transitions).push(frames)
        for begin in range(100, 900, 100):
            part = Segmenter(CLASSES, smoothing, transitions)
            frame = begin
            while not ready(part) and frame < 1800:
                part.push(frames.part(slice(frame, frame + 1)))
                frame += 1
            if frame == 1800:
                continue
            converged = part.segments_converged
            later = part.push(frames.part(slice(frame, None)))
            expected = [s for s in full if s.decided_at >= frames.stamps[frame]]
            yield frame - begin, converged, later, expected


@pytest.mark.parametrize("smoothing", SMOOTHINGS)
def test_once_states_have_converged_the_segments_that_begin_later_are_those_of_the_whole(smoothing):
    earlier = 0
    for _, converged, later, expected in parts(smoothing, lambda part: part.states_converged):
        earlier += not converged
        assert later[1:] == expected[1:]
    assert earlier > 10  # than the segments are


@pytest.mark.parametrize("smoothing", SMOOTHINGS)
def test_segments_of_a_part_are_those_of_the_whole_once_converged(smoothing):
    converged_after = []
    for frames, _, later, expected in parts(smoothing, lambda part: part.segments_converged):
        converged_after.append(frames)
        assert later == expected
    assert np.median(converged_after) < 500


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda rows: rows * 1.01, "the rows of transitions are no probabilities"),
        (lambda rows: rows - 0.5 * np.eye(len(rows)) + 0.5, "rows of transitions"),
        (lambda rows: rows[:, :-1], "transitions has shape"),
        (lambda rows: rows[:0, :0], "transitions is missing"),
    ],
)
def test_transitions_that_are_none_are_refused(hmm_file, tmp_path, change, complaint):
    model = load_model(hmm_file)
    bad = replace(model, transitions=change(model.transitions))
    with pytest.raises(ModelError, match=complaint):
        save_model(bad, tmp_path / "bad.safetensors")


def pushed(day, model_file, size):
    samples = np.concatenate(list(read_audio(day))).reshape(-1, FRAME_SAMPLES)[:1200]
    pipeline = Pipeline("mic", DEFAULT, Classifier(load_model(model_file)))
    records = []
    for first in range(0, len(samples), size):
        block = samples[first : first + size]
        stamps = START + np.arange(first, first + len(block)) * FRAME_NANOSECONDS
        records += pipeline.push(Frames(first, block, stamps))
    return records + pipeline.finish()


@pytest.mark.parametrize("size", [1, 7, 200])
def test_blocks_of_any_size_give_the_same_records(day, hmm_file, size):
    assert pushed(day, hmm_file, size) == pushed(day, hmm_file, 1200)


def test_segments_are_fewer_and_labels_as_they_were(day, hmm_file, model_file):
    smooth, merged = pushed(day, hmm_file, 100), pushed(day, model_file, 100)
    of = {
        kind: [[r for r in records if r.topic == f"/mic/{kind}"] for records in (smooth, merged)]
        for kind in ("label", "segment")
    }
    assert of["label"][0] == of["label"][1]
    assert 3 < len(of["segment"][0]) < len(of["segment"][1])


def test_a_segment_is_written_when_it_is_known_and_log_time_never_runs_back(day, hmm_file):
    records = pushed(day, hmm_file, 100)
    times = [record.log_time for record in records]
    assert times == sorted(times)
    over = START + 1200 * FRAME_NANOSECONDS
    ends = []
    for item, line in pairwise(records):
        if item.topic == "/mic/segment":
            segment = decode(item.data, SEGMENT)
            start = nanoseconds(segment.header.stamp)
            assert not ends or start == ends[-1]
            ends.append(start + nanoseconds(segment.duration))
            assert item.log_time == min(ends[-1] + DECIDED_AFTER * FRAME_NANOSECONDS, over)
            assert line.topic == "/rosout"
            assert nanoseconds(decode(line.data, LOG).stamp) == line.log_time == item.log_time
    assert ends[-1] == over


@pytest.fixture(scope="module")
def folder(tmp_path_factory, day, hmm_file):
    """Logs of a minute, with gaps."""
    folder = tmp_path_factory.mktemp("recorded")
    settings = Settings(output=folder, model=hmm_file, max_bag_duration=60)
    record(
        settings,
        LossySource(FileSource([day], START), {5: 7, 12: 150}),
        Flag(),
    )
    return folder


def replay(folder, output, model_file, **wanted):
    model = load_model(model_file)
    wanted = ReplayOptions(model=lambda _: model, output=output, **wanted)
    return replay_logs(LogSet(find_logs(folder), "features"), wanted, Flag())


def written(folder, start=0, end=1 << 62):
    """Segments of some span of time, as written."""
    return [
        (m.log_time, m.data)
        for log in find_logs(folder)
        for m in LogReader(log).messages()
        if m.topic == "/mic/segment" and start <= m.log_time < end
    ]


def test_a_recording_comes_out_again_bit_for_bit(folder, hmm_file, tmp_path):
    result = replay(folder, tmp_path / "again", hmm_file)
    assert result.compared.identical
    assert result.compared.segments == len(written(folder)) > 10
    assert written(tmp_path / "again") == written(folder)


@pytest.mark.parametrize("offset", [0.5, 33.33, 58.9, 121.0, 170.0])
def test_a_part_is_as_in_the_whole(folder, hmm_file, tmp_path, offset):
    result = replay(folder, tmp_path / "part", hmm_file, start_offset=offset, duration=10.0)
    start = START + round(offset * SECOND)
    recorded = written(folder, start, start + 10 * SECOND)
    assert result.compared.identical
    assert result.compared.segments == len(recorded)
    assert written(tmp_path / "part")[: len(recorded)] == recorded


def test_logs_of_a_recorder_that_smooths_are_sound(folder):
    assert {kind for findings in examine(folder) for kind in findings.counts} == {
        ("warning", "gap")
    }


@pytest.mark.parametrize(
    ("start", "end", "rules"),
    [(-200.0, -100.0, {"stamp", "segment-hole"}), (-9.0, 0.5, {"stamp", "segment-overlap"})],
)
def test_a_segment_that_is_written_too_late_or_before_it_is_over_is_found(
    folder, tmp_path, start, end, rules
):
    path = find_logs(folder)[0]
    log = Log(path)
    segment = log.messages("/mic/segment")[0]
    begin = segment.log_time + round(start * SECOND)
    duration = round((end - start) * SECOND)
    log.change(segment, header__stamp=time_message(begin), duration=duration_message(duration))
    (findings,) = examine(log.write(tmp_path / path.name))
    assert {rule for level, rule in findings.counts if level == "error"} == rules


def test_doubts_about_the_class_of_a_sound_do_not_make_it_silent():
    doubtful = np.full((60, 5), 0.15, np.float32)
    doubtful[:, 0], doubtful[:, 1] = 0.36, 0.19  # sound by 0.64, of which class is doubtful
    quiet = np.tile(np.float32([0.96, 0.01, 0.01, 0.01, 0.01]), (40, 1))
    probabilities = np.concatenate([quiet, doubtful, quiet])
    as_before = decided(FixedLagSmoother(default_transitions(CLASSES), LAG, 0.5), probabilities, 50)
    assert (as_before == 0).all()
    apart = ClassesApart(0, 0.2)
    smoother = FixedLagSmoother(default_transitions(CLASSES), LAG, 0.5, apart)
    states = decided(smoother, probabilities, 50)
    assert (states[45:95] == 1).mean() > 0.9
    assert (states[:30] == 0).all()


def test_silence_apart_from_the_classes_gives_the_same_states_in_blocks_of_any_size():
    probabilities = made_up(11)
    probabilities[100:140] = [1, 0, 0, 0, 0]
    probabilities[300:340] = [0, 1, 0, 0, 0]
    smoother = FixedLagSmoother(default_transitions(CLASSES), LAG, 0.5, ClassesApart(0, 0.2))
    full = decided(smoother, probabilities, len(probabilities))
    for size in (1, 13, 1024):
        assert decided(smoother, probabilities, size).tolist() == full.tolist()
    likely = log_likelihoods(probabilities, 0.5, ClassesApart(0, 0.2))
    assert np.isfinite(likely).all()
    best = np.delete(likely, 0, axis=1).max(axis=1)
    expected = 0.5 * np.log(np.maximum(1.0 - probabilities[:, 0].astype(float), 1e-38))
    np.testing.assert_allclose(best, np.maximum(expected, np.log(1e-6)), atol=1e-9)


def test_without_an_exponent_the_likelihoods_are_as_ever_to_the_bit():
    probabilities = made_up(12)
    before = np.round(np.maximum(0.5 * np.log(probabilities.astype(float)), np.log(1e-6)) * 2**30)
    np.testing.assert_array_equal(log_likelihoods(probabilities, 0.5) * 2**30, before)
