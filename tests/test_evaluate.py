import json
from collections import Counter
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import soundfile
from hypothesis import given, settings
from hypothesis import strategies as st
from log_fixtures import run
from sklearn.metrics import confusion_matrix, f1_score, precision_recall_fscore_support

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.evaluation import (
    Events,
    event_based,
    false_alarms_per_day,
    laid_out,
    segment_based,
)
from hearthlog.analyzer.evaluation.log_scores import evaluate_labelling
from hearthlog.analyzer.evaluation.model_scores import evaluate_model
from hearthlog.analyzer.logs.labelling import Labelling
from hearthlog.analyzer.logs.spans import Spans, intersection, joined
from hearthlog.analyzer.training.clips import clip_frames, steady_noise
from hearthlog.analyzer.training.dataset import build_dataset
from hearthlog.analyzer.training.manifest import BUILTIN, read_manifest, scenario_of
from hearthlog.analyzer.training.scores import (
    Bin,
    calibration_error,
    difference,
    reliability,
    score,
)
from hearthlog.analyzer.training.train import default_transitions, train_model
from hearthlog.analyzer.training.window_methods import PAPER
from hearthlog.models.classes import ordered
from hearthlog.models.classifiers.model import Smoothing
from hearthlog.models.modelfile import load_model, save_model
from hearthlog.schemas.errors import ignore_progress
from hearthlog.tools.cli.tables import print_scores
from hearthlog.tools.home.simulate import write_training_set


@pytest.fixture
def hearthlog(capfd):
    """Run the command in this process and return what came of it."""
    return partial(run, capfd)


SECOND = 1_000_000_000
FRAME = SECOND // 20
CLASSES = ("silence", "speech", "coughing")
TOP_LEVEL = {
    "macro_f1",
    "macro_f1_interval",
    "per_class",
    "confusion",
    "segment_based",
    "event_based",
    "false_alarms_per_day",
    "groups",
    "classes",
}

labels = st.lists(
    st.tuples(st.integers(0, 2), st.integers(0, 2), st.integers(0, 4)), min_size=1, max_size=60
)


def guesses(rng, groups, per_group=8):
    """Segments whose sources are easy or hard: (target, probabilities, group)."""
    hardness = rng.uniform(0, 3, groups)
    group = np.repeat(np.arange(groups), per_group)
    target = np.repeat(rng.integers(0, 3, groups), per_group)
    logits = rng.normal(0, 1, (len(group), 3)) * hardness[group, np.newaxis]
    logits[np.arange(len(group)), target] += 1.5
    probabilities = np.exp(logits)
    return target, probabilities / probabilities.sum(axis=1, keepdims=True), group


@given(labels)
@settings(deadline=None)
def test_scores_are_those_of_scikit_learn_over_the_classes_that_occur(rows):
    target, predicted, group = np.array(rows).T
    found = score(target, predicted, group, CLASSES)
    present = np.unique(target)
    expected = precision_recall_fscore_support(target, predicted, labels=present, zero_division=0)
    ours = [found.per_class[CLASSES[i]] for i in present]
    np.testing.assert_allclose(
        [[c.precision, c.recall, c.f1] for c in ours], np.transpose(expected[:3])
    )
    assert [c.support for c in ours] == expected[3].tolist()
    macro = f1_score(target, predicted, labels=present, average="macro", zero_division=0)
    assert found.macro_f1 == pytest.approx(macro)
    every = confusion_matrix(target, predicted, labels=range(3))
    assert found.confusion == every.tolist()
    assert found.segments == len(rows)
    assert (found.macro_f1_interval is None) == (len(np.unique(group)) == 1)


def test_a_class_that_does_not_occur_has_no_recall_and_is_no_part_of_the_mean():
    found = score(np.array([0, 0, 1]), np.array([0, 2, 1]), np.arange(3), CLASSES)
    absent = found.per_class["coughing"]
    assert (absent.precision, absent.recall, absent.f1, absent.support) == (0.0, None, None, 0)
    assert found.macro_f1 == pytest.approx((2 / 3 + 1) / 2)
    assert json.loads(json.dumps(found.confusion)) == [[1, 0, 1], [0, 1, 0], [0, 0, 0]]


