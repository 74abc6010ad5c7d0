"""`hearthlog relabel`, `replay`, `diff`: logs labelled again, and differences of two labellings."""

import json
import math
import os
import signal
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from threading import Event as Flag
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import typer

from hearthlog.schemas.errors import LogError, listed
from hearthlog.schemas.new_files import check_new
from hearthlog.tools.cli.options import (
    LOG_HELP,
    End,
    Json,
    LocalLog,
    Logs,
    Microphone,
    Scheduler,
    Start,
    check_output,
    log_location,
    logs_folder,
    parse_span,
    scenario_files,
    starter_of,
)
from hearthlog.tools.cli.tables import print_difference, print_queue
from hearthlog.tools.cli.terminal import (
    end_with_warnings,
    first_of,
    moment,
    number,
    print_notice,
    print_recording,
    share_done,
    stopped_by,
    unfinished_lines,
    wrong_use,
)

if TYPE_CHECKING:
    from hearthlog.analyzer.logs.labelling import Labellings, NamedLabelling
    from hearthlog.analyzer.logs.recorder_info import RecorderInfo
    from hearthlog.analyzer.relabel.player import Replay, ReplayOptions
    from hearthlog.analyzer.relabel.relabel import Relabelled
    from hearthlog.analyzer.relabel.replay import LogSet
    from hearthlog.analyzer.review.review_list import ReviewSpan
    from hearthlog.models.classifiers.model import Model


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
        typer.Option(
            "--queue",
            help="List the spans of labelling A to review first: unsure, differing, novel.",
        ),
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
    from hearthlog.analyzer.review.review_list import write_spans
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
        write_spans(output, listed)
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
    from hearthlog.analyzer.evaluation import compare_labellings
    from hearthlog.analyzer.review.review_list import disagreements_to_review

    difference = compare_labellings(*sides)
    figures = {"microphone": microphone, **asdict(difference)}
    figures["disagreements"] = len(difference.disagreements.starts)
    spans = partial(disagreements_to_review, difference, microphone)  # may be a hundred thousand
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


_MAX_RATE = "max"


def replay(
    path: LocalLog,
    *,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help="New folder for a new log, or a new Rerun recording, *.rrd; without it the "
            "replay is only compared with the recording.",
        ),
    ] = None,
    model: Annotated[
        Path | None,
        typer.Option(
            help="Model file. By default the model of the recording, from the current folder, "
            "models, the folder of the logs, or hearthlog itself; without it there are "
            "statistics but no labels (exit status 3)."
        ),
    ] = None,
    scenario: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=FILE",
            help="Additional model, as in `hearthlog record`; may be repeated. By default the "
            "labels of scenarios are left out.",
        ),
    ] = None,
    microphone: Microphone = None,
    source: Annotated[
        Literal["features", "clips"],
        typer.Option("--from", help="Replay the features, or the clips of sound."),
    ] = "features",
    rate: Annotated[
        str, typer.Option("--rate", "-r", help="Speed as a multiple of real time, or max.")
    ] = _MAX_RATE,
    start_offset: Annotated[
        float, typer.Option(help="Start this many seconds into the logs.")
    ] = 0.0,
    playback_duration: Annotated[
        float | None, typer.Option(help="Stop after this many seconds of the logs.")
    ] = None,
    loop: Annotated[bool, typer.Option("--loop", "-l", help="Repeat until Ctrl-C.")] = False,
    as_json: Json = False,
) -> None:
    """Run logs through the pipeline again; with the recorded model, bit for bit as recorded.

    SIGINT (Ctrl-C) and SIGTERM complete the new log. Exit status 3: the replay was
    interrupted, a log is unfinished, sound before or between the logs is missing, or there
    were no labels.
    """
    from hearthlog.analyzer.relabel.player import ReplayOptions
    from hearthlog.analyzer.relabel.replay import LogSet
    from hearthlog.models.modelfile import load_model
    from hearthlog.models.starter import GENERAL, starter_file
    from hearthlog.schemas.logs.files import find_logs

    _check_span(start_offset, playback_duration)
    if loop and output is not None:
        wrong_use(
            "--loop and --output exclude each other: a loop would write the same log repeatedly"
        )
    options = ReplayOptions(
        scenarios={name: load_model(file) for name, file in scenario_files(scenario).items()},
        kind="audio" if source == "clips" else "features",
        output=output,
        start_offset=start_offset,
        duration=playback_duration,
        rate=_parse_rate(rate),
        loop=loop,
    )
    _check_output(output, path)
    logs = LogSet(find_logs(path), options.kind, microphone)
    folder = path if path.is_dir() else path.parent
    models = _Models(model, (Path(), Path("models"), folder, starter_file(GENERAL).parent))
    models.report(logs.chosen(options))
    stop = stopped_by(signal.SIGINT, signal.SIGTERM)
    began = time.monotonic()
    result = _run(logs, replace(options, model=models), stop)
    took = time.monotonic() - began
    if as_json:
        print(json.dumps(_replay_as_json(result, took), indent=2))
    elif output is None:
        print(*_figures(result, took), sep="\n")
    else:
        if output.suffix == ".rrd":
            print_recording(output)
        else:
            print(*result.logs, sep="\n")
        print_notice(*_figures(result, took))
    warnings = _warnings(result)
    if models.are_recorded and not warnings and not result.compared.identical:
        warnings.append(
            "the same model gives other results than recorded: is this another "
            "version of hearthlog?"
        )
    print_notice(*warnings)
    if warnings or models.are_lacking:
        raise typer.Exit(3)


