"""`hearthlog evaluate`: how good a model is, or the labels of a log."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hearthlog.tools.cli.method import chosen_method
from hearthlog.tools.cli.progress import share_done
from hearthlog.tools.cli.selection import wrong_use
from hearthlog.tools.cli.text import tell

if TYPE_CHECKING:
    from hearthlog.analyzer.evaluation.evaluate_method import Kind
    from hearthlog.analyzer.evaluation.event_scores import Detections
    from hearthlog.analyzer.training.dataset import Dataset
    from hearthlog.analyzer.training.method import Method
    from hearthlog.analyzer.training.scores import Bin, Scores


def evaluate(
    log: Annotated[
        Path | None, typer.Argument(help="A log, or a folder of logs, to compare with --reference.")
    ] = None,
    *,
    reference: Annotated[
        str | None,
        typer.Option(help="Label file, as `annotate` reads it; or review, for review layers."),
    ] = None,
    topic: Annotated[
        str | None,
        typer.Option(help="Segments to compare; by default what the recorder labelled."),
    ] = None,
    model: Annotated[Path | None, typer.Option(help="Model file, to be run on --data.")] = None,
    data: Annotated[
        Path | None,
        typer.Option(help="Manifest of labelled clips (CSV), or the folder of a manifest.csv."),
    ] = None,
    scenario: Annotated[
        str | None,
        typer.Option(
            help="What is told apart: bathroom, general, or a TOML file; by default what the model "
            "was trained for."
        ),
    ] = None,
    folds: Annotated[
        str | None,
        typer.Option(
            help="Cross-validate learning from --data; what is never split: segment, source or "
            "collection."
        ),
    ] = None,
    method: Annotated[
        str, typer.Option(help="How to learn: bands, or paper (42 statistics).")
    ] = "bands",
    adaptation: Annotated[
        bool,
        typer.Option(
            "--adaptation",
            help="F1 against corrected segments of a home, each collection of --data in its place.",
        ),
    ] = False,
    search: Annotated[
        bool,
        typer.Option(
            "--search", help="Cross-validate learning with other costs and gammas, best first."
        ),
    ] = False,
    scheduler: Annotated[
        str | None, typer.Option(help="Learn on this Dask cluster, as tcp://host:port.")
    ] = None,
    plot: Annotated[Path | None, typer.Option(help="Picture to make, *.png.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Score a model, or a way to learn, on labelled clips, or a log against a reference.

    Exit status 3: a log was unfinished, or the reference has labels that the log does not know.
    """
    of_log, of_model = (log, reference), (model, data)
    if folds is not None or adaptation or search:
        from hearthlog.analyzer.workers.parallel import joblib_on

        if not data or not scenario or any((*of_log, topic, model)):
            wrong_use("--folds, --adaptation or --search goes with --data and --scenario alone")
        if adaptation and (folds or search):
            wrong_use("--adaptation goes without --folds and --search")
        if plot is not None and (adaptation or search):
            wrong_use("--plot does not go with --adaptation and --search")
        _check_plot(plot)
        with joblib_on(scheduler):
            if adaptation:
                _evaluate_adaptation(data, scenario, method, as_json=as_json)
            elif search:
                _search(data, scenario, folds or "source", method, as_json=as_json)
            else:
                assert folds is not None
                _evaluate_method(data, scenario, folds, method, plot, as_json=as_json)
    elif scheduler is not None:
        wrong_use("--scheduler goes with --folds, --adaptation or --search")
    elif all(of_log) and not any((*of_model, scenario)):
        _check_plot(plot)
        assert log is not None
        assert reference is not None
        _evaluate_log(log, reference, topic, plot, as_json=as_json)
    elif all(of_model) and not any((*of_log, topic)):
        _check_plot(plot)
        assert model is not None
        assert data is not None
        _evaluate_model(model, data, scenario, plot, as_json=as_json)
    else:
        wrong_use("give either a log and --reference, or --model and --data, or --folds and --data")


