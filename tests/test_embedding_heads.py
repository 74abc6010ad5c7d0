"""Heads on what a network hears: exact, mixed with a classifier, and checked when read."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from safetensors.numpy import load

from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.evidence import (
    UNTAUGHT,
    EmbeddingHeads,
    mix_weight,
)
from hearthlog.models.classifiers.model import (
    FORMAT,
    FORMAT_OF_EMBEDDINGS,
    EmbeddingMix,
    NamesHead,
)
from hearthlog.models.modelfile import load_model, model_card, save_model
from hearthlog.models.starter import GENERAL, starter_file
from hearthlog.schemas.arrays import read_sealed, write_sealed
from hearthlog.schemas.errors import ModelError

pytestmark = pytest.mark.fast

WIDTH = 143
DIGEST = "b4" * 32
RNG = np.random.default_rng


@cache
def plain():
    return load_model(starter_file(GENERAL))


def mix_of(model, **changed):
    sounds = [name for name in model.classes if name != "silence"]
    values = {name: [64 + i, 70] for i, name in enumerate(sounds)}
    names = NamesHead(weight=0.5, slope=0.2, classes=values)
    fields = {
        "network": "yamnet",
        "projection_sha256": DIGEST,
        "values": WIDTH,
        "head_weights": [1.0, 1.0],
        "names": [names],
        "machine_weight": 0.75,
        "inverse_temperature": 1.4,
    }
    return EmbeddingMix(**{**fields, **changed})


def with_heads(seed=1, **changed):
    """The starter model, with heads that were drawn at random."""
    model, rng = plain(), RNG(seed)
    mix = mix_of(model, **changed)
    shape = len(mix.head_weights), WIDTH, len(model.classes)
    update = {"format": FORMAT_OF_EMBEDDINGS, "embedding": mix}
    return replace(
        model,
        description=model.description.model_copy(update=update),
        embedding_weights=rng.integers(-(2**20), 2**20, shape, np.int32),
        embedding_bias=rng.integers(-(2**22), 2**22, shape[::2], np.int32),
        embedding_scaler=np.ones((2, WIDTH)),
    )


def windows(count, seed=2):
    return RNG(seed).integers(-127, 128, (count, WIDTH)).astype(np.int8)


def inputs_of(model, count, seed=3):
    vectors = model.arrays["landmarks"]
    rows = np.resize(RNG(seed).permutation(len(vectors)), count)
    return np.ascontiguousarray(vectors[rows], np.float32)


def test_a_window_says_the_same_to_the_bit_whatever_is_computed_with_it():
    heads = Classifier(with_heads()).embedding_heads
    values = windows(5000)
    full = heads.log_probabilities(values)
    assert (full[:, list(plain().classes).index("silence")] == 0).all()
    for size in (1, 7, 300):
        some = values[:600]
        parts = [heads.log_probabilities(some[i : i + size]) for i in range(0, len(some), size)]
        np.testing.assert_array_equal(np.concatenate(parts), full[:600])
    order = RNG(5).permutation(len(values))
    np.testing.assert_array_equal(heads.log_probabilities(values[order]), full[order])


def test_sums_of_the_largest_weights_are_exact():
    model = with_heads(names=[])
    largest = np.full_like(model.embedding_weights, 2**31 - 1)
    largest[:, ::2] = -largest[:, ::2] + 1
    values = windows(64)
    exact = values.astype(object) @ largest[0].astype(object)
    inexact = values.astype(np.float64) @ largest[0].astype(np.float64)
    assert (exact == inexact.astype(object)).all()
    heads = EmbeddingHeads(
        model.description.embedding, largest, model.embedding_bias, model.classes
    )
    assert np.isfinite(heads.log_probabilities(values)).all()


def test_no_head_has_a_veto():
    heads = Classifier(with_heads()).embedding_heads
    output = heads.log_probabilities(windows(500))
    assert output.min() >= np.log(1e-4) * 2.5 - 1e-3
    assert output.max() <= 2.5 * 1e-3


def test_heads_share_what_silence_leaves_and_leave_silence_as_it_is():
    model, count = with_heads(), 400
    classifier, alone = Classifier(model), Classifier(plain())
    inputs = inputs_of(model, count)
    before, _ = alone.classify(inputs)
    output = classifier.embedding_heads.log_probabilities(windows(count))
    after, novelty = classifier.classify(inputs, None, output)
    silence = classifier.classes.index("silence")
    np.testing.assert_allclose(after[:, silence], before[:, silence], atol=2**-15)
    np.testing.assert_allclose(after.sum(axis=1), 1.0, atol=1e-3)
    sounds = np.delete(np.arange(len(classifier.classes)), silence)
    of_machine = before[:, sounds].astype(float)
    of_machine = np.log(of_machine / of_machine.sum(axis=1, keepdims=True) + 1e-4)
    mean = (0.75 * of_machine + output[:, sounds]) / mix_weight(model.description.embedding)
    expected = np.exp(1.4 * mean)
    expected *= (1 - before[:, [silence]]) / expected.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(after[:, sounds], expected, atol=2e-2)
    known = [i for i, name in enumerate(classifier.classes) if name != "unknown"]
    np.testing.assert_allclose(novelty, 1 - after[:, known].max(axis=1), atol=1e-6)


def test_where_heads_say_nothing_labels_are_as_without_them_to_the_bit():
    model, count = with_heads(), 600
    classifier, alone = Classifier(model), Classifier(plain())
    inputs = inputs_of(model, count)
    output = classifier.embedding_heads.log_probabilities(windows(count))
    output[::3] = np.nan
    mixed, _ = classifier.classify(inputs, None, output)
    silent, _ = alone.classify(inputs)
    np.testing.assert_array_equal(mixed[::3], silent[::3])
    assert (mixed[1::3] != silent[1::3]).any(axis=1).mean() > 0.9
    np.testing.assert_array_equal(classifier.classify(inputs)[0], silent)
    evidence = RNG(9).normal(size=output.shape)
    for rows in (slice(0, 1), slice(5, 9), slice(250, 270)):
        some, _ = classifier.classify(inputs[rows], evidence[rows], output[rows])
        full, _ = classifier.classify(inputs, evidence, output)
        np.testing.assert_array_equal(some, full[rows])


def test_a_model_with_heads_is_saved_and_loaded_and_its_card_names_the_network(tmp_path):
    model, path = with_heads(), tmp_path / "heads.safetensors"
    save_model(model, path)
    loaded = load_model(path)
    assert loaded.description == model.description
    np.testing.assert_array_equal(loaded.embedding_weights, model.embedding_weights)
    np.testing.assert_array_equal(loaded.embedding_bias, model.embedding_bias)
    assert "yamnet" in model_card(loaded)
    assert DIGEST[:12] in model_card(loaded)


def test_a_model_without_heads_says_nothing_of_them_so_that_older_versions_read_it(tmp_path):
    path = tmp_path / "plain.safetensors"
    save_model(plain(), path)
    assert b"embedding" not in path.read_bytes()
    assert b"class_exponent" not in path.read_bytes()
    assert load_model(path).description.format == FORMAT


def _content(path, about=(), arrays=()):
    """A model file with some fields and arrays changed."""
    data = path.read_bytes()
    before, text, _ = read_sealed(path, data, "hearthlog")
    description = json.loads(text)
    for key, value in dict(about).items():
        inside = description
        *parents, last = key.split(".")
        for parent in parents:
            inside = inside[int(parent)] if isinstance(inside, list) else inside[parent]
        if value is None:
            inside.pop(last)
        else:
            inside[last] = value
    changed = {**before, **dict(arrays)}
    changed = {name: array for name, array in changed.items() if array is not None}
    return write_sealed(changed, "hearthlog", json.dumps(description))


@pytest.fixture(scope="module")
def heads_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("heads") / "heads.safetensors"
    save_model(with_heads(), path)
    return path


@pytest.mark.parametrize(
    ("about", "reason"),
    [
        ({"format": 5}, "format"),
        ({"format": 6}, "format"),
        ({"format": 8}, "format 8, newer"),
        ({"embedding": None}, "format"),
        ({"embedding.values": 142}, "embedding_weights has shape"),
        ({"embedding.values": 0}, "embedding.values"),
        ({"embedding.values": 10**9}, "embedding.values"),
        ({"embedding.head_weights": []}, "embedding.head_weights"),
        ({"embedding.head_weights": [1.0]}, "embedding_weights has shape"),
        ({"embedding.head_weights": [1.0, 1e300]}, "embedding.head_weights"),
        ({"embedding.head_weights": [1.0, float("nan")]}, "embedding.head_weights"),
        ({"embedding.head_weights": [1.0] * 9}, "embedding.head_weights"),
        ({"embedding.projection_sha256": "b4"}, "embedding.projection_sha256"),
        ({"embedding.network": "\x1b[2J"}, "embedding.network"),
        ({"embedding.inverse_temperature": 0.0}, "embedding.inverse_temperature"),
        ({"embedding.inverse_temperature": float("inf")}, "embedding.inverse_temperature"),
        ({"embedding.machine_weight": -1.0}, "embedding.machine_weight"),
        ({"embedding.bias": {"nothing": 1.0}}, "a class that the model has not"),
        ({"embedding.bias": {"silence": 1.0}}, "or silence"),
        ({"embedding.names.0.classes": {"silence": [1], "speech": [2]}}, "or silence"),
        ({"embedding.names.0.classes": {"speech": [2]}}, "embedding.names.0.classes"),
        ({"embedding.names.0.classes": {"speech": [143], "music": [2]}}, "beyond the 143"),
        ({"embedding.names.0.classes": {"speech": [-1], "music": [2]}}, "embedding.names.0"),
        ({"embedding.names.0.classes": {"speech": [], "music": [2]}}, "embedding.names.0"),
        ({"embedding.extra": 1}, "embedding.extra"),
        ({"smoothing.class_exponent": 0.0}, "class_exponent"),
        ({"smoothing.class_exponent": 1e9}, "class_exponent"),
    ],
)
def test_a_description_of_heads_that_makes_no_sense_is_refused_by_name(
    heads_file, tmp_path, about, reason
):
    path = tmp_path / "hostile.safetensors"
    path.write_bytes(_content(heads_file, about))
    with pytest.raises(ModelError, match=reason) as refused:
        load_model(path)
    assert str(refused.value).isprintable()


@pytest.mark.parametrize("name", ["embedding_weights", "embedding_bias"])
@pytest.mark.parametrize("change", ["missing", "flat", "float", "int64", "cut"])
def test_arrays_of_heads_that_do_not_fit_are_refused(heads_file, tmp_path, name, change):
    array = load(heads_file.read_bytes())[name]
    other = {
        "missing": None,
        "flat": array.ravel(),
        "float": array.astype(np.float32) + np.float32(np.nan),
        "int64": array.astype(np.int64),
        "cut": np.ascontiguousarray(array[..., :-1]),
    }[change]
    path = tmp_path / "hostile.safetensors"
    path.write_bytes(_content(heads_file, (), {name: other}))
    with pytest.raises(ModelError, match=name):
        load_model(path)


def test_a_head_that_leaves_all_classes_to_others_is_refused(heads_file, tmp_path):
    bias = load(heads_file.read_bytes())["embedding_bias"].copy()
    bias[1] = UNTAUGHT
    path = tmp_path / "hostile.safetensors"
    path.write_bytes(_content(heads_file, (), {"embedding_bias": bias}))
    with pytest.raises(ModelError, match="embedding_bias has a head without a class"):
        load_model(path)


def test_an_exponent_without_heads_is_refused(tmp_path):
    path = tmp_path / "hostile.safetensors"
    path.write_bytes(_content(starter_file(GENERAL), {"smoothing.class_exponent": 0.2}))
    with pytest.raises(ModelError, match="class_exponent without heads"):
        load_model(path)


def test_heads_in_a_model_that_says_nothing_of_them_are_refused(tmp_path):
    model = with_heads()
    arrays = {"embedding_weights": model.embedding_weights, "embedding_bias": model.embedding_bias}
    path = tmp_path / "hostile.safetensors"
    path.write_bytes(_content(starter_file(GENERAL), (), arrays))
    with pytest.raises(ModelError, match=r"embedding_\w+ is out of place"):
        load_model(path)