class _Models:
    """The given model, or the models of the logs.

    After `report`, `are_recorded` tells whether all models are the recorded ones, and `are_lacking`
    whether one is missing.
    """

    def __init__(self, given: Path | None, folders: Sequence[Path]) -> None:
        from hearthlog.models.modelfile import load_model

        self._given = None if given is None else load_model(given)
        self._folders = folders
        self._models: dict[tuple[str, str], Model | None] = {}
        self.are_recorded = True
        self.are_lacking = False

    def __call__(self, info: "RecorderInfo") -> "Model | None":
        """Return the model for a recorder's info."""
        from hearthlog.analyzer.relabel.replay import find_recorded_model

        if self._given is not None:
            return self._given
        key = info.model, info.model_sha256
        if key not in self._models:
            self._models[key] = (
                find_recorded_model(*key, self._folders) if info.model_sha256 else None
            )
        return self._models[key]

    def report(self, infos: Sequence["RecorderInfo"]) -> None:
        """Report models that differ from the recorded ones."""
        for info in {(o.model, o.model_sha256): o for o in infos}.values():
            model = self(info)
            digest = "" if model is None else model.sha256
            if digest == info.model_sha256:
                continue
            self.are_recorded = False
            recorded = "recorded without a model"
            if info.model_sha256:
                recorded = f"recorded with model {info.model!r} (sha256 {info.model_sha256[:12]})"
            if model is None:
                self.are_lacking = True
                what = (
                    "which was not found, so there are no labels: name it, or another, with --model"
                )
            else:
                what = f"replayed with {model.name!r} (sha256 {digest[:12]})"
            print_notice(f"{recorded}, {what}")


def _check_span(start_offset: float, duration: float | None) -> None:
    if not 0 <= start_offset < math.inf:
        wrong_use(f"--start-offset {start_offset}: not a number of seconds from 0")
    if duration is not None and not 0 < duration < math.inf:
        wrong_use(f"--playback-duration {duration}: not a number of seconds above 0")


def _parse_rate(text: str) -> float | None:
    try:
        rate = None if text == _MAX_RATE else float(text)
    except ValueError:
        rate = math.nan
    if rate is not None and not 0 < rate < math.inf:
        wrong_use(f"--rate {text}: not a multiple of real time such as 1 or 0.5, nor {_MAX_RATE}")
    return rate


def _check_output(output: Path | None, source: Path) -> None:
    """Refuse an existing output, or one among the replayed logs."""
    if output is None:
        return
    if output.suffix == ".rrd":
        from hearthlog.analyzer.review.viewer.recording import check_output

        check_output(output)
        return
    if output.suffix == ".mcap":
        wrong_use(f"--output {output}: name a folder; its logs are named by time")
    if output.resolve().is_relative_to(source.resolve()):
        raise LogError(f"{output}: is inside the replayed folder; choose another one")
    if not output.is_dir() or any(output.iterdir()):
        check_new(output)


def _run(logs: "LogSet", options: "ReplayOptions", stop: Flag) -> "Replay":
    from hearthlog.analyzer.relabel.replay import replay as replay_logs

    def run(options: "ReplayOptions") -> "Replay":
        with share_done("replaying") as progress:
            return replay_logs(logs, options, stop, progress)

    if options.output is None or options.output.suffix != ".rrd":
        return run(options)
    from hearthlog.analyzer.review.timeline_reader import read_timeline
    from hearthlog.analyzer.review.viewer.recording import save_timeline

    output = options.output
    with tempfile.TemporaryDirectory(prefix=f".{output.name}.", dir=output.parent) as folder:
        result = run(replace(options, output=Path(folder) / "logs"))
        save_timeline(read_timeline(result.logs), output)
    return replace(result, logs=[])


def _figures(result: "Replay", took: float) -> list[str]:
    same = result.compared
    speed = result.seconds / max(took, 1e-9)
    lines = [f"{result.seconds:.1f} s of sound in {took:.1f} s ({speed:.0f} times real time)"]
    if result.labels:
        agreement = _agreement(same.same_labels, same.identical_labels, same.labels)
        lines.append(f"{result.labels} labels, {agreement}")
    if result.segments:
        agreement = _agreement(same.identical_segments, same.identical_segments, same.segments)
        lines.append(f"{result.segments} segments, {agreement}")
    if result.gaps:
        lines.append(f"{result.gaps} gaps")
    return lines


def _agreement(same: int, identical: int, recorded: int) -> str:
    """Return how much of the recorded data was reproduced."""
    if not recorded:
        return "none were recorded"
    bits = "; bit for bit" if identical == recorded else ""
    return f"{same} of the {recorded} recorded ones again ({same / recorded:.2%}){bits}"


def _warnings(result: "Replay") -> list[str]:
    unfinished = "unfinished, replayed up to the last whole chunk"
    lines = [f"{unfinished}: {path}" for path in result.unfinished]
    if count := len(result.missing):
        more = f" (and {count - 1} more times)" if count > 1 else ""
        lines.append(
            f"sound before {moment(result.missing[0])}{more} is not in these logs: its first "
            "second has no labels, and an open segment begins too late; add the earlier logs"
        )
    if result.interrupted:
        lines.append(f"interrupted after {result.seconds:.1f} s of sound")
    return lines


def _replay_as_json(result: "Replay", took: float) -> dict[str, object]:
    fields = asdict(result)
    for key in ("sources", "logs", "unfinished"):
        fields[key] = [str(path) for path in fields[key]]
    fields["compared"] = {k: v for k, v in fields["compared"].items() if not k.startswith("_")}
    fields["compared"]["bit_for_bit"] = result.compared.identical
    return {"seconds": result.seconds, "took_seconds": took} | fields
