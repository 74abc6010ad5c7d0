"""`hearthlog train`: labelled sound to a model file."""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hearthlog.tools.cli.method import chosen_method
from hearthlog.tools.cli.progress import share_done
from hearthlog.tools.cli.selection import wrong_use

if TYPE_CHECKING:
    from hearthlog.analyzer.training.dataset import Dataset, Recording
    from hearthlog.analyzer.training.method import Method
    from hearthlog.analyzer.training.scenario import Scenario
    from hearthlog.models.classifiers.model import Model
    from hearthlog.models.features.feature_set import FeatureSet

_FEW_SOURCES = 5
_FEW_SECONDS = 30.0


def train(
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Model file to make, *.safetensors.")
    ],
    data: Annotated[
        list[Path] | None,
        typer.Option(help="Manifest of labelled clips (CSV), or the folder of a manifest.csv."),
    ] = None,
    scenario: Annotated[
        str | None, typer.Option(help="What to tell apart: bathroom, general, or a TOML file.")
    ] = None,
    home: Annotated[
        list[Path] | None,
        typer.Option(help="Logs with review layers, and enrolled sounds, to learn from as well."),
    ] = None,
    base: Annotated[
        Path | None, typer.Option(help="Model to adapt to the home, instead of --data.")
    ] = None,
    method: Annotated[
        str, typer.Option(help="bands, or paper: the 42 statistics and SVM of the paper.")
    ] = "bands",
    cost: Annotated[
        float | None, typer.Option(help="Of a wrong segment; evaluate --search finds a good one.")
    ] = None,
    gamma: Annotated[
        float | None, typer.Option(help="Of the kernel, times the number of inputs; as --cost.")
    ] = None,
    smoothing: Annotated[
        str, typer.Option(help="How labels become segments: hmm, or merge (the paper's).")
    ] = "hmm",
    scheduler: Annotated[
        str | None, typer.Option(help="Learn on this Dask cluster, as tcp://host:port.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Learn a model from labelled sound, and measure it on sources it has not heard."""
    from hearthlog.models.modelfile.modelfile import check_output, load_model, save_model

    check_output(output)
    if base is not None:
        if data or scenario or not home or scheduler or (cost, gamma) != (None, None):
            wrong_use("--base goes with --home, and with nothing that is about --data")
        model, segments = _adapted(base, home)
    else:
        if not data or not scenario:
            wrong_use("give --data and --scenario, or --base and --home")
        from hearthlog.analyzer.workers.parallel import joblib_on

        chosen = chosen_method(method, cost=cost, gamma=gamma)
        with joblib_on(scheduler):
            model, segments = _learned(data, scenario, home or [], chosen, smoothing)
    save_model(model, output)
    saved = load_model(output)
    if as_json:
        about = saved.description.model_dump()
        result = {"model": str(output), "sha256": saved.sha256, "skipped": dict(segments.skipped)}
        print(json.dumps(result | about))
    else:
        _print(saved, segments)
        print(f"\n{output}: {output.stat().st_size / 1e6:.2f} MB, sha256 {saved.sha256}")


def _learned(
    data: list[Path], scenario: str, home: list[Path], method: "Method", smoothing: str
) -> tuple["Model", "Dataset"]:
    from hearthlog.analyzer.training.dataset import build_dataset
    from hearthlog.analyzer.training.manifest import read_manifest
    from hearthlog.analyzer.training.scenario import load_scenario
    from hearthlog.analyzer.training.train import SMOOTHINGS, train_model

    if smoothing not in SMOOTHINGS:
        wrong_use(f"--smoothing {smoothing}: choose one of {', '.join(SMOOTHINGS)}")
    chosen = load_scenario(scenario)
    clips = [clip for path in data for clip in read_manifest(_manifest(path), chosen.labels)]
    with share_done(f"listening to {len(clips)} clips", announce=True) as report:
        recordings = _heard_at(home, method.features)
        segments = build_dataset(clips, chosen, report, recordings, method.features)
    _warn_of_few(segments)
    with share_done(f"learning from {len(segments)} segments", announce=True) as report:
        return train_model(segments, chosen, report, method, smoothing), segments


def _adapted(base: Path, home: list[Path]) -> tuple["Model", "Dataset"]:
    from hearthlog.analyzer.training.dataset import cut_recordings
    from hearthlog.analyzer.training.home_data import home_sequences
    from hearthlog.analyzer.training.train import adapt_model
    from hearthlog.models.features.installed import feature_set
    from hearthlog.models.modelfile.modelfile import load_model

    model = load_model(base)
    features = feature_set(model.description.feature_set)
    segments = cut_recordings(_heard_at(home, features), _scenario(model), features)
    with share_done(f"learning from {len(segments)} segments of the home besides", announce=True):
        sequences = [run for folder in home for run in home_sequences(folder, model.classes)]
        return adapt_model(model, segments, sequences), segments


def _scenario(model: "Model") -> "Scenario":
    from hearthlog.analyzer.training.scenario import Scenario

    about = model.description
    classes = {name: tuple(labels) for name, labels in about.scenario.items()}
    return Scenario(about.scenario_name, classes)


def _manifest(path: Path) -> Path:
    return path / "manifest.csv" if path.is_dir() else path


def _heard_at(folders: list[Path], features: "FeatureSet") -> Iterator["Recording"]:
    from hearthlog.analyzer.training.home_data import home_recordings

    for folder in folders:
        yield from home_recordings(folder, features)


def _warn_of_few(segments: "Dataset") -> None:
    for name, amount in segments.amounts.items():
        if amount.sources < _FEW_SOURCES or amount.seconds < _FEW_SECONDS:
            typer.echo(
                f"hearthlog: class {name} has {amount.sources} sources, {amount.seconds:.0f} s: "
                f"too few to be trusted; better {_FEW_SOURCES} sources and {_FEW_SECONDS:.0f} s",
                err=True,
            )


def _print(model: "Model", segments: "Dataset") -> None:
    from hearthlog.models.classifiers.classifier import classifier_kind

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
    parameters = [f"{name} {value:.4g}" for name, value in about.parameters.items()]
    print(*parameters, classifier_kind(about.kind).summary(model), sep=", ", end="\n\n")
    print("confusion: true class in rows, predicted in columns")
    size = max(len(str(value)) for row in metrics.confusion for value in row) + 2
    for name, row in zip(about.classes, metrics.confusion, strict=True):
        print(f"{name:{width}}", *(f"{value:{size}}" for value in row), sep="")
    if about.training_data.home:
        print("\nlearned from the home besides (the figures above are those before)")
    for name, amount in about.training_data.home.items():
        if amount.segments:
            print(f"{name:{width}}  {amount.sources:7}  {amount.seconds:7.1f}  {amount.segments:8}")
    _print_skipped(segments.skipped)


def _print_skipped(skipped: Mapping[str, int]) -> None:
    if skipped:
        print("\nrecordings left out")
    for reason, count in skipped.items():
        print(f"{count:6}  {reason}")
