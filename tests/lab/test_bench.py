"""The benchmark runs to its end on a little sound; how fast is not for a test to say."""

import json
import math
import os
import re
import subprocess
import sys
from importlib import import_module
from unittest.mock import patch

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

pytest.importorskip("hearthlog.tools.lab.bench", reason="the wheel leaves the benchmarks out")

from hearthlog.models.modelfile import load_model
from hearthlog.models.starter import GENERAL, starter_file
from hearthlog.schemas.frames import FRAME_SAMPLES, NANOSECONDS, SAMPLE_RATE
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.tools.home.clips import SHIPPED
from hearthlog.tools.home.simulate import write_training_set
from hearthlog.tools.lab import queue
from hearthlog.tools.lab.bench import (
    check,
    features,
    history,
    inference,
    reading,
    relabel,
    timing,
    workload,
    writing,
)
from hearthlog.tools.lab.bench.hours import KINDS
from hearthlog.tools.lab.bench.labmic import make_microphone
from hearthlog.tools.lab.bench.table import Row, Table, Target
from hearthlog.tools.lab.bench.workload import Workload


def bench(*arguments):
    with patch.dict(os.environ):  # which the command sets for processes of one core
        module = import_module("hearthlog.tools.lab.bench.__main__")
        app = typer.Typer()
        app.command()(module.bench)
        return CliRunner().invoke(app, [*map(str, arguments)])


