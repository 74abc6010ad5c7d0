"""Learning in threads or on a Dask cluster alike, with a cost and gamma that were chosen."""

import dataclasses
import os
import pty
import sys
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from threading import Event

import numpy as np
import pytest
import tasks
from blobs import blobs
from clusters import running, scheduler_in, two_threads_in, worker_of
from joblib import delayed
from log_fixtures import run
from threadpoolctl import threadpool_info, threadpool_limits

from hearthlog.analyzer.errors import WorkerError
from hearthlog.analyzer.training.calibration import cross_validate
from hearthlog.analyzer.training.method import prepare
from hearthlog.analyzer.training.train import group_folds
from hearthlog.analyzer.training.window_methods import PAPER
from hearthlog.analyzer.workers import fits_on, in_parallel, single_thread
from hearthlog.models.modelfile import load_model
from hearthlog.schemas.errors import ignore_progress
from hearthlog.tools.cli import terminal
from hearthlog.tools.home.simulate import write_training_set


@pytest.fixture
def hearthlog(capfd):
    """Run the command in this process and return what came of it."""
    return partial(run, capfd)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    with two_threads_in(tmp_path_factory.mktemp("cluster")) as address:
        yield address


@pytest.fixture(scope="module")
def clips(tmp_path_factory):
    return write_training_set(tmp_path_factory.mktemp("clips"), clips_per_class=2, seed=3)


def test_a_search_tries_less_as_much_and_more_of_both():
    methods = PAPER.variations()
    assert len(set(methods)) == 9
    assert PAPER in methods
    assert {dataclasses.replace(method, cost=0.0, gamma=0.0) for method in methods} == {
        dataclasses.replace(PAPER, cost=0.0, gamma=0.0)
    }


def test_a_cluster_decides_as_threads_do_bit_for_bit(cluster):
    data, _ = blobs(3, 60, features=PAPER.features)
    methods, examples = PAPER.variations()[:3], prepare(PAPER, data)
    arguments = (methods, examples, 3, group_folds(data), ignore_progress)
    here = cross_validate(*arguments)
    with fits_on(cluster):
        there = cross_validate(*arguments)
    assert not np.isnan(here).any()
    np.testing.assert_array_equal(here, there)


def blas_threads():
    return {one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"}


def test_who_leaves_first_lets_the_others_go_on_with_one_thread():
    before, entered, left = blas_threads(), Event(), Event()

    def stay():
        with single_thread():
            entered.set()
            assert left.wait(20)
            return blas_threads()

    with ThreadPoolExecutor(1) as pool, threadpool_limits(2, user_api="blas"):
        with single_thread():
            waiting = pool.submit(stay)
            assert entered.wait(20)
        left.set()
        assert waiting.result() == {1}
        assert blas_threads() == {2}
    assert blas_threads() == before


def test_a_cluster_runs_what_it_is_given(cluster):
    def ids():
        return set(in_parallel(delayed(tasks.own_id)() for _ in range(4)))

    assert ids() == {os.getpid()}
    with fits_on(cluster):
        assert os.getpid() not in ids()
    assert ids() == {os.getpid()}


def test_a_scheduler_that_goes_away_while_learning_is_one_line(tmp_path):
    with (
        scheduler_in(tmp_path) as (address, scheduler),
        worker_of(address, "--no-nanny", threads=2),
        pytest.raises(WorkerError) as error,
        fits_on(address),
    ):
        [scheduler.kill() for _ in in_parallel(delayed(tasks.nap)(0.2) for _ in range(40))]
    assert str(error.value).startswith(f"the Dask scheduler at {address} is gone")


def test_a_fit_that_kills_its_workers_is_one_line(tmp_path):
    with (
        scheduler_in(tmp_path) as (address, _),
        worker_of(address, "--local-directory", str(tmp_path), threads=2),
        pytest.raises(WorkerError, match="lost its worker 4 times"),
        fits_on(address),
    ):
        list(in_parallel(delayed(tasks.die)() for _ in range(2)))


def test_a_model_learned_with_a_cluster_is_the_same_file(cluster, clips, tmp_path, hearthlog):
    words = ["--data", clips, "--scenario", "bathroom", "--method", "paper", "--cost", 2]
    for name, more in (("here", ()), ("there", ("--scheduler", cluster))):
        done = hearthlog("train", *words, *more, "-o", tmp_path / f"{name}.safetensors")
        assert done.returncode == 0, done.stderr
    here, there = (load_model(tmp_path / f"{name}.safetensors") for name in ("here", "there"))
    assert here.description.parameters["cost"] == 2
    assert here.description.parameters["gamma"] == pytest.approx(PAPER.gamma / 42)
    assert here.sha256 == there.sha256


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ("evaluate method wires --data d --scenario bathroom", "method 'wires' is not installed"),
        ("train -o m.safetensors --data d --scenario bathroom --cost 0", "--cost 0: it must"),
        ("train -o m.safetensors --data d --scenario bathroom --gamma nan", "--gamma nan: it must"),
        ("train -o m.safetensors --base b --home h --cost 0", "--gamma go with --data"),
    ],
)
def test_wrong_use_is_one_line(words, line, tmp_path, hearthlog):
    words = words.replace("m.safetensors", str(tmp_path / "m.safetensors"))
    done = hearthlog(*words.split())
    assert done.returncode == 2
    assert line in done.stderr
    assert done.stderr.count("\n") == 1


_STEPS = """
import time
from hearthlog.tools.cli.terminal import share_done
with share_done("trying") as report:
    for done in range(1, 5):
        time.sleep(0.3)
        report(done / 2000)
"""


def test_a_terminal_shows_the_time_left():
    shown, terminal = pty.openpty()
    with running([sys.executable, "-c", _STEPS], stderr=terminal) as process:
        os.close(terminal)
        text = b""
        while part := _read(shown):
            text += part
        assert process.wait() == 0
    os.close(shown)
    assert b"trying" in text
    assert b"0:1" in text  # of ten minutes or so


def test_elsewhere_a_line_now_and_then_says_how_much_is_done(monkeypatch, capsys):
    monkeypatch.setattr(terminal, "_LINE_SECONDS", 0.0)
    with terminal.share_done("trying") as report:
        report(0.125)
    assert capsys.readouterr().err == "hearthlog: trying: 12.5%\n"


def _read(terminal):
    try:
        return os.read(terminal, 4096)
    except OSError:  # the other side is closed
        return b""
