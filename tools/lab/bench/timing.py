"""Time that can be compared on a machine that others use too."""

import itertools
import os
import resource
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from hearthlog.recorder.host import module_command
from hearthlog.schemas.errors import HearthlogError

_TURN_SECONDS = 0.5
HEARTHLOG = module_command("hearthlog.tools.cli.main")


class BenchError(HearthlogError):
    """A measurement cannot be made."""


class Seconds(NamedTuple):
    """How long something took: of CPU over all threads or processes, and by the clock."""

    cpu: float
    elapsed: float

    def __truediv__(self, count: float) -> "Seconds":
        return Seconds(self.cpu / count, self.elapsed / count)

    def or_less(self, other: "Seconds") -> "Seconds":
        """Return the lower of each."""
        return Seconds(min(self.cpu, other.cpu), min(self.elapsed, other.elapsed))


_FOREVER = Seconds(float("inf"), float("inf"))


def best_of(
    runs: Mapping[str, Callable[[], object]], turns: int = 5, least: float | None = None
) -> dict[str, Seconds]:
    """Measure the time of each run, in its best turn.

    Others on the machine disturb CPU time less than elapsed time. Turns last at least `least`
    seconds, half a one by default, because a long run meets other people's work more often than a
    short one, and come one after the other, because what slows the core slows all alike.
    """
    seconds = _TURN_SECONDS if least is None else least
    best = dict.fromkeys(runs, _FOREVER)
    for _ in range(turns):
        for name, run in runs.items():
            best[name] = best[name].or_less(_mean_time(run, seconds))
    return best


def _mean_time(run: Callable[[], object], least: float) -> Seconds:
    began, used = time.perf_counter(), time.process_time()
    count, cpu = 0, 0.0
    while cpu < least:
        run()
        count += 1
        cpu = time.process_time() - used
    return Seconds(cpu, time.perf_counter() - began) / count


def best_of_processes(commands: Sequence[Sequence[str | Path]]) -> Seconds:
    """Run `hearthlog` with each of these arguments, each time on one core, and on the next one.

    Returns
    -------
    Seconds
        Of the quickest run by each clock, from its start to its end.

    Raises
    ------
    BenchError
        If the command fails, with what it said.
    """
    cores = itertools.cycle(sorted(os.sched_getaffinity(0)))
    best = _FOREVER
    for arguments, core in zip(commands, cores, strict=False):
        with _on_core(core):
            began, used = time.perf_counter(), _cpu_of_children()
            hearthlog(arguments)
            cpu = _cpu_of_children() - used
            best = best.or_less(Seconds(cpu, time.perf_counter() - began))
    return best


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
