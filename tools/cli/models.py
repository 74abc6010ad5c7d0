"""`hearthlog models`: a folder of model files, and the one of them that speaks."""

import json
from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hearthlog.schemas.text import printable

if TYPE_CHECKING:
    from hearthlog.analyzer.evaluation.compare_models import Comparison
    from hearthlog.analyzer.training.dataset import Recording
    from hearthlog.analyzer.training.scenario import Scenario
    from hearthlog.models.features.feature_set import FeatureSet
    from hearthlog.models.modelfile.registry import Entry

models = typer.Typer(
    no_args_is_help=True, help="Keep models in a folder: compare them, and choose which speaks."
)


class Alias(StrEnum):
    """What a model may be promoted to."""

    champion = "champion"
    candidate = "candidate"


_Folder = Annotated[
    Path | None,
    typer.Option(
        help="Folder of model files.", show_default="that of the configured model, else models"
    ),
]
_Json = Annotated[bool, typer.Option("--json", help="Print it as JSON.")]


@models.command("list")
def list_(folder: _Folder = None, as_json: _Json = False) -> None:
    """List the models; exit status 3: one of them cannot be used."""
    from hearthlog.models.modelfile.registry import list_models

    found = list_models(_folder(folder))
    bad = [entry for entry in found if entry.model is None]
    if as_json:
        print(json.dumps([_as_json(entry) for entry in found], indent=2))
    else:
        _print(found)
    for entry in bad:
        typer.echo(f"hearthlog: {entry.problem}", err=True)
    if bad:
        raise typer.Exit(3)


@models.command()
def show(
    name: Annotated[str, typer.Argument(help="A model, or an alias.")],
    folder: _Folder = None,
    as_json: _Json = False,
) -> None:
    """Print a model's card: what it tells apart, how well, and what it learned from."""
    from hearthlog.models.modelfile.card import model_card
    from hearthlog.models.modelfile.registry import load

    model = load(_folder(folder), name)
    if as_json:
        about = {"name": model.name, "sha256": model.sha256}
        print(json.dumps(about | model.description.model_dump(), indent=2))
    else:
        print(*map(printable, model_card(model).splitlines()), sep="\n")


@models.command()
def compare(
    a: Annotated[str, typer.Argument(help="A model, or an alias.")] = "champion",
    b: Annotated[str, typer.Argument(help="A model, or an alias.")] = "candidate",
    folder: _Folder = None,
    data: Annotated[
        Path | None,
        typer.Option(help="Manifest of labelled clips (CSV), or the folder of a manifest.csv."),
    ] = None,
    logs: Annotated[
        Path | None, typer.Option(help="Folder of logs with review layers, or one log.")
    ] = None,
    scenario: Annotated[
        str | None,
        typer.Option(
            help="What is told apart: bathroom, general, or a TOML file; by default what A was "
            "trained for."
        ),
    ] = None,
    as_json: _Json = False,
) -> None:
    """Run two models on the same sound, and say which is better, and how surely.

    Sources that one of them has learned from are left out. Exit status 3: there are no others.
    """
    from hearthlog.analyzer.evaluation.compare_models import compare_models
    from hearthlog.analyzer.evaluation.evaluate_model import scenario_of
    from hearthlog.analyzer.training.scenario import load_scenario
    from hearthlog.models.features.installed import feature_set
    from hearthlog.models.modelfile.registry import load
    from hearthlog.tools.cli.selection import wrong_use

    if (data is None) == (logs is None):
        wrong_use("give either --data or --logs")
    place = _folder(folder)
    first, second = load(place, a), load(place, b)
    chosen = scenario_of(first) if scenario is None else load_scenario(scenario)
    features = feature_set(first.description.feature_set)
    found = compare_models(first, second, _recordings(data, logs, chosen, features), chosen)
    if as_json:
        print(json.dumps(asdict(found) | {"clear": found.clear}, indent=2))
    else:
        _print_comparison(found)
    if not found.held_out:
        typer.echo(
            "hearthlog: every source is one that these models have learned from: this says nothing "
            "of how good they are on others",
            err=True,
        )
        raise typer.Exit(3)


@models.command()
def promote(
    name: Annotated[str, typer.Argument(help="A model, or an alias.")] = "candidate",
    folder: _Folder = None,
    to: Annotated[Alias, typer.Option(help="What it becomes.")] = Alias.champion,
) -> None:
    """Check a model, and make it the champion in one step; a recorder that runs takes it over."""
    from hearthlog.models.modelfile.registry import promote as promote_model

    place = _folder(folder)
    model, before = promote_model(place, name, to.value)
    if model.name == before:
        print(f"{model.name} is the {to} already")
    else:
        print(f"{model.name} ({model.sha256[:12]}) is the {to}{_after(before)}")


