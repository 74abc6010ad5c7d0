"""`hearthlog relabel`: logs labelled anew by a model."""

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hearthlog.schemas.errors import listed
from hearthlog.tools.cli.options import Json, Logs, Scheduler, log_location, starter_of
from hearthlog.tools.cli.text import first_of, number, tell

if TYPE_CHECKING:
    from hearthlog.analyzer.relabel.relabel import Relabelled

_TASKS = "hearthlog.analyzer.relabel.layer"


def relabel(
    logs: Logs,
    *,
    model: Annotated[
        Path,
        typer.Option(
            help="Model file, where workers find it too, or general, bathroom or audioset.",
            parser=log_location,
        ),
    ],
    workers: Annotated[
        int | None,
        typer.Option(min=1, max=256, help="Processes; as many as there are cores by default."),
    ] = None,
    scheduler: Scheduler = None,
    as_json: Json = False,
) -> None:
    """Label every frame of logs anew, in layers beside them.

    The logs are not changed. Layers that are there and would be the same are left as they are:
    what was interrupted goes on where it was when it is run again.

    Exit status 3: a log is damaged, or was not relabelled; the others are done.
    """
    from hearthlog.analyzer.workers import open_workers
    from hearthlog.tools.cli.progress import share_done

    count = workers or os.cpu_count() or 1
    with open_workers(count, scheduler, _TASKS) as pool:
        # Here, since it takes as long as the workers take to be ready.
        from hearthlog.analyzer.relabel.relabel import relabel as run
        from hearthlog.models.modelfile.modelfile import load_model

        model = starter_of(model, logs)
        where = model.resolve() if model.is_file() else model  # else the name of a starter
        loaded = load_model(model)
        with share_done("labelling logs", announce=True) as report:
            result = run(logs, loaded, where, pool, report)
    if as_json:
        print(json.dumps(_as_json(result, loaded.name, loaded.sha256), indent=2))
    else:
        _print(result, loaded.name)
    if not (result.layers or result.current):
        raise typer.Exit(1)
    if result.failed or result.lost:
        raise typer.Exit(3)


def _print(result: "Relabelled", model: str) -> None:
    print(f"{number(len(result.layers), 'layer')} of {number(result.frames, 'frame')} by {model}")
    if result.current:
        print(f"{number(len(result.current), 'layer')} there already")
    if result.active:
        print(f"{number(len(result.active), 'log')} still being written")
    if result.left_out:
        named = [f"{name} (features of {kind})" for name, kind in sorted(result.left_out.items())]
        tell(f"left out, as {model} is for other features: {listed(named, 'and')}")
    if result.by_features:
        logs_there = number(len(result.by_features), "log")
        tell(f"{logs_there} without the embeddings that {model} takes: labelled without them")
    for what, logs in (("not relabelled", result.failed), ("partly relabelled", result.lost)):
        named = [why if str(log.parent) in why else f"{log}: {why}" for log, why in logs.items()]
        for line in first_of(what, sorted(named)):
            tell(line)


def _as_json(result: "Relabelled", model: str, sha256: str) -> dict[str, object]:
    from hearthlog.analyzer.workers.workers import kernel_in_use

    return {
        "model": model,
        "model_sha256": sha256,
        "kernel": kernel_in_use(),
        "frames": result.frames,
        "layers": [str(layer) for layer in sorted(result.layers)],
        "current": [str(layer) for layer in sorted(result.current)],
        "active": [str(log) for log in result.active],
        "lost": {str(log): why for log, why in result.lost.items()},
        "failed": {str(log): why for log, why in result.failed.items()},
        "left_out": result.left_out,
        "by_features": [str(log) for log in result.by_features],
    }
