"""`hearthlog evaluate`: scores of a model, labels, a method, and scenes."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from typer.core import TyperGroup

from hearthlog.schemas.errors import Progress, shortened
from hearthlog.tools.cli.options import (
    METHOD,
    METHODS,
    SCENARIO,
    Clips,
    Json,
    LocalLog,
    OwnScenario,
    Plot,
    Scheduler,
    check_output,
    chosen_method,
    labelled_clips,
    starter_here,
)
from hearthlog.tools.cli.tables import (
    print_coughs,
    print_event_counts,
    print_reliability,
    print_scenes,
    print_scores,
    print_skipped,
)
from hearthlog.tools.cli.terminal import (
    NAME_WIDTH,
    end_with_warnings,
    number,
    print_json,
    share_done,
    unfinished_lines,
    wrong_use,
)

if TYPE_CHECKING:
    from hearthlog.analyzer.evaluation.model_scores import ModelEvaluation
    from hearthlog.analyzer.training.dataset import Dataset
    from hearthlog.analyzer.training.manifest import LabelledClip, Scenario, SkippedClip
    from hearthlog.analyzer.training.method import Method
    from hearthlog.analyzer.training.scores import Bin, Scores
    from hearthlog.analyzer.training.train import CrossValidation
    from hearthlog.models.classifiers.model import Model


ModelFile = Annotated[Path, typer.Argument(help="Model file.")]


def scenes(
    model: ModelFile,
    *,
    data: Clips,
    scenes: Annotated[int, typer.Option(min=1, max=100, help="Number of scenes.")] = 3,
    minutes: Annotated[
        float, typer.Option(min=0.25, max=60, help="Length of a scene in minutes.")
    ] = 30.0,
    floor: Annotated[
        float, typer.Option(min=-120, max=0, help="Level of the noise in dBFS.")
    ] = -70.0,
    colour: Annotated[
        Literal["white", "pink", "brown"], typer.Option(help="Spectrum of the noise.")
    ] = "white",
    gain: Annotated[float, typer.Option(min=-60, max=60, help="Level of the clips in dB.")] = 0.0,
    seed: Annotated[int, typer.Option(min=0, help="Random seed of the scenes.")] = 10,
    scenario: OwnScenario = None,
    plot: Plot = None,
    as_json: Json = False,
) -> None:
    """Compose scenes of labelled clips, record them with a model, and score its labels.

    Exit status 3: a class has no clip, the model was trained on some of the clips, or some
    cannot be read.
    """
    from hearthlog.analyzer.errors import require

    require("sklearn", "scipy", "joblib", "matplotlib")
    from hearthlog.analyzer.evaluation.scenes import (
        SceneOptions,
        alarms_per_hour,
        evaluate_scenes,
    )
    from hearthlog.analyzer.training.manifest import left_out_lines

    check_output("--plot", plot, ".png", "a picture")
    loaded, clips, classes, left_out = read_model_and_clips(model, data, scenario)
    options = SceneOptions(scenes, 60.0 * minutes, floor, colour, gain, seed)
    with share_done(f"recording {number(scenes, 'scene')}", announce=True) as report:
        found = evaluate_scenes(model, loaded, clips, classes, options, report)
    where = f"{colour} noise at {floor:g} dBFS"
    if plot is not None:
        from hearthlog.analyzer.evaluation.plots import save_scenes

        save_scenes(plot, f"{loaded.name} on scenes of {data} over {where}", found)
    if as_json:
        scores = asdict(found.scores)
        frames = scores.pop("segments")
        print_json(
            {"model": str(model), "sha256": loaded.sha256, "scenario": classes.name}
            | {"options": asdict(options), "frames": frames}
            | scores
            | asdict(found.detections)
            | {
                "false_alarms_per_hour": alarms_per_hour(found.detections),
                "scenes": [asdict(one) for one in found.scenes],
                "coughs": None if found.coughs is None else asdict(found.coughs),
                "evaluated_seconds": found.evaluated_seconds,
                "sounds": found.sounds,
                "clips": found.clips,
                "sources": found.sources,
                "sources_learned": found.sources_learned,
                "skipped": dict(found.skipped),
            }
        )
    else:
        print(
            f"model {loaded.name}, scenario {classes.name}: {number(scenes, 'scene')} of "
            f"{minutes:g} min over {where}\n{number(found.sounds, 'sound')}, drawn from "
            f"{number(found.clips, 'clip')}; frames of 50 ms\n"
        )
        print_scores(found.scores, found.detections, hours=1)
        print()
        print_scenes(found.scenes)
        if found.coughs is not None:
            print_coughs(found.coughs)
        print_skipped(found.skipped, "clips")
    warnings = left_out_lines([*left_out, *found.left_out])
    warnings += learned_lines(found.sources_learned, found.sources)
    if found.lacking:
        names = ", ".join(found.lacking)
        warnings.append(
            f"{data}: has no clip of {names}: every label of these classes is a false alarm"
        )
    end_with_warnings(warnings)


def learned_lines(learned: int, sources: int) -> list[str]:
    """Return a line with the number of sources that a model was trained on, if any."""
    if not learned:
        return []
    count = f"{learned:,} of the {number(sources, 'source')}"
    return [f"the model was trained on {count}: the figures are too good; leave these out"]


def read_model_and_clips(
    model: Path, data: Path, scenario: str | None
) -> "tuple[Model, list[LabelledClip], Scenario, list[SkippedClip]]":
    """Read a model, its scenario unless another one is named, and clips, with the skipped ones."""
    from hearthlog.analyzer.training.manifest import load_scenario, scenario_of
    from hearthlog.models.modelfile import load_model

    loaded = load_model(starter_here(model))
    classes = load_scenario(scenario) if scenario else scenario_of(loaded)
    left_out: list[SkippedClip] = []
    return loaded, labelled_clips([data], classes.labels, left_out), classes, left_out


_MOVED = {  # options of one subcommand that was split
    "--folds": "method",
    "--model": "model",
    "--reference": "log",
}
_LAB = {  # subcommands and options that moved to modules of `hearthlog.tools.lab`
    "paper": "paper",
    "robustness": "robustness",
    "search": "grid_search",
    "--search": "grid_search",
    "adaptation": "adaptation_curve",
    "--adaptation": "adaptation_curve",
}


class _Group(TyperGroup):
    """Points users of removed subcommands and options to their replacement."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments after `evaluate`."""
        options = {word.partition("=")[0] for word in args}
        module = next((_LAB[word] for word in (*args[:1], *options) if word in _LAB), None)
        if module and args[0] not in self.commands and not ctx.resilient_parsing:
            command = f"python -m hearthlog.tools.lab.{module}"
            wrong_use(f"run `{command} …` in a checkout of hearthlog; its --help lists the options")
        verb = next((verb for option, verb in _MOVED.items() if option in options), None)
        if verb and args[0] not in self.commands and not ctx.resilient_parsing:
            wrong_use(f"use `hearthlog evaluate {verb} …`; its --help lists the options")
        return super().parse_args(ctx, args)


