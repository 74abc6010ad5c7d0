"""A network of sounds is tried before it is listened with; what is wrong with it is one line."""

import hashlib
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile
from networks import model
from onnx import helper

from hearthlog.models.embedding import WINDOW_FRAMES, Projection, write_projection
from hearthlog.models.embedding import session as sessions
from hearthlog.models.embedding.networks import (
    NETWORKS,
    NOISE,
    YAMNET,
    Embedder,
    EmbeddingNetwork,
    KnownAnswer,
    NetworkFile,
    find_network,
    synthetic_sounds,
)
from hearthlog.recorder.labelling import embedder_probe
from hearthlog.recorder.labelling.embedder_probe import Probe, open_embedder, probe_network
from hearthlog.schemas.errors import HearthlogWarning, ModelError
from hearthlog.schemas.frames import FRAME_SAMPLES
from hearthlog.tools.cli.models import _tried

_PLACES = (
    Path(__file__).parents[2] / "shared" / "data" / "networks" / "yamnet.tflite",
    Path("~/.local/share/hearthlog/networks/yamnet.tflite").expanduser(),
)
_SILENCE = np.zeros((WINDOW_FRAMES, FRAME_SAMPLES), np.float32)


@pytest.fixture(scope="module")
def yamnet_file():
    pytest.importorskip("ai_edge_litert")
    path = next(filter(Path.exists, _PLACES), None)
    if path is None:
        pytest.skip("needs the network, in ../shared/data/networks")
    return path


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """The folder of networks of one test, whose verbs are not told to listen without one."""
    monkeypatch.delenv("HEARTHLOG_EMBEDDING", raising=False)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    monkeypatch.setenv("XDG_DATA_DIRS", str(tmp_path / "all"))
    folder = tmp_path / "data" / "hearthlog" / "networks"
    folder.mkdir(parents=True)
    return folder


@pytest.fixture
def yamnet(yamnet_file, folder):
    path = folder / "yamnet.tflite"
    path.symlink_to(yamnet_file)
    return path


def constant(rows, op="ReduceMean"):
    """A network whose embedding has three values and whose logits two, from the level of sound."""
    return model(
        [
            helper.make_node("Abs", ["waveform"], ["sizes"]),
            helper.make_node(op, ["sizes"], ["size"], axes=[1], keepdims=1),
            *(helper.make_node("Mul", ["size", name], [f"{name}_out"]) for name in rows),
        ],
        {name: np.array([row], np.float32) for name, row in rows.items()},
        (1, 1600),
        {f"{name}_out": [1, len(row)] for name, row in rows.items()},
    )


_ROWS = {"embedding": [1.0, 2.0, 3.0], "logits": [4.0, -4.0]}


def network_of(folder, data, **changes):
    """Write a network of another distribution, and its projection; return it."""
    projection = Projection(
        mean=np.zeros(3, np.float32),
        components=np.eye(3, 2, dtype=np.float32),
        steps=np.full(4, 0.25, np.float32),
        lows=np.full(4, -12.5, np.float32),
        groups={"loud": [0], "quiet": [1]},
    )
    place = folder / "own.safetensors"
    write_projection(projection, place)
    (folder / "own.onnx").write_bytes(data)
    network = EmbeddingNetwork(
        name="own",
        files=(NetworkFile(hashlib.sha256(data).hexdigest(), len(data)),),
        window=1600,
        width=3,
        names=2,
        projection=place,
        licence="CC0-1.0",
        attribution="me",
        suffix=".onnx",
    )
    return replace(network, **changes)


def test_yamnet_gives_integers_and_the_answers_that_are_known(yamnet):
    embedder = Embedder(YAMNET, yamnet)
    sound = synthetic_sounds(_SILENCE.size)[NOISE].reshape(_SILENCE.shape)
    values = embedder(sound)
    assert (values.shape, values.dtype) == ((len(embedder.projection.names),), np.int8)
    assert (values != embedder(_SILENCE)).any()
    assert embedder.different_answers() == []
    other = replace(YAMNET, answers=(KnownAnswer(NOISE, 514, "white noise", 4.0), *YAMNET.answers))
    (line,) = Embedder(other, yamnet).different_answers()
    assert line.startswith("white noise of noise: 1.")