@models.command()
def rollback(folder: _Folder = None) -> None:
    """Make the champion before the champion again."""
    from hearthlog.models.modelfile.registry import rollback as roll_back

    model, before = roll_back(_folder(folder))
    print(f"{model.name} ({model.sha256[:12]}) is the champion again{_after(before)}")


def _recordings(
    data: Path | None, logs: Path | None, scenario: "Scenario", features: "FeatureSet"
) -> "list[Recording]":
    from hearthlog.analyzer.training.dataset import clip_recordings
    from hearthlog.analyzer.training.home_data import home_recordings
    from hearthlog.analyzer.training.manifest import read_manifest
    from hearthlog.tools.cli.progress import share_done

    if logs is not None:
        return list(home_recordings(logs, features))
    assert data is not None
    clips = read_manifest(data / "manifest.csv" if data.is_dir() else data, scenario.labels)
    with share_done(f"listening to {len(clips)} clips") as report:
        return list(clip_recordings(clips, scenario, report, features))


def _folder(given: Path | None) -> Path:
    from hearthlog.recorder.config import load_settings

    if given is not None:
        return given
    configured = load_settings(None, {}, {}).model
    return Path("models") if configured is None else configured.parent


def _after(before: str | None) -> str:
    return "" if before is None else f", after {before}"


def _print_comparison(found: "Comparison") -> None:
    a, b = found.a, found.b
    print(f"{a.scores.segments} segments from {a.scores.groups} sources", end="")
    print(f"; {found.sources_left_out} sources left out that a model has learned from")
    for reason, count in found.skipped.items():
        print(f"{count} recordings left out: {reason}")
    rows = [(name, one.f1, b.scores.per_class[name].f1) for name, one in a.scores.per_class.items()]
    rows += [
        ("macro F1", a.scores.macro_f1, b.scores.macro_f1),
        ("calibration error", a.expected_calibration_error, b.expected_calibration_error),
    ]
    widths = [max(len(row[0]) for row in rows), max(len(a.name), 5), max(len(b.name), 5)]
    print(f"\n{'F1':{widths[0]}}  {a.name:>{widths[1]}}  {b.name:>{widths[2]}}")
    for name, *values in rows:
        cells = ("-" if value is None else f"{value:.3f}" for value in values)
        one, other = cells
        print(f"{name:{widths[0]}}  {one:>{widths[1]}}  {other:>{widths[2]}}")
    print(f"\n{_verdict(found)}")


def _verdict(found: "Comparison") -> str:
    gain, interval = found.difference.macro_f1, found.difference.interval
    if found.a.sha256 == found.b.sha256:
        return "they are the same model"
    better, worse = (found.b, found.a) if gain > 0 else (found.a, found.b)
    if interval is None:
        return (
            f"no clear difference can be told from one source: macro F1 of {found.b.name} is "
            f"{gain:+.3f}"
        )
    span = f"(95 % interval {interval[0]:+.3f} to {interval[1]:+.3f})"
    if not found.clear:
        return f"no clear difference: macro F1 of {found.b.name} is {gain:+.3f} {span}"
    return (
        f"{better.name} is better than {worse.name}: macro F1 of {found.b.name} {gain:+.3f} {span}"
    )


def _print(entries: "list[Entry]") -> None:
    head = ("name", "alias", "classes", "inputs", "macro F1", "ECE", "sha256", "size")
    rows = [head, *(_row(entry) for entry in entries)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(head))]
    for row in rows:
        cells = (text.ljust(width) for text, width in zip(row, widths, strict=True))
        print("  ".join(cells).rstrip())


def _row(entry: "Entry") -> tuple[str, ...]:
    alias, size = ", ".join(entry.aliases), f"{entry.size / 1e6:.2f} MB"
    if entry.model is None:
        return ascii(entry.name)[1:-1], alias, "cannot be used", "", "", "", "", size
    about = entry.model.description
    return (
        entry.name,
        alias,
        f"{about.scenario_name} ({len(about.classes)})",
        f"{about.feature_set} {about.inputs}",
        f"{about.metrics.macro_f1:.3f}{' simulated' * about.training_data.simulated}",
        f"{about.metrics.expected_calibration_error:.3f}",
        entry.model.sha256[:12],
        size,
    )


def _as_json(entry: "Entry") -> dict[str, object]:
    found: dict[str, object] = {
        "name": entry.name,
        "aliases": entry.aliases,
        "bytes": entry.size,
        "problem": entry.problem or None,
    }
    if entry.model is not None:
        about = entry.model.description
        found |= {
            "sha256": entry.model.sha256,
            "scenario": about.scenario_name,
            "classes": about.classes,
            "feature_set": about.feature_set,
            "inputs": about.inputs,
            "simulated": about.training_data.simulated,
            "macro_f1": about.metrics.macro_f1,
            "expected_calibration_error": about.metrics.expected_calibration_error,
        }
    return found
