"""A home may have logs of two feature sets: each is read with models of its own set."""

import json
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path
from threading import Event

import numpy as np
import pytest
from log_fixtures import run
from logs import features, read

from hearthlog.analyzer.logs import recorder_info
from hearthlog.analyzer.marks.marks import Mark, write_marks
from hearthlog.analyzer.review.lanes import FEATURES, timeline_plots
from hearthlog.analyzer.review.timeline_reader import read_timeline
from hearthlog.analyzer.training.home_recordings import home_recordings
from hearthlog.analyzer.training.train import DEFAULT as DEFAULT_METHOD
from hearthlog.analyzer.training.train import method_named
from hearthlog.analyzer.training.window_methods import EMBEDDING
from hearthlog.models.features.auros21 import AUROS21
from hearthlog.models.features.installed import DEFAULT, FEATURE_SETS
from hearthlog.recorder.config import Settings
from hearthlog.recorder.recording import record
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import find_logs, is_layer
from hearthlog.tools.cli.options import METHOD

START = 1_772_348_400 * NANOSECONDS
MINUTES = 60 * NANOSECONDS
TAKE_ANOTHER = "take a model for auros21; `hearthlog train --method room21` learns one"


def record_run(folder, day, start, feature_set):
    settings = Settings(output=folder, feature_set=feature_set, max_bag_duration=120)
    return record(settings, FileSource([day], start), Event()).logs


@pytest.fixture(scope="module")
def recorded_both(tmp_path_factory, day):
    """Three minutes of a recorder as it was, and at once three of a recorder as it is."""
    folder = tmp_path_factory.mktemp("both") / "logs"
    old = record_run(folder, day, START, AUROS21.name)
    new = record_run(folder, day, START + 3 * MINUTES, DEFAULT.name)
    assert (len(old), len(new)) == (2, 2)
    return folder


@pytest.fixture
def both(recorded_both, tmp_path):
    return Path(shutil.copytree(recorded_both, tmp_path / "logs"))


@pytest.fixture
def old(both):
    """The old logs alone."""
    for log in find_logs(both):
        if set_of(log) != AUROS21.name:
            log.unlink()
    return both


@pytest.fixture
def hearthlog(capfd):
    return partial(run, capfd)


def set_of(log):
    (info,) = read(log, "info")
    return info.feature_set


def mark(log, *labels):
    stamp = features(log)[1][0]
    spans = [(stamp + 9 * i * NANOSECONDS, label) for i, label in enumerate(labels)]
    write_marks(log, [Mark("mic", t, t + 8 * NANOSECONDS, label) for t, label in spans])


def layers(folder):
    return [path for path in find_logs(folder) if is_layer(path)]


def test_relabelling_labels_the_logs_of_the_models_set_and_says_what_the_others_need(
    both, model_file, tmp_path, hearthlog
):
    done = hearthlog("relabel", both, "--model", model_file, "--workers", 1)
    assert done.returncode == 3
    refused = [line for line in done.stderr.splitlines() if "not relabelled" in line]
    assert len(refused) == 2
    assert all(TAKE_ANOTHER in line for line in refused)
    made = layers(both)
    assert len(made) == 2
    alone = tmp_path / "alone"
    for log in find_logs(both):
        if not is_layer(log) and set_of(log) == DEFAULT.name:
            copy = alone / log.relative_to(both)
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(log, copy)
    assert hearthlog("relabel", alone, "--model", model_file, "--workers", 1).returncode == 0
    topic = "/mic/relabel/simulated/label"
    with_others, without = (read_columns(each, [topic])[topic] for each in (made, layers(alone)))
    np.testing.assert_array_equal(with_others["probabilities"], without["probabilities"])


@pytest.mark.parametrize("verb", ["relabel", "replay"])
def test_a_model_of_another_set_labels_no_log(old, model_file, hearthlog, verb):
    done = hearthlog(verb, old, "--model", model_file)
    assert done.returncode == 1
    assert all(TAKE_ANOTHER in line for line in done.stderr.splitlines() if "has features" in line)
    assert done.stderr.count(TAKE_ANOTHER) >= 1
    assert layers(old) == []


