"""A folder of models always has a champion that can be used, whatever happens to who changes it."""

import json
import random
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from log_fixtures import run
from model_folders import keep_models, put_by_hand

from hearthlog.models.modelfile import load_model, model_card, save_model
from hearthlog.models.registry import (
    first_starter,
    list_models,
    load,
    promote,
    read_judgement,
    rollback,
    target,
)
from hearthlog.models.starter import STARTERS
from hearthlog.schemas.errors import ModelError


@pytest.fixture
def folder(tmp_path, model_file):
    return keep_models(tmp_path / "models", model_file)


def champion(folder):
    return load_model(folder / "champion.safetensors").name


def test_a_model_that_is_loaded_by_an_alias_has_the_name_of_its_file(folder):
    assert load_model(folder / "champion.safetensors").name == "one"


def test_a_promoted_model_is_the_champion_and_the_one_before_comes_back(folder):
    model, before = promote(folder, "two")
    assert (model.name, before, champion(folder)) == ("two", "one", "two")
    promote(folder, "broad")
    assert [rollback(folder)[0].name for _ in range(2)] == ["two", "one"]
    assert champion(folder) == "one"
    assert rollback(folder)[0].name == "general"  # by which a recorder labels without a champion
    with pytest.raises(ModelError, match="no champion before general"):
        rollback(folder)


def test_promoting_the_champion_changes_nothing(folder):
    promote(folder, "two")
    assert promote(folder, "two")[1] == "two"
    assert rollback(folder)[0].name == "one"


def test_the_candidate_is_promoted_by_its_alias(folder):
    promote(folder, "two", "candidate")
    assert champion(folder) == "one"
    assert promote(folder, "candidate")[0].name == "two"
    assert champion(folder) == "two"


def test_a_model_that_cannot_be_used_is_not_promoted(folder):
    (folder / "bad.safetensors").write_bytes(b"garbage")
    for name in ("bad", "nowhere", "../models/two", "candidate"):
        with pytest.raises(ModelError):
            promote(folder, name)
    assert champion(folder) == "one"


def test_rollback_passes_over_champions_that_cannot_be_used(folder):
    promote(folder, "two")
    promote(folder, "broad")
    (folder / "two.safetensors").unlink()
    assert rollback(folder)[0].name == "one"


def test_a_champion_that_leads_nowhere_can_be_replaced(folder):
    put_by_hand(folder, "nowhere.safetensors")
    assert promote(folder, "two")[1] == "nowhere"
    assert champion(folder) == "two"


def test_a_file_that_is_called_champion_is_never_replaced(folder):
    link = folder / "champion.safetensors"
    data = (folder / "one.safetensors").read_bytes()
    link.unlink()
    link.write_bytes(data)
    with pytest.raises(ModelError, match="is no link"):
        promote(folder, "two")
    assert not link.is_symlink()
    assert link.read_bytes() == data


@pytest.mark.parametrize("text", ["champion.safetensors", "/etc/passwd", "../one.safetensors"])
def test_a_link_to_itself_or_out_of_the_folder_is_refused(folder, text):
    put_by_hand(folder, text)
    with pytest.raises(ModelError, match="is no link"):
        target(folder, "champion")
    with pytest.raises(ModelError):
        load_model(folder / "champion.safetensors")


def test_the_list_has_every_file_and_what_is_wrong_with_it(folder):
    (folder / "bad.safetensors").write_bytes(b"garbage")
    promote(folder, "two", "candidate")
    put_by_hand(folder, "gone.safetensors")
    found = {entry.name: entry for entry in list_models(folder)}
    assert list(found) == ["bad", "broad", "gone", "one", "two", *STARTERS]
    assert [name for name, entry in found.items() if entry.starter] == list(STARTERS)
    assert found["gone"].aliases == ("champion",)
    assert found["two"].aliases == ("candidate",)
    assert {name for name, entry in found.items() if entry.model is None} == {"bad", "gone"}
    assert "no such model file" in found["gone"].problem
    assert found["one"].size == (folder / "one.safetensors").stat().st_size