def test_it_writes_nothing_of_its_own_to_standard_error(yamnet):
    code = (
        "from pathlib import Path; from hearthlog.models.embedding.networks import *; "
        f"Embedder(YAMNET, Path({str(yamnet)!r}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    assert (done.stdout, done.stderr) == (b"", b"")


def test_what_others_write_while_it_is_loaded_is_kept(capfd):
    with sessions._without_notice():
        os.write(2, b"one\nINFO: Created TensorFlow Lite XNNPACK delegate for CPU.\ntwo\n")
    os.write(2, b"three\n")
    assert capfd.readouterr().err == "one\ntwo\nthree\n"


def test_without_room_for_what_is_written_it_is_loaded(monkeypatch, capfd):
    def full(**_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(sessions.tempfile, "TemporaryFile", full)
    with sessions._without_notice():
        os.write(2, b"one\n")
    assert capfd.readouterr().err == "one\n"


def test_a_process_without_standard_error_loads_it():
    code = (
        "import os; os.close(2); from hearthlog.models.embedding.session import _without_notice\n"
        "with _without_notice(): pass"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_recorder_without_a_network_imports_no_runtime():
    code = (
        "import sys; import hearthlog.recorder.recording; "
        "from hearthlog.recorder.labelling.embedder_probe import open_embedder; "
        "open_embedder('none'); "
        "assert not {'ai_edge_litert', 'onnx', 'onnxruntime'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda data: data[:100_000], "or not all of it: it has 100,000 bytes, not "),
        (lambda data: data + b"x", "or not all of it: it has "),
        (lambda data: data[:-1] + bytes([data[-1] ^ 1]), r"\(its sha256 begins with "),
        (lambda _: b"", "it has 0 bytes"),
    ],
)
def test_another_file_under_its_name_is_refused(yamnet_file, folder, change, words):
    path = folder / "yamnet.tflite"
    path.write_bytes(change(yamnet_file.read_bytes()))
    with pytest.raises(ModelError, match=words + ".*fetch it: hearthlog models fetch yamnet$"):
        Embedder(YAMNET, path)


@pytest.mark.parametrize("data", [b"", b"\0" * 64, b"TFL3" * 50, os.urandom(3000)])
def test_a_file_that_is_no_tflite_is_one_line(folder, data):
    pytest.importorskip("ai_edge_litert")
    path = folder / "yamnet.tflite"
    path.write_bytes(data)
    known = replace(YAMNET, files=(NetworkFile(hashlib.sha256(data).hexdigest(), len(data)),))
    with pytest.raises(ModelError, match=r"yamnet\.tflite: is no ") as error:
        Embedder(known, path)
    assert len(str(error.value).splitlines()) == 1


def test_what_is_no_file_is_one_line(folder):
    for path in (folder, folder / "nothing"):
        with pytest.raises(ModelError, match=r"cannot be read|no such network"):
            Embedder(YAMNET, path)


def test_an_onnx_file_is_a_network_too(folder):
    network = network_of(folder, constant(_ROWS))
    embedder = Embedder(network, folder / "own.onnx")
    window = np.full(_SILENCE.shape, 0.5, np.float32)
    np.testing.assert_array_equal(embedder(window), [2, 4, 8, -8])
    np.testing.assert_array_equal(embedder(_SILENCE), [0, 0, 0, 0])


@pytest.mark.parametrize(
    ("data", "changes", "words"),
    [
        (constant({"embedding": [1.0, 2.0], "logits": [1.0, 2.0]}), {}, "one must have 3 values"),
        (constant({"embedding": [1.0] * 3}), {}, "one must have 2 values"),
        (constant(_ROWS | {"logits": [np.nan, 0.0]}), {}, "gives values that are not finite"),
        (constant(_ROWS), {"window": 800}, "the window of this network has 800 samples"),
        (constant(_ROWS), {"width": 2}, "is no projection of its output"),
        (constant(_ROWS), {"names": 1}, "is no projection of its output"),
        (constant(_ROWS), {"suffix": ".pt"}, "ends in none of .tflite, .onnx"),
        (b"no network", {}, "is no ONNX file"),
    ],
)
def test_a_network_that_is_not_what_is_said_of_it_is_refused(folder, data, changes, words):
    network = network_of(folder, data, **changes)
    with pytest.raises(ModelError, match=rf"own\.onnx: .*{words}"):
        Embedder(network, folder / "own.onnx")


def test_a_network_without_an_address_is_brought_from_a_file(folder):
    network = network_of(folder, constant(_ROWS))
    (folder / "own.onnx").write_bytes(b"another")
    with pytest.raises(ModelError, match=r"fetch it: hearthlog models fetch own --from FILE$"):
        Embedder(network, folder / "own.onnx")


def test_sound_that_a_network_fails_at_is_silence_to_it(folder, monkeypatch):
    embedder = Embedder(network_of(folder, constant(_ROWS)), folder / "own.onnx")

    def fail(_):
        raise RuntimeError("no")

    monkeypatch.setattr(embedder, "_session", fail)
    with pytest.warns(HearthlogWarning, match="fails at some sound"):
        np.testing.assert_array_equal(embedder(_SILENCE + 1), [0, 0, 0, 0])


@pytest.mark.parametrize("error", [MemoryError, RuntimeError("no"), ModelError("is bad")])
def test_a_runtime_that_fails_later_keeps_no_recorder_from_its_start(folder, monkeypatch, error):
    def fail(*_):
        raise error

    (folder / "yamnet.tflite").touch()
    monkeypatch.setattr(embedder_probe, "probe_network", lambda *_: Probe(0.01, 60.0, []))
    monkeypatch.setattr(embedder_probe, "load_embedder", fail)
    embedder, line = open_embedder()
    assert embedder is None
    assert line.endswith("; it is recorded without a network")


@pytest.fixture
def distribution(folder, tmp_path, monkeypatch):
    """A distribution with a network of its own, for this process and those that it starts."""
    network = network_of(folder, constant(_ROWS))
    code = "from pathlib import Path, PosixPath\n"
    code += "from hearthlog.models.embedding.networks import EmbeddingNetwork, NetworkFile\n"
    (tmp_path / "brought_network.py").write_text(f"{code}OWN = {network!r}\n")
    about = tmp_path / "brought-1.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: brought\nVersion: 1\n")
    points = "[hearthlog.embedding_networks]\nown = brought_network:OWN\n"
    (about / "entry_points.txt").write_text(points)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}")
    yield network
    NETWORKS._loaded.pop("own", None)