evaluate = typer.Typer(
    cls=_Group, no_args_is_help=True, help="Score the labels of a log, a model, or a method."
)

_Method = Annotated[str | None, typer.Argument(help=METHODS, show_default=METHOD)]
ScenarioOption = Annotated[str, typer.Option(help=SCENARIO)]
Folds = Annotated[
    Literal["segment", "source", "collection"], typer.Option(help="What folds never split.")
]


@evaluate.command("log")
def evaluate_log(
    log: LocalLog,
    *,
    reference: Annotated[
        str, typer.Option(help="Label file, as `annotate` reads it; or review, for review layers.")
    ],
    topic: Annotated[
        str | None,
        typer.Option(help="Topic of the segments; by default the recorder's."),
    ] = None,
    plot: Plot = None,
    as_json: Json = False,
) -> None:
    """Compare the labels of a log with those of a reviewer.

    Exit status 3: a log is unfinished, or the reference has labels that the model lacks.
    """
    from hearthlog.analyzer.errors import require

    require("scipy", "matplotlib")
    from hearthlog.analyzer.evaluation.log_scores import (
        evaluate_labelling,
        read_labelling,
        read_reference,
    )

    check_output("--plot", plot, ".png", "a picture")
    labelled = read_labelling(log, topic)
    true = read_reference(reference, log, labelled.microphone, labelled.scenario)
    result = evaluate_labelling(true, labelled.labelling, labelled.classes)
    _save_plot(plot, f"{labelled.topic} of {log} against {reference}", result.scores)
    if as_json:
        scores = asdict(result.scores)
        frames = scores.pop("segments")
        print_json(
            {"log": str(log), "topic": labelled.topic, "reference": reference, "frames": frames}
            | scores
            | asdict(result.detections)
            | {
                "reference_seconds": result.reference_seconds,
                "evaluated_seconds": result.evaluated_seconds,
                "ambiguous_seconds": result.ambiguous_seconds,
                "unknown_labels": dict(result.unknown_labels),
                "events": {name: one._asdict() for name, one in result.events.items()},
            }
        )
    else:
        print(
            f"{labelled.topic}: {result.evaluated_seconds:.1f} s are labelled of the "
            f"{result.reference_seconds:.1f} s of the reference; frames of 50 ms, "
            f"{number(result.scores.groups, 'block')} of time\n"
        )
        print_scores(result.scores, result.detections)
        print_event_counts(result.events)
        if result.ambiguous_seconds:
            amount = f"{result.ambiguous_seconds:.1f} s have two labels in the reference"
            print(f"\n{amount}: left out of the scores of frames")
    warnings = unfinished_lines(labelled.unfinished)
    if result.unknown_labels:
        warnings.append(_unknown_text(result.unknown_labels))
    end_with_warnings(warnings)


