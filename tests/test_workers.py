"""Tasks on this process, on several, and on a Dask cluster."""

import gc
import os
import signal
import site
import subprocess
import sys
from concurrent.futures import wait
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import psutil
import pytest
import tasks
from clusters import DASK, LONG, PRIVATE, running, scheduler_in, worker_of
from dask.utils import key_split
from distributed import Client
from waiting import wait_for

import hearthlog.analyzer.workers.cluster
from hearthlog.analyzer.errors import LostClusterError, WorkerError
from hearthlog.analyzer.workers import open_workers
from hearthlog.schemas.errors import HearthlogWarning, LogError


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cluster")
    with scheduler_in(folder) as (address, _), worker_of(address, "--local-directory", str(folder)):
        yield address


@pytest.fixture(params=["here", "processes", "cluster"])
def workers(request):
    kind = request.param
    address = request.getfixturevalue("cluster") if kind == "cluster" else None
    with open_workers(2 if kind == "processes" else 1, address) as found:
        yield found


@pytest.fixture
def hurried(monkeypatch):
    for name in ("_CONNECT_SECONDS", "_WORKERS_SECONDS"):
        monkeypatch.setattr(hearthlog.analyzer.workers.cluster, name, 0.5)


def test_a_task_returns_what_its_function_returns(workers):
    futures = [workers.submit(tasks.add, number, 1) for number in range(5)]
    assert [future.result(LONG) for future in futures] == [1, 2, 3, 4, 5]


def test_a_task_raises_what_its_function_raises(workers):
    with pytest.raises(LogError, match=r"^a\.mcap: not a log$"):
        workers.submit(tasks.fail, "a.mcap").result(LONG)
    with pytest.raises(ZeroDivisionError):
        workers.submit(tasks.divide, 1).result(LONG)


def test_an_error_from_elsewhere_says_where_it_was_raised():
    with open_workers(2) as workers:
        error = workers.submit(tasks.divide, 1).exception(LONG)
    assert "return number / 0" in error.__notes__[0]


def test_what_cannot_travel_is_an_error_of_its_task_alone():
    with open_workers(2) as workers:
        error = workers.submit(tasks.fail_pickily).exception(LONG)
        assert isinstance(error, WorkerError)
        assert str(error) == "PickyError: this and that"
        assert isinstance(workers.submit(tasks.return_lock).exception(LONG), TypeError)
        assert workers.submit(lambda: 1).exception(LONG) is not None
        assert workers.submit(tasks.add, 1, 1).result(LONG) == 2


def test_a_worker_of_dask_uses_the_memory_of_freed_arrays_again(cluster):
    with open_workers(1, cluster) as workers:
        assert workers.submit(os.getenv, "MALLOC_TRIM_THRESHOLD_").result(LONG)  # forbids it
        assert workers.submit(tasks.page_faults).result(LONG) < 2_000


def test_a_process_uses_the_memory_of_freed_arrays_again():
    with open_workers(2) as workers:
        assert workers.submit(tasks.page_faults, 40).result(LONG) < 40 * 2_000


def test_without_processes_a_task_is_done_when_it_was_submitted():
    with open_workers() as workers:
        future = workers.submit(tasks.own_id)
        assert future.done()
        assert future.result() == os.getpid()
        assert workers.parallel == 1


def test_two_processes_run_two_tasks_at_once():
    with open_workers(2) as workers:
        first, second = (workers.submit(tasks.nap, 0.5) for _ in range(2))
        wait_for(lambda: len(_children()) == 2)
        assert wait([first, second], LONG).not_done == set()
        assert workers.parallel == 2


def test_a_killed_process_costs_only_its_task_which_runs_again(tmp_path):
    with open_workers(2) as workers:
        others = [workers.submit(tasks.nap, 0.1) for _ in range(4)]
        struck = workers.submit(tasks.die_once, tmp_path / "struck")
        assert struck.result(LONG) == "done"
        assert [other.result(LONG) for other in others] == ["done"] * 4


def test_a_task_that_kills_its_process_is_given_up_after_three():
    with open_workers(2) as workers:
        fatal = workers.submit(tasks.die)
        others = [workers.submit(tasks.add, 1, number) for number in range(4)]
        with pytest.raises(WorkerError, match="lost its worker 3 times"):
            fatal.result(LONG)
        assert [other.result(LONG) for other in others] == [1, 2, 3, 4]


def test_leaving_the_block_ends_the_processes_and_lets_their_tasks_tidy_up(tmp_path):
    with open_workers(2) as workers:
        futures = [workers.submit(tasks.write_slowly, tmp_path) for _ in range(5)]
        wait_for(lambda: len(list(tmp_path.iterdir())) == 2)
    assert all(future.done() for future in futures)
    assert not _children()
    assert not list(tmp_path.iterdir())


_PARENT = """
import sys
import tasks
from clusters import DASK, LONG, PRIVATE, running, scheduler_in, worker_of
from hearthlog.analyzer.workers import open_workers
with open_workers(2) as workers:
    [workers.submit(tasks.write_slowly, sys.argv[1]) for _ in range(3)][0].result()
"""