def _evaluate_model(
    path: Path, data: Path, scenario: str | None, plot: Path | None, *, as_json: bool
) -> None:
    from hearthlog.analyzer.evaluation.evaluate_model import (
        check_classes,
        evaluate_model,
        scenario_of,
    )
    from hearthlog.analyzer.evaluation.table import reliability_table
    from hearthlog.analyzer.training.manifest import read_manifest
    from hearthlog.analyzer.training.scenario import load_scenario
    from hearthlog.models.modelfile.modelfile import load_model

    model = load_model(path)
    chosen = scenario_of(model) if scenario is None else load_scenario(scenario)
    check_classes(model, chosen)
    clips = read_manifest(data / "manifest.csv" if data.is_dir() else data, chosen.labels)
    with share_done(f"listening to {len(clips)} clips", announce=True) as report:
        found = evaluate_model(model, clips, chosen, report)
    if plot is not None:
        _save_plot(plot, f"{model.name} on {data} ({chosen.name})", found.scores, found.reliability)
    if as_json:
        _print_json(
            {"model": str(path), "sha256": model.sha256, "scenario": chosen.name}
            | asdict(found.scores)
            | {
                "expected_calibration_error": found.expected_calibration_error,
                "reliability": [asdict(one) for one in found.reliability],
                "evaluated_seconds": found.evaluated_seconds,
                "skipped": dict(found.skipped),
                "learned_from": found.learned_from,
            }
            | asdict(found.detections)
        )
    else:
        scores = found.scores
        print(
            f"model {model.name}, scenario {chosen.name}: {scores.segments} segments of "
            f"{model.description.window_seconds:g} s from "
            f"{scores.groups} sources\n"
        )
        _print_tables(scores, found.detections)
        print()
        print(*reliability_table(found.reliability, found.expected_calibration_error), sep="\n")
        if found.skipped:
            print("\nclips left out")
            print(*(f"{count:6}  {reason}" for reason, count in found.skipped.items()), sep="\n")
    if found.learned_from:
        typer.echo(
            "hearthlog: the model learned from these very segments: this says nothing of how good "
            "it is on others",
            err=True,
        )


def _evaluate_method(
    data: Path, scenario: str, folds: str, method: str, plot: Path | None, *, as_json: bool
) -> None:
    from hearthlog.analyzer.evaluation.evaluate_method import evaluate_method
    from hearthlog.analyzer.evaluation.table import reliability_table

    chosen, by = chosen_method(method), _kind(folds)
    segments = _segments(data, scenario, chosen)
    with share_done(f"learning from {len(segments)} segments", announce=True) as report:
        found = evaluate_method(segments, chosen, by, report)
    if plot is not None:
        _save_plot(
            plot, f"{method} on {data} ({scenario}), by {folds}", found.scores, found.reliability
        )
    if as_json:
        about = {"scenario": scenario, "method": method, "by": folds, "folds": found.folds}
        _print_json(
            about
            | asdict(found.scores)
            | {
                "expected_calibration_error": found.expected_calibration_error,
                "reliability": [asdict(one) for one in found.reliability],
                "skipped": dict(segments.skipped),
            }
        )
        return
    print(
        f"method {method}, scenario {scenario}: {found.scores.segments} segments of "
        f"{chosen.features.window_seconds:g} s from "
        f"{found.scores.groups} sources, {found.folds} folds by {folds}\n"
    )
    _print_tables(found.scores, None)
    print()
    print(*reliability_table(found.reliability, found.expected_calibration_error), sep="\n")


def _search(data: Path, scenario: str, folds: str, method: str, *, as_json: bool) -> None:
    from hearthlog.analyzer.evaluation.grid_search import search
    from hearthlog.analyzer.evaluation.table import search_table

    chosen, by = chosen_method(method), _kind(folds)
    segments = _segments(data, scenario, chosen)
    with share_done(f"learning from {len(segments)} segments", announce=True) as report:
        tried = search(segments, chosen.variations(), by, report)
    if as_json:
        found = [one.method.parameters | asdict(one.scores) for one in tried]
        _print_json({"scenario": scenario, "method": method, "by": folds, "tried": found})
        return
    print(
        f"method {method}, scenario {scenario}: {len(segments)} segments of "
        f"{chosen.features.window_seconds:g} s, folds by {folds}\n"
    )
    print(*search_table(tried), sep="\n")
    best = tried[0].method.parameters
    options = "".join(f" --{name} {value:g}" for name, value in best.items())
    print(f"\nhearthlog train --method {method}{options} …")


def _kind(folds: str) -> "Kind":
    from hearthlog.analyzer.evaluation.evaluate_method import KINDS

    kinds = [kind for kind in KINDS if kind == folds]
    if not kinds:
        wrong_use(f"--folds {folds}: choose one of {', '.join(KINDS)}")
    return kinds[0]