PROMOTING = """
import sys
from itertools import cycle
from pathlib import Path
from hearthlog.models.registry import promote, rollback
folder = Path(sys.argv[1])
for number, name in enumerate(cycle(["two", "broad", "one"])):
    promote(folder, name)
    if number % 4 == 3:
        rollback(folder)
    print(name, flush=True)
"""


def test_killed_at_any_moment_of_a_promotion_there_is_a_champion_and_one_before(folder):
    rng = random.Random(5)
    for _ in range(10):
        command = [sys.executable, "-c", PROMOTING, str(folder)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            for _ in range(5):
                assert process.stdout.readline()
            end = time.monotonic() + rng.uniform(0.05, 0.3)
            while time.monotonic() < end:
                assert (folder / "champion.safetensors").exists()  # at every moment
            process.kill()
        before = champion(folder)
        assert before in {"one", "two", "broad"}
        lines = (folder / "history").read_text().splitlines()
        assert set(lines) <= {"one", "two", "broad"}
        assert len(lines) <= 100
        assert rollback(folder)[0].name != before
    promote(folder, "two")
    assert not [path.name for path in folder.iterdir() if path.name.startswith(".champion")]


def test_models_are_listed_as_a_table_and_as_json(folder, capfd):
    result = run(capfd, "models", "list", "--folder", folder)
    assert (result.returncode, result.stderr) == (0, "")
    head, *rows = result.stdout.splitlines()
    assert head.split() == ["name", "alias", "network", "classes", "macro", "F1"]
    assert [row.split()[0] for row in rows if row[0] != " "] == ["broad", "one", "two", *STARTERS]
    assert "talking, music, telephone ringing" in " ".join(result.stdout.split())
    result = run(capfd, "models", "list", "--verbose", "--folder", folder)
    head, *rows = result.stdout.splitlines()
    assert head.split()[-6:] == ["macro", "F1", "inputs", "ECE", "sha256", "MB"]
    rows = [row for row in rows if row[0] != " "]  # classes go on in the next line
    assert [row.split()[0] for row in rows] == ["broad", "one", "two", *STARTERS]
    assert rows[3].split()[1] == "starter"
    assert "champion" in rows[1]
    assert load(folder, "one").sha256[:12] in rows[1]
    (folder / "bad.safetensors").write_bytes(b"garbage")
    result = run(capfd, "models", "list", "--json", "--folder", folder)
    assert result.returncode == 3
    assert result.stderr.count("\n") == 1
    found = {entry["name"]: entry for entry in json.loads(result.stdout)}
    assert found["one"]["aliases"] == ["champion"]
    assert found["bad"]["problem"] in result.stderr


def test_a_model_is_shown_by_its_card(folder, capfd):
    result = run(capfd, "models", "show", "champion", "--folder", folder)
    assert result.stdout == model_card(load(folder, "one"))
    result = run(capfd, "models", "show", "one", "--json", "--folder", folder)
    assert json.loads(result.stdout)["sha256"] == load(folder, "one").sha256


def test_promotion_and_rollback_say_what_was_done(folder, capfd):
    command = ("models", "promote", "two", "--folder", folder, "--anyway")
    short = load(folder, "two").sha256[:12]
    assert run(capfd, *command).stdout == f"two ({short}) is the champion, after one\n"
    assert run(capfd, *command).stdout == "two is the champion already\n"
    output = run(capfd, "models", "rollback", "--folder", folder).stdout
    assert output == f"one ({load(folder, 'one').sha256[:12]}) is champion again, after two\n"
    output = run(capfd, "models", "rollback", "--folder", folder).stdout
    assert output.startswith("general (")
    assert output.endswith(") is champion again, after one\n")
    result = run(capfd, "models", "rollback", "--folder", folder)
    assert (result.returncode, result.stderr.count("\n")) == (1, 1)


def adapted_from(folder, name, base):
    """Put a model into the folder that was adapted from another one."""
    one = load(folder, "one")
    training = one.description.training_data.model_copy(update={"base_sha256": base.sha256})
    about = one.description.model_copy(update={"training_data": training})
    save_model(replace(one, description=about), folder / f"{name}.safetensors")
    return load(folder, name)


def test_before_the_first_champion_there_was_the_starter_that_it_comes_from(folder):
    (folder / "history").unlink(missing_ok=True)
    bathroom = load_model(Path("bathroom"))
    home = adapted_from(folder, "home-1", bathroom)
    adapted_from(folder, "home-2", home)
    put_by_hand(folder, "home-2.safetensors")
    assert first_starter(folder) == "bathroom"
    model, before = rollback(folder)
    assert (model.name, model.sha256, before) == ("bathroom", bathroom.sha256, "home-2")
    assert champion(folder) == "bathroom"
    assert load_model(folder / "champion.safetensors").sha256 == bathroom.sha256
    assert read_judgement(folder, bathroom.sha256).may_label
    promote(folder, "one")
    assert [rollback(folder)[0].name for _ in range(2)] == ["bathroom", "general"]


def test_a_starter_is_promoted_unless_a_file_of_the_folder_has_its_name(folder, capfd):
    general = load_model(Path("general"))
    done = run(capfd, "models", "promote", "general", "--folder", folder)
    assert done.stdout == f"general ({general.sha256[:12]}) is the champion, after one\n"
    assert rollback(folder)[0].name == "one"
    shutil.copy(folder / "two.safetensors", folder / "bathroom.safetensors")
    assert promote(folder, "bathroom")[0].sha256 == load(folder, "two").sha256
    (folder / "general.safetensors").unlink()
    put_by_hand(folder, "general.safetensors")
    with pytest.raises(ModelError, match="no such model file"):
        load(folder, "champion")


def test_the_folder_is_that_of_the_configured_model(folder, capfd, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert run(capfd, "models", "show", "two").returncode == 0
    monkeypatch.chdir("/")
    result = run(capfd, "models", "list")
    assert result.stderr.startswith("hearthlog: models: no such folder")
    assert [line.split()[0] for line in result.stdout.splitlines()[1:]] == list(STARTERS)
    monkeypatch.setenv("HEARTHLOG_MODEL", str(folder / "champion.safetensors"))
    assert run(capfd, "models", "show", "two").returncode == 0


def test_a_starter_is_promoted_where_there_is_no_folder_yet(tmp_path, capfd):
    folder = tmp_path / "models"
    for name in ("bathroom", "general"):
        done = run(capfd, "models", "promote", name, "--folder", folder, "--anyway")
        assert (done.returncode, champion(folder)) == (0, name)
    assert oct(folder.stat().st_mode)[-3:] == "700"
    assert oct((folder / "history").stat().st_mode)[-3:] == "600"
    with pytest.raises(ModelError, match="no such folder"):
        promote(tmp_path / "nowhere", "two")
    assert not (tmp_path / "nowhere").exists()
    with pytest.raises(ModelError, match="history"):
        list_models(folder / "history")
    with pytest.raises(ModelError, match="history"):
        promote(folder / "history", "general")


def test_what_is_called_as_a_starter_is_not_returned_to_unjudged(folder):
    (folder / "history").unlink(missing_ok=True)
    other = adapted_from(folder, "general", load(folder, "two"))
    with pytest.raises(ModelError, match=r"general\.safetensors: is not the starter"):
        rollback(folder)
    assert champion(folder) == "one"
    assert read_judgement(folder, other.sha256) is None


def test_a_history_that_cannot_be_written_is_refused_in_one_line(folder):
    (folder / "history").mkdir()
    with pytest.raises(ModelError, match=r"history: cannot be written"):
        promote(folder, "two")
    assert champion(folder) == "one"


def test_a_folder_that_cannot_be_written_is_refused_in_one_line(folder):
    (folder / ".champion.safetensors.tmp").mkdir()
    with pytest.raises(ModelError, match="cannot be written"):
        promote(folder, "two")
    assert champion(folder) == "one"
