"""The embedding of a network that the user brings: from its card to a report, or one clear line."""

import hashlib
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from networks import WIDTH, model, spectral_network, write_network
from onnx import TensorProto, helper
from typer.testing import CliRunner

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.recorder_info import features_of, read_recorder_infos
from hearthlog.analyzer.training.train import method_named
from hearthlog.models.features.installed import feature_set
from hearthlog.models.modelfile import load_model
from hearthlog.recorder.sources.decoding import read_audio
from hearthlog.schemas.errors import HearthlogError, HearthlogWarning, LogError, ModelError
from hearthlog.schemas.frames import FRAME_SAMPLES
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import find_logs
from hearthlog.schemas.logs.metadata import (
    feature_entries,
    features_of_microphone,
    other_features,
)
from hearthlog.tools.cli.main import make_app

_CLIPS = Path(__file__).parent / "data" / "household"
_SCENARIO = """
[classes]
coughing = ["coughing"]
crying = ["crying"]
other = ["objects_activity", "other_negative"]
"""


@pytest.fixture(scope="module", autouse=True)
def networks(tmp_path_factory):
    """A folder of data with the network `levels`, where networks are looked for."""
    folder = tmp_path_factory.mktemp("data")
    write_network(folder, "levels")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_DATA_HOME", str(folder))
        yield folder


@pytest.fixture
def own(tmp_path, monkeypatch):
    """A folder of data of one test."""
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    return tmp_path / "data"


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("model")
    scenario = folder / "few.toml"
    scenario.write_text(_SCENARIO)
    requested = ["--data", _CLIPS / "manifest.csv", "--scenario", scenario, "--method", "levels"]
    done = run("train", *requested, "-o", folder / "few.safetensors")
    assert "macro F1" in done
    return folder / "few.safetensors"


@pytest.fixture(scope="module")
def evening(tmp_path_factory) -> Path:
    """A minute of real household sound."""
    path = tmp_path_factory.mktemp("sound") / "evening.flac"
    files = sorted(_CLIPS.glob("*/*.flac"))[::4]
    sound = [block for file in files for block in read_audio(file)]
    soundfile = pytest.importorskip("soundfile")
    soundfile.write(path, np.concatenate(sound)[: 60 * 16_000], 16_000)
    return path


