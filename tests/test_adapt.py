"""A model learns a home's own sounds: from marks in its logs, in little, and the same each time."""

import dataclasses
import json
from functools import cache, partial
from threading import Event

import numpy as np
import pytest
import soundfile
from blobs import blobs, with_arrays
from log_fixtures import run

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.evaluation.model_scores import segment_probabilities
from hearthlog.analyzer.marks.marks import Mark, write_marks
from hearthlog.analyzer.training.adaptation import adapt_model, is_moved, learned_over
from hearthlog.analyzer.training.dataset import Recording, clip_recordings, cut_recordings
from hearthlog.analyzer.training.home_recordings import (
    HOME_WEIGHT,
    home_recordings,
    training_recordings,
)
from hearthlog.analyzer.training.manifest import (
    BUILTIN,
    LABELS,
    Scenario,
    read_manifest,
    scenario_of,
)
from hearthlog.analyzer.training.method import prepare
from hearthlog.analyzer.training.train import (
    KINDS,
    default_transitions,
    evaluate_method,
    train_model,
)
from hearthlog.analyzer.training.window_methods import BANDS, ROOM, SVM, kept_inputs
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.rbf_machines import HOME_VOTE, home_votes
from hearthlog.models.features import of_segments
from hearthlog.models.features.auros21 import FeatureExtractor, augmented, bands_of
from hearthlog.models.features.floor import FloorTracker
from hearthlog.models.features.installed import DEFAULT
from hearthlog.models.modelfile import load_model, model_card, save_model
from hearthlog.models.starter import GENERAL, starter_file
from hearthlog.recorder.config import Settings
from hearthlog.recorder.recording import record
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.schemas.errors import HearthlogWarning, ModelError, ignore_progress
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import find_logs
from hearthlog.tools.home.clips import SHIPPED


@pytest.fixture
def hearthlog(capfd):
    """Run the command in this process and return what came of it."""
    return partial(run, capfd)


RATE = 16_000


def split(data, kept):
    """Return the segments of some groups, and the others."""
    inside = np.isin(data.group, kept)
    return rows(data, inside), rows(data, ~inside)


def rows(data, chosen):
    names = ("windows", "target", "group", "collection", "weight", "floor")
    changed = {name: getattr(data, name)[chosen] for name in names}
    copies = {name: getattr(data, name)[:, chosen] for name in ("copies", "copy_floor")}
    return dataclasses.replace(data, **changed, **copies)


def moved(data, amount):
    """Let a home sound like nothing that was heard before."""
    windows = data.windows.copy()
    windows[:, :, 9:] += np.float32(amount)
    return dataclasses.replace(data, windows=windows, weight=np.full(len(data), 5.0))


def sounds_of(method):
    """Segments that a model learns from, and others."""
    data, scenario = blobs(4, 60, spread=0.6, features=method.features)
    return *split(data, data.group[data.group % 6 < 4]), scenario


@cache
def world_of(method):
    """A model, and a home where everything sounds different: a part to learn from, and the rest."""
    learned, other, scenario = sounds_of(method)
    few, rest = split(moved(other, 40.0), other.group[other.group % 6 == 4])
    return train_model(learned, scenario, ignore_progress, method), few, rest


@pytest.fixture(scope="module")
def world():
    return world_of(ROOM)


def accuracy(model, data):
    return (predicted(model, data.windows, data.floor) == data.target).mean()


def predicted(model, segments, floor):
    classifier = Classifier(model)
    inputs = of_segments(classifier.inputs, segments, floor)
    return segment_probabilities(classifier, inputs).argmax(axis=1)


def test_a_model_that_was_adapted_knows_the_home_better(world):
    base, few, rest = world
    adapted = adapt_model(base, few)
    assert accuracy(adapted, rest) > accuracy(base, rest) + 0.2
    about = adapted.description.training_data
    assert about.base_sha256 == base.sha256
    assert sum(amount.segments for amount in about.home.values()) == len(few)
    assert "Adapted to a home" in model_card(adapted)


def test_adapting_to_the_same_home_gives_the_same_file(world, tmp_path):
    base, few, _ = world
    for name in ("a", "b"):
        save_model(adapt_model(base, few), tmp_path / f"{name}.safetensors")
    a, b = (load_model(tmp_path / f"{name}.safetensors") for name in ("a", "b"))
    assert a.sha256 == b.sha256


