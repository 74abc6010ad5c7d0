"""Tasks on this process, on several, and on a Dask cluster."""

import gc
import os
import signal
import site
import subprocess
import sys
from concurrent.futures import wait
from pathlib import Path

import psutil
import pytest
import tasks
from clusters import DASK, LONG, PRIVATE, running, scheduler_in, until, worker_of

import hearthlog.analyzer.workers.cluster
from hearthlog.analyzer.errors import WorkerError
from hearthlog.analyzer.workers import open_workers
from hearthlog.schemas.errors import LogError


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
    monkeypatch.setattr(hearthlog.analyzer.workers.cluster, "_CONNECT_SECONDS", 0.5)


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


def test_without_processes_a_task_is_done_when_it_was_submitted():
    with open_workers() as workers:
        future = workers.submit(tasks.own_id)
        assert future.done()
        assert future.result() == os.getpid()
        assert workers.parallel == 1


def test_two_processes_run_two_tasks_at_once():
    with open_workers(2) as workers:
        first, second = (workers.submit(tasks.nap, 0.5) for _ in range(2))
        until(lambda: len(_children()) == 2)
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
        until(lambda: len(list(tmp_path.iterdir())) == 2)
    assert all(future.done() for future in futures)
    assert not _children()
    assert not list(tmp_path.iterdir())


_PARENT = """
import sys
import tasks
from clusters import DASK, LONG, PRIVATE, running, scheduler_in, until, worker_of
from hearthlog.analyzer.workers import open_workers
with open_workers(2) as workers:
    [workers.submit(tasks.write_slowly, sys.argv[1]) for _ in range(3)][0].result()
"""


@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGKILL])
def test_processes_end_with_their_parent(tmp_path, end):
    command = [sys.executable, "-c", _PARENT, str(tmp_path)]
    with running(command, stderr=subprocess.PIPE, start_new_session=True) as parent:
        until(lambda: len(list(tmp_path.iterdir())) == 2)
        children = psutil.Process(parent.pid).children()
        os.killpg(parent.pid, end)
        assert parent.wait(LONG) == -end
        assert psutil.wait_procs(children, LONG)[1] == []
        said = parent.stderr.read()
    assert not list(tmp_path.iterdir())
    assert said.count(b"Traceback") == (end == signal.SIGINT)  # the parent's alone


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
            until(begun.exists)
            scheduler.kill()
            assert client.wait(LONG) == 0
            said = client.stderr.read().decode()
    assert said.startswith("the Dask scheduler at")
    assert said.count("\n") == 1


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
def test_a_worker_with_another_hearthlog_is_refused(cluster, tmp_path, site_of):
    start, paths, has = site_of(tmp_path)
    options = ["--nthreads", "1", "--no-nanny", *PRIVATE]
    said = rf"the Dask worker at tcp://127\.0\.0\.1:\d+ has {has}, this is "
    with open_workers(scheduler=cluster) as workers:
        with running([*start, cluster, *options], paths=paths, cwd=tmp_path):
            until(lambda: workers.parallel == 2)
            futures = [workers.submit(tasks.nap, 0.1) for _ in range(20)]
            errors = [future.exception(LONG) for future in futures]
            assert None in errors
            with pytest.raises(WorkerError, match=said):
                raise next(error for error in errors if error is not None)
            with pytest.raises(WorkerError, match=said), open_workers(scheduler=cluster):
                pass
        until(lambda: workers.parallel == 1)


def _children():
    name = "hearthlog.analyzer.workers"
    return [child for child in psutil.Process().children() if child.cmdline()[-1] == name]
