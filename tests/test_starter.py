"""The models that come with hearthlog."""

import csv
import os
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile
from conftest import HEARTHLOG

from hearthlog.analyzer.training.manifest import LABELS, read_manifest
from hearthlog.models.classifiers.model import PublicCollection, may_be_shipped
from hearthlog.models.embedding import read_projection
from hearthlog.models.embedding.networks import YAMNET
from hearthlog.models.modelfile import load_model, model_card
from hearthlog.models.starter import (
    BY_FEATURES,
    GENERAL,
    NETWORK,
    STARTERS,
    starter_file,
    with_network,
)
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import find_logs


@pytest.fixture
def record(tmp_path):
    """Record in an empty folder, where nothing is configured."""
    soundfile.write(tmp_path / "hum.wav", np.full(48_000, 0.01, np.float32), 16_000)
    env = {name: value for name, value in os.environ.items() if name != "HEARTHLOG_MODEL"}

    def run(*arguments, **variables):
        return subprocess.run(
            [*HEARTHLOG, "record", "hum.wav", *map(str, arguments)],
            cwd=tmp_path,
            env=env | variables,
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )

    return run


def model_of(folder):
    (log,) = find_logs(folder)
    return read_columns([log], ["/mic/info"])["/mic/info"]["model"].tolist()


@pytest.mark.fast
@pytest.mark.parametrize(
    ("licence", "allowed"),
    [
        ("CC0", True),
        ("CC0 1.0", True),
        ("Public domain", True),
        ("CC BY 3.0 (repo README; per-clip credits there)", True),
        ("CC-BY-SA 4.0", True),
        ("cc by-sa 3.0", True),
        ("ODbL 1.0 / DbCL", True),
        ("Apache-2.0 file in repo; clips are from Freesound / own recordings", True),
        ("", False),
        ("unstated", False),
        ("MIT (repo); clip provenance unstated", False),
        ("CC BY-NC 4.0", False),
        ("CC BY-NC-SA 3.0", False),
        ("CC BY-ND 4.0", False),
        ("CC (per-file .txt: BY / BY-NC / public domain)", False),
        ("Apache-2.0 (repo); broadcast/commercial excerpts", False),
        ("GPL-3.0", False),
        ('sounds: "Personal Use"', False),
    ],
)
def test_a_licence_says_whether_a_model_may_be_shipped(licence, allowed):
    assert may_be_shipped(licence) == allowed


@pytest.mark.fast
def test_the_starters_together_take_less_than_6_mb():
    assert sum(starter_file(name).stat().st_size for name in STARTERS) < 6_000_000


@pytest.mark.fast
@pytest.mark.parametrize("name", STARTERS)
def test_a_starter_has_learned_only_from_what_may_be_shipped(name):
    model = load_model(Path(name))
    collections = model.description.training_data.collections
    assert len(collections) > 5
    assert [one for one in collections if not may_be_shipped(one.licence)] == []
    assert model.description.scenario_name == name.removesuffix("-embedding")
    assert "Do not pass on" not in model_card(model)


@pytest.mark.fast
def test_a_card_names_the_licences_that_forbid_passing_the_model_on():
    model = load_model(Path("general"))
    learned = [PublicCollection(name="esc50", licence="CC BY-NC 3.0", clips=3)]
    data = model.description.training_data.model_copy(update={"collections": learned})
    described = model.description.model_copy(update={"training_data": data})
    card = model_card(replace(model, description=described))
    assert "Do not pass on without permission" in card
    assert "- esc50 (CC BY-NC 3.0)\n" in card


@pytest.mark.fast
@pytest.mark.parametrize("name", [one for one in STARTERS if one != with_network(GENERAL)])
def test_a_starter_says_how_good_it_is_in_collections_that_were_left_out(name):
    elsewhere = load_model(Path(name)).description.elsewhere
    assert elsewhere.collections > 5
    assert elsewhere.expected_calibration_error < 0.1
    low, high = elsewhere.macro_f1_interval
    assert low < elsewhere.macro_f1 < high
    assert len(elsewhere.classes) >= 3