@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGKILL])
def test_processes_end_with_their_parent(tmp_path, end):
    command = [sys.executable, "-c", _PARENT, str(tmp_path)]
    with running(command, stderr=subprocess.PIPE) as parent:
        wait_for(lambda: len(list(tmp_path.iterdir())) == 2)
        children = psutil.Process(parent.pid).children()
        os.killpg(parent.pid, end)
        assert parent.wait(LONG) == -end
        assert psutil.wait_procs(children, LONG)[1] == []
        output = parent.stderr.read()
    assert not list(tmp_path.iterdir())
    assert output.count(b"Traceback") == (end == signal.SIGINT)  # the parent's alone


def test_a_lost_worker_of_a_cluster_costs_only_its_task(cluster, tmp_path):
    with open_workers(scheduler=cluster) as workers:
        struck = workers.submit(tasks.die_once, str(tmp_path / "struck"))
        others = [workers.submit(tasks.add, 1, number) for number in range(4)]
        assert struck.result(LONG) == "done"
        assert [other.result(LONG) for other in others] == [1, 2, 3, 4]


def test_a_client_of_a_cluster_does_not_listen(cluster):
    mine = psutil.Process()
    before = {found.laddr for found in mine.net_connections() if found.status == "LISTEN"}
    with open_workers(scheduler=cluster) as workers:
        workers.submit(tasks.own_id).result(LONG)
        listening = {found.laddr for found in mine.net_connections() if found.status == "LISTEN"}
    assert listening == before


@pytest.mark.usefixtures("hurried")
@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "127.0.0.1", "smoke://signal"])
def test_no_scheduler_is_one_line(address):
    with pytest.raises(WorkerError) as error, open_workers(scheduler=address):
        pass
    assert str(error.value) == f"no Dask scheduler at {address}; start one with: dask scheduler"
    # What is left of a client locks up the next one, if it is collected when that one starts.
    assert not [found for found in gc.get_objects() if type(found).__name__ == "Client"]


@pytest.mark.usefixtures("hurried")
def test_a_cluster_without_workers_is_one_line(tmp_path):
    with (
        scheduler_in(tmp_path) as (address, _),
        pytest.raises(WorkerError) as error,
        open_workers(scheduler=address),
    ):
        pass
    assert str(error.value) == (
        f"the Dask scheduler at {address} has no workers; start some with: dask worker {address}"
    )


def test_a_scheduler_that_goes_away_is_an_error_of_all_that_is_not_done(tmp_path):
    with (
        scheduler_in(tmp_path) as (address, scheduler),
        worker_of(address, "--no-nanny"),
        open_workers(scheduler=address) as workers,
    ):
        done = workers.submit(tasks.add, 1, 1)
        assert done.result(LONG) == 2
        futures = [workers.submit(tasks.nap, 30) for _ in range(3)]
        scheduler.kill()
        for future in futures:
            with pytest.raises(WorkerError, match=rf"scheduler at {address} is gone"):
                future.result(10)
        with pytest.raises(WorkerError, match="is gone"):
            workers.submit(tasks.add, 1, 1).result(10)
        assert workers.parallel == 1
        assert done.result() == 2


_CLIENT = """
import sys, time
import tasks
from hearthlog.analyzer.workers import open_workers
with open_workers(scheduler=sys.argv[1]) as workers:
    future = workers.submit(tasks.touch_and_nap, sys.argv[2], 30)
    workers._client._timeout = 0.5  # after which Dask says that it cannot connect again
    print(future.exception(), file=sys.stderr)
    while workers._client.status != "closed":
        time.sleep(0.02)
"""


def test_a_scheduler_that_goes_away_leaves_nothing_but_the_error_on_the_terminal(tmp_path):
    begun = tmp_path / "begun"
    with scheduler_in(tmp_path) as (address, scheduler), worker_of(address, "--no-nanny"):
        command = [sys.executable, "-c", _CLIENT, address, str(begun)]
        with running(command, stderr=subprocess.PIPE) as client:
            wait_for(begun.exists)
            scheduler.kill()
            assert client.wait(LONG) == 0
            output = client.stderr.read().decode()
    assert output.startswith("the Dask scheduler at")
    assert output.count("\n") == 1


def _site_of_another_version(folder):
    about = folder / "hearthlog-0.0.9.dist-info" / "METADATA"
    about.parent.mkdir()
    about.write_text("Metadata-Version: 2.1\nName: hearthlog\nVersion: 0.0.9\n")
    return [DASK, "worker"], [str(folder)], "hearthlog 0.0.9"


def _site_without_hearthlog(folder):
    for path in map(Path, site.getsitepackages()):
        for found in path.iterdir():
            if "hearthlog" not in found.name and found.suffix != ".pth":
                (folder / found.name).symlink_to(found)
    return (
        [sys.executable, "-S", "-m", "distributed.cli.dask_worker"],
        [str(folder)],
        "no hearthlog",
    )


