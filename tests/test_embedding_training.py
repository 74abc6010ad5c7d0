"""Heads are learned from clips and from marks, and measured together with the classifier."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from blobs import blobs

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.training import clips as hearing
from hearthlog.analyzer.training import train as installed
from hearthlog.analyzer.training.adaptation import adapt_model, base_heads, learn_home
from hearthlog.analyzer.training.clips import (
    AS_IT_IS,
    IN_A_ROOM,
    SHORT,
    ClipEmbedder,
    clip_embeddings,
)
from hearthlog.analyzer.training.dataset import (
    EmbeddingWindows,
    Recording,
    build_dataset,
    cut_recordings,
)
from hearthlog.analyzer.training.heads import (
    HeadInputs,
    Tried,
    best_mix,
    head_inputs_of,
    learn_heads,
    names_head,
    rejecting_head,
)
from hearthlog.analyzer.training.manifest import BUILTIN, Scenario, read_manifest
from hearthlog.analyzer.training.train import evaluate_method, group_folds, train_model
from hearthlog.analyzer.training.window_methods import EMBEDDING, ROOM
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.evidence import UNTAUGHT, EmbeddingHeads
from hearthlog.models.classifiers.model import FORMAT, FORMAT_OF_EMBEDDINGS
from hearthlog.models.embedding.networks import YAMNET, load_embedder
from hearthlog.models.features import of_segments
from hearthlog.models.modelfile import load_model, save_model
from hearthlog.schemas.errors import ModelError, ignore_progress

HEARING = head_inputs_of("yamnet")
WIDTH = len(HEARING.names)
COLLECTIONS = 4
CLASSES = ("silence", "speech", "music", "coughing")


def labelled_as(target, classes, rng, noise=30.0):
    """Windows of classes that lie apart in the components, and in their groups of names."""
    centres = np.random.default_rng(5).normal(0, 6, (classes, WIDTH))
    values = centres[target] + rng.normal(0, noise, (len(target), WIDTH))
    return np.clip(np.rint(values), -127, 127).astype(np.int8)


@cache
def made_up(classes=4, count=48):
    """Features that say little, and embeddings that say much."""
    data, _ = blobs(classes, count, spread=12.0)
    rng, names = np.random.default_rng(7), CLASSES[:classes]
    several = 3  # windows of each segment
    collection = data.group % COLLECTIONS
    rows = np.repeat(np.arange(len(data)), several)
    return replace(
        data,
        classes=names,
        seconds=dict.fromkeys(names, float(count)),
        collection=collection,
        collection_names=tuple(f"collection {number}" for number in range(COLLECTIONS)),
        collections={(f"collection {number}", "CC0"): 6 for number in range(COLLECTIONS)},
        embedded=labelled_as(data.target, classes, rng),
        is_embedded=np.ones(len(data), bool),
        embedding_windows=EmbeddingWindows(
            labelled_as(data.target[rows], classes, rng),
            data.target[rows],
            data.group[rows],
            collection[rows],
            np.arange(len(rows)) % several > 0,
            rows,
        ),
    )


def scenario_of(data):
    return Scenario("made up", {name: (name,) for name in data.classes})


@cache
def learned():
    data = made_up()
    return train_model(data, scenario_of(data), ignore_progress, EMBEDDING)


def output_of(model, data):
    """What a model says of segments: of which class, and how sure it is."""
    classifier = Classifier(model)
    inputs = of_segments(classifier.inputs, data.windows, data.floor)[:, 0]
    output = classifier.embedding_heads.log_probabilities(data.embedded)
    return classifier.classify(np.ascontiguousarray(inputs), None, output)[0]


def sounds_of(model, data):
    """Of which class of sound segments are, silence left aside."""
    return 1 + output_of(model, data)[:, 1:].argmax(axis=1)


def test_metrics_and_scores_elsewhere_are_those_of_the_mix():
    data = made_up()
    with_heads = learned().description
    without = train_model(
        replace(data, embedding_windows=data.embedding_windows.rows(slice(0))),
        scenario_of(data),
        ignore_progress,
        EMBEDDING,
    ).description
    assert (with_heads.format, without.format) == (FORMAT_OF_EMBEDDINGS, FORMAT)
    assert with_heads.metrics.macro_f1 > without.metrics.macro_f1 + 0.1
    assert with_heads.elsewhere.macro_f1 > without.elsewhere.macro_f1 + 0.1
    assert with_heads.elsewhere.expected_calibration_error < 0.15
    assert without.embedding is None
    assert without.smoothing.class_exponent is None
    assert with_heads.smoothing.class_exponent == EMBEDDING.class_exponent
    assert with_heads.smoothing.weight == EMBEDDING.observation_weight


def test_cross_validation_by_collections_scores_the_mix():
    data = made_up()
    mixed = evaluate_method(data, EMBEDDING, "collection", ignore_progress).scores.macro_f1
    alone = evaluate_method(data, ROOM, "collection", ignore_progress).scores.macro_f1
    assert mixed > alone + 0.1


def test_the_same_segments_give_the_same_model(tmp_path):
    data, paths = made_up(), [tmp_path / "one.safetensors", tmp_path / "two.safetensors"]
    save_model(learned(), paths[0])
    save_model(train_model(data, scenario_of(data), ignore_progress, EMBEDDING), paths[1])
    assert paths[0].read_bytes() == paths[1].read_bytes()
    loaded = load_model(paths[0])
    np.testing.assert_array_equal(output_of(loaded, data), output_of(learned(), data))


def test_what_is_left_out_is_not_learned_from():
    data = made_up()
    heads = learn_heads(data.embedding_windows, data.classes, HEARING.inputs)
    other = data.embedding_windows._replace(values=data.embedding_windows.values.copy())
    hidden = data.embedding_windows.collection == 2
    other.values[hidden] = 100
    seen = learn_heads(other, data.classes, HEARING.inputs, ~hidden)
    again = learn_heads(data.embedding_windows, data.classes, HEARING.inputs, ~hidden)
    np.testing.assert_array_equal(seen.weights, again.weights)
    assert (seen.weights != heads.weights).any()


def test_a_class_of_hardly_any_source_is_left_to_others():
    data = made_up()
    few = np.unique(data.embedding_windows.group[data.embedding_windows.target == 3])[:2]
    seen = (data.embedding_windows.target != 3) | np.isin(data.embedding_windows.group, few)
    heads = learn_heads(data.embedding_windows, data.classes, HEARING.inputs, seen)
    assert not heads.weights[..., 3].any()
    assert (heads.bias[:, 3] == UNTAUGHT).all()
    mix = learned().description.embedding
    output = EmbeddingHeads(mix, *heads, data.classes).log_probabilities(data.embedded)
    assert np.ptp(output[:, 3]) < 1e-6
    assert np.log(1e-4) < output[0, 3] < 0


def test_names_are_mixed_in_where_a_class_has_hardly_any_source():
    data, few = made_up(), made_up().embedding_windows
    few = np.unique(few.group[few.target == 3])[:2]
    kept = (data.embedding_windows.target != 3) | np.isin(data.embedding_windows.group, few)
    data = replace(data, embedding_windows=data.embedding_windows.rows(kept))
    known = np.ones(len(data), bool)
    way = Tried(group_folds(data), np.zeros((len(data), len(data.classes))), known)
    mix = best_mix(data, HEARING, [way]).mix
    assert [HEARING.names[one] for one in mix.names[-1].classes["coughing"]] == ["coughing"]
    assert mix.names[-1].weight == 0.5, "next to both heads; alone, names weigh 1.25"


def bathroom(noise):
    """A bathroom that a network hears well, with the names of its sounds."""
    data = made_up()
    groups, first = HEARING.groups, HEARING.inputs[-1].start
    names = ("outside", "flushing_water", "tap_water", "coughing")
    own = np.array([first + groups.index(name) for name in names])
    rng = np.random.default_rng(17)

    def with_names(target):
        values = labelled_as(target, len(names), rng, noise=3)
        values[:, first:] = -40
        values[np.arange(len(values)), own[target]] = 40
        drawn = values[:, first:] + rng.normal(0, noise, values[:, first:].shape)
        values[:, first:] = np.clip(np.rint(drawn), -127, 127)
        return values

    windows = data.embedding_windows
    return replace(
        data,
        classes=("silence", "flushing_water", "tap_water", "other"),
        embedded=with_names(data.target),
        embedding_windows=windows._replace(values=with_names(windows.target)),
    )


@pytest.mark.parametrize(
    ("noise", "fourth", "heads"), [(0, "other", 1), (60, "other", 2), (0, "coughing", 2)]
)
def test_names_of_a_few_sounds_among_others_take_the_place_of_a_head_that_is_hardly_better(
    noise, fourth, heads
):
    data = bathroom(noise)
    data = replace(data, classes=(*data.classes[:3], fourth))
    known = np.ones(len(data), bool)
    way = Tried(group_folds(data), np.zeros((len(data), len(data.classes))), known)
    mix = best_mix(data, HEARING, [way]).mix
    assert len(mix.head_weights) == heads
    assert len(mix.names) == 2 - heads


def test_names_are_those_of_the_scenario_and_what_is_outside_it():
    general = (*BUILTIN["general"].classes, "unknown")
    head = rejecting_head(HEARING, general)
    assert len({tuple(values) for values in head.classes.values()}) == 2
    names = [HEARING.names[value] for value in head.classes["unknown"]]
    assert names == ["flushing_water", "shower", "tap_water", "outside"]
    head = names_head(HEARING, (*BUILTIN["bathroom"].classes, "unknown"))
    assert [HEARING.names[value] for value in head.classes["shower"]] == ["shower"]
    assert head.bias["flushing_water"] > 0
    assert "speech" in [HEARING.names[value] for value in head.classes["other"]]
    assert names_head(HEARING, ("silence", "speech", "doorbell_of_mine")) is None
    assert rejecting_head(HEARING, BUILTIN["general"].classes) is None


def home_of(model, count, new="", seed=11):
    """A home in which a class sounds like another one does elsewhere, and perhaps a new class."""
    rng, base = np.random.default_rng(seed), made_up()
    names = (*model.classes, new) if new else tuple(model.classes)
    target = np.repeat(np.arange(1, len(names)), count)
    sounds = np.where(target >= len(model.classes), 0, target)
    sounds = np.where(sounds == 1, 2, sounds)  # speech like music
    shift = np.zeros((len(target), WIDTH))
    shift[target == 1] = np.random.default_rng(13).normal(0, 12, WIDTH)
    embedded = labelled_as(sounds, 4, rng).astype(float) + shift
    embedded = np.clip(np.rint(embedded), -127, 127).astype(np.int8)
    source = rng.permutation(np.flatnonzero(base.target > 0))[: len(target)]
    collection = np.zeros(len(target), np.intp)
    return replace(
        base,
        windows=base.windows[source],
        floor=base.floor[source],
        target=target,
        group=np.arange(len(target)) % 5,
        collection=collection,
        weight=np.full(len(target), 3.0),
        copies=base.copies[:, source],
        copy_floor=base.copy_floor[:, source],
        classes=names,
        seconds=dict.fromkeys(names, 1.0),
        collection_names=("this home",),
        collections={("this home", ""): 1},
        embedded=embedded,
        is_embedded=np.ones(len(target), bool),
        embedding_windows=EmbeddingWindows(
            embedded,
            target,
            np.arange(len(target)) % 5,
            collection,
            target >= 0,
            np.arange(len(target)),
        ),
    )


def test_marks_of_a_home_move_the_heads_and_what_is_not_marked_stays(tmp_path):
    base = learned()
    tried = home_of(base, 30, seed=12)
    adapted = adapt_model(base, home_of(base, 30))
    speech = tried.target == 1
    before, after = (sounds_of(one, tried)[speech] == 1 for one in (base, adapted))
    assert after.mean() > before.mean() + 0.2
    others = made_up()
    as_before = sounds_of(base, others) == sounds_of(adapted, others)
    assert as_before.mean() > 0.88
    mix = adapted.description.embedding
    assert mix.of_home
    assert mix.base_inverse_temperature == base.description.embedding.inverse_temperature
    assert adapted.description.format == FORMAT_OF_EMBEDDINGS
    path = tmp_path / "home.safetensors"
    save_model(adapted, path)
    np.testing.assert_array_equal(output_of(load_model(path), tried), output_of(adapted, tried))


def test_adapted_again_it_is_as_adapted_once():
    base = learned()
    first = adapt_model(base, home_of(base, 4))
    both, again = adapt_model(base, home_of(base, 8)), adapt_model(first, home_of(first, 8))
    np.testing.assert_array_equal(both.embedding_weights, again.embedding_weights)
    np.testing.assert_array_equal(both.embedding_bias, again.embedding_bias)
    assert both.description.embedding == again.description.embedding


WITH_UNKNOWN = ("silence", "speech", "music", "unknown")


def test_what_is_unknown_stays_so_until_somebody_marks_a_sound_of_no_class():
    base = learned()
    windows = home_of(base, 8).embedding_windows
    heads = base_heads(base, base.classes)
    for marked, moved in ((1, False), (3, True)):
        taught = learn_home(heads, windows, windows.target == marked, WITH_UNKNOWN)
        assert taught.weights[-1][:, 1].any()
        assert taught.weights[-1][:, 3].any() == moved


def test_a_mark_of_many_windows_teaches_as_much_as_one_of_a_single_one():
    base = learned()
    windows = home_of(base, 8).embedding_windows
    heads, speech = base_heads(base, base.classes), windows.target == 1
    once = learn_home(heads, windows, speech, base.classes)
    often = windows.rows(np.repeat(np.arange(len(speech)), np.where(speech, 5, 1)))
    again = learn_home(heads, often, often.target == 1, base.classes)
    np.testing.assert_allclose(again.weights, once.weights, atol=2)


def test_a_new_class_is_learned_from_a_few_marks():
    base = learned()
    adapted = adapt_model(base, home_of(base, 30, "doorbell"))
    tried = home_of(base, 30, "doorbell", seed=14)
    found = sounds_of(adapted, tried)
    new = tried.target == len(base.classes)
    assert (found[new] == len(base.classes)).mean() > 0.2
    assert (found[~new] == len(base.classes)).mean() < 0.1


def test_a_home_without_embeddings_leaves_the_heads_as_they_are():
    base = learned()
    home = home_of(base, 8)
    silent = replace(
        home,
        embedded=np.empty((len(home), 0), np.int8),
        is_embedded=np.zeros(len(home), bool),
        embedding_windows=EmbeddingWindows(*(one[:0] for one in home.embedding_windows)),
    )
    adapted = adapt_model(base, silent)
    np.testing.assert_array_equal(adapted.embedding_weights, base.embedding_weights)
    assert not adapted.description.embedding.of_home
    assert adapted.description.embedding.inverse_temperature == (
        base.description.embedding.inverse_temperature
    )


class Levels:
    """A network that hears how loud a window is in its middle, before and behind it."""

    def __init__(self):
        self.windows = []

    def __call__(self, window):
        self.windows.append(window.copy())
        level = 10 * np.log10(np.square(window).mean(axis=1) + 1e-12)
        return np.rint([level[:5].mean(), level[8:12].mean(), level[-5:].mean()]).astype(np.int8)


def tone(seconds, seed=1):
    rng = np.random.default_rng(seed)
    return (
        (0.1 * rng.standard_normal(round(seconds * 20) * 800)).astype(np.float32).reshape(-1, 800)
    )


def test_windows_of_a_clip_are_those_that_a_home_gives():
    network = Levels()
    recorded = clip_embeddings(tone(3.0), network, np.array([0, 10, 20]), silence=False)
    assert np.bincount(recorded.version).tolist() == [13, 7, 4]
    assert recorded.starts[recorded.version == AS_IT_IS].tolist() == list(range(-10, 55, 5))
    [half] = recorded.at(-10)
    assert half[0] < half[2] - 40  # nothing was before the clip
    assert recorded.taught.all()
    assert {*recorded.version} == {AS_IT_IS, IN_A_ROOM, SHORT}
    again = clip_embeddings(tone(3.0), Levels(), np.array([0, 10, 20]), silence=False)
    for one, other in zip(recorded, again, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("seconds", [0.05, 0.3, 0.95, 1.0])
def test_a_short_clip_teaches_the_windows_that_it_fills_as_well_as_it_can(seconds):
    recorded = clip_embeddings(tone(seconds), Levels(), np.empty(0, np.intp), silence=False)
    assert (recorded.version == AS_IT_IS).sum() >= 1
    assert (recorded.version == SHORT).sum() == 4


def test_of_silence_only_the_segments_are_heard():
    recorded = clip_embeddings(tone(3.0), Levels(), np.array([0, 40]), silence=True)
    assert recorded.starts.tolist() == [0, 40]
    assert not recorded.taught.any()
    nothing = clip_embeddings(tone(0.5), Levels(), np.empty(0, np.intp), silence=True)
    assert nothing.values.shape == (0, 3)


def test_a_clip_is_heard_once_in_a_run():
    network = Levels()
    embedder = ClipEmbedder(network)
    embedder(tone(2.0), np.array([0]), silence=False)
    count = len(network.windows)
    embedder(tone(2.0), np.array([0]), silence=False)
    assert len(network.windows) == count
    embedder(tone(2.0, 2), np.array([0]), silence=False)
    assert len(network.windows) > count


def test_another_seed_hears_a_clip_in_another_room():
    first, again, other = Levels(), Levels(), Levels()
    for network, seed in ((first, 0), (again, 0), (other, 1)):
        ClipEmbedder(network, seed)(tone(2.0), np.array([0]), silence=False)
    recorded = [np.concatenate(one.windows) for one in (first, again, other)]
    np.testing.assert_array_equal(recorded[0], recorded[1])
    assert not np.array_equal(recorded[0], recorded[2])


def test_segments_take_the_window_that_is_nearest():
    recorded = clip_embeddings(tone(3.0), Levels(), np.array([0, 10, 20]), silence=False)
    assert len(recorded.at(10)) == 1
    np.testing.assert_array_equal(recorded.at(12), recorded.at(10))
    assert not len(recorded.at(200))
    features = ROOM.features
    frames = tone(3.0)
    recording = Recording("speech", "one", "a", "", features.extractor()(frames), embedded=recorded)
    scenario = Scenario("made up", {name: (name,) for name in CLASSES})
    data = cut_recordings([recording], scenario, features)
    assert data.is_embedded.all()
    assert len(data.embedding_windows.target) == len(recorded.version)
    assert data.embedding_windows.tried.sum() == (recorded.version == AS_IT_IS).sum()


def test_without_the_network_the_method_says_what_to_fetch(monkeypatch):
    for module in (installed, hearing):
        monkeypatch.setattr(module, "find_network", lambda _: None)
    hearing.network_embedder.cache_clear()
    assert installed.default_method() is installed.DEFAULT
    assert installed.clip_embedder(ROOM) is None
    with pytest.raises(ModelError, match="hearthlog models fetch yamnet"):
        installed.clip_embedder(EMBEDDING)
    with pytest.raises(DataError):
        installed.method_named("embeddings")


@pytest.fixture(scope="module")
def network():
    pytest.importorskip("ai_edge_litert")
    path = Path(__file__).parents[2] / "shared" / "data" / "networks" / "yamnet.tflite"
    if not path.exists():
        pytest.skip("needs the network, in ../shared/data/networks")
    return load_embedder(YAMNET.name, path)


def test_clips_are_heard_by_the_network(network, household):
    clips = read_manifest(household / "manifest.csv", BUILTIN["general"].labels, [])
    of_two = {
        label: [clip for clip in clips if clip.label == label][:3] for label in ("speech", "music")
    }
    scenario = Scenario("two", {label: (label,) for label in of_two})
    some = [clip for same in of_two.values() for clip in same]
    embedder = ClipEmbedder(network)
    data = build_dataset(some, scenario, ignore_progress, embedder=embedder)
    assert data.is_embedded.all()
    assert data.embedded.shape == (len(data), WIDTH)
    assert isinstance(HEARING, HeadInputs)
    speech = data.embedded[:, HEARING.names.index("speech")].astype(int)
    music = data.embedded[:, HEARING.names.index("music")].astype(int)
    more = speech - music
    assert more[data.target == 0].mean() > more[data.target == 1].mean() + 4