@evaluate.command("model")
def evaluate_model(
    model: ModelFile,
    *,
    data: Clips,
    scenario: OwnScenario = None,
    plot: Plot = None,
    as_json: Json = False,
) -> None:
    """Score a model on labelled clips.

    Exit status 3: the model was trained on some of the clips, or some cannot be read.
    """
    from hearthlog.analyzer.errors import require

    require("sklearn", "scipy", "joblib", "matplotlib")
    from hearthlog.analyzer.evaluation import model_scores as evaluation
    from hearthlog.analyzer.training.manifest import left_out_lines
    from hearthlog.models.features.installed import feature_set

    check_output("--plot", plot, ".png", "a picture")
    loaded, clips, classes, left_out = read_model_and_clips(model, data, scenario)
    seconds = feature_set(loaded.description.feature_set).window_seconds
    evaluation.check_classes(loaded, classes)
    with share_done(f"listening to {len(clips)} clips", announce=True) as report:
        result = evaluation.evaluate_model(loaded, clips, classes, report)
    scores = result.scores
    _save_plot(plot, f"{loaded.name} on {data} ({classes.name})", scores, result.reliability)
    if as_json:
        print_json(
            {"model": str(model), "sha256": loaded.sha256, "scenario": classes.name}
            | asdict(scores)
            | _calibration(result)
            | {
                "evaluated_seconds": result.evaluated_seconds,
                "skipped": dict(result.skipped),
                "sources_learned": result.sources_learned,
            }
            | asdict(result.detections)
        )
    else:
        print(
            f"model {loaded.name}, scenario {classes.name}: {scores.segments} segments of "
            f"{seconds:g} s from {scores.groups} sources\n"
        )
        print_scores(scores, result.detections)
        print_reliability(result.reliability, result.expected_calibration_error)
        print_skipped(result.skipped, "clips")
    warnings = left_out_lines([*left_out, *result.left_out])
    end_with_warnings([*warnings, *learned_lines(result.sources_learned, scores.groups)])