@pytest.mark.parametrize("method", [BANDS, ROOM])
def test_adapting_an_adapted_model_begins_with_what_the_first_one_learned(method):
    base, few, _ = world_of(method)
    once = adapt_model(base, few)
    twice = adapt_model(once, few)
    for name, array in once.arrays.items():
        np.testing.assert_array_equal(array, twice.arrays[name])
    moved = base if is_moved(base) else learned_over(base)
    temperatures = once.description.inverse_temperature, twice.description.inverse_temperature
    assert temperatures[0] == temperatures[1] != moved.description.inverse_temperature
    assert twice.description.base_inverse_temperature == moved.description.inverse_temperature


def test_few_marks_bring_back_the_temperature_that_the_model_had_before_more_marks(world):
    base, few, _ = world
    adapted = adapt_model(adapt_model(base, few), rows(few, np.arange(len(few)) < 5))
    assert adapted.description.inverse_temperature == base.description.inverse_temperature


def of_old(base, moved):
    """A support vector machine as an earlier version adapted it: one vector in ten is of a home."""
    support = base.arrays["support_vectors"]
    counts = base.arrays["support_counts"]
    target = np.repeat(np.arange(len(counts)), counts)
    kept = np.arange(len(support)) % 10 > 0
    rows = np.full(len(support), -1)
    rows[kept] = np.flatnonzero(kept)
    vectors = support.copy()
    vectors[~kept] += np.float32(moved)
    return with_arrays(
        base,
        support_vectors=vectors,
        base_target=target.astype(np.int64),
        support_base=rows,
        base_vectors=support[~kept],
        base_costs=np.ones(len(counts)),
    )


def test_what_an_earlier_version_adapted_begins_with_what_its_base_had_kept():
    base, few, rest = world_of(SVM)
    old = of_old(base, 40.0)
    inputs, target = kept_inputs(old)
    np.testing.assert_array_equal(inputs, base.arrays["support_vectors"])
    assert target.tolist() == kept_inputs(base)[1].tolist()
    assert accuracy(adapt_model(old, few), rest) > accuracy(old, rest) + 0.2


@pytest.mark.parametrize("twice", [False, True])
def test_an_adapted_machine_whose_vectors_are_numbered_wrongly_is_refused(twice, tmp_path):
    adapted = of_old(world_of(SVM)[0], 0.0)
    save_model(adapted, tmp_path / "right.safetensors")
    numbers = adapted.arrays["support_base"].copy()
    kept = np.flatnonzero(numbers >= 0)
    numbers[kept[0]] = numbers[kept[1]] if twice else 1_000_000
    with pytest.raises(ModelError, match="support_base has numbers that no vector of the base has"):
        save_model(with_arrays(adapted, support_base=numbers), tmp_path / "x.safetensors")


def test_landmarks_are_as_unsure_as_the_machine_that_they_learn_from():
    base, few, _ = world_of(SVM)
    update = {"inverse_temperature": 0.01}
    unsure = dataclasses.replace(base, description=base.description.model_copy(update=update))
    inputs = of_segments(Classifier(base).inputs, few.windows, few.floor)
    probabilities = segment_probabilities(Classifier(learned_over(unsure)), inputs)
    np.testing.assert_allclose(probabilities, 1 / len(base.classes), atol=0.05)


@pytest.mark.parametrize("method", [BANDS, SVM])
def test_landmarks_say_what_a_machine_says(method):
    base, over = world_of(method)[0], learned_over(world_of(method)[0])
    assert is_moved(over)
    assert over.classes == base.classes
    _, unseen, _ = sounds_of(method)
    inputs = of_segments(Classifier(base).inputs, unseen.windows, unseen.floor)
    before, after = (segment_probabilities(Classifier(one), inputs) for one in (base, over))
    assert np.abs(after - before).mean() < 0.1


def test_a_class_the_home_has_not_is_not_forgotten(world):
    base, few, _ = world
    three = rows(few, few.target != 2)
    learned, _, _ = sounds_of(ROOM)
    own = rows(learned, learned.target == 2)
    assert accuracy(adapt_model(base, three), own) > 0.9


@pytest.mark.parametrize("method", [BANDS, ROOM])
def test_a_model_keeps_no_windows(method):
    assert not len(world_of(method)[0].training_windows)


