"""Kill the scheduler at random moments of `hearthlog relabel --scheduler`, and see how that ends.

    python tests/scheduler_kills.py LOGS MODEL [TIMES]

LOGS is a folder of small logs without layers, of which a copy is labelled each time. The moments
are between the first connection and the end of a run that nothing happens to.
"""

import random
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import psutil
from clusters import scheduler_in, worker_of

_ANNOUNCED = "hearthlog: labelling logs\n"
_COMMAND = [sys.executable, "-m", "hearthlog.tools.cli.main", "relabel"]


class Ending(NamedTuple):
    """How a run ended."""

    status: int | None  # None: it had to be killed, too
    seconds: float  # from the loss of the scheduler on
    output: str  # on standard error, besides what is announced

    @property
    def good(self) -> bool:
        """Whether it was done before, or ended within 30 s with one line."""
        one_line = self.output.startswith("hearthlog: ") and self.output.count("\n") == 1
        return self.seconds < 30 and (self.status == 0 or (self.status == 1 and one_line))


def run_and_kill(
    logs: Path, model: Path, folder: Path, due: Callable[[Path], Callable[[], bool]]
) -> Ending:
    """Label a copy of logs on a cluster of one's own, and kill its scheduler once that is due.

    `due` is told the copy when the run has connected, and returns the function that is asked.
    """
    folder.mkdir()
    copy = shutil.copytree(logs, folder / "logs")
    with (
        scheduler_in(folder) as (address, scheduler),
        worker_of(address, "--nworkers", "2", "--local-directory", str(folder)),
    ):
        command = [*_COMMAND, str(copy), "--model", str(model), "--scheduler", address]
        with subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        ) as process:
            while process.poll() is None and not _connected(process.pid, address):
                time.sleep(0.05)
            is_due = due(copy)
            while process.poll() is None and not is_due():
                time.sleep(0.02)
            scheduler.kill()
            killed = time.monotonic()
            try:
                _, output = process.communicate(timeout=120)
                status = process.returncode
            except subprocess.TimeoutExpired:
                process.kill()
                status, output = None, process.communicate()[1]
            return Ending(status, time.monotonic() - killed, output.replace(_ANNOUNCED, "", 1))


def _connected(process: int, address: str) -> bool:
    port = int(address.rpartition(":")[2])
    with suppress(psutil.NoSuchProcess):
        connections = psutil.Process(process).net_connections("tcp")
        return any(each.raddr and each.raddr.port == port for each in connections)
    return False


def after(seconds: float) -> Callable[[Path], Callable[[], bool]]:
    """Say that the kill is due some seconds after the run has connected."""

    def due(_: Path) -> Callable[[], bool]:
        connected = time.monotonic()
        return lambda: time.monotonic() - connected > seconds

    return due


def with_layers(count: int) -> Callable[[Path], Callable[[], bool]]:
    """Say that the kill is due when so many layers are done."""
    return lambda logs: lambda: sum(1 for _ in logs.rglob("*.relabel-*.mcap")) >= count


def _main(logs: str, model: str, times: str = "100") -> None:
    rng = random.Random(0)
    with TemporaryDirectory() as text, ThreadPoolExecutor(2) as pool:
        folder = Path(text)

        def once(number: int) -> tuple[float, Ending]:
            seconds = rng.uniform(0.0, longest)
            due = after(seconds)
            ending = run_and_kill(Path(logs), Path(model), folder / str(number), due)
            shutil.rmtree(folder / str(number), ignore_errors=True)
            return seconds, ending

        took: list[float] = []

        def never(_: Path) -> Callable[[], bool]:
            connected = time.monotonic()
            return lambda: took.append(time.monotonic() - connected) or False

        assert run_and_kill(Path(logs), Path(model), folder / "whole", never).status == 0
        longest = took[-1]
        endings = []
        for seconds, ending in pool.map(once, range(int(times))):
            endings.append(ending)
            print(f"{seconds:6.2f} s {'' if ending.good else 'BAD '}{ending}", flush=True)  # noqa: T201
        print(Counter((one.status, one.output[:60]) for one in endings))  # noqa: T201
        print(  # noqa: T201
            f"{sum(one.good for one in endings)} of {times} good; "
            f"{max(one.seconds for one in endings):.1f} s at most after the loss"
        )


if __name__ == "__main__":
    _main(*sys.argv[1:])
