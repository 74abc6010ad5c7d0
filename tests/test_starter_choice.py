"""`general` and `bathroom` mean the starters that take embeddings where a network hears."""

import hashlib
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from threading import Event as Flag

import numpy as np
import pytest
import soundfile
from log_fixtures import run
from networks import model
from onnx import helper

from hearthlog.analyzer.recorder_status import _networks
from hearthlog.models.embedding.networks import NETWORKS, YAMNET, NetworkFile
from hearthlog.models.modelfile import load_model
from hearthlog.recorder.config import NO_MODEL, MicrophoneSettings, Settings
from hearthlog.recorder.labelling import embedder_probe
from hearthlog.recorder.labelling.embedder_probe import Probe, likely_network
from hearthlog.recorder.recording import record_files
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import find_logs
from hearthlog.tools.cli.options import starter_of
from hearthlog.tools.cli.record import _report_network

_START = 1_772_348_400 * NANOSECONDS
_HOUR = 3600 * NANOSECONDS
_QUICK = Probe(0.01, 60.0, [])


@pytest.fixture(autouse=True)
def nobody_chose(tmp_path, monkeypatch):
    """Neither a model nor a network is configured, and no network lies on this machine."""
    monkeypatch.delenv("HEARTHLOG_EMBEDDING", raising=False)
    monkeypatch.delenv("HEARTHLOG_MODEL", raising=False)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    monkeypatch.setenv("XDG_DATA_DIRS", str(tmp_path / "all"))
    monkeypatch.chdir(tmp_path)
    sound = np.random.default_rng(3).normal(0, 0.05, 5 * 16_000).astype(np.float32)
    soundfile.write("noise.wav", sound, 16_000)


@pytest.fixture
def yamnet(tmp_path, monkeypatch):
    """A file in the place of yamnet that hears how loud it is, with shapes as yamnet's."""
    rows = {"embedding": np.ones((1, YAMNET.width)), "logits": -np.ones((1, YAMNET.names))}
    data = model(
        [
            helper.make_node("Abs", ["waveform"], ["sizes"]),
            helper.make_node("ReduceMean", ["sizes"], ["size"], axes=[1], keepdims=1),
            *(helper.make_node("Mul", ["size", name], [f"{name}_out"]) for name in rows),
        ],
        {name: row.astype(np.float32) for name, row in rows.items()},
        (1, YAMNET.window),
        {f"{name}_out": list(row.shape) for name, row in rows.items()},
    )
    files = (NetworkFile(hashlib.sha256(data).hexdigest(), len(data)),)
    monkeypatch.setitem(NETWORKS._loaded, "yamnet", replace(YAMNET, files=files, suffix=".onnx"))
    # What it is tried by is another process, which knows the other file.
    monkeypatch.setattr(embedder_probe, "probe_network", lambda *_: _QUICK)
    embedder_probe._probed.cache_clear()
    path = tmp_path / "data" / "hearthlog" / "networks" / "yamnet.onnx"
    path.parent.mkdir(parents=True)
    path.write_bytes(data)
    yield path
    embedder_probe._probed.cache_clear()


def recorded(folder="logs", hour=0, **settings):
    """Record some noise, and return what labelled it, by microphone and scenario."""
    chosen = Settings(output=Path(folder), **{"model": Path("general"), **settings})
    record_files(chosen, FileSource([Path("noise.wav")], _START + hour * _HOUR), Flag())
    infos = read_columns([max(find_logs(Path(folder)))], ["/mic/info"])["/mic/info"]
    return infos["model"].tolist()


@pytest.mark.usefixtures("yamnet")
def test_where_a_network_hears_the_starter_that_takes_it_labels_and_says_so(capsys):
    assert recorded() == ["general-embedding"]
    assert capsys.readouterr().err == (
        "hearthlog: the labels are by the starter model general-embedding, not trained on this "
        "home: by what the network yamnet hears\n"
    )
    assert recorded("water", model=Path("bathroom")) == ["bathroom-embedding"]
    assert recorded("default", model=Path("models/champion.safetensors")) == ["general-embedding"]
    microphone = MicrophoneSettings(model=Path("bathroom"))
    assert recorded("own", microphone=[microphone]) == ["bathroom-embedding"]


@pytest.mark.usefixtures("yamnet")
def test_a_scenario_takes_the_starter_for_the_network_too():
    recorded(model=NO_MODEL, scenarios={"water": Path("bathroom")})
    (log,) = find_logs(Path("logs"))
    columns = read_columns([log], ["/mic/scenario/water/label"])
    assert "/mic/scenario/water/label" in columns
    with log.open("rb") as file:
        assert b"bathroom-embedding" in file.read()


def test_a_network_that_goes_away_leaves_the_starter_that_needs_none(yamnet, capsys):
    assert recorded() == ["general-embedding"]
    yamnet.unlink()
    assert recorded(hour=1) == ["general"]
    assert capsys.readouterr().err.endswith(
        "the labels are by the starter model general, not trained on this home: by features "
        "alone, as the network yamnet is missing\n"
    )
    assert recorded(hour=2, model=Path("general-embedding")) == ["general-embedding"]
    assert "takes embeddings of yamnet, and there are none" in capsys.readouterr().err