def test_what_a_home_says_of_coughs_and_shouts_changes_nothing_else():
    base = load_model(starter_file(GENERAL))
    scenario = scenario_of(base)
    recordings = clip_recordings(read_manifest(SHIPPED, LABELS), scenario, ignore_progress)
    data = cut_recordings(recordings, scenario)
    of_home = np.isin(data.target, [data.classes.index(one) for one in ("coughing", "yelling")])
    adapted = adapt_model(base, rows(data, of_home & (np.arange(len(data)) % 2 == 0)))
    before, after = (predicted(one, data.windows, data.floor) for one in (base, adapted))
    right = (before[of_home] == data.target[of_home]).mean()
    assert (after[of_home] == data.target[of_home]).mean() > right
    assert (before == after)[~of_home].mean() > 0.97


def test_a_home_without_segments_is_refused(world):
    base, few, _ = world
    with pytest.raises(DataError, match="no segments of a class of the model"):
        adapt_model(base, rows(few, few.target < 0))


def test_a_model_with_vectors_of_a_home_labels_as_it_did():
    base, few, rest = world_of(SVM)
    home = of_segments(DEFAULT.inputs[SVM.inputs], few.windows, few.floor)[:, 0]
    old = with_arrays(base, home_vectors=home, home_target=few.target.astype(np.int64))
    assert accuracy(old, rest) > accuracy(base, rest) + 0.2


def test_what_is_near_to_the_vectors_of_a_home_is_drawn_to_its_class_and_nothing_else():
    home, others = np.array([[0.5, 0.0], [0.0, 0.0], [1e-9, 0.0]]), np.array([[0.0], [1.0], [1.0]])
    votes = home_votes(home, others)
    assert votes[0].tolist() == [HOME_VOTE, 0.0]
    assert votes[1].tolist() == [0.0, 0.0]
    assert 0.0 < votes[2, 0] < 1e-6


def test_marks_in_a_log_become_segments_of_the_features_that_were_logged(recorded):
    log = find_logs(recorded)[0]
    labelled = read_columns([log], ["/mic/features"])["/mic/features"]
    stamps = labelled["header.stamp"]
    marks = [
        Mark("mic", int(stamps[100]), int(stamps[160]), "speech"),
        Mark("mic", int(stamps[300]), int(stamps[306]), "coughing"),
    ]
    layer = write_marks(log, marks)
    try:
        found = list(home_recordings(recorded))
    finally:
        layer.unlink()
    assert [item.label for item in found] == ["speech", "coughing"]
    np.testing.assert_array_equal(found[0].features, labelled["values"][100:160])
    np.testing.assert_array_equal(found[1].features, labelled["values"][293:313])  # a whole second
    assert found[0].group == found[1].group
    floors = FloorTracker()(
        DEFAULT.band_powers(labelled["values"]), int(labelled["frame"][0])
    ).powers
    behind = len(floors) - len(stamps)  # from the end of the mark on, as the recorder tracked it
    np.testing.assert_array_equal(found[0].floor, floors[behind + 100 : behind + 160])
    np.testing.assert_array_equal(found[1].floor, floors[behind + 293 : behind + 313])
    assert found[0].floor.all()
    data = cut_recordings(found, Scenario("x", {"speech": ("speech",), "coughing": ("coughing",)}))
    assert data.weight.min() == HOME_WEIGHT


def test_marks_that_contradict_the_floor_of_the_room_are_left_out_and_counted(
    hearthlog, model_file, tmp_path
):
    """A fan at a steady level is the room after a minute, whatever a mark says."""
    rng = np.random.default_rng(0)
    sound = 0.01 * rng.standard_normal(100 * RATE)
    sound[90 * RATE : 95 * RATE] *= 10.0
    soundfile.write(tmp_path / "fan.wav", sound, RATE)
    logs = tmp_path / "logs"
    recording = hearthlog("record", tmp_path / "fan.wav", "-o", logs, "--start", "2026-03-01")
    assert recording.returncode == 0, recording.stderr
    labels = tmp_path / "labels.txt"
    marks = ("70 80 speech", "82 88 coughing", "90 95 music", "96 99 silence")
    labels.write_text("\n".join(mark.replace(" ", "\t") for mark in marks))
    assert hearthlog("annotate", "import", find_logs(logs)[0], labels).returncode == 0
    with pytest.warns(HearthlogWarning, match="^2 marks lie where nothing is louder than the"):
        found = list(home_recordings(logs, gate=2.0))
    assert [item.label for item in found] == ["music", "silence"]
    assert [item.label for item in home_recordings(logs)] == [mark.split()[2] for mark in marks]
    words = ("--base", model_file, "--home", logs, "-o", tmp_path / "home.safetensors")
    trained = hearthlog("train", *words)
    assert trained.returncode == 3
    (line,) = [line for line in trained.stderr.splitlines() if "2 marks lie" in line]
    assert f"the first is speech in {find_logs(logs)[0].name}: they are left out" in line


