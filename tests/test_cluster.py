"""A run on a Dask cluster, while parts of the cluster are killed."""

import json
from threading import Event

import pytest
from killed_workers import every_layers, layers, relabel_under_fire
from scheduler_kills import run_and_kill, with_layers
from simulated_fleet import write_fleet

from hearthlog.analyzer.relabel.relabel import relabel
from hearthlog.analyzer.workers import open_workers
from hearthlog.models.modelfile import load_model
from hearthlog.recorder.config import Settings
from hearthlog.recorder.recording import record
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.schemas.logs.files import find_logs

START = 1_772_348_400_000_000_000


@pytest.fixture(scope="module")
def small_logs(day, model_file, tmp_path_factory):
    """Logs of three seconds."""
    folder = tmp_path_factory.mktemp("small")
    settings = Settings(output=folder, model=model_file, max_bag_duration=3)
    record(settings, FileSource([day], START), Event())
    return find_logs(folder)[:6]


@pytest.mark.parametrize("done", [0, 4])
def test_a_scheduler_that_is_killed_ends_a_run_with_one_line(
    small_logs, model_file, tmp_path, done
):
    fleet = write_fleet(small_logs, tmp_path / "fleet", 2, 6)
    ending = run_and_kill(fleet, model_file, tmp_path / "run", with_layers(done))
    assert ending.status == 1, ending
    assert "Dask scheduler at tcp://" in ending.output
    assert ending.output.startswith("hearthlog: ")
    assert ending.output.count("\n") == 1


def test_a_fleet_is_labelled_while_workers_are_killed(
    small_logs, model_file, tmp_path, monkeypatch
):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1772348400")
    fleet, alone = (write_fleet(small_logs, tmp_path / str(homes), homes, 6) for homes in (12, 1))
    with open_workers() as workers:
        assert not relabel([alone], load_model(model_file), model_file, workers).failed
    (full,) = map(layers, alone.iterdir())
    assert len(full) == 6
    run = relabel_under_fire(fleet, model_file, tmp_path, every_layers(fleet, 15))
    assert run.status == 0, run
    assert run.kills >= 3
    with open_workers() as workers:  # a task may have been given out twice, and end after the run
        again = relabel([fleet], load_model(model_file), model_file, workers)
    assert len(again.current) == 12 * 6
    assert [layers(home) for home in fleet.iterdir()] == [full] * 12


def test_a_store_that_throttles_is_asked_again(
    small_logs, model_file, bucket, throttled_account, hearthlog
):
    """Both servers have the same buckets, since they are in one process."""
    for log in small_logs[:4]:
        (bucket / "2026" / "03" / "01" / log.name).write_bytes(log.read_bytes())
    command = ("relabel", bucket, "--model", model_file, "--workers", "2", "--json")
    done = hearthlog(*command, env=throttled_account)
    assert done.returncode == 0, done.stderr
    assert len(json.loads(done.stdout)["layers"]) == 4
