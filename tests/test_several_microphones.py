"""What is learned and measured where a log is of several microphones, each with its own model."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile
from log_fixtures import run
from model_folders import keep_models
from together import record_together

from hearthlog.analyzer.activity.checked_minutes import read_reviewed_labels
from hearthlog.analyzer.logs.home_logs import find_home_logs
from hearthlog.analyzer.logs.labelling import find_labellings
from hearthlog.analyzer.logs.recorder_info import model_of
from hearthlog.analyzer.marks.marks import RANDOM, Mark, ReviewedSpan, write_marks
from hearthlog.analyzer.promotion import find_champion
from hearthlog.analyzer.promotion.comparison import gather_evidence
from hearthlog.analyzer.promotion.recent_time import recent_logs
from hearthlog.analyzer.review.spans import labelling_model
from hearthlog.analyzer.training.pseudo_labels import unreviewed_silence, unreviewed_sounds
from hearthlog.models.modelfile import load_model
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.schemas.frames import SAMPLE_RATE
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import find_logs, is_layer, relabel_path

SECOND = 10**9
START = 1_772_348_400 * SECOND
MODELS = {"kitchen": "one", "bath": "two"}
LATER = {"kitchen": 0, "bath": 240 * SECOND}  # the sound has three minutes


@pytest.fixture
def home(day, tmp_path, model_file, monkeypatch):
    """A home with a log of two microphones, in the current folder."""
    keep_models(tmp_path / "models", model_file)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HEARTHLOG_MODEL")
    sources = {name: FileSource([day], START + later) for name, later in LATER.items()}
    models = {name: file_of(name) for name in sources}
    return record_together(Path("logs"), sources, models, max_bag_duration=3600)


def file_of(microphone):
    return Path("models", f"{MODELS[microphone]}.safetensors")


def log_in(home):
    (log,) = (path for path in find_logs(home) if not is_layer(path))
    return log


def loudest(home, microphone):
    """Start, end and label of the longest sound that is not silence."""
    found = read_columns([log_in(home)], [f"/{microphone}/segment"])[f"/{microphone}/segment"]
    each = zip(found["header.stamp"], found["duration"], found["label"], strict=True)
    start, length, label = max((one for one in each if one[2] != "silence"), key=lambda one: one[1])
    return int(start), int(start + length), str(label)


def test_it_is_known_of_each_microphone_which_model_labels_it(home):
    for name, model in MODELS.items():
        wanted = model, load_model(file_of(name)).sha256
        assert model_of(log_in(home), name) == wanted
        assert wanted in find_home_logs([home]).latest_models()
        logs = find_labellings(log_in(home)).with_topic(f"/{name}/segment")
        assert labelling_model(logs, name, Path("models")).sha256 == wanted[1]


def test_a_layer_is_of_its_own_model_for_each_microphone(home, capfd):
    assert run(capfd, "relabel", home, "--model", file_of("bath")).returncode == 0
    layer = relabel_path(log_in(home), "two")
    assert {model_of(layer, name).model for name in MODELS} == {"two"}


def test_a_review_is_of_the_model_of_its_microphone(home):
    log = log_in(home)
    spans = [ReviewedSpan(name, *loudest(home, name)[:2]) for name in MODELS]
    write_marks(log, [], reviewed=spans)
    found = read_reviewed_labels(find_home_logs([home]), "live", 0, 1 << 62, [])
    assert {one.span.microphone: one.model for one in found} == {
        name: load_model(file_of(name)).sha256 for name in MODELS
    }


def test_what_nobody_looked_at_is_kept_of_each_microphone(home):
    model = load_model(file_of("kitchen"))
    names = {loudest(home, name)[2] for name in MODELS}
    sounds = unreviewed_sounds([home], model, names)
    silence = [one for part in unreviewed_silence([home], model) for one in part.recordings]
    for recordings in (sounds, silence):
        assert {one.span[0] >= START + LATER["bath"] for one in recordings} == {False, True}


def test_training_asks_for_a_base_and_then_learns_of_both_microphones(home, capfd):
    log = log_in(home)
    marks = [Mark(name, *loudest(home, name)) for name in MODELS]
    write_marks(log, marks, reviewed=[ReviewedSpan(*mark[:3]) for mark in marks])
    requested = run(capfd, "train", "--home", home)
    assert (requested.returncode, requested.stderr) == (
        2,
        "hearthlog: the latest logs were labelled by two and one: choose one with --base\n",
    )
    done = run(capfd, "train", "--home", home, "--base", file_of("kitchen"))
    assert done.returncode == 0, done.stderr
    assert "several microphones" not in done.stderr
    assert "comparing it with the current model" in done.stderr


def test_models_are_judged_by_what_each_microphone_heard_at_the_same_time(
    day, model_file, tmp_path
):
    noise = np.random.default_rng(5).standard_normal(180 * SAMPLE_RATE) / 3000
    soundfile.write(tmp_path / "night.wav", noise, SAMPLE_RATE)
    files = {"kitchen": tmp_path / "night.wav", "bath": day}
    sources = {name: FileSource([file], START) for name, file in files.items()}
    models = dict.fromkeys(files, model_file)
    home = record_together(tmp_path / "logs", sources, models, max_bag_duration=3600)
    recorded = loudest(home, "bath")
    spans = [ReviewedSpan(name, *recorded[:2], chosen=RANDOM) for name in files]
    write_marks(log_in(home), [], reviewed=spans)
    model = load_model(model_file)
    found = gather_evidence(model, model, recent_logs([home]))
    assert [each[:3] for each in (found.random, found.quiet)] == [(1, 1, 1), (1, 1, 1)]


@pytest.mark.parametrize("microphone", ["kitchen", "bath"])
def test_a_model_is_compared_with_the_one_that_it_was_adapted_from(home, microphone):
    Path("models", "champion.safetensors").unlink()
    labels_now = load_model(file_of(microphone))
    about = labels_now.description
    data = about.training_data.model_copy(update={"base_sha256": labels_now.sha256})
    adapted = replace(
        labels_now,
        description=about.model_copy(update={"training_data": data}),
        sha256="0" * 64,
    )
    champion = find_champion(Path("models"), [home], adapted)
    assert champion.sha256 == labels_now.sha256