def test_another_distribution_brings_a_network(distribution):
    assert NETWORKS.names() == ["yamnet", "own"]
    assert find_network("own").name == "own.onnx"
    embedder, line = open_embedder("own")
    assert line == ""
    assert embedder.network == distribution


def test_a_network_is_tried_in_a_process_of_its_own(yamnet):
    probe = probe_network("yamnet", yamnet)
    assert 0 < probe.seconds < 1
    assert 10 < probe.megabytes < 120
    assert probe.different_answers == []
    embedder, line = open_embedder()
    assert (embedder.network, line) == (YAMNET, "")


@pytest.mark.parametrize(
    ("code", "words"),
    [
        ("os.kill(os.getpid(), 4)", "crashes (SIGILL): this processor lacks instructions"),
        ("os.kill(os.getpid(), 11)", "crashes (SIGSEGV): "),
        ("os.kill(os.getpid(), 9)", "crashes (SIGKILL): perhaps there is too little memory"),
        ("time.sleep(60)", "hangs: no answer in 1 s"),
        ("sys.exit(1)", "cannot be tried (it says nothing)"),
        ("raise ImportError('no libfoo.so')", "cannot be tried (ImportError: no libfoo.so)"),
        ("print('nonsense')", "cannot be tried"),
        ("answer(seconds=0.4)", "too slow here: 0.4 s for a window, every 0.5 s of each of 3"),
        ("answer(seconds=0.1)", "of each of 3 microphones; this machine manages one every 0.6 s"),
        ("answer(megabytes=1000)", "takes 1000 MB of memory, and the limit is 300"),
        ("print(json.dumps({'error': 'yamnet.tflite: is bad'}))", "yamnet.tflite: is bad"),
    ],
)
def test_a_runtime_that_fails_is_one_line_and_recording_goes_on(folder, monkeypatch, code, words):
    (folder / "yamnet.tflite").touch()
    start = (
        "import json, os, sys, time\n"
        "def answer(seconds=0.01, megabytes=60.0):\n"
        "    print(json.dumps(dict(seconds=seconds, megabytes=megabytes, different_answers=[])))\n"
    )
    monkeypatch.setattr(embedder_probe, "missing_modules", lambda _: [])
    monkeypatch.setattr(embedder_probe, "_PATIENCE_SECONDS", 1)
    monkeypatch.setattr(
        embedder_probe, "module_command", lambda _: [sys.executable, "-c", start + code]
    )
    embedder, line = open_embedder("", 3)
    assert embedder is None
    assert words in line
    assert line.endswith("; it is recorded without a network")
    assert len(line.splitlines()) == 1


