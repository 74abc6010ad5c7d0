"""Ratios to peers in one run, compared with those of a recorded run: speed that was lost."""

import json
from collections.abc import Callable, Mapping
from itertools import chain
from pathlib import Path
from statistics import median
from typing import Any

from hearthlog.tools.lab.bench import features, inference, reading, writing
from hearthlog.tools.lab.bench.history import machine
from hearthlog.tools.lab.bench.table import Row, Table, Target
from hearthlog.tools.lab.bench.timing import BenchError, best_of
from hearthlog.tools.lab.bench.workload import Workload

MINUTES, CLIPS = 5.0, 8  # of a workload that is made in seconds
_TURNS, _TURN_SECONDS = 7, 0.1
_TOLERANCE = 0.5  # of a ratio: other work on the machine moves that of reading by 0.4

Contest = tuple[Callable[[], object], Callable[[], object]]


def measure_ratios(work: Workload) -> dict[str, float]:
    """Measure how many times the CPU time of ours each peer takes, at what is measured quickly.

    Parameters
    ----------
    work : Workload
        Of `MINUTES` and `CLIPS`: of other sizes, ratios are others.

    Returns
    -------
    dict of str to float
    """
    modules = (features, inference, reading, writing)
    contests: dict[str, Contest] = dict(chain(*(m.contests(work).items() for m in modules)))
    return {name: _ratio(*contest) for name, contest in contests.items()}


def _ratio(ours: Callable[[], object], theirs: Callable[[], object]) -> float:
    """Return the median ratio of turns that follow each other: what slows one slows the other."""
    pairs = [best_of({"ours": ours, "theirs": theirs}, 1, _TURN_SECONDS) for _ in range(_TURNS)]
    return median(pair["theirs"].cpu / pair["ours"].cpu for pair in pairs)


def last_run(path: Path) -> dict[str, Any]:
    """Return the last recorded run with ratios, if there is one of this machine.

    Parameters
    ----------
    path : Path
        File of JSON lines, as `hearthlog.tools.lab.bench.history.record` writes it.

    Raises
    ------
    BenchError
        If the file cannot be read, or holds no such run.
    """
    try:
        runs = [json.loads(line) for line in path.read_text("utf-8").splitlines()]
        kept = [run for run in runs if run.get("ratios")]
    except (OSError, ValueError, AttributeError) as error:
        raise BenchError(f"{path}: cannot be read as recorded runs ({error})") from error
    if not kept:
        raise BenchError(f"{path}: holds no run with ratios; `make bench-history` records one")
    last: dict[str, Any] = ([run for run in kept if run["machine"] == machine()] or kept)[-1]
    return last


def compare(ratios: Mapping[str, float], run: Mapping[str, Any]) -> Table:
    """Compare ratios with those of a recorded run.

    Parameters
    ----------
    ratios : mapping of str to float
        By what was measured.
    run : mapping
        As `last_run` returns it.

    Returns
    -------
    Table
        A ratio that fell by more than noise lets it is missed.
    """
    rows = [
        Row(name, ratio, "x", target=_limit(run["ratios"].get(name)), note=_before(run, name))
        for name, ratio in ratios.items()
    ]
    return Table(f"check: CPU time of peers / ours; recorded {run['date']}, {run['machine']}", rows)


def _limit(before: float | None) -> Target | None:
    return None if before is None else Target(round((1 - _TOLERANCE) * before, 1))


def _before(run: Mapping[str, Any], name: str) -> str:
    before = run["ratios"].get(name)
    return "not recorded" if before is None else f"recorded: {before:.1f}"