@pytest.mark.fast
@pytest.mark.parametrize("name", STARTERS)
def test_who_made_the_recordings_is_told_beside_the_starters(name):
    file = "README.md" if name in BY_FEATURES else "README-embedding.md"
    page = starter_file(name).with_name(file).read_text()
    model = load_model(Path(name))
    assert model_card(model) in page
    for one in model.description.training_data.collections:
        assert one.name in page


@pytest.mark.fast
@pytest.mark.parametrize("name", [*map(with_network, BY_FEATURES)])
def test_a_starter_for_a_network_takes_what_is_logged_of_it(name):
    projection = read_projection(YAMNET.projection)
    mix = load_model(Path(name)).description.embedding
    assert mix.network == NETWORK == YAMNET.name
    assert mix.projection_sha256 == projection.sha256
    assert mix.values == len(projection.names)
    assert starter_file(name).stat().st_size < 1_000_000


def test_without_a_model_the_general_starter_labels_and_says_so(record, tmp_path):
    done = record("-o", "logs")
    assert done.returncode == 0
    by = "by features alone, as no network is wanted"
    assert f"starter model general, not trained on this home: {by}" in done.stderr
    assert model_of(tmp_path / "logs") == ["general"]


def test_the_champion_of_the_folder_of_models_labels_where_there_is_one(
    record, model_file, tmp_path
):
    (tmp_path / "models").mkdir()
    (tmp_path / "models" / "champion.safetensors").write_bytes(model_file.read_bytes())
    done = record("-o", "logs")
    assert "starter" not in done.stderr
    assert model_of(tmp_path / "logs") == ["champion"]


def test_a_champion_that_is_gone_is_missed(record, tmp_path):
    (tmp_path / "models").mkdir()
    (tmp_path / "models" / "champion.safetensors").symlink_to("home-1.safetensors")
    done = record("-o", "logs")
    assert "models/champion.safetensors: the model that it points to is gone" in done.stderr
    assert model_of(tmp_path / "logs") == ["general"]


def test_a_starter_is_taken_by_its_name(record, tmp_path):
    assert record("-o", "logs", "--model", "bathroom").returncode == 0
    assert model_of(tmp_path / "logs") == ["bathroom"]


def test_no_model_can_be_asked_for(record, tmp_path):
    start = "--start", "2026-03-01T07:00"
    assert record("-o", "a", *start, "--model", "none").stderr == ""
    assert record("-o", "b", *start, HEARTHLOG_MODEL="none").stderr == ""
    assert model_of(tmp_path / "a") == model_of(tmp_path / "b") == [""]


def test_an_installation_without_its_starters_says_so(monkeypatch, tmp_path):
    monkeypatch.setattr("hearthlog.models.starter.__file__", str(tmp_path / "__init__.py"))
    with pytest.raises(Exception, match="lacks its starter models"):
        load_model(Path("general"))


def test_the_card_of_a_starter_is_shown_without_a_folder_of_models(hearthlog, tmp_path):
    shown = hearthlog("models", "show", "general", "--folder", tmp_path / "none")
    assert shown.stdout.startswith("# Model general")
    assert "In collections of which nothing was learned" in shown.stdout


@pytest.mark.fast
def test_what_was_learned_from_is_listed_with_its_credits(tmp_path):
    manifest = Path(__file__).parent / "data" / "household" / "manifest.csv"
    clips = read_manifest(manifest, LABELS)[:5]
    lab = pytest.importorskip("hearthlog.tools.lab.starter", reason="the wheel leaves the lab out")
    lab._write_sources(tmp_path / "sources.csv", [manifest], clips)
    with (tmp_path / "sources.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["path"] for row in rows] == [
        f"covid19-cough/dataset/coughing/{clip.path.name}" for clip in clips
    ]
    assert {row["licence"] for row in rows} == {"CC0"}


@pytest.mark.fast
@pytest.mark.parametrize("name", ["sources.csv", "sources-embedding.csv"])
def test_the_sources_of_the_starters_are_named_without_places_on_a_disk(name):
    lines = starter_file("general").with_name(name).read_text().splitlines()
    assert len(lines) > 500
    assert not [line for line in lines if ".." in line.split(",")[0] or line.startswith("/")]