@pytest.mark.parametrize("site_of", [_site_of_another_version, _site_without_hearthlog])
def test_a_worker_with_another_hearthlog_that_joins_later_gets_nothing(cluster, tmp_path, site_of):
    start, paths, has = site_of(tmp_path)
    options = ["--nthreads", "1", "--no-nanny", *PRIVATE]
    reported = pytest.warns(HearthlogWarning, match=rf"has {has}, this is .*: not used")
    with (
        reported,
        open_workers(scheduler=cluster) as workers,
        running([*start, cluster, *options], paths=paths, cwd=tmp_path),
    ):
        wait_for(lambda: workers.refused)
        assert workers.parallel == 1
        futures = [workers.submit(tasks.own_id) for _ in range(20)]
        assert len({future.result(LONG) for future in futures}) == 1


@pytest.mark.parametrize("site_of", [_site_of_another_version, _site_without_hearthlog])
def test_a_worker_with_another_hearthlog_is_refused_before_a_run(cluster, tmp_path, site_of):
    start, paths, has = site_of(tmp_path)
    options = ["--nthreads", "1", "--no-nanny", *PRIVATE]
    output = rf"the Dask worker at tcp://127\.0\.0\.1:\d+ has {has}, this is "
    with running([*start, cluster, *options], paths=paths, cwd=tmp_path):
        wait_for(lambda: _threads(cluster) == 2)
        with pytest.raises(WorkerError, match=output), open_workers(scheduler=cluster):
            pass
    wait_for(lambda: _threads(cluster) == 1)


def test_tasks_go_on_when_all_workers_leave_and_others_come(tmp_path):
    with scheduler_in(tmp_path) as (address, _):
        first = worker_of(address, "--no-nanny")
        with first as process, open_workers(scheduler=address) as workers:
            futures = [workers.submit(tasks.nap, 1.0) for _ in range(3)]
            process.kill()
            with worker_of(address, "--no-nanny"):
                assert [future.result(LONG) for future in futures] == ["done"] * 3


def test_a_task_that_fails_once_is_tried_again(cluster, tmp_path):
    with open_workers(scheduler=cluster) as workers:
        assert workers.submit(tasks.fail_once, str(tmp_path / "failed")).result(LONG) == "done"


def test_dask_names_tasks_after_their_functions(cluster, tmp_path):
    with open_workers(scheduler=cluster) as workers, Client(cluster, set_as_default=False) as other:
        futures = [workers.submit(tasks.touch_and_nap, str(tmp_path / "n"), 5) for _ in range(2)]
        wait_for((tmp_path / "n").exists)
        keys = [key for running in other.processing().values() for key in running]
        assert len(set(keys)) == 2
        assert {key_split(key) for key in keys} == {"touch_and_nap"}
        assert not any(future.done() for future in futures)


def test_a_large_array_is_sent_once_and_arrives_again_after_its_worker_left(tmp_path):
    array = np.arange(100_000.0)
    with scheduler_in(tmp_path) as (address, _), cluster_of_one(address) as (workers, process):
        assert workers.submit(tasks.total, array, 1).result(LONG) == array.sum() + 1
        ((_, sent),) = workers._sent.values()
        assert workers.submit(tasks.total, array, 2).result(LONG) == array.sum() + 2
        assert next(iter(workers._sent.values()))[1] is sent
        process.kill()
        with worker_of(address, "--no-nanny"):
            assert workers.submit(tasks.total, array, 3).result(LONG) == array.sum() + 3


@contextmanager
def cluster_of_one(address):
    with worker_of(address, "--no-nanny") as process, open_workers(scheduler=address) as workers:
        yield workers, process


def test_a_scheduler_that_stops_answering_is_gone(tmp_path, monkeypatch):
    monkeypatch.setattr(hearthlog.analyzer.workers.cluster, "_SILENT_SECONDS", 1.0)
    with (
        scheduler_in(tmp_path) as (address, scheduler),
        worker_of(address, "--no-nanny"),
        open_workers(scheduler=address) as workers,
    ):
        future = workers.submit(tasks.nap, 1000)
        scheduler.send_signal(signal.SIGSTOP)
        with pytest.raises(LostClusterError, match=rf"scheduler at {address} does not answer"):
            future.result(LONG)


def test_a_cluster_that_has_lost_all_workers_is_not_waited_for_without_end(tmp_path, monkeypatch):
    with scheduler_in(tmp_path) as (address, _), cluster_of_one(address) as (workers, process):
        monkeypatch.setattr(hearthlog.analyzer.workers.cluster, "_DESERTED_SECONDS", 1.0)
        process.kill()
        with pytest.raises(LostClusterError, match="has had no workers"):
            workers.submit(tasks.own_id).result(LONG)


def _threads(address):
    with Client(address, set_as_default=False) as client:
        return sum(client.nthreads().values())


def _children():
    name = "hearthlog.analyzer.workers"
    return [child for child in psutil.Process().children() if child.cmdline()[-1] == name]