@pytest.fixture(scope="module")
def logs(trained, evening, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("logs")
    run("record", evening, "--model", trained, "-o", folder, "--start", "2026-03-01T07:00:00")
    return folder


def run(*words):
    """Run the command in this process; return what it says."""
    done = CliRunner().invoke(make_app(words[:1]), [str(word) for word in words])
    if isinstance(done.exception, HearthlogError):
        raise done.exception
    assert done.exit_code in {0, 3}, done.output
    return done.stdout


def extractor(folder, network=None, **card):
    write_network(folder, "one", network, **card)
    return feature_set("one").extractor()


def test_a_frame_has_its_level_and_the_embedding_of_the_last_whole_window(networks):
    del networks
    frames = np.random.default_rng(1).normal(0, 0.1, (60, FRAME_SAMPLES)).astype(np.float32)
    values = feature_set("levels").extractor()(frames)
    session = _session(spectral_network())
    sound = np.concatenate([np.zeros(15_600, np.float32), frames.ravel()])
    for frame in (0, 9, 10, 30, 59):
        end = 15_600 + (frame + 1) * 800 // 8000 * 8000
        expected = session.run(None, {"waveform": sound[np.newaxis, end - 15_600 : end]})[0][0]
        np.testing.assert_allclose(values[frame, 1:], expected, rtol=1e-3)
    power = feature_set("levels").power(values)
    np.testing.assert_allclose(power, np.square(frames).mean(axis=1), rtol=0.02)


@settings(max_examples=20)
@given(
    sizes=st.lists(st.integers(1, 45), min_size=1, max_size=12),
    hop=st.sampled_from([0.05, 0.1234, 0.48, 0.5, 1.3]),
)
def test_blocks_of_any_size_give_the_same_bits(networks, sizes, hop):
    write_network(networks, "any", hop_seconds=hop)
    rng = np.random.default_rng(len(sizes))
    frames = rng.normal(0, 0.1, (sum(sizes), FRAME_SAMPLES)).astype(np.float32)
    extract = feature_set("any").extractor()
    full = extract(frames)
    extract.restart()
    parts = [extract(part) for part in np.split(frames, np.cumsum(sizes)[:-1])]
    assert np.concatenate(parts).tobytes() == full.tobytes()


def test_a_gap_lets_the_network_hear_nothing_of_what_was_before(networks):
    del networks
    rng = np.random.default_rng(2)
    before, after = rng.normal(0, 0.1, (2, 40, FRAME_SAMPLES)).astype(np.float32)
    extract = feature_set("levels").extractor()
    extract(before)
    extract.restart()
    np.testing.assert_array_equal(extract(after), feature_set("levels").extractor()(after))


@pytest.mark.parametrize("hop", [0.05, 0.1234, 0.48, 0.5, 1.0])
def test_the_first_inputs_are_of_sound_since_the_gap_alone(own, hop):
    write_network(own, "one", hop_seconds=hop)
    features = feature_set("one")
    frames = np.random.default_rng(3).normal(0, 0.1, (60, FRAME_SAMPLES)).astype(np.float32)
    inputs = features.inputs["embedding"].stream()
    extract = features.extractor()
    extract._recent[:] = 0.5  # as if it had not been silent before
    first = inputs(extract(frames))[0]
    again = features.inputs["embedding"].stream()(features.extractor()(frames))
    np.testing.assert_array_equal(first, again[0])
    assert len(again) == 60 - features.window_frames + 1


def test_a_stream_of_inputs_and_single_windows_agree(networks):
    del networks
    features = feature_set("levels")
    frames = np.random.default_rng(4).normal(0, 0.1, (80, FRAME_SAMPLES)).astype(np.float32)
    values = features.extractor()(frames)
    inputs, size = features.inputs["embedding"], features.window_frames
    stream = inputs.stream()
    streamed = np.concatenate([stream(values[:5]), stream(values[5:40]), stream(values[40:])])
    windows = np.lib.stride_tricks.sliding_window_view(values, size, axis=0).swapaxes(1, 2)
    np.testing.assert_array_equal(streamed, inputs.of_windows(windows))


def test_a_network_at_another_rate_is_given_sound_at_that_rate(own):
    network = spectral_network((1, 23_400), rate=24_000)
    extract = extractor(own, network, sample_rate=24_000)
    tone = np.sin(2 * np.pi * 1000 / 16_000 * np.arange(40 * 800)).astype(np.float32) * 0.5
    values = extract(tone.reshape(-1, 800))[-1, 1:]
    centres = np.geomspace(100.0, 0.45 * 24_000, WIDTH)
    assert abs(np.log2(centres[values.argmax()] / 1000)) < 0.3


def test_several_embeddings_of_a_window_are_averaged(own):
    twice = model(
        [helper.make_node("Concat", ["waveform", "zeros"], ["both"], axis=0)],
        {"zeros": np.zeros((1, 800), np.float32)},
        (1, 800),
        {"both": [2, 800]},
    )
    extract = extractor(own, twice, window_seconds=0.05, hop_seconds=0.05, width=800)
    frames = np.full((3, FRAME_SAMPLES), 0.5, np.float32)
    np.testing.assert_array_equal(extract(frames)[:, 1:], 0.25)


def test_sound_that_is_not_finite_or_beyond_full_scale_gives_finite_values(networks):
    del networks
    frames = np.zeros((30, FRAME_SAMPLES), np.float32)
    frames[:, ::7], frames[:, 1::7], frames[:, 2::7] = np.nan, np.inf, 1e30
    assert np.isfinite(feature_set("levels").extractor()(frames)).all()


def test_a_log_says_which_network_it_has(logs, networks):
    columns = read_columns(find_logs(logs), ["/mic/info", "/mic/features", "/mic/label"])
    info, features = columns["/mic/info"], columns["/mic/features"]
    assert info["feature_set"][0] == "levels"
    assert list(info["feature_names"][0][:2]) == ["level", "embedding_1"]
    assert features["values"].shape[1] == 1 + WIDTH
    (origin,) = read_recorder_infos(find_logs(logs)[0], "features")
    network = networks / "hearthlog" / "networks" / "levels.onnx"
    digest = hashlib.sha256(network.read_bytes()).hexdigest()
    assert origin.metadata["feature_set_sha256"] == digest
    assert len(columns["/mic/label"]) == len(features) - feature_set("levels").window_frames + 1


def test_each_microphone_of_a_log_has_features_of_its_own():
    first = feature_entries("levels", 7, "ab" * 32, "")
    other = feature_entries("plp", 1, "", "hearthlog-feature-sets 1.0.0")
    record = {**first, **other_features(first, other, "hall")}
    assert features_of_microphone(record, "kitchen").items() >= first.items()
    of_hall = features_of_microphone(record, "hall")
    assert {**of_hall, "feature_set": "plp"}.items() >= other.items()
    assert "feature_set_sha256" not in of_hall


def test_a_replay_and_a_relabelling_give_the_labels_bit_for_bit(logs, trained, tmp_path):
    copy = shutil.copytree(logs, tmp_path / "logs")
    compared = json.loads(run("replay", copy, "--model", trained, "--json"))["compared"]
    assert compared["identical_labels"] == compared["labels"] > 1000
    run("relabel", copy, "--model", trained, "--workers", "1")
    columns = read_columns([*copy.rglob("*.mcap")], ["/mic/label", "/mic/relabel/few/label"])
    live, again = columns["/mic/label"], columns["/mic/relabel/few/label"]
    np.testing.assert_array_equal(live["probabilities"], again["probabilities"])


def test_logs_are_read_where_only_the_card_is(logs, own, networks, tmp_path):
    copy = shutil.copytree(logs, tmp_path / "logs")
    card = networks / "hearthlog" / "networks" / "levels.toml"
    folder = own / "hearthlog" / "networks"
    folder.mkdir(parents=True)
    shutil.copy(card, folder)
    run("report", copy, "--day", "2026-03-01", "-o", tmp_path / "report.html")
    run("doctor", copy)
    with pytest.raises(ModelError, match=r"levels\.onnx: no such network"):
        feature_set("levels").extractor()


def test_a_home_is_learned_from(logs, trained, tmp_path):
    copy = shutil.copytree(logs, tmp_path / "logs")
    marks = tmp_path / "marks.txt"
    marks.write_text("5\t15\tcoughing\n20\t30\tcrying\n")
    run("annotate", "import", copy, marks)
    run("train", "--base", trained, "--home", copy, "-o", tmp_path / "adapted.safetensors")
    adapted = load_model(tmp_path / "adapted.safetensors").description
    assert adapted.training_data.home["coughing"].segments > 5
    assert adapted.feature_set_sha256 == load_model(trained).description.feature_set_sha256


def test_a_model_of_another_network_of_this_name_is_refused(logs, trained, own):
    write_network(own, "levels", spectral_network((1, "any")))
    with pytest.raises(ModelError, match=r"is for the network levels with sha256 .* retrain it"):
        load_model(trained)
    (origin,) = read_recorder_infos(find_logs(logs)[0], "features")
    with pytest.raises(LogError, match="has features of the network levels with sha256"):
        features_of(origin)


def test_a_model_of_the_same_network_with_another_hop_is_refused(trained, own):
    write_network(own, "levels", hop_seconds=0.25)
    with pytest.raises(ModelError, match=r"version .* of feature set levels.*retrain it"):
        load_model(trained)


def test_where_there_is_no_card_one_line_says_so(logs, trained, own):
    with pytest.raises(ModelError, match=rf"'levels' is not installed.*{own}/hearthlog/networks"):
        load_model(trained)
    (origin,) = read_recorder_infos(find_logs(logs)[0], "features")
    with pytest.raises(LogError, match="'levels' is not installed"):
        features_of(origin)


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ({"width": 4097}, "width: Input should be less than or equal to 4096"),
        ({"width": 0}, "width: Input should be greater"),
        ({"hop_seconds": 0.0}, "hop_seconds: Input should be greater"),
        ({"window_seconds": 2.4}, ".*together more than 2.5"),
        ({"sample_rate": 1}, "sample_rate: Input should be greater"),
        ({"sha256": "0"}, "sha256: String should match"),
        ({"colour": "blue"}, "colour: Extra inputs are not permitted"),
        ({"names": ["a", "b"]}, "names: there are 2, and width says 16"),
        ({"names": ["level", *"abcdefghijklmno"]}, "names: one is there twice, or is level"),
        ({"input": None, "width": None}, "width: Field required"),
    ],
)
def test_a_card_that_says_what_cannot_be_is_refused(own, content, problem):
    write_network(own, "one", **content)
    with pytest.raises(ModelError, match=rf"one\.toml: {problem}"):
        feature_set("one")


