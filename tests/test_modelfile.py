import hashlib
import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from blobs import blobs, with_arrays
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.numpy import load, save

from hearthlog.analyzer.training.manifest import Scenario
from hearthlog.analyzer.training.train import train_model
from hearthlog.analyzer.training.window_methods import ROOM, SVM
from hearthlog.models.classifiers.classifier import Classifier, LabelTiming, label_timing
from hearthlog.models.classifiers.model import read_description
from hearthlog.models.features.installed import DEFAULT
from hearthlog.models.modelfile import load_model, model_card, save_model
from hearthlog.schemas.errors import ModelError, ignore_progress

pytestmark = pytest.mark.fast

ARRAYS = (
    "scaler_mean",
    "scaler_scale",
    "support_vectors",
    "support_counts",
    "dual_coefficients",
    "intercepts",
)


@cache
def model():
    return train_model(*blobs(3, 12), ignore_progress, SVM)


@cache
def gated():
    """A model that knows silence, and thus has a gate and may have floors."""
    data, _ = blobs(2, 12)
    names = ("silence", "speech")
    data = replace(data, classes=names, seconds=dict.fromkeys(names, 12.0))
    return train_model(data, Scenario("blobs", {n: (n,) for n in names}), ignore_progress)


@cache
def model_bytes():
    with TemporaryDirectory() as folder:
        path = Path(folder) / "model.safetensors"
        save_model(model(), path)
        return path.read_bytes()


def description():
    data = model_bytes()
    header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
    return json.loads(header["__metadata__"]["hearthlog"])


def content(about=None, arrays=None):
    arrays = load(model_bytes()) if arrays is None else arrays
    about = description() if about is None else about
    return save(arrays, {"hearthlog": json.dumps(about)})