evaluate.command()(scenes)


@evaluate.command("method")
def evaluate_method(
    method: _Method = None,
    *,
    data: Clips,
    scenario: ScenarioOption,
    folds: Folds = "source",
    scheduler: Scheduler = None,
    plot: Plot = None,
    as_json: Json = False,
) -> None:
    """Cross-validate a training method: train on a part of the clips, and test on the rest."""
    from hearthlog.analyzer.errors import require

    require("sklearn", "scipy", "joblib", "matplotlib")
    from hearthlog.analyzer.training.train import evaluate_method as cross_validate

    check_output("--plot", plot, ".png", "a picture")
    with learning(method, data, scenario, scheduler) as (chosen, segments, progress):
        result = cross_validate(segments, chosen, folds, progress)
    title = f"{chosen.name} on {data} ({scenario}), by {folds}"
    _save_plot(plot, title, result.scores, result.reliability)
    if as_json:
        print_json(
            {"scenario": scenario, "method": chosen.name, "by": folds, "folds": result.folds}
            | asdict(result.scores)
            | _calibration(result)
            | {"skipped": dict(segments.skipped)}
        )
        end_with_left_out(segments.left_out)
        return
    print(
        f"method {chosen.name}, scenario {scenario}: {result.scores.segments} segments of "
        f"{chosen.features.window_seconds:g} s from {result.scores.groups} sources, "
        f"{result.folds} folds by {folds}\n"
    )
    print_scores(result.scores)
    print_reliability(result.reliability, result.expected_calibration_error)
    end_with_left_out(segments.left_out)


@contextmanager
def learning(
    name: str | None, data: Path, scenario: str, scheduler: str | None
) -> "Iterator[tuple[Method, Dataset, Progress]]":
    """Cut the clips into segments; the block trains on the cluster."""
    from hearthlog.analyzer.training.dataset import build_dataset
    from hearthlog.analyzer.training.manifest import load_scenario
    from hearthlog.analyzer.training.train import clip_embedder
    from hearthlog.analyzer.workers import fits_on

    method = chosen_method(name)
    with fits_on(scheduler):
        classes = load_scenario(scenario)
        left_out: list[SkippedClip] = []
        clips = labelled_clips([data], classes.labels, left_out)
        classes = classes.with_unknown((clip.label, clip.source_group) for clip in clips)
        with share_done(f"listening to {len(clips)} clips", announce=True) as progress:
            segments = build_dataset(
                clips,
                classes,
                progress,
                features=method.features,
                rooms=method.rooms,
                embedder=clip_embedder(method),
            )
        segments = replace(segments, left_out=[*left_out, *segments.left_out])
        with share_done(f"learning from {len(segments)} segments", announce=True) as progress:
            yield method, segments, progress


def end_with_left_out(left_out: "Sequence[SkippedClip]") -> None:
    """Report skipped clips; end with exit status 3 if there are any."""
    from hearthlog.analyzer.training.manifest import left_out_lines

    end_with_warnings(left_out_lines(left_out))


def _calibration(result: "CrossValidation | ModelEvaluation") -> dict[str, Any]:
    return {
        "expected_calibration_error": result.expected_calibration_error,
        "reliability": [asdict(one) for one in result.reliability],
    }


def _unknown_text(seconds_of: Any) -> str:
    """List the labels that occur only in the reference, longest time first."""
    most = sorted(seconds_of.items(), key=lambda item: -item[1])[:10]
    names = ", ".join(f"{shortened(name, NAME_WIDTH)} ({seconds:.1f} s)" for name, seconds in most)
    more = f" and {len(seconds_of) - len(most)} more" if len(seconds_of) > len(most) else ""
    return f"the log does not know these labels of the reference: {names}{more}"


def _save_plot(path: Path | None, title: str, scores: "Scores", bins: "Sequence[Bin]" = ()) -> None:
    from hearthlog.analyzer.evaluation.plots import save_plot

    if path is not None:
        save_plot(path, title, scores, bins)