@pytest.fixture(autouse=True)
def short_turns(monkeypatch):
    """Everything is measured once: how fast it is, is not asked."""
    monkeypatch.setattr(timing, "_TURN_SECONDS", 1e-6)
    monkeypatch.setattr(check, "_TURN_SECONDS", 1e-6)
    monkeypatch.setattr(check, "_TURNS", 1)


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    """Half a minute of sound, a model of few clips, and two minutes that stand for a day."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(workload, "_DAY", 120)
        small = Workload(tmp_path_factory.mktemp("work"), minutes=0.5, clips_per_class=3)
        assert small.day
        assert small.completed_day
        assert all(map(small.day_of, KINDS))
    return small


def figures(output):
    """The measured column of printed tables, by what stands before it."""
    lines = [line.split("  ") for line in output.splitlines() if line.startswith("  ")]
    cells = [[cell.strip() for cell in line if cell.strip()] for line in lines]
    return {row[0]: float(row[1].replace(",", "")) for row in cells if row[0] != "measured"}


@pytest.fixture(scope="module")
def run_of_folder(tmp_path_factory):
    """What is printed of a folder of recordings, and the file that the run is appended to."""
    folder = tmp_path_factory.mktemp("run")
    write_training_set(folder / "sound", 3, seed=1)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(check, "measure_ratios", lambda work: {"minutes": work.minutes})
        sound, runs = folder / "sound", folder / "runs.jsonl"
        done = bench("size", "recording", "--audio", sound, "--record", runs)
    assert done.exit_code == 0, done.output
    return done.stdout, runs


def test_recordings_of_a_folder_are_recorded_and_the_log_is_accounted_for_byte_by_byte(
    run_of_folder,
):
    found = figures(run_of_folder[0])
    assert all(math.isfinite(value) and value > 0 for value in found.values())
    parts = sum(value for name, value in found.items() if name.startswith("/"))
    parts += found["index of messages"] + found["the rest"]
    assert parts == pytest.approx(found["the whole log"], rel=0.01)
    assert {"/mic/features", "/mic/statistics", "/mic/label", "hearthlog record"} <= set(found)


def test_every_peer_that_is_installed_gets_a_speed_and_a_ratio(tmp_path):
    rows = features.measure(Workload(tmp_path, minutes=0.1)).rows
    assert len(rows) == 8
    assert all(math.isfinite(row.value) and row.value > 0 for row in rows)
    assert rows[5].ratio == pytest.approx(rows[0].value / rows[5].value)


def test_a_peer_that_is_missing_is_named_and_the_others_are_measured(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "opensmile", None)
    rows = {
        row.what.split()[0]: row for row in features.measure(Workload(tmp_path, minutes=0.1)).rows
    }
    assert rows["opensmile"].value is None
    assert rows["opensmile"].note.startswith("not installed")
    assert rows["librosa"].value > 0


def test_the_simulated_sound_comes_in_whole_frames(tmp_path):
    work = Workload(tmp_path, minutes=0.0501)
    assert len(work.samples) == 3 * SAMPLE_RATE
    assert work.frames(1.0).shape == (SAMPLE_RATE // FRAME_SAMPLES, FRAME_SAMPLES)


def test_without_a_compiler_there_is_no_microphone_and_the_reason_is_said(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(timing.BenchError, match=r"no microphone to record: gcc, .*missing"):
        make_microphone(tmp_path, np.zeros(SAMPLE_RATE, np.int16))


@pytest.mark.parametrize(
    ("row", "verdict"),
    [
        (Row("", 3.0, target=Target(2.0)), "met"),
        (Row("", 1.0, target=Target(2.0)), "MISSED"),
        (Row("", 3.0, target=Target(2.0, at_most=True)), "MISSED"),
        (Row("", 3.0, ratio=1.0, target=Target(2.0)), "MISSED"),
        (Row("", None, target=Target(2.0)), ""),
        (Row("", 3.0), ""),
    ],
)
def test_a_missed_target_is_said(row, verdict):
    assert row.verdict == verdict
    assert verdict in str(Table("", [row]))


def test_an_unknown_measurement_is_refused_and_the_known_ones_are_listed():
    done = bench("speed")
    assert done.exit_code == 2
    words = " ".join(done.stderr.replace("│", " ").split())  # of a panel
    assert "features, embedding, recording, live, bridge" in words


def test_where_no_viewer_runs_the_others_are_measured_and_the_end_says_what_is_missing(
    tmp_path, monkeypatch
):
    write_training_set(tmp_path, 3, seed=1)
    nothing_to_draw_with = {"WGPU_BACKEND": "vulkan", "VK_DRIVER_FILES": "/none"}
    for name, value in (nothing_to_draw_with | {"VK_ICD_FILENAMES": "/none"}).items():
        monkeypatch.setenv(name, value)
    done = bench("review", "size", "--audio", tmp_path)
    assert done.exit_code == 3, done.output
    tables = done.stdout.split("\n\n")
    day = next(line for line in tables[0].splitlines() if line.startswith("  a day "))
    assert re.search(r" - .*Rerun's viewer does not run here", day)
    assert figures(tables[1])["the whole log"] > 0
    assert done.stderr.splitlines()[-1] == (
        "hearthlog bench: not measured: a day (review); a month, a sample of it (review)"
    )


def test_a_folder_without_sound_is_one_clear_line(tmp_path):
    command = [sys.executable, "-m", "hearthlog.tools.lab.bench", "features", "--audio", tmp_path]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].endswith(
        "holds no second of sound in files *.flac or *.wav"
    )
    assert "Traceback" not in done.stderr


def test_the_readers_agree_and_each_gets_a_time_and_a_ratio(work):
    rows = reading.measure(work).rows
    assert all(math.isfinite(row.value) and row.value >= 0 for row in rows)
    assert sum(row.ratio is not None for row in rows) == 6
    assert all(row.elapsed > 0 for row in rows if row.unit in {"s", "ms"})


def test_days_of_each_kind_of_sound_and_hours_are_relabelled(work):
    table = relabel.measure(work)
    assert table.title.startswith("relabel: days of 2,3")
    assert all(math.isfinite(row.value) and row.value > 0 for row in table.rows)
    assert [row.what.split(",")[0] for row in table.rows[:3]] == list(KINDS)


def test_models_that_homes_have_are_measured_on_the_same_features(work):
    rows = {row.what: row for row in inference.measure(work).rows}
    names = "simulated", "adapted", "starter"
    adapted, starter = (rows[f"{name}: 600 frames labelled"].note for name in names[1:])
    assert int(adapted.split()[0]) > int(rows["simulated: 600 frames labelled"].note.split()[0])
    assert starter.endswith("landmarks, 8 classes")
    assert all(0 < rows[f"{name}: its file"].value < 1000 for name in names)


def test_logs_are_measured_in_the_states_in_which_the_live_recorder_leaves_them(work):
    read = {}
    for state, log in work.live._asdict().items():
        with LogFile(log) as file:
            assert file.complete == (state != "unfinished")
            spans = (file.chunks["end"] - file.chunks["start"]) / NANOSECONDS
            longest = 10 if state == "finished" else 0.5
            assert longest / 2 < spans.max() <= longest + 0.2
        read[state] = read_columns([log], ["/mic/features"])["/mic/features"]["values"]
    assert len(read["finished"]) == 600
    assert np.array_equal(read["finished"], read["completed"])
    assert np.array_equal(read["finished"], read["unfinished"])


def test_columns_and_messages_are_written_at_a_speed(work):
    columns, single = writing.measure(work).rows
    assert single.ratio == pytest.approx(columns.value / single.value)
    assert columns.elapsed > 0


def test_figures_with_a_target_are_kept_run_by_run_and_drawn(tmp_path):
    runs, picture = tmp_path / "runs.jsonl", tmp_path / "runs.svg"
    for value in (12.0, 15.0):
        rows = [
            Row("hearthlog, in one call", 700.0, "x real time"),
            Row("librosa 0.11.0", 60.0, "x real time", value, Target(10.0), elapsed=50.0),
            Row("opensmile", None, target=Target(2.0), note="not installed"),
            Row("memory", 80.0, "MB", target=Target(100.0, at_most=True)),
            Row("a minute", 20.0, "ms", target=Target(50.0, at_most=True), elapsed=25.0),
        ]
        tables = {"features": Table("", rows)}
        history.record(runs, "abc", "the simulated home", tables, {"writing: mcap": 8.5})

    (first, last) = map(json.loads, runs.read_text("utf-8").splitlines())
    named = {"features: librosa", "features: memory", "features: a minute"}
    assert set(first["figures"]) == named
    assert first["figures"]["features: a minute"]["elapsed"] == 25.0
    assert first["ratios"] == {"writing: mcap": 8.5}
    librosa = {"value": 15.0, "unit": "x", "limit": 10.0, "at_most": False}
    assert last["figures"]["features: librosa"] == librosa
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ", first["date"])
    assert (first["commit"], first["sound"]) == ("abc", "the simulated home")
    assert {"machine", "system", "kernel", "load"} <= set(first)
    assert {"hearthlog", "numpy", "python"} <= set(first["versions"])

    history.draw(runs, picture)
    drawn = picture.read_bytes()
    history.draw(runs, picture)
    assert drawn.startswith(b"<?xml")
    assert drawn.count(b'<g id="axes_') == 4  # three figures, and the ratio
    assert picture.read_bytes() == drawn


def test_a_history_without_a_run_is_drawn_too(tmp_path):
    (tmp_path / "runs.jsonl").touch()
    history.draw(tmp_path / "runs.jsonl", tmp_path / "runs.svg")
    assert (tmp_path / "runs.svg").exists()


def test_a_run_is_recorded_where_it_is_asked_for(run_of_folder):
    (run,) = map(json.loads, run_of_folder[1].read_text("utf-8").splitlines())
    assert run["sound"] == "sound"
    assert run["figures"]["recording: hearthlog record"]["value"] > 0
    assert run["ratios"] == {"minutes": check.MINUTES}


def recorded_ratios(path, *runs):
    lines = [{"date": str(n), "machine": m, "ratios": r} for n, (m, r) in enumerate(runs)]
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    return path


def test_every_contest_gives_a_ratio_of_cpu_time(work):
    ratios = check.measure_ratios(work)
    assert [name.partition(":")[0] for name in ratios] == [
        *("features", "inference", "reading, finished", "reading, chunks of 0.5 s", "writing")
    ]
    assert all(math.isfinite(ratio) and ratio > 0 for ratio in ratios.values())


def test_a_ratio_that_fell_is_told_from_one_that_noise_moved(tmp_path):
    here = history.machine()
    path = recorded_ratios(
        tmp_path / "runs.jsonl",
        *((here, {"writing: mcap": 100.0}), (here, {"writing: mcap": 10.0}), (here, {})),
        ("another machine", {"writing: mcap": 50.0}),
    )
    run = check.last_run(path)
    assert run["ratios"] == {"writing: mcap": 10.0}
    for ratio, verdict in ((30.0, "met"), (6.0, "met"), (4.0, "MISSED")):
        table = check.compare({"writing: mcap": ratio, "reading: new": 1.0}, run)
        assert [row.verdict for row in table.rows] == [verdict, ""]
    other = recorded_ratios(tmp_path / "other.jsonl", ("another machine", {"writing: mcap": 50.0}))
    assert check.last_run(other)["ratios"] == {"writing: mcap": 50.0}


@pytest.mark.parametrize("text", ['{"date": "1"}\n', "no JSON\n", "1\n"])
def test_without_a_recorded_run_the_check_says_so_before_it_measures(tmp_path, text):
    (tmp_path / "runs.jsonl").write_text(text)
    done = bench("--check", tmp_path / "runs.jsonl")
    assert isinstance(done.exception, timing.BenchError)
    assert re.fullmatch(f"{tmp_path / 'runs.jsonl'}: .*", str(done.exception))


def test_the_queue_is_compared_with_chance_run_by_run():
    def of(run, chosen, macro):
        return [queue.Outcome(run, count, chosen, 80.0, macro, 0.9) for count in (20, 60)]

    results = [
        *of("a", "queue", 0.7),
        *of("a", "random", 0.6),
        *of("a", "random", 0.64),
        *of("b", "queue", 0.5),
        *of("b", "random", 0.55),
        *of("b", "random", 0.51),
    ]
    rows = queue.table_of(results).rows[:6]
    assert [row.value for row in rows] == pytest.approx([0.6, 0.025, 1, 1, 80.0, 0.9])
    assert [row.verdict for row in rows] == ["", "MISSED", "", "MISSED", "", ""]


def test_scenes_of_which_the_truth_is_known_are_asked_by_the_queue_and_by_chance(tmp_path):
    conditions = queue.Conditions(starter_file(GENERAL), SHIPPED, 1.5, 1)
    scene = queue.recorded(tmp_path / "scene", conditions, queue.ROOMS[0], 0)
    for spans in (queue.by_queue(scene.logs, 5), queue.by_chance(scene.logs, 5, [0])):
        assert len(spans) == 5
        assert all(scene.truth.starts[0] <= s.start < s.end <= scene.truth.ends[-1] for s in spans)
    recorded = queue.read_evaluation_set(scene, load_model(conditions.model))
    assert len(recorded.inputs) == len(recorded.quiet) == len(recorded.true) > 200
    silent = recorded.true[recorded.quiet] == "silence"
    assert silent.mean() > 0.8  # the gate is silent where nothing sounds