def test_without_its_runtime_one_line_says_what_to_install(folder, monkeypatch):
    (folder / "yamnet.tflite").touch()
    monkeypatch.setitem(sys.modules, "ai_edge_litert", None)
    embedder, line = open_embedder()
    assert embedder is None
    assert "its runtime is not installed; try: pip install '.[embedding]'" in line


def test_without_a_network_only_who_asked_for_one_is_told():
    assert open_embedder() == (None, "")
    assert open_embedder("none") == (None, "")
    embedder, line = open_embedder("yamnet")
    assert embedder is None
    assert line.startswith(
        "the network yamnet is not installed; hearthlog models fetch yamnet installs"
    )
    assert line.endswith("it; it is recorded without a network")
    embedder, line = open_embedder("other")
    assert embedder is None
    assert line.startswith("network of sounds 'other' is not installed; there is yamnet")


def test_a_configured_network_that_is_not_there_is_noticed(hearthlog, tmp_path, folder):
    file = tmp_path / "home.toml"
    file.write_text(f'model = "none"\nembedding = "yamnet"\noutput = "{tmp_path}/logs"\n')
    done = hearthlog("config", "check", file)
    assert done.returncode == 1
    assert (
        "the network yamnet is not installed; hearthlog models fetch yamnet installs it"
        in done.stderr
    )
    (folder / "yamnet.tflite").write_bytes(b"half")
    assert "or not all of it: it has 4 bytes" in hearthlog("config", "check", file).stderr
    file.write_text(f'model = "none"\nembedding = "none"\noutput = "{tmp_path}/logs"\n')
    assert hearthlog("config", "check", file).returncode == 0


def test_a_file_that_hears_otherwise_is_told_when_it_is_fetched(yamnet, monkeypatch):
    probe = Probe(0.01, 60.0, ["beep of tone: -3.00, where 2.00 is known"])
    monkeypatch.setattr(embedder_probe, "probe_network", lambda *_: probe)
    (line,) = _tried(YAMNET, yamnet)
    assert "differs from the network that models were trained with (beep of tone: -3.00" in line


@pytest.mark.parametrize("signal", [4, 11])
def test_a_recorder_records_where_the_runtime_crashes(yamnet, hearthlog, tmp_path, signal):
    crashing = tmp_path / "site" / "ai_edge_litert"
    crashing.mkdir(parents=True)
    (crashing / "__init__.py").touch()
    (crashing / "interpreter.py").write_text(f"import os\nos.kill(os.getpid(), {signal})\n")
    path = f"{crashing.parent}:{os.environ.get('PYTHONPATH', '')}"
    sound = np.random.default_rng(1).normal(0, 0.1, 48_000)
    soundfile.write(tmp_path / "a.wav", sound, 16_000)
    done = hearthlog(
        *("record", tmp_path / "a.wav", "--model", "none", "-o", tmp_path / "logs"),
        *("--start", "2026-03-01T07:00:00"),
        env={"PYTHONPATH": path},
    )
    assert done.returncode == 0
    assert f"{yamnet}: the network crashes (SIG" in done.stderr
    assert done.stderr.count("it is recorded without a network") == 1
    assert Path(done.stdout.strip()).exists()
