"""Time that can be compared on a machine that others use too."""

import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from schemas.errors import HearthlogError

HEARTHLOG = [sys.executable, "-m", "tools.cli.main"]


class BenchError(HearthlogError):
    """A measurement cannot be made."""


def best_of(runs: Mapping[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Measure the CPU time, in seconds and over all threads, of the quickest of several runs.

    CPU time, because a long run meets other people's work more often than a short one; in turns,
    because what slows the core itself then slows all alike.
    """
    best = dict.fromkeys(runs, float("inf"))
    for _ in range(repeats):
        for name, run in runs.items():
            began = time.process_time()
            run()
            best[name] = min(best[name], time.process_time() - began)
    return best


def best_of_processes(arguments: Sequence[str | Path], repeats: int) -> tuple[float, float]:
    """Run `hearthlog` several times, each time on one core, and each time on the next one.

    Returns
    -------
    elapsed, cpu : float
        Seconds of the quickest run by each clock, from its start to its end.

    Raises
    ------
    BenchError
        If the command fails, with what it said.
    """
    cores = sorted(os.sched_getaffinity(0))
    elapsed = cpu = float("inf")
    for repeat in range(repeats):
        with _on_core(cores[repeat % len(cores)]):
            began, used = time.perf_counter(), _cpu_of_children()
            hearthlog(arguments)
            elapsed = min(elapsed, time.perf_counter() - began)
            cpu = min(cpu, _cpu_of_children() - used)
    return elapsed, cpu


def hearthlog(arguments: Sequence[str | Path]) -> None:
    """Run the command to its end.

    Raises
    ------
    BenchError
        If it fails, with what it said.
    """
    command = [*HEARTHLOG, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603  ours
    if done.returncode != 0:
        raise BenchError(f"hearthlog {arguments[0]} failed: {done.stderr.strip()[-300:]}")


@contextmanager
def _on_core(core: int) -> Iterator[None]:
    """Keep this process, and those it starts, on one core."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {core})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def _cpu_of_children() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime
