"""Dask clusters on loopback, of real processes, on ports that they choose."""

import json
import os
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

from distributed import Client
from waiting import wait_for

DASK = str(Path(sys.executable).with_name("dask"))
LONG = 60.0


@contextmanager
def running(command, paths=(), stderr=subprocess.DEVNULL, **options):
    paths = [*paths, str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(filter(None, paths)),
        "DASK_DISTRIBUTED__SCHEDULER__WORKER_SATURATION": "1.0",
        "TERM": "xterm",
        "COLUMNS": "100",
    }
    # In a group of its own, which is killed at once: of what comes and goes no list is complete.
    with subprocess.Popen(
        command,
        stdout=subprocess.DEVNULL,
        stderr=stderr,
        env=environment,
        start_new_session=True,
        **options,
    ) as process:
        try:
            yield process
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)


# Without these a port of Dask's web server, and of a worker, is open to the network.
PRIVATE = ["--host", "127.0.0.1", "--dashboard-address", "127.0.0.1:0", "--no-dashboard"]


@contextmanager
def scheduler_in(folder):
    """Start a scheduler; it chooses its port."""
    about = folder / "scheduler.json"
    command = [DASK, "scheduler", "--port", "0", "--scheduler-file", str(about)]
    with running([*command, *PRIVATE]) as process:
        wait_for(
            lambda: about.exists() and about.read_text().endswith("}")
        )  # it is written in place
        yield json.loads(about.read_text())["address"], process


@contextmanager
def worker_of(address, *options, threads=1):
    """Start a worker; one with a nanny is ready once that has heard of it.

    A nanny whose worker dies before gives up, and nothing replaces the worker.
    """
    command = [DASK, "worker", address, "--nthreads", str(threads)]
    with running([*command, *PRIVATE, *options]) as process:
        if "--no-nanny" not in options:
            _await_nanny(address, process.pid)
        yield process


@contextmanager
def two_threads_in(folder):
    """The address of a cluster of one worker; joblib does without one that has a single thread."""
    with scheduler_in(folder) as (address, _), worker_of(address, "--no-nanny", threads=2):
        yield address


def _await_nanny(address, pid):
    def state(dask_worker):
        return os.getpid(), dask_worker.status.name

    with Client(address, set_as_default=False) as client:
        wait_for(lambda: (pid, "running") in client.run(state, nanny=True).values())
