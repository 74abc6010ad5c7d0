"""`python -m hearthlog.tools.lab.bench [NAME ...]`: measure, side by side and in one run."""

import os

from hearthlog.schemas.blas import kernel_environment
from hearthlog.tools.lab.command import run

# Before numpy is imported: "one core" is to be true for everyone.
os.environ.update(
    dict.fromkeys(
        ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
    )
)
os.environ.update(kernel_environment())
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # an installed hearthlog has its bytecode

import tempfile
from pathlib import Path
from typing import Annotated

import typer

from hearthlog.tools.lab.bench import (
    bridge,
    embedding,
    features,
    history,
    inference,
    live,
    reading,
    recording,
    relabel,
    review,
    size,
    writing,
)
from hearthlog.tools.lab.bench import (
    check as checks,
)
from hearthlog.tools.lab.bench.table import Table
from hearthlog.tools.lab.bench.workload import Workload

MEASUREMENTS = {
    module.__name__.rpartition(".")[2]: module.measure
    for module in (
        features,
        embedding,
        recording,
        live,
        bridge,
        inference,
        size,
        reading,
        writing,
        relabel,
        review,
    )
}


def bench(
    names: Annotated[
        list[str] | None, typer.Argument(help=f"Of {', '.join(MEASUREMENTS)}; all by default.")
    ] = None,
    audio: Annotated[
        Path | None,
        typer.Option(help="Folder of recordings to use instead of the simulated home."),
    ] = None,
    record: Annotated[
        Path | None, typer.Option(help="File to append the figures to, as a line of JSON.")
    ] = None,
    check: Annotated[
        Path | None,
        typer.Option(help="Such a file: measure what is quick, and compare with its last run."),
    ] = None,
) -> None:
    """Measure hearthlog against its peers and its targets.

    Exit status 3: something could not be measured; the tables say why. With --check 1: hearthlog
    lost speed against a peer.
    """
    if check is not None:
        recorded = checks.last_run(check)
        table = checks.compare(_ratios(), recorded)
        print(table)
        raise typer.Exit(int(any(row.verdict == "MISSED" for row in table.rows)))
    chosen = names or list(MEASUREMENTS)
    if unknown := [name for name in chosen if name not in MEASUREMENTS]:
        raise typer.BadParameter(f"{unknown[0]}: known are {', '.join(MEASUREMENTS)}")
    tables: dict[str, Table] = {}
    commit = history.commit()
    source = "the simulated home" if audio is None else audio.name
    with tempfile.TemporaryDirectory(prefix="hearthlog-bench-") as folder:
        work = Workload(Path(folder), audio)
        typer.echo(f"hearthlog bench: sound of {source}", err=True)
        for number, name in enumerate(chosen, start=1):
            typer.echo(f"hearthlog bench: {number} of {len(chosen)}, {name} ...", err=True)
            tables[name] = MEASUREMENTS[name](work)
            print(f"{tables[name]}\n", flush=True)
    if record is not None:
        typer.echo("hearthlog bench: ratios for --check ...", err=True)
        history.record(record, commit, source, tables, _ratios())
    missing = [f"{what} ({name})" for name, table in tables.items() for what in table.missing]
    if missing:
        typer.echo(f"hearthlog bench: not measured: {'; '.join(missing)}", err=True)
        raise typer.Exit(3)


def _ratios() -> dict[str, float]:
    with tempfile.TemporaryDirectory(prefix="hearthlog-bench-") as folder:
        work = Workload(Path(folder), minutes=checks.MINUTES, clips_per_class=checks.CLIPS)
        return checks.measure_ratios(work)


if __name__ == "__main__":
    run(bench)