def test_the_floor_at_a_mark_is_that_of_a_recorder_that_did_not_begin_with_its_log(day, tmp_path):
    settings = Settings(output=tmp_path, max_bag_duration=60)
    record(settings, FileSource([day], 1_772_348_400 * 10**9), Event())
    logs = find_logs(tmp_path)
    full = read_columns(logs, ["/mic/features"])["/mic/features"]
    stamps = full["header.stamp"]
    floors = FloorTracker()(DEFAULT.band_powers(full["values"]), 0).powers
    second = int(np.searchsorted(stamps, 1_772_348_460 * 10**9))
    begin, end = int(stamps[second + 10]), int(stamps[second + 50])
    layer = write_marks(logs[1], [Mark("mic", begin, end, "silence")])
    try:
        (found,) = home_recordings(tmp_path)
    finally:
        layer.unlink()
    behind = len(floors) - len(stamps) + second
    np.testing.assert_array_equal(found.floor, floors[behind + 10 : behind + 50])


def test_a_mark_by_another_name_is_learned_as_its_class(recorded):
    log = find_logs(recorded)[0]
    stamps = read_columns([log], ["/mic/features"])["/mic/features"]["header.stamp"].tolist()
    names = {"crying": "crying_sobbing", "yelling": "shout"}
    learned = []
    for crying, yelling in (names, names.values()):
        marks = [
            Mark("mic", stamps[100], stamps[140], crying),
            Mark("mic", stamps[140], stamps[180], yelling),
        ]
        layer = write_marks(log, marks)
        try:
            data = cut_recordings(home_recordings(recorded), BUILTIN["general"])
        finally:
            layer.unlink()
        learned.append((data.digest, data.amounts))
    assert learned[0] == learned[1]
    assert [name for name, one in learned[0][1].items() if one.seconds] == ["crying", "yelling"]


def test_transitions_that_an_earlier_version_learned_from_a_home_are_forgotten(world):
    base, few, _ = world
    training = base.description.training_data.model_copy(update={"home_frames": 1000})
    description = base.description.model_copy(update={"training_data": training})
    learned = np.full_like(base.transitions, 1.0 / len(base.classes))
    adapted = adapt_model(
        dataclasses.replace(base, description=description, transitions=learned), few
    )
    np.testing.assert_array_equal(adapted.transitions, default_transitions(base.classes))
    assert not adapted.description.training_data.home_frames


def test_a_second_across_a_gap_is_not_learned_from(recorded):
    for log in find_logs(recorded):
        labelled = read_columns([log], ["/mic/features"])["/mic/features"]
        stamps, frames = labelled["header.stamp"], labelled["frame"].astype(np.int64)
        if len(gaps := np.flatnonzero(np.diff(frames) != 1)):
            break
    gap = gaps[0]
    layer = write_marks(log, [Mark("mic", int(stamps[gap - 9]), int(stamps[gap + 31]), "speech")])
    try:
        found = list(home_recordings(recorded))
    finally:
        layer.unlink()
    assert [len(item.features) for item in found] == [10, 30]