def _evaluate_adaptation(data: Path, scenario: str, method: str, *, as_json: bool) -> None:
    from hearthlog.analyzer.evaluation.adaptation_curve import adaptation_curve

    chosen = chosen_method(method)
    segments = _segments(data, scenario, chosen)
    with share_done(f"learning from {len(segments)} segments", announce=True) as report:
        found = adaptation_curve(segments, chosen, report)
    if as_json:
        _print_json({"scenario": scenario, "method": method} | found._asdict())
        return
    width = max(map(len, (*found.collections, "collection left out")))
    window = f"{chosen.features.window_seconds:g} s"
    print(f"macro F1 after so many corrected segments of {window}\n")
    print(f"{'collection left out':{width}}", *(f"{count:6}" for count in found.corrected))
    for name, row in (found.collections | {"mean": found.mean}).items():
        print(f"{name:{width}}", *(f"{value:6.3f}" for value in row))


def _segments(data: Path, scenario: str, method: "Method") -> "Dataset":
    from hearthlog.analyzer.training.dataset import build_dataset
    from hearthlog.analyzer.training.manifest import read_manifest
    from hearthlog.analyzer.training.scenario import load_scenario

    chosen = load_scenario(scenario)
    clips = read_manifest(data / "manifest.csv" if data.is_dir() else data, chosen.labels)
    with share_done(f"listening to {len(clips)} clips", announce=True) as report:
        return build_dataset(clips, chosen, report, features=method.features)


def _evaluate_log(
    log: Path, reference: str, topic: str | None, plot: Path | None, *, as_json: bool
) -> None:
    from hearthlog.analyzer.evaluation.evaluate_log import compare, read_reference
    from hearthlog.analyzer.logs.labelling import read_labelled

    labelled = read_labelled(log, topic)
    wanted = read_reference(reference, log, labelled.microphone)
    found = compare(wanted, labelled.labelling, labelled.classes)
    if plot is not None:
        _save_plot(plot, f"{labelled.topic} of {log} against {reference}", found.scores, ())
    if as_json:
        scores = asdict(found.scores)
        frames = scores.pop("segments")
        _print_json(
            {"log": str(log), "topic": labelled.topic, "reference": reference, "frames": frames}
            | scores
            | asdict(found.detections)
            | {
                "reference_seconds": found.reference_seconds,
                "evaluated_seconds": found.evaluated_seconds,
                "ambiguous_seconds": found.ambiguous_seconds,
                "unknown_labels": dict(found.unknown_labels),
            }
        )
    else:
        blocks = f"{found.scores.groups} block{'s' if found.scores.groups > 1 else ''} of time"
        print(
            f"{labelled.topic}: {found.evaluated_seconds:.1f} s are labelled of the "
            f"{found.reference_seconds:.1f} s of the reference; frames of 50 ms, "
            f"{blocks}\n"
        )
        _print_tables(found.scores, found.detections)
        if found.ambiguous_seconds:
            print(f"\n{found.ambiguous_seconds:.1f} s have two labels in the reference", end="")
            print(": left out of the scores of frames")
    for line in _log_warnings(labelled.unfinished, found.unknown_labels):
        tell(line)
    if labelled.unfinished or found.unknown_labels:
        raise typer.Exit(3)


def _log_warnings(unfinished: tuple[Path, ...], unknown: Any) -> list[str]:
    from hearthlog.analyzer.evaluation.table import shown

    lines = [f"unfinished, read up to the last whole chunk: {path}" for path in unfinished]
    if unknown:
        most = sorted(unknown.items(), key=lambda item: -item[1])[:10]
        names = ", ".join(f"{shown(name)} ({seconds:.1f} s)" for name, seconds in most)
        more = f" and {len(unknown) - len(most)} more" if len(unknown) > len(most) else ""
        lines.append(f"the log does not know these labels of the reference: {names}{more}")
    return lines


def _print_tables(scores: "Scores", detections: "Detections | None") -> None:
    from hearthlog.analyzer.evaluation.table import class_table, confusion_table

    print(*class_table(scores, detections), sep="\n")
    print()
    print(*confusion_table(scores), sep="\n")


def _print_json(result: dict[str, Any]) -> None:
    print(json.dumps(result, allow_nan=False))


def _check_plot(path: Path | None) -> None:
    from hearthlog.schemas.storage.new_files import check_new

    if path is None:
        return
    if path.suffix != ".png":
        wrong_use(f"--plot {path}: a picture is named *.png")
    check_new(path)


def _save_plot(path: Path, title: str, scores: "Scores", bins: "list[Bin] | tuple[()]") -> None:
    from hearthlog.analyzer.evaluation.plot import save_plot

    save_plot(path, title, scores, bins)
