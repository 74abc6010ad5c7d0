"""A model that has never learned from a real sound says so wherever it is used."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from queue import SimpleQueue
from time import sleep

import pytest

from hearthlog.models.classifiers.model import SIMULATED, Amount, PublicCollection
from hearthlog.models.modelfile import load_model, save_model
from hearthlog.models.registry import override_judgement
from hearthlog.recorder.labelling.model_watch import ModelWatch

LINE = (
    "hearthlog: model {} was trained on simulated sounds only and is mostly wrong about real "
    "ones, whatever its confidence; train one from recordings\n"
)


@pytest.fixture
def simulated(second_file, tmp_path):
    """A model that has learned from made-up sounds alone."""
    return shutil.copy(second_file, tmp_path / "made_up.safetensors")


def other(model_file, path, **changes):
    """Save a model whose training data are said to be others."""
    model = load_model(model_file)
    data = model.description.training_data.model_copy(update=changes)
    about = model.description.model_copy(update={"training_data": data})
    save_model(replace(model, description=about), path)
    return load_model(path)


def test_the_recorder_says_that_a_model_knows_simulated_sounds_alone(
    hearthlog, simulated, day, tmp_path
):
    words = "record", day, "--start", "2026-03-01T07:00", "--model", simulated
    result = hearthlog(*words, "-o", tmp_path / "logs")
    assert (result.returncode, result.stderr) == (0, LINE.format("made_up"))


def test_its_card_and_the_list_of_models_say_so_too(hearthlog, simulated, model_file):
    folder = simulated.parent
    (folder / "real.safetensors").write_bytes(model_file.read_bytes())
    lines = hearthlog("models", "list", "--verbose", "--folder", folder).stdout.splitlines()
    made_up, real = (next(x for x in lines if name in x) for name in ("made_up", "real"))
    assert (" simulated " in made_up, " simulated " in real) == (True, False)
    entries = json.loads(hearthlog("models", "list", "--folder", folder, "--json").stdout)
    found = {one["name"]: one["simulated"] for one in entries if not one["starter"]}
    assert found == {"made_up": True, "real": False}
    for name, states in (("made_up", True), ("real", False)):
        card = hearthlog("models", "show", name, "--folder", folder).stdout
        assert ("Trained on simulated sounds only" in card) is states


def test_a_model_that_takes_the_place_of_another_is_looked_at_as_well(
    model_file, simulated, tmp_path, capfd
):
    link = tmp_path / "champion.safetensors"
    link.symlink_to(model_file)
    override_judgement(tmp_path, load_model(simulated).sha256)
    watch = ModelWatch(link, requested := SimpleQueue())
    link.unlink()
    link.symlink_to(simulated)
    requested.put(None)
    while watch.ready is None:  # else pytest ends it
        assert not list(watch.refusals())
        sleep(0.02)
    watch.close()
    assert LINE.format("made_up") in capfd.readouterr().err


@pytest.mark.parametrize(
    ("names", "segments", "simulated"),
    [
        ([SIMULATED], 0, True),
        ([SIMULATED, SIMULATED], 0, True),
        ([SIMULATED], 1, False),
        ([SIMULATED, "ESC-50"], 0, False),
        (["ESC-50"], 0, False),
        ([""], 0, False),
        ([], 0, False),
    ],
)
def test_one_real_sound_makes_a_model_another(model_file, tmp_path, names, segments, simulated):
    model = other(
        model_file,
        tmp_path / "other.safetensors",
        collections=[PublicCollection(name=name, licence="CC0", clips=1) for name in names],
        home={"speech": Amount(sources=segments, segments=segments, seconds=1.0)},
    )
    assert model.description.training_data.simulated is simulated


@pytest.mark.parametrize(("name", "simulated"), [("merged", True), ("adapted", False)])
def test_a_model_of_an_earlier_version_is_told_by_the_same(name, simulated):
    golden = Path(__file__).with_name("golden") / "0.1.0" / "models"
    model = load_model(golden / f"{name}.safetensors")
    assert model.description.training_data.simulated is simulated
