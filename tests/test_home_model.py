"""A home's model is made of the one that labelled its latest log, without naming files."""

import shutil
from pathlib import Path

import pytest
from log_fixtures import run
from model_folders import keep_models

from hearthlog.models import modelfile, starter
from hearthlog.models.modelfile import load_model
from hearthlog.models.registry import promote
from hearthlog.schemas.logs.files import find_logs


@pytest.fixture
def place(tmp_path, model_file, day, monkeypatch, capfd):
    """The current folder: with models, logs by the champion `one`, and marks."""
    keep_models(tmp_path / "models", model_file)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HEARTHLOG_MODEL")
    recorded(capfd, day, "07:00")
    run(capfd, "export", "logs", "-o", "labels.txt", "--topics", "/mic/segment")
    assert run(capfd, "annotate", "import", "logs", "labels.txt").returncode == 0
    return tmp_path


def recorded(capfd, day, time, *options):
    done = run(capfd, "record", day, "--start", f"2026-03-01T{time}", *options)
    assert done.returncode == 0, done.stderr


def trained(capfd, *options):
    return run(capfd, "train", "--home", "logs", *options)


def base_of(name):
    return load_model(Path("models", f"{name}.safetensors")).description.training_data.base_sha256


def sha256_of(name):
    return load_model(Path("models", f"{name}.safetensors")).sha256


@pytest.mark.usefixtures("place")
def test_the_models_of_a_home_are_numbered_and_it_is_said_how_one_labels(capfd):
    for number in (1, 2):
        done = trained(capfd)
        assert done.returncode == 0, done.stderr
        assert "adapting one, which labelled the latest log" in done.stderr
        assert f"`hearthlog models promote home-{number}" in done.stdout.splitlines()[-1]
        assert base_of(f"home-{number}") == sha256_of("one")


@pytest.mark.usefixtures("place")
def test_of_logs_by_two_models_the_latest_counts(capfd, day):
    promote(Path("models"), "two")
    recorded(capfd, day, "08:00")
    done = trained(capfd)
    assert "adapting two, which labelled the latest log" in done.stderr
    assert base_of("home-1") == sha256_of("two")


@pytest.mark.usefixtures("place")
def test_if_the_recorders_of_a_home_have_different_models_one_is_to_be_chosen(capfd, day):
    promote(Path("models"), "two")
    recorded(capfd, day, "08:00", "--node", "bath")
    done = trained(capfd)
    assert (done.returncode, done.stderr) == (
        2,
        "hearthlog: the latest logs were labelled by one and two: choose one with --base\n",
    )
    assert trained(capfd, "--base", "models/one.safetensors").returncode == 0
    assert base_of("home-1") == sha256_of("one")


@pytest.mark.usefixtures("place")
def test_a_model_that_is_gone_is_named(capfd):
    for name in ("champion", "one"):
        Path("models", f"{name}.safetensors").unlink()
    done = trained(capfd)
    assert done.returncode == 2
    assert "the latest log was labelled by one (" in done.stderr
    assert done.stderr.endswith("name its file with --base\n")
    assert done.stderr.count("\n") == 1


@pytest.mark.usefixtures("place")
def test_a_log_without_labels_is_adapted_to_from_a_model_that_is_named(capfd, day):
    shutil.rmtree("logs")
    recorded(capfd, day, "07:00", "--model", "none")
    done = trained(capfd)
    assert done.returncode == 2
    assert done.stderr.startswith("hearthlog: the latest log has no labels: name a model with --")
    assert not list(Path("models").glob("home-*"))
    assert find_logs(Path("logs"))


def test_a_starter_whose_file_is_gone_and_a_name_of_none_are_one_line(
    day, tmp_path, monkeypatch, capfd
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HEARTHLOG_MODEL")
    unknown = run(capfd, "record", day, "--model", "generall")
    names = "the starter models are general and bathroom"
    assert unknown.returncode == 1
    assert unknown.stderr == f"hearthlog: generall: there is no such model file; {names}\n"
    for module in (starter, modelfile):
        monkeypatch.setattr(module, "starter_file", lambda name: tmp_path / name / "gone")
    gone = run(capfd, "record", day)
    assert gone.returncode == 1
    assert gone.stderr.startswith("hearthlog: general: this installation of hearthlog lacks its ")
    assert gone.stderr.endswith("install it again, or name a model file\n")
    assert gone.stderr.count("\n") == 1
    assert not list(tmp_path.rglob("*.mcap*"))