def test_weights_stand_for_as_many_segments():
    rng = np.random.default_rng(1)
    target, predicted, group = rng.integers(0, 3, (3, 40))
    weight = rng.integers(1, 9, 40)
    once = score(target, predicted, group, CLASSES, weight)
    again = score(*(np.repeat(a, weight) for a in (target, predicted, group)), CLASSES)
    assert once == again


def test_the_interval_is_the_same_each_time_and_covers_what_is_true():
    rng = np.random.default_rng(2)
    target, probabilities, _ = guesses(rng, 20_000)
    true = f1_score(target, probabilities.argmax(axis=1), average="macro")
    covered = 0
    for _ in range(100):
        sample = guesses(rng, 60)
        found = score(sample[0], sample[1].argmax(axis=1), sample[2], CLASSES)
        low, high = found.macro_f1_interval
        covered += low <= true <= high
    assert 85 <= covered <= 100
    assert found == score(sample[0], sample[1].argmax(axis=1), sample[2], CLASSES)


def test_the_interval_is_over_sources_not_over_segments():
    target, probabilities, group = guesses(np.random.default_rng(3), 40, per_group=30)
    predicted = probabilities.argmax(axis=1)
    low, high = score(target, predicted, group, CLASSES).macro_f1_interval
    narrow = score(target, predicted, np.arange(len(group)), CLASSES).macro_f1_interval
    assert high - low > 1.5 * (narrow[1] - narrow[0])


def test_a_better_model_is_told_from_one_that_is_the_same():
    target, good, group = guesses(np.random.default_rng(4), 100)
    poor = np.random.default_rng(5).dirichlet(np.ones(3), len(target))
    better = difference(target, poor, good, group, CLASSES)
    assert better.interval[0] > 0
    macro = [f1_score(target, p.argmax(axis=1), average="macro") for p in (poor, good)]
    assert better.macro_f1 == pytest.approx(macro[1] - macro[0])
    same = difference(target, good, good * 0.5, group, CLASSES)
    assert (same.macro_f1, *same.interval) == (0.0, 0.0, 0.0)


def test_the_comparison_is_paired():
    target, good, group = guesses(np.random.default_rng(6), 100)
    other = good.copy()
    other[::50] = np.roll(other[::50], 1, axis=1)
    low, high = difference(target, good, other, group, CLASSES).interval
    own = score(target, good.argmax(axis=1), group, CLASSES).macro_f1_interval
    assert high - low < 0.5 * (own[1] - own[0])


def test_reliability_adds_up_to_the_calibration_error():
    target, probabilities, _ = guesses(np.random.default_rng(7), 300)
    bins = reliability(probabilities, target)
    assert sum(b.count for b in bins) == len(target)
    right = probabilities.argmax(axis=1) == target
    assert sum(b.accuracy * b.count for b in bins) == pytest.approx(right.sum())
    error = sum(abs(b.accuracy - b.confidence) * b.count for b in bins) / len(target)
    assert calibration_error(probabilities, target) == pytest.approx(error)
    assert calibration_error(np.eye(3)[target], target) == 0.0
    assert reliability(np.eye(3)[target], target) == [Bin(14, 1.0, 1.0, len(target))]


def test_nothing_to_score_is_said():
    nothing = np.empty(0, np.intp)
    with pytest.raises(DataError, match="nothing to score"):
        score(nothing, nothing, nothing, CLASSES)


# Events


def events(*rows):
    starts, ends, numbers = np.array(rows, float).reshape(-1, 3).T
    return Events(
        (starts * SECOND).round().astype(np.int64),
        (ends * SECOND).round().astype(np.int64),
        numbers.astype(np.int64),
    )


def home(rng, count):
    starts = np.sort(rng.uniform(0, 60, count))
    return events(
        *zip(
            starts,
            starts + rng.exponential(2, count) + 0.01,
            rng.integers(0, 3, count),
            strict=True,
        )
    )