def test_a_card_without_a_digest_is_told_that_of_its_network(own):
    path = write_network(own, "one", sha256=None)
    digest = hashlib.sha256(path.with_suffix(".onnx").read_bytes()).hexdigest()
    with pytest.raises(ModelError, match=f'sha256 = "{digest}"'):
        feature_set("one")


def test_a_card_cannot_take_a_name_of_ours(own):
    write_network(own, "home33")
    write_network(own, "room")
    assert feature_set("home33").digest == ""
    with pytest.raises(DataError, match="'home33' is not installed"):
        method_named("home33")
    with pytest.raises(DataError, match="room is a method, and a network: give its card another"):
        method_named("room")
    with pytest.raises(ModelError, match="not installed"):
        feature_set("../networks/home33")


def _single(nodes, constants=None, shape=(1, 15_600), outputs=None, **more):
    return model(nodes, constants or {}, shape, outputs or {"out": None}, **more)


def _with_external_weights() -> bytes:
    made = onnx.load_model_from_string(spectral_network())
    weights = made.graph.initializer[0]
    weights.data_location = TensorProto.EXTERNAL
    weights.ClearField("raw_data")
    weights.external_data.add(key="location", value="../../secret")
    return made.SerializeToString()


_NAN = _single([helper.make_node("Log", ["waveform"], ["out"])])
_WIDE = _single([helper.make_node("Relu", ["waveform"], ["out"])])
_TWO_INPUTS = onnx.load_model_from_string(_WIDE)
_TWO_INPUTS.graph.input.append(helper.make_tensor_value_info("state", TensorProto.FLOAT, (1,)))
_TWO = _single(
    [helper.make_node("Relu", ["waveform"], ["a"]), helper.make_node("Abs", ["waveform"], ["b"])],
    outputs={"a": None, "b": None},
)
_INTEGERS = _single([helper.make_node("Shape", ["waveform"], ["out"])])


