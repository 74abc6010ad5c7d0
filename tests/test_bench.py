"""The benchmark runs to its end on a little sound; how fast is not for a test to say."""

import json
import math
import re
import subprocess
import sys

import numpy as np
import pytest

pytest.importorskip("hearthlog.tools.bench", reason="the wheel leaves the benchmarks out")

from hearthlog.models.modelfile.modelfile import load_model
from hearthlog.models.starter import GENERAL, starter_file
from hearthlog.schemas.frames import FRAME_SAMPLES, SAMPLE_RATE
from hearthlog.tools.bench import features, history, queue, reading, timing, writing
from hearthlog.tools.bench.labmic import make_microphone
from hearthlog.tools.bench.table import Row, Table, Target
from hearthlog.tools.bench.workload import Workload
from hearthlog.tools.home.clips import SHIPPED
from hearthlog.tools.home.simulate import write_training_set


def bench(*arguments):
    return subprocess.run(
        [sys.executable, "-m", "hearthlog.tools.bench", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def figures(output):
    """The measured column of printed tables, by what stands before it."""
    lines = [line.split("  ") for line in output.splitlines() if line.startswith("  ")]
    cells = [[cell.strip() for cell in line if cell.strip()] for line in lines]
    return {row[0]: float(row[1].replace(",", "")) for row in cells if row[0] != "measured"}


def test_recordings_of_a_folder_are_recorded_and_the_log_is_accounted_for_byte_by_byte(tmp_path):
    write_training_set(tmp_path, 3, seed=1)

    done = bench("size", "recording", "--audio", tmp_path)

    assert done.returncode == 0, done.stderr
    found = figures(done.stdout)
    assert all(math.isfinite(value) and value > 0 for value in found.values())
    parts = sum(value for name, value in found.items() if name.startswith("/"))
    parts += found["index of messages"] + found["the rest"]
    assert parts == pytest.approx(found["the whole log"], rel=0.01)
    assert {"/mic/features", "/mic/statistics", "/mic/label", "hearthlog record"} <= set(found)


def test_every_peer_that_is_installed_gets_a_speed_and_a_ratio(tmp_path, monkeypatch):
    monkeypatch.setattr(timing, "_TURN_SECONDS", 1e-6)
    rows = features.measure(Workload(tmp_path, minutes=0.1)).rows
    assert len(rows) == 8
    assert all(math.isfinite(row.value) and row.value > 0 for row in rows)
    assert rows[5].ratio == pytest.approx(rows[0].value / rows[5].value)


def test_a_peer_that_is_missing_is_named_and_the_others_are_measured(tmp_path, monkeypatch):
    monkeypatch.setattr(timing, "_TURN_SECONDS", 1e-6)
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
    assert done.returncode == 2
    assert "features, recording, live, inference, size" in " ".join(done.stderr.split())


def test_where_no_viewer_runs_the_others_are_measured_and_the_end_says_what_is_missing(
    tmp_path, monkeypatch
):
    write_training_set(tmp_path, 3, seed=1)
    nothing_to_draw_with = {"WGPU_BACKEND": "vulkan", "VK_DRIVER_FILES": "/none"}
    for name, value in (nothing_to_draw_with | {"VK_ICD_FILENAMES": "/none"}).items():
        monkeypatch.setenv(name, value)
    done = bench("review", "size", "--audio", tmp_path)
    assert done.returncode == 3, done.stderr
    tables = done.stdout.split("\n\n")
    day = next(line for line in tables[0].splitlines() if line.startswith("  a day "))
    assert re.search(r" - .*Rerun's viewer does not run here", day)
    assert figures(tables[1])["the whole log"] > 0
    assert done.stderr.splitlines()[-1] == (
        "hearthlog bench: not measured: a day (review); a month, a sample of it (review)"
    )


def test_a_folder_without_sound_is_one_clear_line(tmp_path):
    done = bench("features", "--audio", tmp_path)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].endswith(
        "holds no second of sound in files *.flac or *.wav"
    )
    assert "Traceback" not in done.stderr


def test_the_readers_agree_and_each_gets_a_time_and_a_ratio(tmp_path, monkeypatch):
    monkeypatch.setattr(timing, "_TURN_SECONDS", 1e-6)
    monkeypatch.setattr(reading, "_DAY", 60)
    rows = reading.measure(Workload(tmp_path, minutes=1.0)).rows
    assert all(math.isfinite(row.value) and row.value >= 0 for row in rows)
    assert sum(row.ratio is not None for row in rows) == 3


def test_columns_and_messages_are_written_at_a_speed(tmp_path, monkeypatch):
    monkeypatch.setattr(timing, "_TURN_SECONDS", 1e-6)
    columns, single = writing.measure(Workload(tmp_path, minutes=0.2)).rows
    assert single.ratio == pytest.approx(columns.value / single.value)


def test_figures_with_a_target_are_kept_run_by_run_and_drawn(tmp_path):
    runs, picture = tmp_path / "runs.jsonl", tmp_path / "runs.svg"
    for value in (12.0, 15.0):
        rows = [
            Row("hearthlog, in one call", 700.0, "x real time"),
            Row("librosa 0.11.0", 60.0, "x real time", value, Target(10.0)),
            Row("opensmile", None, target=Target(2.0), note="not installed"),
            Row("memory", 80.0, "MB", target=Target(100.0, at_most=True)),
        ]
        history.record(runs, {"features": Table("", rows)}, "the simulated home")

    (first, last) = map(json.loads, runs.read_text("utf-8").splitlines())
    assert set(first["figures"]) == {"features: librosa", "features: memory"}
    librosa = {"value": 15.0, "unit": "x", "limit": 10.0, "at_most": False}
    assert last["figures"]["features: librosa"] == librosa
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ", first["date"])
    assert {"commit", "machine", "sound"} <= set(first)
    assert {"hearthlog", "numpy", "python"} <= set(first["versions"])

    history.draw(runs, picture)
    drawn = picture.read_bytes()
    history.draw(runs, picture)
    assert drawn.startswith(b"<?xml")
    assert picture.read_bytes() == drawn


def test_a_history_without_a_run_is_drawn_too(tmp_path):
    (tmp_path / "runs.jsonl").touch()
    history.draw(tmp_path / "runs.jsonl", tmp_path / "runs.svg")
    assert (tmp_path / "runs.svg").exists()


def test_a_run_is_recorded_where_it_is_asked_for(tmp_path):
    write_training_set(tmp_path / "sound", 3, seed=1)
    runs = tmp_path / "runs.jsonl"
    done = bench("recording", "--audio", tmp_path / "sound", "--record", runs)
    assert done.returncode == 0, done.stderr
    (run,) = map(json.loads, runs.read_text("utf-8").splitlines())
    assert run["sound"] == "sound"
    assert run["figures"]["recording: hearthlog record"]["value"] > 0


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
    heard = queue.heard(scene, load_model(conditions.model))
    assert len(heard.inputs) == len(heard.quiet) == len(heard.true) > 200
    silent = heard.true[heard.quiet] == "silence"
    assert silent.mean() > 0.8  # the gate is silent where nothing sounds
