"""`hearthlog train`: labelled clips to a model file."""

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from models.modelfile import Model


def train(
    data: Annotated[
        Path,
        typer.Option(help="Manifest of labelled clips (CSV), or the folder of a manifest.csv."),
    ],
    scenario: Annotated[
        str, typer.Option(help="What to tell apart: bathroom, general, or a TOML file.")
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Model file to make, *.safetensors.")
    ],
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Learn a model from labelled clips, and measure it on sources it has not heard."""
    from analyzer.dataset import build_dataset
    from analyzer.manifest import read_manifest
    from analyzer.scenario import load_scenario
    from analyzer.train import train_model
    from models.modelfile import check_output, load_model, save_model

    check_output(output)
    chosen = load_scenario(scenario)
    clips = read_manifest(data / "manifest.csv" if data.is_dir() else data, chosen.labels)
    with _progress(f"listening to {len(clips)} clips") as report:
        segments = build_dataset(clips, chosen, report)
    with _progress(f"learning from {len(segments.target)} segments") as report:
        model = train_model(segments, chosen, report)
    save_model(model, output)
    saved = load_model(output)
    if as_json:
        about = saved.description.model_dump()
        result = {"model": str(output), "sha256": saved.sha256, "skipped": segments.skipped}
        print(json.dumps(result | about))
    else:
        _print(saved, segments.skipped)
        print(f"\n{output}: {output.stat().st_size / 1e6:.2f} MB, sha256 {saved.sha256}")


@contextmanager
def _progress(what: str) -> Iterator[Callable[[int, int], None]]:
    """Show a bar on stderr if that is a terminal, else one line."""
    from rich.console import Console
    from rich.progress import Progress

    if not sys.stderr.isatty():
        typer.echo(f"hearthlog: {what}", err=True)
        yield lambda _done, _total: None
        return
    with Progress(console=Console(stderr=True)) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def _print(model: "Model", skipped: dict[str, int]) -> None:
    about, metrics = model.description, model.description.metrics
    width = max(len(name) for name in (*about.classes, "class"))
    print(f"{'class':{width}}  sources  seconds  segments  precision  recall     F1")
    for name in about.classes:
        amount, result = about.training_data.classes[name], metrics.classes[name]
        print(
            f"{name:{width}}  {amount.sources:7}  {amount.seconds:7.0f}  {amount.segments:8}  "
            f"{result.precision:9.3f}  {result.recall:6.3f}  {result.f1:5.3f}"
        )
    print(f"\nmacro F1 {metrics.macro_f1:.3f}, expected calibration error ", end="")
    print(f"{metrics.expected_calibration_error:.3f}", end="")
    print(f" (cross-validated, {metrics.folds} folds, sources never split)")
    print(f"cost {about.cost:g}, gamma {about.gamma:.4g}, ", end="")
    print(f"{len(model.support_vectors)} support vectors\n")
    print("confusion: true class in rows, predicted in columns")
    size = max(len(str(value)) for row in metrics.confusion for value in row) + 2
    for name, row in zip(about.classes, metrics.confusion, strict=True):
        print(f"{name:{width}}", *(f"{value:{size}}" for value in row), sep="")
    if skipped:
        print("\nclips left out")
    for reason, count in skipped.items():
        print(f"{count:6}  {reason}")