@pytest.mark.parametrize(
    ("network", "problem"),
    [
        (b"no network", "is no ONNX file"),
        (b"", "is no ONNX file"),
        (spectral_network()[:-40], "is no "),
        (_with_external_weights(), "keeps weights in other files: save it as one file"),
        (spectral_network((1, 64, 96)), r"takes waveform: tensor\(float\) of shape \[1, 64, 96\]"),
        (spectral_network((1, 16_000)), "the window of its card has 15600 samples"),
        (_TWO_INPUTS.SerializeToString(), "takes waveform, state; it is given only samples"),
        (_TWO, "gives a, b; its card must say which as output"),
        (_WIDE, r"of shape \[1, 15600\]; .* has 16 values \(and 4096 are the most\)"),
        (_NAN, r"not finite|of shape"),
        (_INTEGERS, "is no network|gives no numbers|of shape"),
        (_single([helper.make_node("NoSuchThing", ["waveform"], ["out"])]), "onnxruntime takes"),
    ],
)
def test_a_network_that_is_not_what_its_card_says_is_refused(own, network, problem):
    with pytest.raises(ModelError, match=rf"one\.onnx: .*{problem}") as refused:
        extractor(own, network)
    assert len(str(refused.value).splitlines()) == 1


def test_values_that_are_not_finite_are_refused(own):
    network = _single([helper.make_node("Log", ["waveform"], ["out"])], shape=(1, 800))
    with pytest.raises(ModelError, match="gives values that are not finite as out"):
        extractor(own, network, window_seconds=0.05, hop_seconds=0.05, width=800)


