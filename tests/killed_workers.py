"""Label a simulated fleet on a Dask cluster of four processes, of which one is killed ever again.

    python tests/killed_workers.py LOGS MODEL HOMES DAYS SECONDS

LOGS is a folder with the logs of a day, which all homes have again every day. Every SECONDS one of
the processes is killed. Says whether the layers are those that one process makes of such a home.
"""

import hashlib
import os
import random
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import psutil
from clusters import scheduler_in, worker_of

from hearthlog.schemas.logs.files import is_layer

_DAY = 86_400  # seconds
_COMMAND = [sys.executable, "-m", "hearthlog.tools.cli.main", "relabel"]


class Run(NamedTuple):
    """A run under fire."""

    status: int
    kills: int
    output: str  # on standard error


def relabel_under_fire(fleet: Path, model: Path, folder: Path, due: Callable[[], bool]) -> Run:
    """Label a fleet on a cluster of one's own, and kill a process of it whenever that is due."""
    with (
        scheduler_in(folder) as (address, _),
        worker_of(address, "--nworkers", "4", "--local-directory", str(folder)) as nannies,
        subprocess.Popen(
            [*_COMMAND, str(fleet), "--model", str(model), "--scheduler", address],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        ) as process,
    ):
        done, kills = threading.Event(), []
        killer = threading.Thread(target=_kill, args=(nannies.pid, due, done, kills))
        killer.start()
        _, output = process.communicate()
        done.set()
        killer.join()
    return Run(process.returncode, len(kills), output)


def _kill(nannies: int, due: Callable[[], bool], done: threading.Event, kills: list[int]) -> None:
    rng = random.Random(0)
    while not done.wait(0.2):
        if due():
            with suppress(psutil.NoSuchProcess):
                victim = rng.choice(_workers(nannies))
                victim.kill()
                kills.append(victim.pid)


def _workers(nannies: int) -> list[psutil.Process]:
    """List the processes that run tasks; each has a nanny, which starts it again."""
    children = psutil.Process(nannies).children(recursive=True)
    return [child for child in children if "spawn_main" in " ".join(child.cmdline())]


def every(seconds: float) -> Callable[[], bool]:
    """Make the function that says every few seconds that a kill is due."""
    last = time.monotonic()

    def due() -> bool:
        nonlocal last
        if time.monotonic() - last < seconds:
            return False
        last = time.monotonic()
        return True

    return due


def every_layers(fleet: Path, count: int) -> Callable[[], bool]:
    """Make the function that says that a kill is due whenever so many more layers are done."""
    last = 0

    def due() -> bool:
        nonlocal last
        now = sum(1 for _ in fleet.rglob("*.relabel-*.mcap"))
        if now - last < count:
            return False
        last = now
        return True

    return due


def layers(home: Path) -> dict[str, str]:
    """Return the digests of the layers of a home; nothing else was left beside the logs."""
    files = [path for path in home.rglob("*") if path.is_file()]
    assert all(path.suffix == ".mcap" for path in files)
    return {
        path.relative_to(home).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in files
        if is_layer(path)
    }


def _main(logs: str, model: str, homes: str, days: str, seconds: str) -> None:
    from hearthlog.tools.lab.home.copies import copy_logs  # noqa: PLC0415  the wheel leaves it out

    os.environ["SOURCE_DATE_EPOCH"] = "1772348400"
    with TemporaryDirectory() as text:
        folder = Path(text)
        home = folder / "alone" / "home-000"
        copy_logs(Path(logs), home, int(days), _DAY)
        fleet = folder / "fleet"
        for number in range(int(homes)):  # links, which take no room
            shutil.copytree(home, fleet / f"home-{number:03}", copy_function=os.link)
        subprocess.run([*_COMMAND, str(home), "--model", model, "--workers", "1"], check=True)
        began = time.monotonic()
        run = relabel_under_fire(fleet, Path(model), folder, every(float(seconds)))
        elapsed = time.monotonic() - began
        print(f"{run.output}status {run.status}, {run.kills} kills, {elapsed:.0f} s")  # noqa: T201
        alone = layers(home)
        equal = sum(layers(one) == alone for one in fleet.iterdir())
        print(  # noqa: T201
            f"{equal} of {homes} homes have the {len(alone)} layers, of {days} logs, that one "
            "process makes, bit for bit"
        )


if __name__ == "__main__":
    _main(*sys.argv[1:])
