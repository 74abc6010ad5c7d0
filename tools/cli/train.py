"""`hearthlog manifest` and `hearthlog train`: collections of labelled clips, and training."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer

from hearthlog.schemas.errors import listed
from hearthlog.schemas.new_files import private_folder
from hearthlog.tools.cli.options import (
    CLIPS,
    METHOD,
    METHODS,
    SCENARIO,
    Json,
    Scheduler,
    check_output,
    chosen_method,
    labelled_clips,
    models_folder,
    starter_of,
)
from hearthlog.tools.cli.tables import print_counts, print_skipped
from hearthlog.tools.cli.terminal import (
    end_with_warnings,
    number,
    print_lines,
    print_notice,
    print_table,
    share_done,
    wrong_use,
)

if TYPE_CHECKING:
    from collections import Counter

    from hearthlog.analyzer.collections.manifest_writer import ManifestSummary
    from hearthlog.analyzer.promotion import Verdict
    from hearthlog.analyzer.training.dataset import Dataset
    from hearthlog.analyzer.training.manifest import Scenario, SkippedClip
    from hearthlog.analyzer.training.method import Method
    from hearthlog.models.classifiers.model import Amount, Model
    from hearthlog.schemas.arrays import Float32, Indices


_FEW_SOURCES = 5
_FEW_SECONDS = 30.0
_SCENARIO = f"{SCENARIO} With --home only: a scenario of the recorder, by name."
_SPEAKERS = "speakers"  # the speaker scenario


def train(
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help="Model file to write, *.safetensors.",
            show_default="for a home the next of models/home-1.safetensors …",
        ),
    ] = None,
    data: Annotated[list[Path] | None, typer.Option(help=CLIPS)] = None,
    scenario: Annotated[str | None, typer.Option(help=_SCENARIO)] = None,
    home: Annotated[
        list[Path] | None,
        typer.Option(
            help="Folder of logs with review layers, and of enrolled sounds, to learn from.",
            readable=False,
        ),
    ] = None,
    base: Annotated[
        Path | None,
        typer.Option(
            help="Model to adapt to the home, instead of --data.",
            show_default="the model of the latest log",
        ),
    ] = None,
    method: Annotated[str | None, typer.Option(help=METHODS, show_default=METHOD)] = None,
    cost: Annotated[
        float | None,
        typer.Option(help="Cost of a wrong segment; docs/evaluate.md shows how to find it."),
    ] = None,
    gamma: Annotated[
        float | None,
        typer.Option(help="Gamma of the kernel times the number of inputs; see --cost."),
    ] = None,
    smoothing: Annotated[
        str, typer.Option(help="Smoothing of labels to segments: hmm, or merge (as in the paper).")
    ] = "hmm",
    seed: Annotated[
        int,
        typer.Option(min=0, max=2**31, help="Random seed of the rooms simulated for the clips."),
    ] = 0,
    scheduler: Scheduler = None,
    as_json: Json = False,
) -> None:
    """Train a model on labelled sound, and measure it on sources left out of the training.

    A model of a home is checked there, and written whatever the result; `hearthlog models
    promote` ends with 1 if the check fails. Exit status 3: clips or manifest rows were left
    out because they cannot be read.
    """
    from hearthlog.analyzer.errors import require
    from hearthlog.models.modelfile import check_output, load_model, save_model
    from hearthlog.schemas.messages.topics import check_scenario_name

    require("sklearn", "scipy", "joblib")
    left_out: list[SkippedClip] = []
    speakers = scenario == _SPEAKERS
    if speakers or data:
        fits = output is not None and scenario is not None and base is None
        if not fits or (speakers and not home):
            own = "scenario speakers goes with --home" if speakers else "data goes with --scenario"
            wrong_use(f"--{own} and --output, and without --base")
    elif not home or scheduler or (cost, gamma, seed) != (None, None, 0):
        wrong_use(
            "name the training data: `hearthlog train --home logs` for a model of this home, or "
            "`hearthlog train --data MANIFEST.csv --scenario general -o general.safetensors`; "
            "--scheduler, --seed, --cost and --gamma go with --data"
        )
    else:
        named = check_scenario_name(scenario) if scenario else ""
        base = _model_of(home, named) if base is None else starter_of(base, home)
    if output is not None:
        check_output(output)
    if not data and not speakers:
        assert base is not None
        assert home is not None
        model, segments = _adapted(base, home, scenario or "")
    else:
        assert scenario is not None
        from hearthlog.analyzer.training.train import DEFAULT
        from hearthlog.analyzer.workers import fits_on

        # Speakers are separated by features alone.
        method = DEFAULT.name if speakers and method is None else method
        chosen = replace(chosen_method(method, cost=cost, gamma=gamma), seed=seed)
        with fits_on(scheduler):
            words = scenario, home or [], chosen, smoothing
            model, segments = _learned(data or [], *words, left_out)
    output = output or _next_model(f"scenario-{scenario}" if scenario else "home")
    save_model(model, output)
    saved = load_model(output)
    of_home = bool(home) and (scenario is None or (bool(data) and not speakers))
    verdict = _judged(saved, output, home or []) if of_home else None
    if as_json:
        _print_json(saved, output, segments, verdict, left_out)
    else:
        _print(saved, segments)
        print(f"\n{output}: {output.stat().st_size / 1e6:.2f} MB, sha256 {saved.sha256}")
        if verdict is not None:
            _print_verdict(verdict, home or [], output)
        elif scenario and not (data or speakers):
            print(
                f"\nto use it, replace the model file of scenario {scenario}, or run `hearthlog "
                f"record --scenario {scenario}={output}`"
            )
    if left_out:
        raise typer.Exit(3)


def _print_json(
    model: "Model",
    output: Path,
    segments: "Dataset",
    verdict: "Verdict | None",
    left_out: "Sequence[SkippedClip]",
) -> None:
    result: dict[str, Any] = {
        "model": str(output),
        "sha256": model.sha256,
        "skipped": dict(segments.skipped),
    }
    if left_out:
        result["left_out"] = [one._asdict() for one in left_out]
    if verdict is not None:
        result["judgement"] = verdict.judgement.model_dump()
    print(json.dumps(result | model.description.model_dump()))


def _judged(model: "Model", output: Path, home: list[Path]) -> "Verdict | None":
    from hearthlog.analyzer.promotion import judge
    from hearthlog.schemas.errors import ModelError

    try:
        with share_done("comparing it with the current model", announce=True) as report:
            return judge(output.parent, model, home, report)
    except ModelError as error:  # the model was written regardless
        print_notice(str(error))
        return None


def _print_verdict(verdict: "Verdict", home: list[Path], output: Path) -> None:
    from hearthlog.tools.cli.promotion import print_verdict, refusal

    own = output.parent == models_folder()
    print_verdict(verdict, home, output.stem if own else str(output))
    if not verdict.judgement.may_label:
        print(f"\n{refusal(verdict.judgement, verdict.model)}")
    elif own:
        print(
            f"\nthe check found no harm: `hearthlog models promote {output.stem}` makes it "
            "champion, and a recorder without --model uses it within about a second"
        )


def _next_model(name: str) -> Path:
    """Return a new model path for the home or a scenario; creates the folder of models."""
    folder = models_folder()
    numbers = (path.stem.removeprefix(f"{name}-") for path in folder.glob(f"{name}-*.safetensors"))
    number = max((int(text) for text in numbers if text.isdecimal()), default=0) + 1
    private_folder(folder)
    return folder / f"{name}-{number}.safetensors"


def _model_of(home: list[Path], scenario: str) -> Path:
    """Return the model that labelled the latest log, and print its name."""
    from hearthlog.analyzer.logs.home_logs import find_home_logs
    from hearthlog.models.registry import find_model_by_sha256

    logs = find_home_logs(home)
    models = logs.latest_scenario_models(scenario) if scenario else logs.latest_models()
    if not models:
        wrong_use(
            f"--scenario {scenario}: no log has its labels; name a recorded scenario, or its "
            "model with --base, or train one from clips with --data"
        )
    (name, sha256), *others = models
    if others:
        names = listed([name, *(other for other, _ in others)], "and")
        wrong_use(f"the latest logs were labelled by {names}: choose one with --base")
    if not name:
        wrong_use("the latest log has no labels: name a model with --base, such as --base general")
    folder = models_folder()
    path = find_model_by_sha256(folder, sha256)
    if path is None:
        wrong_use(
            f"the latest log was labelled by {name} ({sha256[:12]}), which is neither in "
            f"{folder} nor a starter model of this version: name its file with --base"
        )
    print_notice(f"adapting {name}, which labelled the latest log")
    return path


def _learned(
    data: list[Path],
    scenario: str,
    home: list[Path],
    method: "Method",
    smoothing: str,
    left_out: "list[SkippedClip]",
) -> tuple["Model", "Dataset"]:
    """Train a model of a scenario, or of the enrolled speakers."""
    from hearthlog.analyzer.training.manifest import left_out_lines
    from hearthlog.analyzer.training.train import train_model
    from hearthlog.models.classifiers.model import SmoothingMethod

    if smoothing not in get_args(SmoothingMethod):
        choices = ", ".join(get_args(SmoothingMethod))
        wrong_use(f"--smoothing {smoothing}: choose one of {choices}")
    others = None
    if scenario == _SPEAKERS:
        segments, chosen, others = _cut_voices(data, home, method, left_out)
    else:
        segments, chosen = _cut_clips(data, scenario, home, method, left_out)
    print_notice(*left_out_lines(segments.left_out))
    left_out += segments.left_out
    if scenario != _SPEAKERS:
        _warn_of_few(segments)
    with share_done(f"learning from {len(segments)} segments", announce=True) as report:
        model = train_model(segments, chosen, report, method, smoothing, others)
    return model, segments


def _cut_clips(
    data: list[Path],
    scenario: str,
    home: list[Path],
    method: "Method",
    left_out: "list[SkippedClip]",
) -> "tuple[Dataset, Scenario]":
    """Cut the clips of a scenario, and the marks of homes, into segments."""
    from hearthlog.analyzer.training.dataset import build_dataset
    from hearthlog.analyzer.training.home_recordings import training_recordings
    from hearthlog.analyzer.training.manifest import left_out_lines, load_scenario
    from hearthlog.analyzer.training.train import clip_embedder
    from hearthlog.models.classes import UNKNOWN

    chosen = load_scenario(scenario)
    clips = labelled_clips(data, chosen.labels, left_out)
    print_notice(*left_out_lines(left_out))
    chosen = chosen.with_unknown((clip.label, clip.source_group) for clip in clips)
    if UNKNOWN not in chosen.classes:
        print_notice(
            "fewer than 5 sources have a label outside the classes, such as other_negative: the "
            "model will assign every sound to one of its classes; add some to have an unknown "
            "class"
        )
    embedder = clip_embedder(method)
    space = None if embedder is None or embedder.source is None else embedder.source.space
    recordings = [
        one
        for folder in home
        for one in training_recordings(folder, method.features, method.gate, space)
    ]
    without = sum(one.embedded is None for one in recordings)
    if space is not None and without:
        print_notice(
            f"{without} of {len(recordings)} marks of the home have no embedding of "
            f"{space.network} as installed: only their features are used"
        )
    with share_done(f"listening to {len(clips)} clips", announce=True) as report:
        segments = build_dataset(
            clips, chosen, report, recordings, method.features, method.rooms, embedder, method.seed
        )
    return segments, chosen


def _cut_voices(
    data: list[Path], home: list[Path], method: "Method", left_out: "list[SkippedClip]"
) -> "tuple[Dataset, Scenario, tuple[Float32, Indices]]":
    """Cut the voices of enrolled speakers, and clips of other sounds, into segments."""
    from hearthlog.analyzer.discover.speech import check_voices
    from hearthlog.analyzer.training.dataset import clip_recordings, cut_recordings
    from hearthlog.analyzer.training.manifest import left_out_lines
    from hearthlog.analyzer.training.speakers import (
        others_of,
        speaker_recordings,
        speakers_scenario,
    )
    from hearthlog.models.modelfile import load_model
    from hearthlog.models.starter import GENERAL, starter_file

    enrolled = list(speaker_recordings(home, method.features))
    scenario = speakers_scenario(enrolled)
    check_voices(enrolled, method.features)
    clips = labelled_clips(data, scenario.labels, left_out)
    print_notice(*left_out_lines(left_out))
    others = others_of(load_model(starter_file(GENERAL)), method, scenario)
    with share_done(f"listening to {len(clips)} clips", announce=bool(clips)) as report:
        more = list(
            clip_recordings(
                clips, scenario, report, method.features, method.rooms, seed=method.seed
            )
        )
    return cut_recordings([*enrolled, *more], scenario, method.features), scenario, others


def _adapted(base: Path, home: list[Path], scenario: str) -> tuple["Model", "Dataset"]:
    from hearthlog.analyzer.errors import DataError
    from hearthlog.analyzer.training.adaptation import adapt_model, is_moved
    from hearthlog.analyzer.training.home_training_set import read_home_training_set
    from hearthlog.models.modelfile import load_model

    model = load_model(base)
    segments, notes, nothing = read_home_training_set(home, model, scenario)
    print_notice(*notes)
    if not len(segments):
        reasons = [f"{count} recordings: {why}" for why, count in segments.skipped.items()]
        why = "; ".join(reasons) or nothing
        raise DataError(f"nothing to learn from this home: {why}")
    if not is_moved(model):
        print_notice(
            f"{model.name} is of kind {model.description.kind}: landmarks first learn its "
            "answers, then the home"
        )
    what = f"learning from {len(segments)} segments of the home besides"
    with share_done(what, announce=True):
        adapted = adapt_model(model, segments)
    return adapted, segments


def _warn_of_few(segments: "Dataset") -> None:
    for name, amount in segments.amounts.items():
        if amount.sources < _FEW_SOURCES or amount.seconds < _FEW_SECONDS:
            print_notice(
                f"class {name} has {amount.sources} sources, {amount.seconds:.0f} s: too few to "
                f"trust; better {_FEW_SOURCES} sources and {_FEW_SECONDS:.0f} s"
            )


def _print(model: "Model", segments: "Dataset") -> None:
    from hearthlog.models.classes import in_words, ordered

    data, amounts = model.description.training_data, ("sources", "seconds", "segments")
    adapted = bool(data.base_sha256)
    if not adapted:  # an adapted model has the base model's figures, which were printed
        print_figures(model)
    if data.home:
        home = "also trained on the home"
        print(home if adapted else f"\n{home} (the figures above are those without it)")
        kept = data.home_confirmed
        rows = [
            (in_words(name), *_amounts(data.home[name]), str(kept.get(name, 0)))
            for name in ordered(data.home)
            if data.home[name].segments
        ]
        print_table(("class", *amounts, "not marked"), rows)
    print_skipped(segments.skipped)


def print_figures(model: "Model") -> None:
    """Print the training data of a model, and its scores on unseen sources."""
    from hearthlog.models.classes import UNKNOWN, in_words, ordered
    from hearthlog.models.classifiers.classifier import classifier_kind

    description, metrics = model.description, model.description.metrics
    data = description.training_data
    rows = []
    for name in ordered(description.classes):
        amount, result = data.classes[name], metrics.classes[name]
        if not amount.segments:  # taken from another model only
            continue
        figures = (f"{value:.3f}" for value in (result.precision, result.recall, result.f1))
        rows.append((in_words(name), *_amounts(amount), *figures))
    head = "class", "sources", "seconds", "segments", "precision", "recall", "F1"
    print_table(head, rows)
    others = f" without {in_words(UNKNOWN)!r}" * (UNKNOWN in description.classes)
    print(
        f"\nmacro F1 {metrics.macro_f1:.3f}{others}, expected calibration error "
        f"{metrics.expected_calibration_error:.3f} (cross-validated, {metrics.folds} folds, "
        "sources never split)"
    )
    if (elsewhere := description.elsewhere) is not None:
        print(
            f"in collections left out of the training: {elsewhere.right:.0%} of "
            f"{elsewhere.segments} segments of its classes right, expected calibration error "
            f"{elsewhere.expected_calibration_error:.3f} ({elsewhere.collections} left out in "
            "turn)"
        )
    parameters = [f"{name} {value:.4g}" for name, value in description.parameters.items()]
    print(*parameters, classifier_kind(description.kind).summary(model), sep=", ", end="\n\n")
    print_counts(description.classes, metrics.confusion)


def _amounts(amount: "Amount") -> tuple[str, str, str]:
    return str(amount.sources), f"{amount.seconds:.1f}", str(amount.segments)


_SHOWN = 12


def manifest(
    collection: Annotated[
        str,
        typer.Argument(
            help="esc50, fsd50k, urbansound8k, desed, vocalsound, audioset-strong, ravdess, "
            "emodb, voxceleb, or folder."
        ),
    ],
    folder: Annotated[Path | None, typer.Argument(help="Folder of the collection.")] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Manifest to write, *.csv.")
    ] = None,
    map_file: Annotated[
        Path | None,
        typer.Option(
            "--map", help="Labels of the categories (TOML), in the format of --print-map."
        ),
    ] = None,
    source: Annotated[
        str | None,
        typer.Option(help="Name of the source of a `folder`; by default the folder's name."),
    ] = None,
    licence: Annotated[
        str | None, typer.Option(help="Licence of the sounds in a `folder`, such as CC0.")
    ] = None,
    print_map: Annotated[
        bool,
        typer.Option("--print-map", help="Print the map of the collection, for editing, and exit."),
    ] = False,
) -> None:
    """List the clips of a collection, with labels, sources and licences, for training.

    Exit status 3: some audio files of the collection are missing.
    """
    from hearthlog.analyzer.collections import FOLDER, NAMES, find_collection
    from hearthlog.analyzer.collections.manifest_writer import make_manifest, shipped_map

    chosen = find_collection(collection)
    if chosen is None:
        wrong_use(f"{collection}: no such collection; choose one of {', '.join(NAMES)}")
    if (source or licence) and chosen != FOLDER:
        wrong_use(f"--source and --licence are for a folder; {chosen.title} has its own")
    if print_map:
        print(shipped_map(chosen.name), end="")
        return
    if folder is None or output is None:
        wrong_use("give the folder of the collection, and --output; or --print-map")
    check_output("--output", output, ".csv", "a manifest")
    with share_done(f"looking at {folder}") as report:
        made = make_manifest(chosen, folder, output, report, map_file, source or "", licence or "")
    _print_manifest(made)
    print(f"\n{output}: {number(made.clips.total(), 'clip')}")
    alone = [label for label, count in made.clips.items() if len(made.groups[label]) == 1 < count]
    if chosen == FOLDER and alone:
        print_notice(
            f"{', '.join(alone)}: all files count as one recording, because their names differ "
            "only in a number, and training needs several; put each recording or person in a "
            "subfolder"
        )
    if made.missing:
        files = number(made.files, "audio file")
        lost = f"{made.missing:,} of {files} are not there, such as {made.first_missing}"
        end_with_warnings([f"{folder}: {lost}; left out"])


def _print_manifest(made: "ManifestSummary") -> None:
    rows = [
        (label, f"{count:,}", f"{len(made.groups[label]):,}")
        for label, count in sorted(made.clips.items())
    ]
    print_table(("label", "clips", "sources"), rows)
    print()
    print_lines(_counts("licences", made.licences, "unstated"))
    print_lines(_counts("other_negative is", made.negatives))
    print_lines(f"left out: {count:,}, {why}" for why, count in made.left_out.most_common())
    print_lines(_counts("clips that may belong to a class of ours are", made.skipped))


def _counts(what: str, counts: "Counter[str]", unnamed: str = "") -> list[str]:
    """Return a line with the most frequent names; empty list if there are none."""
    named = [f"{name or unnamed} {count:,}" for name, count in counts.most_common(_SHOWN)]
    more = [f"and {len(counts) - _SHOWN:,} more"] if len(counts) > _SHOWN else []
    return [f"{what}: {', '.join(named + more)}"] if named else []