def _failing_at_half(measure, lookup):
    """A network of a row and a measure of the sound, which looks up another row from 0.5 on."""
    return _single(
        [
            helper.make_node("Abs", ["waveform"], ["sizes"]),
            helper.make_node(measure, ["sizes"], ["size"]),
            helper.make_node("Mul", ["size", "two"], ["double"]),
            helper.make_node("Reshape", ["double", "one"], ["flat"]),
            helper.make_node("Cast", ["flat"], ["step"], to=TensorProto.INT64),
            lookup,
            helper.make_node("Add", ["row", "size"], ["out"]),
        ],
        {
            "two": np.array(2.0, np.float32),
            "one": np.array([1]),
            "all": np.array([9999]),
            "rows": np.array([0]),
            "columns": np.array([1]),
            "table": np.arange(WIDTH, dtype=np.float32)[np.newaxis],
        },
    )


_LOOKUPS = {
    "an error": helper.make_node("Gather", ["table", "step"], ["row"]),
    "no rows": helper.make_node("Slice", ["table", "step", "all", "rows"], ["row"]),
    "another width": helper.make_node("Slice", ["table", "step", "all", "columns"], ["row"]),
}


@pytest.mark.parametrize("failure", _LOOKUPS)
def test_sound_that_a_network_fails_at_is_silence_to_it_and_the_rest_is_heard(own, failure):
    extract = extractor(own, _failing_at_half("ReduceMean", _LOOKUPS[failure]))
    quiet, loud = (np.full((40, FRAME_SAMPLES), level, np.float32) for level in (0.25, 0.75))
    with pytest.warns(HearthlogWarning, match="fails at some sound, which counts as silence"):
        values = extract(loud)
    np.testing.assert_array_equal(values[-1, 1:], np.arange(WIDTH))
    np.testing.assert_array_equal(extract(quiet)[-1, 1:], np.arange(WIDTH) + 0.25)


@pytest.mark.parametrize("failure", _LOOKUPS)
def test_a_network_that_fails_at_loud_noise_is_refused(own, failure):
    with pytest.raises(ModelError, match=r"one\.onnx: (fails|gives out of shape)"):
        extractor(own, _failing_at_half("ReduceMax", _LOOKUPS[failure]))


def test_a_network_that_was_changed_is_refused(own):
    path = write_network(own, "one")
    path.with_suffix(".onnx").write_bytes(spectral_network((1, "any")))
    with pytest.raises(ModelError, match=r"has sha256 .*, and its card is about"):
        feature_set("one").extractor()


def test_a_network_that_never_ends_is_refused(own, monkeypatch):
    monkeypatch.setattr("hearthlog.models.embedding.session._PATIENCE_SECONDS", 0.3)
    body = helper.make_graph(
        [
            helper.make_node(kind, [a], [b])
            for kind, a, b in (("Identity", "go", "on"), ("Abs", "x", "y"))
        ],
        "body",
        [
            helper.make_tensor_value_info("i", TensorProto.INT64, ()),
            helper.make_tensor_value_info("go", TensorProto.BOOL, ()),
            helper.make_tensor_value_info("x", TensorProto.FLOAT, (1, 15_600)),
        ],
        [
            helper.make_tensor_value_info("on", TensorProto.BOOL, ()),
            helper.make_tensor_value_info("y", TensorProto.FLOAT, (1, 15_600)),
        ],
    )
    endless = _single(
        [helper.make_node("Loop", ["", "true", "waveform"], ["out"], body=body)],
        {"true": np.array(True)},
    )
    with pytest.raises(ModelError, match="takes more than 0 s for a window"):
        extractor(own, endless)


def test_without_onnxruntime_one_line_says_what_to_install(own, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ModelError, match=r"needs onnxruntime, .* pip install '\.\[onnx\]'"):
        extractor(own, spectral_network((1, "one more")))


def test_onnxruntime_is_imported_only_for_sound():
    code = (
        "import sys; from hearthlog.models.features.installed import feature_set; "
        "feature_set('levels'); assert not {'onnxruntime', 'onnx'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def _session(network: bytes):
    onnxruntime = pytest.importorskip("onnxruntime")
    return onnxruntime.InferenceSession(network, providers=["CPUExecutionProvider"])
