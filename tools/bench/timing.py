"""Time that can be compared on a machine that others use too."""

import itertools
import os
import resource
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from hearthlog.recorder.modules import module_command
from hearthlog.schemas.errors import HearthlogError

_TURN_SECONDS = 0.5
HEARTHLOG = module_command("hearthlog.tools.cli.main")


class BenchError(HearthlogError):
    """A measurement cannot be made."""


def best_of(
    runs: Mapping[str, Callable[[], object]],
    turns: int = 5,
    clock: Callable[[], float] = time.process_time,
) -> dict[str, float]:
    """Measure the time of each run in seconds, in its best turn.

    By default CPU time over all threads, which others on the machine disturb less than elapsed
    time; that is for what uses several cores. Turns last at least half a second, because a long
    run meets other people's work more often than a short one, and come one after the other,
    because what slows the core slows all alike.
    """
    best = dict.fromkeys(runs, float("inf"))
    for _ in range(turns):
        for name, run in runs.items():
            best[name] = min(best[name], _mean_time(run, clock))
    return best


def _mean_time(run: Callable[[], object], clock: Callable[[], float]) -> float:
    began = clock()
    count, used = 0, 0.0
    while used < _TURN_SECONDS:
        run()
        count += 1
        used = clock() - began
    return used / count


def best_of_processes(commands: Sequence[Sequence[str | Path]]) -> tuple[float, float]:
    """Run `hearthlog` with each of these arguments, each time on one core, and on the next one.

    Returns
    -------
    elapsed, cpu : float
        Seconds of the quickest run by each clock, from its start to its end.

    Raises
    ------
    BenchError
        If the command fails, with what it said.
    """
    cores = itertools.cycle(sorted(os.sched_getaffinity(0)))
    elapsed = cpu = float("inf")
    for arguments, core in zip(commands, cores, strict=False):
        with _on_core(core):
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