def test_a_log_that_names_no_set_is_of_the_first_one(old):
    log = find_logs(old)[0]
    info = replace(recorder_info.read_recorder_infos(log, "features")[0], feature_set="")
    assert recorder_info.features_of(info) == AUROS21


def test_what_says_which_method_is_for_a_set_names_one_that_is():
    for name in FEATURE_SETS.names():
        if name in {AUROS21.name, DEFAULT.name}:
            advice = recorder_info.models_for(name)
            method = advice.partition("--method ")[2].partition("`")[0]
            assert method_named(method).features.name == name
    assert recorder_info.models_for("octaves") == "take a model for octaves"
    assert f"{EMBEDDING.name} where its network is, else {DEFAULT_METHOD.name}" == METHOD
    assert DEFAULT_METHOD.features == DEFAULT


@pytest.mark.parametrize("base", [True, False])
def test_a_home_all_of_whose_marks_are_of_another_set_is_refused_at_once(  # noqa: PLR0913, PLR0917
    both, model_file, training_set, tmp_path, hearthlog, base
):
    mark(find_logs(both)[0], "speech", "music")
    clips = ["--data", training_set, "--scenario", "general"]
    learned = ["--base", model_file] if base else clips
    done = hearthlog("train", *learned, "--home", both, "-o", tmp_path / "x.safetensors")
    (line,) = done.stderr.splitlines()
    assert done.returncode == 1
    assert line.endswith(f"features of set auros21, and home33 is needed: {TAKE_ANOTHER}")
    assert not (tmp_path / "x.safetensors").exists()


def test_of_a_home_of_both_sets_the_marks_of_one_are_learned_and_the_others_counted(
    both, model_file, tmp_path, hearthlog
):
    logs = find_logs(both)
    mark(logs[0], "speech", "music")
    mark(logs[-1], "speech", "music", "crying")
    adapted = ["--base", model_file, "--home", both, "-o", tmp_path / "x.safetensors"]
    done = hearthlog("train", *adapted, "--json")
    assert done.returncode == 0, done.stderr
    output = json.loads(done.stdout)
    assert output["skipped"] == {"its features are not home33": 2}
    learned = output["training_data"]["home"]
    assert sum(one["seconds"] for name, one in learned.items() if name != "silence") == 24
    assert [item.features.shape[1] for item in home_recordings(both, AUROS21)] == [21, 21, 0, 0, 0]


@pytest.mark.parametrize("missing", ["old", "new", "both", "neither"])
def test_a_sound_is_enrolled_as_the_latest_log_of_the_home(both, household, hearthlog, missing):
    for log in find_logs(both):
        if missing == "both" or missing == ("old" if set_of(log) == AUROS21.name else "new"):
            log.unlink()
    cough = min(household.glob("cough*/*.flac"))
    for _ in range(2):
        done = hearthlog("enrol", "coughing", "--home", both, "--file", cough, "--seconds", 1)
        assert done.returncode == 0, done.stderr
        log = Path(done.stdout.partition(": ")[0])
        assert set_of(log) == (AUROS21.name if missing == "new" else DEFAULT.name)


def test_a_day_of_both_sets_is_drawn_with_every_feature(both):
    timeline = read_timeline([both])
    (plot,) = (plot for plot in timeline_plots(timeline) if plot.kind is FEATURES)
    assert plot.values.shape[1] == DEFAULT.width
    assert np.isfinite(plot.values).all()
    later = plot.times > START + 3 * MINUTES
    assert np.ptp(plot.values[later], axis=0).min() > 0.5


def test_logs_of_both_sets_are_replayed_each_as_it_was(both, tmp_path, hearthlog):
    assert hearthlog("replay", both, "-o", tmp_path / "again").returncode == 0
    for topic in ("/mic/features", "/mic/statistics"):
        columns, again = (
            read_columns(find_logs(folder), [topic])[topic] for folder in (both, tmp_path / "again")
        )
        for field in set(columns.fields):
            assert all(map(np.array_equal, columns[field], again[field]))
