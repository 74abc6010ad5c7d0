"""A day, and a month, from logs to a picture of them in Rerun's viewer."""

import json
import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from hearthlog.analyzer.review.viewer.viewer import open_hidden
from hearthlog.schemas.errors import HearthlogError
from hearthlog.schemas.logs.files import find_logs
from hearthlog.tools.lab.bench.table import Row, Table, Target
from hearthlog.tools.lab.bench.timing import BenchError
from hearthlog.tools.lab.bench.workload import Workload

_DAYS = 31
_START_SECONDS = 20.0  # until a viewer listens
_TITLE = "review: from logs to a picture of them, elapsed"
_DAY = Row("a day", None, "s", target=Target(5, at_most=True))
_MONTH = Row("a month, a sample of it", None, "s", target=Target(15, at_most=True))
_RUN = """
import json, resource, sys, time
began = float(sys.argv[1])
from pathlib import Path
from hearthlog.analyzer.review.viewer.viewer import open_hidden
with open_hidden() as viewer:
    from hearthlog.analyzer.review.timeline_reader import read_timeline
    timeline = read_timeline([Path(sys.argv[2])])
    viewer.draw(timeline, close_up=False)
    viewer.wait_until_drawn()
    viewer.picture()
    seconds = time.time() - began
    # Of this process; what getrusage says begins with that of the one before it.
    status = Path("/proc/self/status").read_text()
    ours = int(status.partition("VmHWM:")[2].split()[0]) / 1024
viewers = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
print(json.dumps([seconds, ours, viewers]))
"""


class _Run(NamedTuple):
    seconds: float
    ours: float  # megabytes
    viewers: float


def measure(work: Workload) -> Table:
    """Measure from the start of the command to a picture of everything."""
    try:
        _check_viewer()
    except (HearthlogError, OSError) as error:
        return Table(_TITLE, [replace(row, note=str(error)) for row in (_DAY, _MONTH)])
    logs, month = work.day, work.folder / "month"
    for number in range(_DAYS):  # they take as long to read as if they were of other days
        (month / str(number)).mkdir(parents=True)
        for log in find_logs(logs):
            os.link(log, month / str(number) / log.name)
    day, many = _shown(logs), _shown(month)
    rows = [
        replace(_DAY, value=day.seconds),
        Row("  peak memory of hearthlog", day.ours, "MB", target=Target(500, at_most=True)),
        Row("  peak memory of the viewer", day.viewers, "MB"),
        replace(_MONTH, value=many.seconds),
    ]
    return Table(_TITLE, rows)


def _check_viewer() -> None:
    """Raise DataError or OSError where the viewer makes no picture."""
    deadline = time.monotonic() + _START_SECONDS
    with open_hidden() as viewer:
        while True:
            try:
                viewer.picture()
            except OSError:
                viewer.check()
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.1)
            else:
                return


def _shown(logs: Path) -> _Run:
    command = [sys.executable, "-c", _RUN, str(time.time()), str(logs)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
    if done.returncode:
        raise BenchError(done.stderr.strip().splitlines()[-1])
    return _Run(*json.loads(done.stdout.splitlines()[-1]))
