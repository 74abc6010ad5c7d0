"""What the benchmarks measured over time: a line of JSON for each run, and a picture of them."""

import json
import os
import platform
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from hearthlog.analyzer.workers import kernel_in_use
from hearthlog.tools.lab.bench.table import Table

_PACKAGES = (
    *("hearthlog", "librosa", "mcap-ros2-support", "numpy", "opensmile", "pyAudioAnalysis"),
    *("rerun-sdk", "rosbags", "scikit-learn"),
)
_VERSION = re.compile(r" \d[\w.]*$")
_COLUMNS = 3
_PANEL_INCHES = (3.6, 1.7)


def record(
    path: Path,
    commit: str,
    sound: str,
    tables: Mapping[str, Table],
    ratios: Mapping[str, float],
) -> None:
    """Append a run: of the figures those that have a target.

    Parameters
    ----------
    path : Path
        File of JSON lines; made where there is none.
    commit : str
        Of the code, as `commit` has returned it before.
    sound : str
        What it was measured on.
    tables : mapping of str to Table
        By the name of the measurement.
    ratios : mapping of str to float
        What later runs are checked against.
    """
    figures = {
        f"{name}: {_VERSION.sub('', row.what.strip())}": {
            "value": row.value if row.ratio is None else row.ratio,
            "unit": row.unit if row.ratio is None else "x",
            "limit": row.target.limit,
            "at_most": row.target.at_most,
        }
        | ({} if row.elapsed is None or row.ratio is not None else {"elapsed": row.elapsed})
        for name, table in tables.items()
        for row in table.rows
        if row.target is not None and row.value is not None
    }
    run = {
        "date": f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}",
        "commit": commit,
        "machine": machine(),
        "system": f"{platform.system()} {platform.release()}",
        "load": round(os.getloadavg()[1], 1),  # of the last five minutes
        "kernel": kernel_in_use(),
        "versions": {"python": platform.python_version()} | dict(_versions()),
        "sound": sound,
        "figures": figures,
        "ratios": dict(ratios),
    }
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(run) + "\n")


def draw(path: Path, picture: Path) -> None:
    """Draw the course of every figure, with its target as a dashed line, as SVG.

    Parameters
    ----------
    path : Path
        File of JSON lines, as `record` writes it.
    picture : Path
        Is written over.
    """
    import matplotlib as mpl  # noqa: PLC0415  recording does without
    from matplotlib.figure import Figure  # noqa: PLC0415

    runs = [_with_ratios(json.loads(line)) for line in path.read_text("utf-8").splitlines()]
    names = sorted({name for run in runs for name in run["figures"]})
    rows = max(-(-len(names) // _COLUMNS), 1)
    width, height = _PANEL_INCHES
    figure = Figure((width * _COLUMNS, height * rows), layout="constrained")
    if not names:
        figure.text(0.5, 0.5, "no run has been recorded", ha="center")
    for place, name in enumerate(names, start=1):
        _draw_panel(figure.add_subplot(rows, _COLUMNS, place), name, runs)
    # A salt, so that the same runs give the same bytes.
    with mpl.rc_context({"svg.hashsalt": "hearthlog", "svg.fonttype": "none"}):
        figure.savefig(picture, format="svg", metadata={"Date": None})


def _with_ratios(run: dict[str, Any]) -> dict[str, Any]:
    """Count the ratios of a run among its figures; they have no target."""
    ratios = {
        f"check, {name}": {"value": ratio, "unit": "x"}
        for name, ratio in run.get("ratios", {}).items()
    }
    return {**run, "figures": run["figures"] | ratios}


def _draw_panel(axes: Any, name: str, runs: Sequence[Mapping[str, Any]]) -> None:
    from matplotlib.dates import ConciseDateFormatter  # noqa: PLC0415

    measured = [run for run in runs if name in run["figures"]]
    for machine in dict.fromkeys(run["machine"] for run in measured):
        same = [run for run in measured if run["machine"] == machine]
        values = [run["figures"][name]["value"] for run in same]
        dates = [datetime.fromisoformat(run["date"]) for run in same]
        axes.plot(dates, values, "o-", markersize=3, label=machine)
    last = measured[-1]["figures"][name]
    title = name
    if "limit" in last:
        axes.axhline(last["limit"], color="grey", linestyle="--", linewidth=1)
        title += f" ({'≤' if last['at_most'] else '≥'} {last['limit']:g})"
    axes.set_title(title, fontsize=7)
    axes.set_ylabel(last["unit"], fontsize=7)
    axes.set_ylim(bottom=0)
    axes.tick_params(labelsize=6)
    axes.xaxis.set_major_formatter(ConciseDateFormatter(axes.xaxis.get_major_locator()))


def commit() -> str:
    """Name the commit of the code; empty if it is not known."""
    command = ["git", "describe", "--always", "--dirty", "--exclude", "*"]
    try:
        done = subprocess.run(  # noqa: S603  git, as the user has it
            command, cwd=Path(__file__).parent, capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return ""
    return done.stdout.strip()


def machine() -> str:
    """Name the processor, and how many cores there are."""
    cpus = Path("/proc/cpuinfo")
    text = cpus.read_text("utf-8") if cpus.exists() else ""
    model = re.search(r"^(?:model name|Model)\s*:\s*(.+)$", text, re.MULTILINE)
    return f"{model[1] if model else platform.machine()}, {os.cpu_count()} cores"


def _versions() -> Iterator[tuple[str, str]]:
    for package in _PACKAGES:
        try:
            yield package, version(package)
        except PackageNotFoundError:
            continue


if __name__ == "__main__":
    draw(*map(Path, sys.argv[1:3]))
