"""`hearthlog relabel` and `diff`: labels of another model, and differences of two labellings."""

import json
import os
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from hearthlog.schemas.errors import listed
from hearthlog.tools.cli.options import (
    LOG_HELP,
    End,
    Json,
    Logs,
    Microphone,
    Scheduler,
    Start,
    check_output,
    log_location,
    logs_folder,
    parse_span,
    starter_of,
)
from hearthlog.tools.cli.tables import print_difference, print_queue
from hearthlog.tools.cli.terminal import (
    end_with_warnings,
    first_of,
    number,
    print_notice,
    share_done,
    unfinished_lines,
    wrong_use,
)

if TYPE_CHECKING:
    from hearthlog.analyzer.logs.labelling import Labellings, NamedLabelling
    from hearthlog.analyzer.relabel.relabel import Relabelled
    from hearthlog.analyzer.review.review_list import ReviewSpan


_TASKS = "hearthlog.analyzer.relabel.layer"


def relabel(
    logs: Logs,
    *,
    model: Annotated[
        Path,
        typer.Option(
            help="Model file that the workers can read too, or general, bathroom or audioset.",
            parser=log_location,
        ),
    ],
    workers: Annotated[
        int | None,
        typer.Option(min=1, max=256, help="Number of processes; by default one per core."),
    ] = None,
    scheduler: Scheduler = None,
    as_json: Json = False,
) -> None:
    """Label every frame of logs again, in layers next to the logs.

    The logs are not changed. Existing layers with the same result are kept, so an interrupted
    run continues when it is run again.

    Exit status 3: a log is damaged, or was not relabelled; the others are done.
    """
    from hearthlog.analyzer.workers import open_workers

    count = workers or os.cpu_count() or 1
    with open_workers(count, scheduler, _TASKS) as pool:
        # Imported here: it takes as long as the workers take to start.
        from hearthlog.analyzer.relabel.relabel import relabel as run
        from hearthlog.models.modelfile import load_model

        model = starter_of(model, logs)
        where = model.resolve() if model.is_file() else model  # otherwise a starter name
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
        print_notice(f"left out, because {model} needs other features: {listed(named, 'and')}")
    if result.by_features:
        logs_there = number(len(result.by_features), "log")
        print_notice(f"{logs_there} without embeddings for {model}: labelled by features only")
    for what, logs in (("not relabelled", result.failed), ("partly relabelled", result.lost)):
        named = [why if str(log.parent) in why else f"{log}: {why}" for log, why in logs.items()]
        print_notice(*first_of(what, sorted(named)))


def _as_json(result: "Relabelled", model: str, sha256: str) -> dict[str, object]:
    from hearthlog.analyzer.workers import kernel_in_use

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


_SHOWN, _QUEUED = 10, 60


def diff(
    log: Annotated[str, typer.Argument(help=f"{LOG_HELP} By default the folder logs.")],
    a: Annotated[
        str | None,
        typer.Argument(help="A labelling: live, review, or the model of a relabel layer."),
    ] = None,
    b: Annotated[
        str | None, typer.Argument(help="The other labelling; not needed with --queue.")
    ] = None,
    *,
    queue: Annotated[
        bool,
        typer.Option("--queue", help="List spans of a worth a review: unsure, differing, novel."),
    ] = False,
    spans: Annotated[
        int | None,
        typer.Option(min=1, help=f"How many to show ({_SHOWN}), or to queue ({_QUEUED})."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--list", help="File to write, *.csv: the queue, or all disagreements."),
    ] = None,
    microphone: Microphone = None,
    start: Start = None,
    end: End = None,
    as_json: Json = False,
) -> None:
    """Compare two labellings of logs, or list spans to review next.

    Exit status 3: a log is damaged or unfinished; its readable part and the others were used.
    """
    from hearthlog.analyzer.logs.labelling import find_labellings
    from hearthlog.analyzer.review.review_list import write_list
    from hearthlog.schemas.messages.topics import labelling_topic

    place = log_location(log)
    if a is None or (b is None and not place.exists()):
        place, a, b = log_location(logs_folder()), log, a
    if b is None and not queue:
        wrong_use(f"{a}: name a second labelling, or use --queue")
    check_output("--list", output, ".csv", "a list of spans")
    limits = parse_span(start, end)
    sources = find_labellings(place)
    name = sources.microphone(microphone)
    chosen = [sources.find(name, labelling) for labelling in (a, b) if labelling is not None]
    if len(set(chosen)) < len(chosen):
        wrong_use(f"{a} and {b} are the same; there is {', '.join(sources.names(name))}")
    with share_done("reading segments") as progress:
        sides = [sources.read(name, each, *limits, progress) for each in chosen]
    if queue:
        result = _queue(sources, name, sides, spans or _QUEUED)
    else:
        result = _difference(name, sides, spans or _SHOWN)
    if output is not None:
        listed = result.spans()
        write_list(output, listed)
        print_notice(f"{len(listed)} spans are listed in {output}")
    if as_json:
        spans_as_text = [span.as_text() for span in result.spans()]
        print(json.dumps({**result.figures, "spans": spans_as_text}, allow_nan=False))
    else:
        result.print_tables()
    unfinished = sources.unfinished([labelling_topic(name, each, "segment") for each in chosen])
    end_with_warnings([*sources.losses, *unfinished_lines(unfinished)])


class _Result(NamedTuple):
    figures: dict[str, Any]
    spans: "Callable[[], list[ReviewSpan]]"
    print_tables: Callable[[], None]


def _difference(microphone: str, sides: "list[NamedLabelling]", shown: int) -> _Result:
    from hearthlog.analyzer.evaluation.event_scores import compare_labellings
    from hearthlog.analyzer.review.review_list import disagreements

    difference = compare_labellings(*sides)
    figures = {"microphone": microphone, **asdict(difference)}
    figures["disagreements"] = len(difference.disagreements.starts)
    spans = partial(disagreements, difference, microphone)  # may be a hundred thousand
    return _Result(figures, spans, partial(print_difference, difference, shown))


def _queue(
    sources: "Labellings", microphone: str, sides: "list[NamedLabelling]", count: int
) -> _Result:
    from hearthlog.analyzer.review.candidates import reviewed_time
    from hearthlog.analyzer.review.ranking import make_queue
    from hearthlog.analyzer.review.review_list import queued
    from hearthlog.schemas.messages.topics import is_review, scenario_name

    names = [side.name for side in sides]
    if any(map(is_review, names)):
        wrong_use("a queue lists spans without a review: compare other labellings")
    with share_done("reading labels") as progress:
        ranked = make_queue(
            sources,
            microphone,
            sides[0],
            other=sides[1] if len(sides) > 1 else None,
            reviewed=reviewed_time(sources, microphone, scenario_name(names[0])).spans,
            count=count,
            progress=progress,
        )
    if not ranked.has_uncertainty:
        print_notice(
            f"{names[0]}: its labels have no probabilities, so the score leaves uncertainty out"
        )
    figures = {"microphone": microphone, "labelling": names[0], "candidates": ranked.candidates}
    spans = partial(queued, ranked, microphone, *names)
    return _Result(figures, spans, partial(print_queue, ranked))
