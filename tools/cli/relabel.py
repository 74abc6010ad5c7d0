"""`hearthlog relabel`: logs labelled anew by a model."""

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hearthlog.tools.cli.selection import Logs, log_location
from hearthlog.tools.cli.text import tell

if TYPE_CHECKING:
    from hearthlog.analyzer.relabel.run import Relabelled

_SHOWN = 20  # of a list


def relabel(
    logs: Logs,
    *,
    model: Annotated[
        Path, typer.Option(help="Model file, where workers find it too.", parser=log_location)
    ],
    workers: Annotated[
        int | None, typer.Option(min=1, help="Processes; as many as there are cores by default.")
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(help="Dask scheduler, as tcp://host:port, whose workers do it instead."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Label every frame of logs anew, in layers beside them.

    The logs are not changed. Layers that are there and would be the same are left as they are:
    what was interrupted goes on where it was when it is run again.

    Exit status 3: a log is damaged, or was not relabelled; the others are done.
    """
    from hearthlog.analyzer.relabel.run import relabel as run
    from hearthlog.analyzer.workers import open_workers
    from hearthlog.models.modelfile.modelfile import load_model
    from hearthlog.tools.cli.progress import share_done

    loaded = load_model(model)
    count = workers or os.cpu_count() or 1
    with (
        open_workers(count, scheduler) as pool,
        share_done("labelling logs", announce=True) as report,
    ):
        found = run(logs, loaded, model.resolve(), pool, report)
    if as_json:
        print(json.dumps(_as_json(found, loaded.name, loaded.sha256), indent=2))
    else:
        _print(found, loaded.name)
    if not (found.layers or found.current):
        raise typer.Exit(1)
    if found.failed or found.lost:
        raise typer.Exit(3)


def _print(found: "Relabelled", model: str) -> None:
    print(f"{_number(len(found.layers), 'layer')} of {_number(found.frames, 'frame')} by {model}")
    if found.current:
        print(f"{_number(len(found.current), 'layer')} there already")
    if found.active:
        print(f"{_number(len(found.active), 'log')} still being written")
    for what, logs in (("not relabelled", found.failed), ("partly relabelled", found.lost)):
        for log, why in sorted(logs.items())[:_SHOWN]:
            tell(f"{what}: {_about(log, why)}")
        if len(logs) > _SHOWN:
            tell(f"{what}: {len(logs) - _SHOWN} more; see --json")


def _about(log: Path, why: str) -> str:
    return why if str(log.parent) in why else f"{log}: {why}"


def _as_json(found: "Relabelled", model: str, sha256: str) -> dict[str, object]:
    return {
        "model": model,
        "model_sha256": sha256,
        "frames": found.frames,
        "layers": [str(layer) for layer in sorted(found.layers)],
        "current": [str(layer) for layer in sorted(found.current)],
        "active": [str(log) for log in found.active],
        "lost": {str(log): why for log, why in found.lost.items()},
        "failed": {str(log): why for log, why in found.failed.items()},
    }


def _number(count: int, what: str) -> str:
    return f"{count:,} {what}" if count == 1 else f"{count:,} {what}s"