def mistaken(rng, true):
    kept = true.select(np.flatnonzero(rng.random(len(true)) < 0.8))
    moved = kept.starts + (rng.normal(0, 0.15, len(kept)) * SECOND).astype(np.int64)
    starts = np.maximum(moved, 0)
    ends = kept.ends + (rng.normal(0, 0.3, len(kept)) * SECOND).astype(np.int64)
    extra = home(rng, 5)
    return Events(
        np.concatenate([starts, extra.starts]),
        np.concatenate([np.maximum(ends, starts + FRAME), extra.ends]),
        np.concatenate([kept.labels, extra.labels]),
    )


@pytest.mark.parametrize("seed", range(10))
def test_segments_and_events_are_scored_as_by_sed_eval(seed):
    dcase_util = pytest.importorskip("dcase_util")
    sound_event = pytest.importorskip("sed_eval", exc_type=ImportError).sound_event

    def container(found):
        rows = zip(found.starts / SECOND, found.ends / SECOND, found.labels, strict=True)
        return dcase_util.containers.MetaDataContainer(
            [
                {"filename": "a", "event_label": CLASSES[i], "onset": start, "offset": end}
                for start, end, i in rows
            ]
        )

    rng = np.random.default_rng(seed)
    true = home(rng, 40)
    found = mistaken(rng, true)
    peers = (
        sound_event.SegmentBasedMetrics(list(CLASSES), time_resolution=1.0),
        sound_event.EventBasedMetrics(list(CLASSES), t_collar=0.2, percentage_of_length=0.5),
    )
    for peer, ours in zip(peers, (segment_based, event_based), strict=True):
        peer.evaluate(container(true), container(found))
        theirs, mine = peer.results(), ours(true, found, CLASSES)
        pairs = [(theirs["overall"], mine)]
        pairs += [(theirs["class_wise"][name], mine.per_class[name]) for name in CLASSES]
        for their, my in pairs:
            figures = their["f_measure"]
            expected = figures["precision"], figures["recall"], np.nan_to_num(figures["f_measure"])
            np.testing.assert_allclose([my.precision, my.recall, my.f1], expected)


def test_an_event_is_matched_with_one_only_and_as_many_as_possible_are():
    true = events((1.0, 2.0, 0), (1.1, 2.0, 0))
    assert event_based(true, events((1.0, 2.0, 0)), CLASSES).per_class["silence"].recall == 0.5
    # The first could take either; the second only the one at 0.95 s.
    found = events((0.95, 2.0, 0), (1.25, 2.0, 0))
    assert event_based(true, found, CLASSES).f1 == 1.0


def test_a_false_alarm_overlaps_nothing_of_its_class():
    true = events((0, 10, 0), (2, 3, 1), (12, 13, 1))
    found = events((2.9, 3.5, 1), (3.0, 3.5, 1), (5, 6, 1), (20, 21, 2), (9, 30, 0))
    alarms = false_alarms_per_day(true, found, CLASSES, 3600 * SECOND)
    assert alarms == {"silence": 0.0, "speech": 48.0, "coughing": 24.0}


spans = st.lists(st.tuples(st.integers(0, 50), st.integers(1, 9)), max_size=12)


@given(spans, spans)
def test_spans_are_joined_and_cut_like_sets_of_moments(first, second):
    sets = [
        {t for start, length in rows for t in range(start, start + length)}
        for rows in (first, second)
    ]
    spans = [
        joined(*(np.array(v, np.int64) for v in ([a for a, _ in rows], [a + n for a, n in rows])))
        for rows in (first, second)
    ]
    assert [one.length for one in spans] == [len(one) for one in sets]
    assert intersection(*spans).length == len(sets[0] & sets[1])