def refusal(folder, data):
    path = Path(folder) / "hostile.safetensors"
    path.write_bytes(data)
    with pytest.raises(ModelError) as caught:
        load_model(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert message.isprintable()
    return message


def test_what_was_saved_is_loaded(tmp_path):
    path = tmp_path / "kitchen.safetensors"
    save_model(model(), path)
    loaded = load_model(path)
    assert loaded.description == model().description
    for name in ARRAYS:
        assert np.array_equal(loaded.arrays[name], model().arrays[name])
        assert loaded.arrays[name].dtype == model().arrays[name].dtype
    assert loaded.name == "kitchen"
    assert loaded.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert loaded.classes == ("class_0", "class_1", "class_2")
    assert [p.name for p in tmp_path.iterdir()] == ["kitchen.safetensors"]


def test_the_same_model_gives_the_same_bytes(tmp_path):
    save_model(model(), tmp_path / "a.safetensors")
    save_model(load_model(tmp_path / "a.safetensors"), tmp_path / "b.safetensors")
    a, b = ((tmp_path / f"{name}.safetensors").read_bytes() for name in "ab")
    assert a == b == model_bytes()


def test_a_loaded_model_cannot_be_changed(tmp_path):
    path = tmp_path / "a.safetensors"
    path.write_bytes(model_bytes())
    loaded = load_model(path)
    with pytest.raises(ValueError, match="read-only"):
        loaded.arrays["intercepts"][0] = 1.0


def test_a_file_that_exists_is_never_overwritten(tmp_path):
    path = tmp_path / "a.safetensors"
    path.write_bytes(b"precious")
    with pytest.raises(ModelError, match="exists already"):
        save_model(model(), path)
    assert path.read_bytes() == b"precious"
    dangling = tmp_path / "b.safetensors"
    dangling.symlink_to(tmp_path / "nowhere")
    with pytest.raises(ModelError, match="exists already"):
        save_model(model(), dangling)


@pytest.mark.parametrize("name", ["model.pkl", "model", "nowhere/model.safetensors"])
def test_a_name_that_cannot_be_a_model_is_refused(tmp_path, name):
    with pytest.raises(ModelError):
        save_model(model(), tmp_path / name)


def test_a_model_without_silence_has_no_gate_and_one_with_it_has_that_of_its_method(tmp_path):
    assert (model().description.gate, gated().description.gate) == (0.0, ROOM.gate)
    save_model(gated(), tmp_path / "a.safetensors")
    loaded = load_model(tmp_path / "a.safetensors")
    assert Classifier(loaded).gate == ROOM.gate > 0


@pytest.mark.parametrize(
    ("made", "changed", "complaint"),
    [
        (model, {"gate": 2.0}, "has a gate, but no class silence"),
        (model, {"label_frame": 8}, "label_frame: a window has 8 frames"),
        (gated, {"label_frame": 20}, "label_frame: a window has 8 frames"),
    ],
)
def test_what_a_model_says_of_its_labels_must_fit_its_windows_and_classes(
    tmp_path, made, changed, complaint
):
    bad = replace(made(), description=made().description.model_copy(update=changed))
    with pytest.raises(ModelError, match=complaint):
        save_model(bad, tmp_path / "a.safetensors")
    assert list(tmp_path.iterdir()) == []


def test_an_inconsistent_model_is_not_saved(tmp_path):
    broken = with_arrays(model(), intercepts=np.zeros(7))
    with pytest.raises(ModelError, match="intercepts"):
        save_model(broken, tmp_path / "a.safetensors")
    assert list(tmp_path.iterdir()) == []


def test_the_card_names_model_classes_result_and_licence(tmp_path):
    path = tmp_path / "kitchen.safetensors"
    path.write_bytes(model_bytes())
    loaded = load_model(path)
    card = model_card(loaded)
    assert card == model_card(load_model(path))
    macro = f"{loaded.description.metrics.macro_f1:.3f}"
    for part in ("# Model kitchen\n", loaded.sha256, "| class_2 |", macro, "made up: 3 clips, CC0"):
        assert part in card


@pytest.mark.parametrize("kind", ["missing", "folder", "long name"])
def test_what_is_no_file_is_refused(tmp_path, kind):
    path = {
        "missing": tmp_path / "no.safetensors",
        "folder": tmp_path,
        "long name": tmp_path / ("x" * 5000),
    }[kind]
    with pytest.raises(ModelError):
        load_model(path)


def test_a_file_too_large_is_refused_before_it_is_parsed(tmp_path):
    path = tmp_path / "a.safetensors"
    with path.open("wb") as stream:
        stream.truncate(1 << 40)
    with pytest.raises(ModelError, match="larger than 64 MB"):
        load_model(path)


@settings(deadline=None)
@given(length=st.integers(0, len(model_bytes()) - 1))
def test_a_file_cut_short_anywhere_is_refused(length):
    with TemporaryDirectory() as folder:
        refusal(folder, model_bytes()[:length])


@settings(deadline=None)
@given(data=st.binary(max_size=300))
def test_random_bytes_are_refused(data):
    with TemporaryDirectory() as folder:
        refusal(folder, data)


@settings(deadline=None)
@given(
    changes=st.lists(
        st.tuples(st.integers(0, len(model_bytes()) - 1), st.integers(1, 255)),
        min_size=1,
        max_size=3,
        unique_by=lambda change: change[0],
    )
)
def test_changed_bytes_are_refused_or_make_another_sound_model(changes):
    data = bytearray(model_bytes())
    for place, flip in changes:
        data[place] ^= flip
    with TemporaryDirectory() as folder:
        path = Path(folder) / "changed.safetensors"
        path.write_bytes(data)
        try:
            loaded = load_model(path)
        except ModelError:
            refusal(folder, data)
            return
        assert loaded.sha256 != hashlib.sha256(model_bytes()).hexdigest()
        assert all(np.isfinite(loaded.arrays[name]).all() for name in ARRAYS)


@pytest.mark.parametrize("length", [0, 5 << 20, 1 << 62, (1 << 64) - 1])
def test_a_header_of_senseless_length_is_refused(tmp_path, length):
    refusal(tmp_path, length.to_bytes(8, "little") + model_bytes()[8:])


@pytest.mark.parametrize("name", ARRAYS)
@pytest.mark.parametrize("change", ["missing", "another shape", "another type", "flat"])
def test_arrays_that_do_not_fit_are_refused(tmp_path, name, change):
    arrays = load(model_bytes())
    if change == "missing":
        del arrays[name]
    elif change == "another shape":
        arrays[name] = np.concatenate([arrays[name], arrays[name]])
    elif change == "another type":
        arrays[name] = arrays[name].astype(np.int8)
    else:
        arrays[name] = np.zeros((), arrays[name].dtype)
    refusal(tmp_path, content(arrays=arrays))


@pytest.mark.parametrize("name", [name for name in ARRAYS if name != "support_counts"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_are_refused(tmp_path, name, value):
    arrays = {key: array.copy() for key, array in load(model_bytes()).items()}
    arrays[name].flat[-1] = value
    assert "not finite" in refusal(tmp_path, content(arrays=arrays))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("scaler_scale", 0.0),
        ("scaler_scale", -1.0),
        ("scaler_mean", 1e300),
        ("dual_coefficients", 1e300),
        ("support_counts", -1),
        ("support_counts", -(1 << 63)),
        ("support_counts", 1 << 62),
    ],
)
def test_values_that_make_no_sense_are_refused(tmp_path, name, value):
    arrays = {key: array.copy() for key, array in load(model_bytes()).items()}
    arrays[name].flat[0] = value
    refusal(tmp_path, content(arrays=arrays))


def test_counts_that_only_add_up_are_refused(tmp_path):
    arrays = {key: array.copy() for key, array in load(model_bytes()).items()}
    arrays["support_counts"][:2] = -1, arrays["support_counts"][:2].sum() + 1
    assert "support_counts" in refusal(tmp_path, content(arrays=arrays))


def test_a_type_numpy_does_not_have_is_refused(tmp_path):
    header = b'{"a":{"dtype":"F8_E4M3","shape":[1],"data_offsets":[0,1]}}'
    refusal(tmp_path, len(header).to_bytes(8, "little") + header + b"\0")


def test_a_description_beyond_reason_is_not_parsed(tmp_path):
    text = json.dumps(description() | {"unknown": "x" * (5 << 20)})
    assert "header" in refusal(tmp_path, save(load(model_bytes()), {"hearthlog": text}))


def test_an_array_that_half_precision_can_hold_takes_half_the_room(tmp_path):
    arrays = load(model_bytes())
    exact = arrays["support_vectors"].astype(np.float16)
    path = tmp_path / "half.safetensors"
    path.write_bytes(content(arrays=arrays | {"support_vectors": exact}))
    model = load_model(path)
    np.testing.assert_array_equal(model.arrays["support_vectors"], exact.astype(np.float32))
    assert model.arrays["support_vectors"].dtype == np.float32
    again = tmp_path / "again.safetensors"
    save_model(model, again)
    assert load(again.read_bytes())["support_vectors"].dtype == np.float16


def test_an_array_that_half_precision_cannot_hold_stays_as_it_is(tmp_path):
    arrays = load(model_bytes())
    odd = arrays["support_vectors"].astype(np.float32)
    odd[0, 0] = 0.1
    path, again = tmp_path / "odd.safetensors", tmp_path / "again.safetensors"
    path.write_bytes(content(arrays=arrays | {"support_vectors": odd}))
    save_model(load_model(path), again)
    np.testing.assert_array_equal(load_model(again).arrays["support_vectors"], odd)


def test_an_array_too_many_is_refused(tmp_path):
    arrays = load(model_bytes())
    refusal(tmp_path, content(arrays=arrays | {"extra\n\x1b[2J": np.zeros(1)}))


@pytest.mark.parametrize(
    ("key", "value", "reason"),
    [
        ("format", 1, "format"),
        ("format", 8, "format 8, newer"),
        ("format", "1", "format"),
        ("format", [3], "format"),
        ("label_frame", 8, "label_frame"),
        ("label_frame", -1, "label_frame"),
        ("gate", 41.0, "gate"),
        ("gate", 2.0, "gate"),
        ("novelty", "magic", "novelty"),
        ("decision_bias", {"class_0": 1e999}, "decision_bias"),
        ("decision_bias", {"class_9": 1.0}, "decision_bias has a class that it has not"),
        ("base_inverse_temperature", 0.0, "base_inverse_temperature"),
        ("elsewhere", {}, "elsewhere"),
        ("window_seconds", 1e999, "window_seconds"),
        ("kind", "pickle", "kind"),
        ("feature_set", "auros63", "feature set"),
        ("feature_names", ["energy"], "features"),
        ("classes", ["class_0"], "classes"),
        ("classes", ["class_0", "class_1", "class_1"], "twice"),
        ("classes", ["class_0", "class_1", "class_3"], "classes"),
        ("classes", ["class_0", "class_1", "../../etc"], "classes"),
        ("classes", ["class_0", "class_1", "\u001b[2J"], "classes"),
        ("classes", ["class_0", "class_1", "class_2\n"], "classes"),
        ("classes", ["class_0", "class_1", "c" * 1000], "classes"),
        ("classes", [f"c{i}" for i in range(1000)], "classes"),
        ("classes", "class_0", "classes"),
        ("parameters", {"cost": 4.0, "gamma": -1.0}, "gamma"),
        ("parameters", {"cost": 4.0, "gamma": float("nan")}, "gamma"),
        ("parameters", {"cost": 4.0}, "gamma"),
        ("parameters", {"cost": 4.0, "gamma": 1.0, "nu": 1.0}, "nu"),
        ("inputs", "spectrogram", "inputs"),
        ("feature_set_version", 2, f"version 2 of feature set {DEFAULT.name}"),
        ("inverse_temperature", 0.0, "inverse_temperature"),
        ("inverse_temperature", 1e999, "inverse_temperature"),
        ("calibration", "sigmoid", "calibration"),
        ("smoothing", {"method": "magic"}, "smoothing"),
        ("smoothing", {"method": "hmm", "weight": 0.0}, "smoothing.weight"),
        ("smoothing", {"method": "hmm", "reach_seconds": 6.0}, "smoothing.reach_seconds"),
        ("smoothing", {"method": "hmm", "shortest_seconds": -1.0}, "smoothing.shortest_seconds"),
        ("metrics", {}, "metrics"),
        ("scenario", {}, "scenario"),
        ("unknown", 1, "unknown"),
    ],
)
def test_a_description_that_makes_no_sense_is_refused_by_name(tmp_path, key, value, reason):
    assert reason in refusal(tmp_path, content(description() | {key: value}))


@pytest.mark.parametrize("spans", [[[5, 5]], [[1, 3], [2, 4]], [[1]], [[-1, 1]], [[0, 1]] * 1001])
def test_spans_of_a_home_that_are_not_in_order_or_too_many_are_refused(tmp_path, spans):
    about = description()
    training = about["training_data"] | {"home_spans": spans}
    assert "home_spans" in refusal(tmp_path, content(about | {"training_data": training}))


@pytest.mark.parametrize(
    "key",
    sorted(
        description().keys()
        - {"copies", "base_inverse_temperature", "feature_set_sha256", "direction_microphones"}
    ),
)
def test_nothing_of_the_description_may_be_missing(tmp_path, key):
    about = description()
    del about[key]
    assert key in refusal(tmp_path, content(about))


def older(number, **changed):
    """The description of a model as an older version wrote it."""
    about = description()
    for key in ("label_frame", "gate", "decision_bias", "novelty", "elsewhere"):
        del about[key]
    about["inputs"], about["window_seconds"] = "statistics", 1.0
    about["feature_set"] = "auros21"
    about["smoothing"] = {"method": "merge", "lag_seconds": 0.0}
    about["format"] = number
    del about["parameters"]["steps"]
    if number == 2:
        about |= about.pop("parameters")
        del about["feature_set_version"], about["method"]
    return json.dumps(about | changed)


@pytest.mark.parametrize("number", [2, 3])
@pytest.mark.parametrize("seconds", [1.0, 1])
def test_a_label_of_an_older_model_speaks_of_the_last_frame_of_its_second(number, seconds):
    about = read_description(older(number, window_seconds=seconds))
    assert (about.format, about.label_frame, about.gate) == (5, 19, 0.0)
    assert label_timing(about) == LabelTiming(20, 19, needs_floor=False)
    assert label_timing(about).delay == 0
    assert (about.novelty, about.decision_bias, about.elsewhere) == ("machine", {}, None)
    smoothing = about.smoothing
    assert (smoothing.weight, smoothing.reach_seconds, smoothing.shortest_seconds) == (1, 0, 0)


@pytest.mark.parametrize("number", [2, 3])
@pytest.mark.parametrize("seconds", ["1e999", "NaN", "-1.0", "0", "null", "[]", '"1"', "1e300"])
def test_an_older_description_with_a_window_of_no_length_is_refused(number, seconds):
    text = older(number, window_seconds=0.125).replace("0.125", seconds)
    with pytest.raises(ModelError, match="window_seconds"):
        read_description(text)


@pytest.mark.parametrize(
    "text", ["", "null", "[]", "{", "[" * 100_000, '{"classes": ' * 50_000, "1" * 10_000, "\x00"]
)
def test_a_description_that_is_no_json_object_is_refused(tmp_path, text):
    refusal(tmp_path, save(load(model_bytes()), {"hearthlog": text}))


def test_another_safetensors_file_is_refused(tmp_path):
    assert "does not describe itself" in refusal(tmp_path, save({"weight": np.zeros(3)}))
