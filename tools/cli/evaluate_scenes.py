"""`hearthlog evaluate scenes`: a model on sounds as homes have them."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from hearthlog.tools.cli.options import (
    Clips,
    Json,
    OwnScenario,
    Plot,
    check_output,
    labelled_clips,
    starter_here,
)
from hearthlog.tools.cli.progress import share_done
from hearthlog.tools.cli.scores import (
    print_coughs,
    print_scenes,
    print_scores,
    print_skipped,
)
from hearthlog.tools.cli.text import end_with_warnings, number, print_json

if TYPE_CHECKING:
    from hearthlog.analyzer.training.manifest import LabelledClip, Scenario, SkippedClip
    from hearthlog.models.classifiers.model import Model

ModelFile = Annotated[Path, typer.Argument(help="Model file.")]


def scenes(
    model: ModelFile,
    *,
    data: Clips,
    scenes: Annotated[int, typer.Option(min=1, max=100, help="How many to compose.")] = 3,
    minutes: Annotated[float, typer.Option(min=0.25, max=60, help="Length of each.")] = 30.0,
    floor: Annotated[
        float, typer.Option(min=-120, max=0, help="Level of the noise in dBFS.")
    ] = -70.0,
    colour: Annotated[
        Literal["white", "pink", "brown"], typer.Option(help="Of the noise.")
    ] = "white",
    gain: Annotated[float, typer.Option(min=-60, max=60, help="Of the clips, in dB.")] = 0.0,
    seed: Annotated[int, typer.Option(min=0, help="Another one composes other scenes.")] = 10,
    scenario: OwnScenario = None,
    plot: Plot = None,
    as_json: Json = False,
) -> None:
    """Compose scenes of labelled clips, record them with a model, and score its labels.

    Exit status 3: a class has no clip, the model has learned from some of the clips, or some cannot
    be read.
    """
    from hearthlog.analyzer.extras import require

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
        warnings.append(f"{data}: has no clip of {names}: what is labelled so is a false alarm")
    end_with_warnings(warnings)


def learned_lines(learned: int, sources: int) -> list[str]:
    """Say in a line of how many sources a model has learned, if of any."""
    if not learned:
        return []
    count = f"{learned:,} of the {number(sources, 'source')}"
    return [f"the model has learned from {count}: the figures flatter it; leave these out"]


def read_model_and_clips(
    model: Path, data: Path, scenario: str | None
) -> "tuple[Model, list[LabelledClip], Scenario, list[SkippedClip]]":
    """Read a model, its scenario unless another one is named, and clips; some are of no use."""
    from hearthlog.analyzer.training.manifest import load_scenario, scenario_of
    from hearthlog.models.modelfile.modelfile import load_model

    loaded = load_model(starter_here(model))
    classes = load_scenario(scenario) if scenario else scenario_of(loaded)
    left_out: list[SkippedClip] = []
    return loaded, labelled_clips([data], classes.labels, left_out), classes, left_out
