"""Another distribution adds a feature set, a classifier and a method: from sound to report."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

import hearthlog
from hearthlog.models.features import FeatureSet
from hearthlog.models.features.installed import DEFAULT
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import find_logs

EXAMPLE = Path(__file__).parents[1] / "examples" / "extension"


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> dict[str, str]:
    """The environment of commands that find the example installed."""
    folder = tmp_path_factory.mktemp("extension")
    source = shutil.copytree(EXAMPLE, folder / "source")  # a build leaves its traces in it
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation"]
    subprocess.run([*pip, "--target", folder / "site", source], check=True, capture_output=True)
    path = os.pathsep.join(filter(None, [str(folder / "site"), os.environ.get("PYTHONPATH")]))
    return {"PYTHONPATH": path}


@pytest.fixture(scope="module")
def trained(installed, tmp_path_factory, training_set) -> Path:
    model = tmp_path_factory.mktemp("octaves") / "octaves.safetensors"
    requested = ["--data", training_set, "--scenario", "bathroom", "--method", "nearest-octaves"]
    done = command(installed, "train", *requested, "-o", model)
    assert done.returncode == 0, done.stderr
    assert "macro F1" in done.stdout
    return model


@pytest.fixture(scope="module")
def logs(installed, trained, day, tmp_path_factory) -> Path:
    """The day, labelled by a model of the example."""
    folder = tmp_path_factory.mktemp("logs")
    requested = ["--model", trained, "-o", folder, "--start", "2026-03-01T07:00:00"]
    done = command(installed, "record", day, *requested)
    assert done.returncode == 0, done.stderr
    return folder


def command(env, *arguments):
    code = "from hearthlog.tools.cli.main import main; main()"
    return subprocess.run(
        [sys.executable, "-P", "-c", code, *map(str, arguments)],
        capture_output=True,
        text=True,
        env=os.environ | env,
        check=False,
    )


def test_a_module_that_moved_is_imported_with_a_warning_that_names_the_new_one():
    with pytest.warns(DeprecationWarning, match=r"is now hearthlog\.models\.features$") as caught:
        import hearthlog.models.features.feature_set as moved  # noqa: PLC0415
    assert moved.FeatureSet is FeatureSet
    assert caught[0].filename == __file__
    for new in hearthlog._MOVED.values():
        assert find_spec(new) is not None


def test_a_log_has_the_features_and_labels_of_the_example(logs):
    columns = read_columns(find_logs(logs), ["/mic/info", "/mic/features", "/mic/label"])
    info, features, labels = (columns[f"/mic/{kind}"] for kind in ("info", "features", "label"))
    assert info["feature_set"][0] == "octaves"
    assert info["window_seconds"][0] == pytest.approx(1.2)
    assert list(info["feature_names"][0][:2]) == ["level", "octave_62"]
    assert features["values"].shape[1] == 8
    assert len(features) - len(labels) == 23  # labels begin with the first whole window
    assert set(labels["label"]) <= {"silence", "flushing_water", "shower", "tap_water", "other"}
    assert (labels["novelty"] < 1).all()


def test_a_replay_gives_the_labels_bit_for_bit(installed, logs, trained):
    done = command(installed, "replay", logs, "--model", trained, "--json")
    assert done.returncode == 0, done.stderr
    recorded = json.loads(done.stdout)["compared"]
    assert recorded["identical_labels"] == recorded["labels"] > 3000


def test_a_relabelling_gives_the_labels_bit_for_bit(installed, logs, trained, tmp_path):
    copy = shutil.copytree(logs, tmp_path / "logs")
    done = command(installed, "relabel", copy, "--model", trained)
    assert done.returncode == 0, done.stderr
    columns = read_columns([*copy.rglob("*.mcap")], ["/mic/label", "/mic/relabel/octaves/label"])
    live, again = columns["/mic/label"], columns["/mic/relabel/octaves/label"]
    np.testing.assert_array_equal(live["probabilities"], again["probabilities"])


def test_a_home_is_learned_from(installed, logs, day, trained, tmp_path):
    copy = shutil.copytree(logs, tmp_path / "logs")
    spans = [line.split("\t") for line in day.with_suffix(".txt").read_text().splitlines()]
    longest = sorted(spans, key=lambda span: float(span[0]) - float(span[1]))
    quiet = next(span for span in longest if span[2] == "silence")
    loud = next(span for span in longest if span[2] != "silence")
    marks = tmp_path / "marks.txt"
    marks.write_text(f"{quiet[0]}\t{quiet[1]}\tsilence\n{loud[0]}\t{loud[1]}\tshower\n")
    assert command(installed, "annotate", "import", copy, marks).returncode == 0
    adapted = tmp_path / "adapted.safetensors"
    done = command(installed, "train", "--base", trained, "--home", copy, "-o", adapted)
    assert done.returncode == 0, done.stderr
    shown = json.loads(
        command(installed, "models", "show", "adapted", "--folder", tmp_path, "--json").stdout
    )
    assert shown["training_data"]["home"]["shower"]["segments"] > 1


@pytest.mark.parametrize(
    "verb",
    [
        ("info",),
        ("doctor",),
        ("cat", "--topics", "/mic/segment"),
        ("evaluate log", "--reference", "REFERENCE"),
        ("report", "--day", "2026-03-01", "-o", "OUTPUT.html"),
        ("export", "-o", "OUTPUT.parquet", "--topics", "/mic/features"),
    ],
)
def test_what_reads_logs_reads_this_one_too(installed, logs, day, verb, tmp_path):
    words, *options = verb
    names = {"REFERENCE": day.with_suffix(".txt")}
    requested = [names.get(o, o.replace("OUTPUT", str(tmp_path / "out"))) for o in options]
    done = command(installed, *words.split(), logs, *requested)
    labels_of_no_class = words == "evaluate log"
    assert done.returncode == (3 if labels_of_no_class else 0), done.stderr


def test_without_a_model_the_configuration_says_which_features(installed, day, tmp_path):
    env = installed | {"HEARTHLOG_FEATURE_SET": "octaves"}
    assert command(env, "record", day, "-o", tmp_path / "logs").returncode == 0
    info = read_columns(find_logs(tmp_path / "logs"), ["/mic/info"])["/mic/info"]
    assert info["feature_set"][0] == "octaves"


def test_a_model_for_other_features_than_the_log_is_refused(installed, day, trained, tmp_path):
    assert command(installed, "record", day, "-o", tmp_path / "logs").returncode == 0
    done = command(installed, "relabel", tmp_path / "logs", "--model", trained)
    assert done.returncode == 1
    assert f"has features of set {DEFAULT.name}; model octaves is for octaves" in done.stderr
    requested = {"HEARTHLOG_FEATURE_SET": DEFAULT.name} | installed
    done = command(requested, "record", day, "--model", trained, "-o", tmp_path / "other")
    assert done.returncode == 2
    assert f"the model is for feature set octaves, not '{DEFAULT.name}'" in done.stderr


def test_a_model_for_other_features_does_not_take_over_while_recording(
    installed, day, trained, model_file, tmp_path
):
    link = tmp_path / "champion.safetensors"
    link.symlink_to(model_file)
    code = "from hearthlog.tools.cli.main import main; main()"
    requested = ["record", day, "--realtime", "--model", link, "-o", tmp_path / "logs"]
    recorder = subprocess.Popen(
        [sys.executable, "-P", "-c", code, *map(str, requested)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | installed,
    )
    while not list(tmp_path.rglob("*.mcap.active")):
        assert recorder.poll() is None
        time.sleep(0.05)
    link.unlink()
    link.symlink_to(trained)
    assert recorder.stderr is not None
    refusal = recorder.stderr.readline()
    time.sleep(3.0)  # until the log says it too
    recorder.send_signal(signal.SIGINT)
    recorder.communicate(timeout=60)
    assert recorder.returncode in {0, 3}  # 0 if it was stopped before it could say so in the log
    assert "octaves refused" in refusal or "champion refused" in refusal
    assert f"it is for feature set octaves, not {DEFAULT.name}" in refusal


@pytest.mark.parametrize("verb", ["replay", "relabel", "record", "doctor"])
def test_where_the_example_is_not_installed_one_line_says_so(logs, day, trained, verb, tmp_path):
    copy = shutil.copytree(logs, tmp_path / "logs")
    requested = {
        "replay": [copy],
        "relabel": [copy, "--model", trained],
        "record": [day, "--model", trained, "-o", tmp_path / "new"],
        "doctor": [copy],
    }
    done = command({}, verb, *requested[verb])
    if verb == "doctor":
        assert done.returncode == 0, done.stdout
        return
    assert done.returncode in {1, 3}
    assert "'octaves' is not installed" in done.stderr
    assert len(done.stderr.splitlines()) <= 2


def test_an_extension_that_cannot_be_imported_is_one_line(installed, trained, day, tmp_path):
    site = Path(installed["PYTHONPATH"].split(os.pathsep)[0])
    broken = shutil.copytree(site, tmp_path / "broken")
    (broken / "hearthlog_example" / "features.py").write_text("import nowhere_to_be_found\n")
    path = installed["PYTHONPATH"].replace(str(site), str(broken))
    done = command({"PYTHONPATH": path}, "record", day, "--model", trained, "-o", tmp_path / "l")
    assert done.returncode == 1
    assert "hearthlog_example.features:OCTAVES cannot be imported" in done.stderr
    assert len(done.stderr.splitlines()) == 1