def test_a_network_that_cannot_be_used_leaves_it_too(yamnet, capsys, monkeypatch):
    monkeypatch.setattr(embedder_probe, "probe_network", lambda *_: Probe(0.4, 60.0, []))
    assert recorded() == ["general"]
    slow, chosen = capsys.readouterr().err.splitlines()
    assert "too slow here: 0.4 s for a window" in slow
    assert chosen.endswith("by features alone, as the network cannot be used")
    yamnet.write_bytes(b"half")
    embedder_probe._probed.cache_clear()
    monkeypatch.setattr(embedder_probe, "probe_network", lambda *_: _QUICK)
    assert recorded(hour=1) == ["general"]
    assert "or not all of it: it has 4 bytes" in capsys.readouterr().err


@pytest.mark.usefixtures("yamnet")
def test_who_wants_no_network_gets_the_starter_that_needs_none(capsys):
    assert recorded(embedding="none") == ["general"]
    assert capsys.readouterr().err.endswith("by features alone, as no network is wanted\n")
    assert likely_network("none") == ""
    assert likely_network() == "yamnet"
    assert likely_network("other") == ""


@pytest.mark.usefixtures("yamnet")
def test_a_file_of_the_name_of_a_starter_is_that_file(model_file):
    Path("general").write_bytes(model_file.read_bytes())
    assert recorded() == ["general"]


def test_logs_are_relabelled_by_the_starter_that_takes_what_they_have(yamnet, capfd):
    recorded(embedding="none")
    assert starter_of(Path("general"), [Path("logs")]) == Path("general")
    recorded(hour=1)
    yamnet.unlink()  # which makes no difference: the logs have what it heard
    assert starter_of(Path("general"), [Path("logs")]) == Path("general-embedding")
    first, second = sorted(find_logs(Path("logs")))
    assert starter_of(Path("general"), [first]) == Path("general")
    assert starter_of(Path("general"), [first, second]) == Path("general-embedding")
    assert starter_of(Path("home.safetensors"), [second]) == Path("home.safetensors")
    assert starter_of(Path("general"), [Path("nowhere")]) == Path("general")
    capfd.readouterr()
    done = run(capfd, "relabel", "logs", "--model", "general", "--workers", "1")
    assert done.returncode == 0
    assert "2 layers of" in done.stdout
    assert done.stdout.endswith("frames by general-embedding\n")
    assert "1 log without embeddings for general-embedding" in done.stderr


def test_a_starter_is_promoted_for_the_network_that_is_there(yamnet, capfd):
    assert run(capfd, "models", "promote", "general").stdout.startswith("general-embedding (")
    shutil.rmtree("models")

    def promoted(embedding=""):
        env = {"HEARTHLOG_EMBEDDING": embedding}
        done = run(capfd, "models", "promote", "general", "--anyway", env=env)
        assert done.returncode == 0, done
        return load_model(Path("models/champion.safetensors")).name

    assert promoted("none") == "general"
    assert promoted() == "general-embedding"  # though a file general is there
    assert run(capfd, "models", "rollback").stdout.startswith("general (")
    assert promoted() == "general-embedding"
    yamnet.unlink()
    assert promoted() == "general"


def test_the_network_of_a_model_is_named_and_whether_it_is_here(yamnet, capfd):
    def inputs():
        rows = run(capfd, "models", "list").stdout.splitlines()
        return next(row for row in rows if row.startswith("general-embedding"))

    assert "yamnet  " in inputs()
    assert run(capfd, "models", "show", "general-embedding").stderr == ""
    yamnet.unlink()
    assert "yamnet (not here)" in inputs()
    shown = run(capfd, "models", "show", "general-embedding").stderr
    assert shown == ("hearthlog: the network yamnet is not here: hearthlog models fetch yamnet\n")


def test_the_doctor_names_the_network_that_a_model_wants(yamnet):
    recorded(model=Path("general-embedding"))
    yamnet.unlink()
    recorded(model=Path("general-embedding"), hour=1)
    recorded(hour=2)
    labelled, unheard, plain = sorted(find_logs(Path("logs")))
    what = "general-embedding takes what the network yamnet hears"
    assert list(_networks([plain, labelled])) == [("ok", "mic", f"{what}, which is there")]
    ((level, _, text),) = _networks([unheard])
    assert level == "warning"
    assert text.startswith(f"{what}, and it is not there: labels by features alone; hearthlog m")
    assert list(_networks([plain])) == list(_networks([])) == []


def test_on_a_terminal_it_is_said_once_what_a_network_would_gain(tmp_path, capsys, monkeypatch):
    _report_network(Settings(model=Path("general")))
    assert "hearthlog models fetch yamnet (4 MB, once)\n" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "ai_edge_litert", None)
    _report_network(Settings(model=Path("general")))
    assert "it also needs LiteRT; try: " in capsys.readouterr().err
    _report_network(Settings(model=NO_MODEL))
    _report_network(Settings(model=Path("home.safetensors")))
    _report_network(Settings(embedding="none"))
    path = tmp_path / "data" / "hearthlog" / "networks" / "yamnet.tflite"
    path.parent.mkdir(parents=True)
    path.touch()
    _report_network(Settings())
    assert capsys.readouterr().err == ""
