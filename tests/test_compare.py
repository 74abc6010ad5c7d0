"""Two models are compared on what neither has learned from, and only a clear difference is one."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from threading import Event as Flag

import numpy as np
import pytest
from log_fixtures import run
from model_folders import keep_models

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.evaluation.model_scores import compare_models, evaluate_model
from hearthlog.analyzer.marks.marks import Mark, MarkedSpan, read_marks, write_marks
from hearthlog.analyzer.training.adaptation import adapt_model
from hearthlog.analyzer.training.dataset import clip_recordings, cut_recordings
from hearthlog.analyzer.training.home_recordings import home_recordings
from hearthlog.analyzer.training.manifest import load_scenario, read_manifest, scenario_of
from hearthlog.models.modelfile import load_model, save_model
from hearthlog.recorder.config import Settings
from hearthlog.recorder.recording import record
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.schemas.logs.files import find_logs
from hearthlog.tools.home.simulate import write_day, write_training_set

OLD_MODEL = Path(__file__).parent / "golden/0.1.0/models/merged.safetensors"
SECOND = 1_000_000_000
DAY = 86_400 * SECOND
START = 1_772_348_400 * SECOND


@pytest.fixture
def folder(tmp_path, model_file):
    return keep_models(tmp_path / "models", model_file)


@pytest.fixture(scope="session")
def unheard(tmp_path_factory):
    """A manifest of clips that no model has learned from."""
    return write_training_set(tmp_path_factory.mktemp("unheard"), clips_per_class=4, seed=77)


@pytest.fixture(scope="session")
def days(tmp_path_factory):
    """Logs of three days, and beside them what is known to have happened."""
    folder = tmp_path_factory.mktemp("days")
    for number in range(3):
        sound = folder / f"{number}.flac"
        truth = write_day(sound, 1.5, seed=20 + number, manifest=None)
        start = START + number * DAY
        settings = Settings(output=folder / "logs")
        (log,) = record(settings, FileSource([sound], start), Flag()).logs
        marks = [
            Mark("mic", *(start + round(time * SECOND) for time in span[:2]), span[2])
            for span in truth.spans
        ]
        write_marks(log, marks)
    return folder / "logs"


def compare(folder, names, recordings):
    models = [load_model(folder / f"{name}.safetensors") for name in names]
    return compare_models(*models, recordings, scenario_of(models[0]))


def recorded(manifest):
    scenario = load_scenario("general")
    return clip_recordings(read_manifest(manifest, scenario.labels), scenario, lambda *_: None)


def test_a_model_that_guesses_is_clearly_worse(folder, unheard):
    found = compare(folder, ["one", "broad"], recorded(unheard))
    assert found.clear
    assert found.difference.macro_f1 < -0.3
    assert found.difference.interval[1] < 0
    mirrored = compare(folder, ["broad", "one"], recorded(unheard))
    assert mirrored.difference.macro_f1 == -found.difference.macro_f1
    np.testing.assert_allclose(
        mirrored.difference.interval[::-1], -np.array(found.difference.interval)
    )
    assert compare(folder, ["one", "broad"], recorded(unheard)) == found


def test_the_order_of_the_classes_changes_nothing(folder, unheard):
    scenario = load_scenario("general")
    turned = replace(scenario, classes=dict(reversed(scenario.classes.items())))
    models = [load_model(folder / f"{name}.safetensors") for name in ("one", "broad")]
    found = compare_models(*models, list(recorded(unheard)), turned)
    assert found.a.scores.classes == models[0].classes[::-1]
    straight = compare(folder, ["one", "broad"], recorded(unheard))
    assert found.difference.macro_f1 == pytest.approx(straight.difference.macro_f1)


def test_clips_of_other_names_are_those_of_the_classes(folder, unheard):
    other = unheard.with_name("other.csv")
    other.write_text(unheard.read_text().replace(",coughing,", ",Cough,"))
    found, same = (
        compare(folder, ["one", "broad"], recorded(manifest)) for manifest in (other, unheard)
    )
    assert found.b.scores == same.b.scores
    model, scenario = load_model(folder / "broad.safetensors"), load_scenario("general")
    one, two = (
        evaluate_model(model, read_manifest(manifest, scenario.labels), scenario, lambda *_: None)
        for manifest in (other, unheard)
    )
    assert (one.scores, one.detections) == (two.scores, two.detections)


def test_a_model_and_itself_do_not_differ(folder, unheard):
    found = compare(folder, ["one", "one"], recorded(unheard))
    assert (found.difference.macro_f1, found.clear) == (0.0, False)


def test_what_a_model_has_learned_from_is_left_out(folder, days):
    recordings = list(home_recordings(days))
    base = load_model(folder / "one.safetensors")
    first = [item for item in recordings if item.group == recordings[0].group]
    adapted = adapt_model(base, cut_recordings(first, scenario_of(base)))
    save_model(adapted, folder / "adapted.safetensors")
    found = compare(folder, ["one", "adapted"], recordings)
    assert (found.a.sources_learned, found.b.sources_learned) == (0, 1)
    assert (found.sources_left_out, found.held_out, found.a.scores.groups) == (1, True, 2)
    assert found.a.scores == compare(folder, ["one", "two"], recordings[len(first) :]).a.scores


def test_models_that_have_learned_from_everything_are_compared_with_a_warning(folder, days, capfd):
    recordings = list(home_recordings(days))
    base = load_model(folder / "one.safetensors")
    adapted = adapt_model(base, cut_recordings(recordings, scenario_of(base)))
    save_model(adapted, folder / "adapted.safetensors")
    result = run(capfd, "models", "compare", "one", "adapted", "--logs", days, "--folder", folder)
    assert result.returncode == 3
    assert result.stderr.count("\n") == 1
    assert "trained on every source" in result.stderr
    assert "says" not in result.stdout.splitlines()[1]
    assert "min" not in row_of("silence", result.stdout)[-1]


def test_the_champion_and_the_candidate_are_compared_on_reviewed_logs(folder, days, capfd):
    run(capfd, "models", "promote", "broad", "--to", "candidate", "--folder", folder)
    command = ("models", "compare", "--logs", days, "--folder", folder)
    result = run(capfd, *command)
    assert (result.returncode, result.stderr) == (0, "")
    assert result.stdout.splitlines()[-1].startswith("one is better than broad: ")
    found = json.loads(run(capfd, *command, "--json").stdout)
    assert found["clear"] is True
    assert found["difference"]["interval"][0] <= found["difference"]["macro_f1"] < 0
    assert found["a"]["scores"]["groups"] == 3
    assert (found["a"]["name"], found["b"]["name"]) == ("one", "broad")


def keep_deaf(folder):
    one = load_model(folder / "one.safetensors")
    changes = {"gate": 0.0, "decision_bias": {"silence": -30.0}}
    deaf = replace(one, description=one.description.model_copy(update=changes))
    save_model(deaf, folder / "deaf.safetensors")


def row_of(name, text):
    return next(line for line in text.splitlines() if line.startswith(name)).split("  ")


def test_silence_has_a_row_though_nobody_marked_it(folder, days, tmp_path, capfd):
    logs = tmp_path / "logs"
    shutil.copytree(days, logs)
    for log in find_logs(logs):
        silent = [mark for mark in read_marks(log) if mark.label == "silence"]
        write_marks(log, [], deleted=[MarkedSpan(*mark[:3]) for mark in silent])
    keep_deaf(folder)
    command = ("models", "compare", "one", "deaf", "--logs", logs, "--folder", folder)
    *_, before, after = row_of("silence", run(capfd, *command).stdout)
    assert (before.strip() != "0.0 min", after.strip()) == (True, "0.0 min")
    output = json.loads(run(capfd, *command, "--json").stdout)["said"]
    assert output["silence"][0] > 0.1
    assert output["silence"][1] == 0


def test_without_marks_it_is_said_how_much_of_a_day_each_class_has(folder, days, tmp_path, capfd):
    logs = tmp_path / "logs"
    shutil.copytree(days, logs)
    for layer in logs.rglob("*.review.mcap"):
        layer.unlink()
    keep_deaf(folder)
    done = run(capfd, "models", "compare", "one", "deaf", "--logs", logs, "--folder", folder)
    assert done.returncode == 0
    assert "there are no marks" in done.stderr
    assert row_of("silence", done.stdout)[-1].strip() == "0.0 min"


def test_of_clips_it_is_said_how_many_each_model_gives_to_a_class(folder, unheard, capfd):
    keep_deaf(folder)
    command = ("models", "compare", "one", "deaf", "--data", unheard, "--folder", folder)
    *_, before, after = row_of("silence", run(capfd, *command).stdout)
    assert (before.strip() != "0.0%", after.strip()) == (True, "0.0%")


def test_one_source_tells_no_difference(folder, days, capfd):
    log = min(days.rglob("*Z.mcap"))
    result = run(capfd, "models", "compare", "one", "broad", "--logs", log, "--folder", folder)
    assert result.returncode == 0
    assert "one source cannot show a clear difference" in result.stdout


def test_what_cannot_be_compared_is_an_error_of_one_line(folder, days, unheard, tmp_path, capfd):
    def refusal(*arguments):
        result = run(capfd, "models", "compare", *arguments, "--folder", folder)
        assert (result.returncode, result.stderr.count("\n")) == (1, 1)
        return result.stderr

    assert "there is no candidate" in refusal("--logs", days)
    assert "does not fit" in refusal("one", "two", "--data", unheard, "--scenario", "bathroom")
    assert "no log" in refusal("one", "two", "--logs", tmp_path)
    shutil.copy(OLD_MODEL, folder / "old.safetensors")
    unlike = "one is for feature set home33, old for auros21: they cannot be compared"
    assert unlike in refusal("one", "old", "--logs", days)
    assert unlike in refusal("one", "old", "--data", unheard)
    with pytest.raises(DataError, match="no segment"):
        compare(folder, ["one", "two"], [])
    assert run(capfd, "models", "compare", "one", "two", "--folder", folder).returncode == 2