def test_what_is_outside_of_the_evaluated_spans_is_left_out():
    spans = Spans(np.array([10, 20]) * SECOND, np.array([12, 25]) * SECOND)
    laid = laid_out(events((0, 5, 0), (9, 21.5, 1), (24, 30, 2)), spans)
    assert (laid.ends - laid.starts).tolist() == [2 * SECOND, SECOND * 3 // 2, SECOND]
    assert (laid.starts % SECOND == 0).all()
    assert laid.starts[1] - laid.ends[0] >= SECOND


# A log against a reference


def labelling(*rows):
    starts, ends, names = zip(*rows, strict=True)
    return Labelling(
        (np.array(starts) * SECOND).round().astype(np.int64),
        (np.array(ends) * SECOND).round().astype(np.int64),
        np.array(names, object),
    )


@given(st.integers(0, 10_000))
@settings(deadline=None, max_examples=30)
def test_frames_are_counted_as_if_each_were_looked_at(seed):
    rng = np.random.default_rng(seed)
    times = np.unique(rng.integers(0, 60 * SECOND, 30))
    found = Labelling(times[:-1], times[1:], np.array(CLASSES, object)[rng.integers(0, 3, 29)])
    times = np.unique(rng.integers(0, 60 * SECOND, 12))
    names = np.array([*CLASSES, "doorbell"], object)[rng.integers(0, 4, 11)]
    names[0] = "speech"
    reference = Labelling(times[:-1], times[1:], names)
    result = evaluate_labelling(reference, found, CLASSES)
    start = max(found.starts[0], reference.starts[0])
    end = min(found.ends[-1], reference.ends[-1])
    middles = start + FRAME // 2 + FRAME * np.arange((end - start + FRAME // 2 - 1) // FRAME)
    true, output = (
        each.labels[np.searchsorted(each.starts, middles, "right") - 1]
        for each in (reference, found)
    )
    known = true != "doorbell"
    expected = confusion_matrix(true[known], output[known], labels=CLASSES)
    assert result.scores.confusion == expected.tolist()


def test_time_that_only_one_of_them_labels_is_not_evaluated():
    found = labelling((10, 20, "speech"), (20, 30, "silence"))
    result = evaluate_labelling(labelling((0, 15, "speech"), (25, 100, "silence")), found, CLASSES)
    assert (result.reference_seconds, result.evaluated_seconds) == (90.0, 10.0)
    assert result.scores.segments == 200
    assert result.scores.macro_f1 == result.detections.event_based.f1 == 1.0


def test_two_labels_at_a_time_are_left_out_of_the_frames_and_said():
    reference = labelling((0, 10, "speech"), (4, 6, "coughing"))
    result = evaluate_labelling(reference, labelling((0, 10, "speech")), CLASSES)
    assert (result.ambiguous_seconds, result.scores.segments) == (2.0, 160)
    assert result.detections.segment_based.per_class["coughing"].recall == 0.0


def test_labels_that_the_log_does_not_know_are_said():
    reference = labelling((0, 10, "speech"), (10, 14, "doorbell"))
    result = evaluate_labelling(reference, labelling((0, 14, "speech")), CLASSES)
    assert result.unknown_labels == {"doorbell": 4.0}
    assert result.scores.segments == 200
    with pytest.raises(DataError, match="none of the labels of the log"):
        evaluate_labelling(labelling((0, 9, "doorbell")), labelling((0, 14, "speech")), CLASSES)


def test_a_reference_may_have_other_names_for_the_classes():
    found = labelling((0, 10, "speech"), (10, 14, "coughing"))
    ours = evaluate_labelling(labelling((0, 9, "speech"), (9, 14, "coughing")), found, CLASSES)
    others = evaluate_labelling(labelling((0, 9, "Speech"), (9, 14, "cough")), found, CLASSES)
    assert others == ours
    assert others.unknown_labels == {}


def test_a_reference_of_another_time_is_refused():
    with pytest.raises(DataError, match="have no time in common"):
        evaluate_labelling(labelling((100, 110, "speech")), labelling((0, 14, "speech")), CLASSES)


# The command


def test_no_line_of_a_table_is_too_wide(capsys):
    rng = np.random.default_rng(8)
    classes = [f"class_of_a_long_name_{i}" for i in range(32)]
    target, predicted, group = rng.integers(0, 32, (3, 5000))
    weight = rng.integers(0, 10**5, 5000)
    found = score(target, predicted, group, classes, weight)
    print_scores(found)
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 100
    assert lines[-1].startswith("confusion: too many classes")


@pytest.fixture
def some_household(all_household, tmp_path):
    """A manifest of every tenth recording of each label, and of the first two."""
    head, *rows = (all_household / "manifest.csv").read_text("utf-8").splitlines()
    (tmp_path / "clips").symlink_to(all_household)
    seen, kept = Counter(), []
    for row in rows:
        label = row.split(",")[1]
        if seen[label] < 2 or seen[label] % 10 == 0:
            kept.append(f"clips/{row}\n")
        seen[label] += 1
    manifest = tmp_path / "some.csv"
    manifest.write_text("".join([f"{head}\n", *kept]))
    return manifest


def test_a_model_is_scored_on_real_household_sound(some_household, model_file, tmp_path, hearthlog):
    picture, words = tmp_path / "scores.png", (model_file, "--data", some_household)
    options = ("--scenario", "general", "--json", "--plot", picture)
    result = hearthlog("evaluate", "model", *words, *options)
    assert result.returncode == 0, result.stderr
    found = json.loads(result.stdout)
    more = {"expected_calibration_error", "reliability", "segments", "model", "sha256", "scenario"}
    assert TOP_LEVEL | more <= found.keys()
    assert found["scenario"] == "general"
    assert found["segments"] == np.sum(found["confusion"])
    f1 = [one["f1"] for one in found["per_class"].values()]
    assert found["macro_f1"] == pytest.approx(np.mean(f1))
    assert 0.0 < found["macro_f1"] < 1.0
    low, high = found["macro_f1_interval"]
    assert low < high
    assert picture.read_bytes().startswith(b"\x89PNG")
    table = hearthlog("evaluate", "model", *words)
    assert table.returncode == 0
    assert max(map(len, table.stdout.splitlines())) <= 100
    assert f"{found['macro_f1']:.3f}" in table.stdout
    assert f": {found['segments']} segments of 1 s from " in table.stdout


def test_a_log_is_scored_against_a_label_file_and_against_its_review(recorded, tmp_path, hearthlog):
    log = min(recorded.rglob("*.mcap"))
    copy = tmp_path / log.name
    copy.write_bytes(log.read_bytes())
    track = tmp_path / "labels.txt"
    assert hearthlog("export", copy, "-o", track, "--topics", "/mic/segment").returncode == 0
    picture = tmp_path / "scores.png"
    result = hearthlog("evaluate", "log", copy, "--reference", track, "--json", "--plot", picture)
    assert result.returncode == 0, result.stderr
    found = json.loads(result.stdout)
    assert TOP_LEVEL | {"frames", "unknown_labels", "evaluated_seconds"} <= found.keys()
    assert found["macro_f1"] > 0.99
    assert found["event_based"]["f1"] > 0.99
    assert picture.read_bytes().startswith(b"\x89PNG")
    nothing = hearthlog("evaluate", "log", copy, "--reference", "review")
    assert nothing.returncode == 1
    assert "is reviewed" in nothing.stderr
    assert hearthlog("annotate", "import", copy, track).returncode == 0
    review = hearthlog("evaluate", "log", copy, "--reference", "review", "--json")
    assert review.returncode == 0, review.stderr
    assert json.loads(review.stdout)["confusion"] == found["confusion"]
    events = json.loads(review.stdout)["events"]
    assert list(events) == ordered(set(events)), "in one order, whatever the seed of hashes"
    layer = hearthlog(
        "evaluate", "log", copy, "--topic", "/mic/review/segment", "--reference", track, "--json"
    )
    assert json.loads(layer.stdout)["macro_f1"] > 0.99


def test_bad_references_are_one_line(recorded, tmp_path, hearthlog):
    log = min(recorded.rglob("*.mcap"))
    cases = {
        "10000000\t10000009\tspeech\n": "no time in common",
        "0\t9\tdoorbell\n": "none of the labels of the log",
        "0\t9e99\tspeech\n": "no log has",
        "nonsense\n": "labels.txt:1",
        "": "holds no labels",
    }
    for text, output in cases.items():
        track = tmp_path / "labels.txt"
        track.write_text(text)
        result = hearthlog("evaluate", "log", log, "--reference", track)
        assert result.returncode == 1
        assert output in result.stderr
        assert result.stderr.count("\n") == 1
    track.write_text("0\t5\tspeech\n5\t9\tdoorbell\n")
    result = hearthlog("evaluate", "log", log, "--reference", track)
    assert result.returncode == 3
    assert "doorbell (4.0 s)" in result.stderr


def test_a_model_of_another_scenario_is_refused(all_household, model_file, hearthlog):
    words = (model_file, "--data", all_household, "--scenario", "bathroom")
    result = hearthlog("evaluate", "model", *words)
    assert result.returncode == 1
    assert "the model lacks flushing_water" in result.stderr
    assert "the scenario lacks speech" in result.stderr
    assert result.stderr.count("\n") == 1


def test_wrong_use_is_refused_before_anything_is_read(tmp_path, hearthlog):
    (tmp_path / "there.png").touch()
    compared = ("a.mcap", "--reference", "r.txt")
    cases = (
        (("log", "a.mcap"), 2, "--reference"),
        (("log", *compared, "--plot", "p.pdf"), 2, "*.png"),
        (("log", *compared, "--plot", tmp_path / "there.png"), 1, "exists already"),
        (("log", *compared), 1, "no such log"),
        (("model", "m.safetensors", "--data", "d"), 1, "no such model file"),
        (("method", "--data", "d", "--scenario", "general", "--plot", "p.pdf"), 2, "*.png"),
    )
    for words, status, output in cases:
        result = hearthlog("evaluate", *words)
        assert result.returncode == status
        assert output in result.stderr


def clip_and_log(model_file, day, tmp_path, hearthlog, *smoothing):
    """Evaluate a model on a day as a clip, and as a recorder labels it between quiet seconds."""
    model = load_model(model_file)
    about = model.description.model_copy(update=dict(smoothing))
    hidden = about.smoothing.method == "hmm"
    transitions = default_transitions(model.classes) if hidden else np.empty((0, 0))
    model_file = tmp_path / "model.safetensors"
    save_model(replace(model, description=about, transitions=transitions), model_file)
    (tmp_path / "day.flac").write_bytes(day.read_bytes())
    manifest = tmp_path / "one.csv"
    manifest.write_text("path,label,source_group\nday.flac,speech,a\n")
    words = (model_file, "--data", manifest, "--json")
    of_clip = json.loads(hearthlog("evaluate", "model", *words).stdout)
    sound, rate = soundfile.read(day, dtype="int16")
    room = np.rint(32767 * steady_noise(2 * rate, -80.0, np.random.default_rng(0))).astype(np.int16)
    soundfile.write(tmp_path / "room.flac", np.concatenate([room, sound, room]), rate)
    logs, words = tmp_path / "logs", ("--model", model_file, "--start", "2026-03-01T08:00:00")
    recording = hearthlog("record", tmp_path / "room.flac", *words, "-o", logs)
    assert recording.returncode == 0, recording.stderr
    track = tmp_path / "labels.txt"
    track.write_text("0\t2\tsilence\n2\t182\tspeech\n182\t184\tsilence\n")
    result = hearthlog("evaluate", "log", logs, "--reference", track, "--json")
    return of_clip, json.loads(result.stdout)


@pytest.mark.parametrize("method", ["merge", "hmm"])
def test_clips_are_labelled_as_the_recorder_labels_them(
    method, day, second_file, tmp_path, hearthlog
):
    smoothing = Smoothing(method=method, lag_seconds=3.0, reach_seconds=0.6, shortest_seconds=0.25)
    requested = ("smoothing", smoothing)
    of_clip, of_log = clip_and_log(second_file, day, tmp_path, hearthlog, requested)
    assert (of_clip["evaluated_seconds"], of_log["evaluated_seconds"]) == (184.0, 183.5)
    clip, log = (one["event_based"]["per_class"] for one in (of_clip, of_log))
    assert {**clip, "silence": None} == {**log, "silence": None}
    assert of_clip["macro_f1_interval"] is None


def test_labels_beside_their_sounds_are_errors(training_set, model_file):
    model, scenario = load_model(model_file), BUILTIN["general"]
    clips = [c for c in read_manifest(training_set, scenario.labels) if c.label != "silence"][::3]
    early = model.description.model_copy(update={"label_frame": 0})
    right, wrong = (
        evaluate_model(one, clips, scenario, ignore_progress).detections.event_based.macro_f1
        for one in (model, replace(model, description=early))
    )
    assert wrong < right - 0.2


def test_a_model_without_silence_is_judged_in_its_clips_alone(training_set, second_file):
    model = load_model(second_file)
    names = ["quiet" if name == "silence" else name for name in model.classes]
    about = model.description
    renamed = about.model_copy(update={"classes": names, "scenario": {n: [n] for n in names}})
    model = replace(model, description=renamed)
    clips = [
        c for c in read_manifest(training_set, BUILTIN["general"].labels) if c.label == "speech"
    ]
    found = evaluate_model(model, clips, scenario_of(model), ignore_progress)
    assert found.evaluated_seconds == sum(len(clip_frames(clip)) for clip in clips) / 20
    assert found.detections.segment_based.per_class["speech"].recall > 0.5


@pytest.fixture(scope="module")
def own(tmp_path_factory):
    """A model, and the manifest that it has learned from."""
    folder = tmp_path_factory.mktemp("own")
    manifest = write_training_set(folder / "learned", clips_per_class=3, seed=3)
    scenario = BUILTIN["general"]
    clips = read_manifest(manifest, scenario.labels)
    data = build_dataset(clips, scenario, ignore_progress, features=PAPER.features)
    save_model(train_model(data, scenario, ignore_progress, PAPER), folder / "own.safetensors")
    return folder / "own.safetensors", manifest


def test_a_model_says_that_one_clip_of_the_data_was_learned_from(own, hearthlog):
    model, learned = own
    other = write_training_set(learned.parents[1] / "other", clips_per_class=2, seed=4)
    words = ("evaluate", "model", model, "--data", other)
    unseen = hearthlog(*words)
    assert (unseen.returncode, "learned" in unseen.stderr) == (0, False)
    shared = "../learned/speech/speech_002.flac,speech,elsewhere,,,3.0\n"
    other.write_text(other.read_text() + shared)
    assert "was trained on 1 of the" in hearthlog(*words).stderr
    assert json.loads(hearthlog(*words, "--json").stdout)["sources_learned"] == 1


def test_a_model_is_scored_without_the_clips_that_cannot_be_read(own, hearthlog):
    model, learned = own
    other = write_training_set(learned.parents[1] / "faulty", clips_per_class=2, seed=5)
    words = ("evaluate", "model", model, "--data", other)
    clean = hearthlog(*words, "--json")
    (other.parent / "bad.wav").write_text("no sound")
    rows = "bad.wav,speech,a,,,\nnone.wav,speech,a,,,\n"
    other.write_text(other.read_text() + rows)
    result = hearthlog(*words, "--json")
    assert (clean.returncode, result.returncode) == (0, 3)
    for line in ("left out: 1, no such file", "left out: 1, cannot be read, or not all of it"):
        assert line in result.stderr
    assert json.loads(result.stdout)["macro_f1"] == json.loads(clean.stdout)["macro_f1"]


def test_a_model_says_that_it_is_scored_on_what_it_learned_from(own, hearthlog):
    model, manifest = own
    result = hearthlog("evaluate", "model", model, "--data", manifest)
    assert result.returncode == 3
    assert "was trained on 27 of the 27 sources" in result.stderr