def test_the_commands_lead_from_a_label_file_to_an_adapted_model(
    hearthlog, recorded, model_file, tmp_path
):
    log = find_logs(recorded)[0]
    labels = tmp_path / "labels.txt"
    labels.write_text("2.0\t8.0\tspeech\n10.0\t14.0\tsilence\n")
    layer = log.with_name(f"{log.stem}.review.mcap")
    assert hearthlog("annotate", "import", log, labels).returncode == 0
    try:
        output = tmp_path / "home.safetensors"
        done = hearthlog("train", "--base", model_file, "--home", recorded, "-o", output, "--json")
        marked = list(training_recordings(recorded))
    finally:
        layer.unlink()
    assert done.returncode == 0, done.stderr
    about = json.loads(done.stdout)["training_data"]
    learned, kept = about["home"], about["home_confirmed"]
    assert "silence" in kept  # of which any is kept; of the rest, that of which the model is sure
    assert learned["silence"]["segments"] > kept["silence"] > 0
    adapted, base = load_model(output), load_model(model_file)
    assert adapted.classes == base.classes
    home = cut_recordings(marked, scenario_of(base))
    speech = home.amounts["speech"]
    assert speech.seconds == pytest.approx(6.0, abs=0.1)
    assert learned["speech"]["segments"] == speech.segments + kept.get("speech", 0)


def test_augmented_sound_is_what_the_other_microphone_would_give():
    """A gain of the samples is one of the features."""
    rng = np.random.default_rng(0)
    samples = (0.05 * rng.standard_normal(RATE)).astype(np.float32).reshape(20, -1)
    quiet, loud = FeatureExtractor()(samples), FeatureExtractor()(2 * samples)
    windows = np.repeat(quiet[np.newaxis], 400, axis=0)
    changed = augmented(windows, np.random.default_rng(1))
    assert changed.shape == windows.shape
    assert changed.dtype == np.float32
    untouched = (changed == windows).all(axis=(1, 2)).mean()
    assert 0.0 < untouched < 0.2
    np.testing.assert_array_equal(changed[:, :, 1:8], windows[:, :, 1:8])
    gain = 10 * np.log10(changed[:, 0, 0] / windows[:, 0, 0])
    level = (changed[:, :, 8] - windows[:, :, 8]).mean(axis=1)
    assert gain.std() > 3.0
    assert np.corrcoef(gain, level)[0, 1] > 0.5
    # Energy and bands move together: 6 dB are 6 dB.
    energy = 10 * np.log10(loud[:, 0] / quiet[:, 0])
    bands = (bands_of(loud[:, 8:]) - bands_of(quiet[:, 8:])).mean(axis=1)
    np.testing.assert_allclose(energy, bands, atol=0.1)


@pytest.mark.parametrize("kind", KINDS)
def test_folds_by_segment_flatter_and_all_kinds_are_scored(kind):
    data, _ = blobs(3, 60, spread=2.0, features=BANDS.features)
    collections = dataclasses.replace(
        data, collection=data.group % 3, collection_names=("a", "b", "c")
    )
    found = evaluate_method(collections, BANDS, kind, ignore_progress)
    assert found.folds == {"segment": 5, "source": 5, "collection": 3}[kind]
    assert found.scores.segments == 180
    assert 0.2 < found.scores.macro_f1 <= 1.0


def test_one_collection_cannot_be_left_out():
    data, _ = blobs(3, 30, features=BANDS.features)
    with pytest.raises(DataError, match="all recordings are of one collection"):
        evaluate_method(data, BANDS, "collection", ignore_progress)


def test_segments_that_are_all_alike_are_refused():
    data, scenario = blobs(3, 30)
    flat = dataclasses.replace(data, windows=np.ones_like(data.windows))
    with pytest.raises(DataError, match="all segments are alike"):
        train_model(flat, scenario, ignore_progress)


def test_an_enrolled_sound_is_learned_from(hearthlog, model_file, tmp_path):
    rng = np.random.default_rng(3)
    soundfile.write(tmp_path / "kettle.wav", 0.1 * rng.standard_normal(3 * RATE), RATE)
    home = tmp_path / "home"
    enrolled = hearthlog("enrol", "coughing", "--home", home, "--file", tmp_path / "kettle.wav")
    assert enrolled.returncode == 0, enrolled.stderr
    (found,) = home_recordings(home)
    assert isinstance(found, Recording)
    assert (found.label, len(found.features)) == ("coughing", 60)
    learned = prepare(ROOM, cut_recordings([found], BUILTIN["general"])).usable
    assert learned.all()  # however steady it is: it was cut out of its room
    output = tmp_path / "home.safetensors"
    done = hearthlog("train", "--base", model_file, "--home", home, "-o", output)
    assert done.returncode == 0, done.stderr
    assert "also trained on the home" in done.stdout
