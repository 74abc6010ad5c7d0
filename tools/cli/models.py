"""`hearthlog models`: models of a folder, their promotion, and networks to download."""

import json
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple

import typer

from hearthlog.tools.cli.options import (
    CLIPS,
    Json,
    OwnScenario,
    labelled_clips,
    logs_folder,
    models_folder,
    starter_here,
)
from hearthlog.tools.cli.tables import share
from hearthlog.tools.cli.terminal import (
    end_with_warnings,
    print_lines,
    print_notice,
    print_table,
    share_done,
    wrong_use,
)

if TYPE_CHECKING:
    from hearthlog.analyzer.evaluation.model_scores import Comparison
    from hearthlog.analyzer.training.dataset import Recording
    from hearthlog.analyzer.training.manifest import Scenario, SkippedClip
    from hearthlog.models.classifiers.model import Model
    from hearthlog.models.embedding.networks import EmbeddingNetwork
    from hearthlog.models.registry import ModelEntry


def fetch(
    name: Annotated[
        str | None, typer.Argument(help="Network, such as yamnet; without a name all are listed.")
    ] = None,
    source: Annotated[
        Path | None,
        typer.Option("--from", help="File of the network, instead of a download."),
    ] = None,
) -> None:
    """Download a pretrained network, which makes labels in a new home more accurate.

    This is the only command of hearthlog that downloads. It prints the origin of the network,
    verifies the digest of the file, and tests the network. Exit status 3: the network is
    installed but does not work.
    """
    from hearthlog.models.embedding.networks import (
        NETWORKS,
        folder_for_new,
        network_folders,
        read_network_file,
    )
    from hearthlog.tools.download import put
    from hearthlog.tools.service.unit import NAME, SYSTEM_UNITS

    if name is None:
        if source is not None:
            wrong_use("name the network: hearthlog models fetch NAME --from FILE")
        _list()
        return
    network = NETWORKS.get(name)
    print_notice(f"{network.attribution}; its licence is {network.licence}")
    path = folder_for_new() / network.filename
    if source is None:
        _download(network, path)
    else:
        put(read_network_file(network, source)[0], path)
    print(path)
    if path.is_relative_to(network_folders()[0]) and (SYSTEM_UNITS / NAME).exists():
        print_notice(
            "the system service does not search there: to install the network for the "
            "service, use sudo"
        )
    end_with_warnings(_tried(network, path))


def _download(network: "EmbeddingNetwork", path: Path) -> None:
    """Download a network unless present."""
    from hearthlog.models.embedding.networks import read_network_file
    from hearthlog.schemas.errors import ModelError
    from hearthlog.tools.download import DownloadError, download

    with suppress(ModelError):
        read_network_file(network, path)
        print_notice("it is already installed")
        return
    file = network.files[0]
    if not file.url:
        raise ModelError(f"{network.name}: it has no download address; give its file with --from")
    what = f"fetching {file.size / 1e6:.1f} MB from {file.url.split('/')[2]}"
    try:
        with share_done(what, announce=True) as report:
            download(file.url, path, file.size, file.sha256, report)
    except DownloadError as error:
        raise DownloadError(f"{error}; or give its file: models fetch NAME --from FILE") from error


def _tried(network: "EmbeddingNetwork", path: Path) -> list[str]:
    """Test a network as a recorder would use it; return the problems."""
    from hearthlog.analyzer.errors import missing
    from hearthlog.models.embedding.networks import missing_modules
    from hearthlog.recorder.labelling.embedder_probe import check_pace, probe_network
    from hearthlog.schemas.errors import ModelError

    if absent := missing_modules(network.suffix):
        return [missing(*absent)]
    try:
        probe = probe_network(network.name, path)
        check_pace(path, probe)
    except ModelError as error:
        return [str(error)]
    if probe.different_answers:
        first = probe.different_answers[0]
        differs = f"{path}: differs from the network that models were trained with ({first}): "
        return [f"{differs}labels are worse"]
    print_notice(
        f"it works: {1000 * probe.seconds:.2g} ms for a window; recorders take it when they start"
    )
    return []


def _list() -> None:
    from hearthlog.models.embedding.networks import NETWORKS, find_network
    from hearthlog.schemas.errors import ModelError

    problems = []
    for name in NETWORKS.names():
        try:
            network = NETWORKS.get(name)
        except ModelError as error:
            problems.append(str(error))
            continue
        size = f"{network.files[0].size / 1e6:.1f} MB"
        there = find_network(name) or "not there"
        print_lines([f"{name}: {there} ({size}, {network.licence}; {network.attribution})"])
    end_with_warnings(problems)


models = typer.Typer(
    no_args_is_help=True,
    help="Manage a folder of models: compare them, and choose which one labels.",
)
models.command()(fetch)

_HEAD = ("name", "alias", "network", "classes", "macro F1")
_LONG_HEAD = (*_HEAD, "inputs", "ECE", "sha256", "MB")


class _ClassShare(NamedTuple):
    """Share of sound that each of two models assigns to a class."""

    name: str
    a: float
    b: float
    a_text: str
    b_text: str


_Folder = Annotated[
    Path | None,
    typer.Option(
        help="Folder of model files.", show_default="that of the configured model, else models"
    ),
]


@models.command("list")
def list_(
    folder: _Folder = None,
    verbose: Annotated[
        bool, typer.Option("--verbose", help="Also show inputs, calibration, digest and size.")
    ] = False,
    as_json: Json = False,
) -> None:
    """List the models and the starters with their classes of sound.

    Exit status 3: one of them cannot be used.
    """
    from hearthlog.models.registry import list_models

    place = models_folder(folder)
    entries = list_models(place)
    if not place.is_dir():
        print_notice(f"{place}: no such folder yet; these models come with hearthlog")
    if as_json:
        print(json.dumps([_as_json(entry) for entry in entries], indent=2))
    else:
        head, row = (_LONG_HEAD, _long_row) if verbose else (_HEAD, _row)
        print_table(head, map(row, entries), words=head.index("macro F1"))
    end_with_warnings([entry.problem for entry in entries if entry.model is None])


@models.command()
def show(
    name: Annotated[str, typer.Argument(help="A model, an alias, a starter, or a file.")],
    folder: _Folder = None,
    as_json: Json = False,
) -> None:
    """Print the card of a model: its classes, accuracy and training data."""
    from hearthlog.models.modelfile import model_card

    model = _named(models_folder(folder), name)
    if as_json:
        result = {"name": model.name, "sha256": model.sha256} | model.description.model_dump()
        print(json.dumps(result, indent=2))
    else:
        print_lines(model_card(model).splitlines())
    if (network := _network(model)) and not _is_here(network):
        print_notice(f"the network {network} is not here: hearthlog models fetch {network}")


@models.command()
def compare(
    a: Annotated[str, typer.Argument(help="A model, or an alias.")] = "champion",
    b: Annotated[str, typer.Argument(help="A model, or an alias.")] = "candidate",
    folder: _Folder = None,
    data: Annotated[Path | None, typer.Option(help=CLIPS)] = None,
    logs: Annotated[
        Path | None,
        typer.Option(help="Folder of logs with review layers, or one log.", readable=False),
    ] = None,
    live: Annotated[
        bool,
        typer.Option(
            "--live", help="Compare the labels of champion and candidate while recording."
        ),
    ] = False,
    scenario: OwnScenario = None,
    as_json: Json = False,
) -> None:
    """Run two models on the same sound, and report which is better, and how certain that is.

    Sources that either was trained on are left out. Exit status 3: there are no others, or
    some clips cannot be read. For logs, the share of each class in a day is reported too.
    """
    from hearthlog.analyzer.evaluation.model_scores import check_features, compare_models
    from hearthlog.analyzer.training.manifest import left_out_lines, load_scenario, scenario_of

    if live:
        if data or scenario or (a, b) != ("champion", "candidate"):
            wrong_use("--live compares champion and candidate, and takes --logs only")
        _compare_live(logs or Path(logs_folder()), as_json=as_json)
        return
    if (data is None) == (logs is None):
        wrong_use("give either --data or --logs, or --live")
    place = models_folder(folder)
    first, second = _named(place, a), _named(place, b)
    check_features(first, second)
    chosen = scenario_of(first) if scenario is None else load_scenario(scenario)
    left_out: list[SkippedClip] = []
    with_embedding = next((one for one in (first, second) if one.description.embedding), first)
    recordings = _recordings(data, logs, chosen, with_embedding, left_out)
    comparison = None
    if logs is None or recordings:
        comparison = compare_models(first, second, recordings, chosen)
    else:
        print_notice("there are no marks: the differences are shown, not which model is better")
    shares = _shares(first, second, comparison, logs)
    if comparison is None and not shares:
        print_notice("there are no recent logs that neither was trained on: record for some hours")
    if as_json:
        result = {} if comparison is None else asdict(comparison) | {"clear": comparison.clear}
        result["said"] = {one.name: [one.a, one.b] for one in shares}
        print(json.dumps(result, indent=2))
    elif comparison is None:
        _print_shares(first.name, second.name, shares, None)
    else:
        _print_comparison(comparison, shares)
    warnings = left_out_lines(left_out)
    if comparison is not None and not comparison.held_out:
        warnings.append(
            "the models were trained on every source: this does not show how good they are on "
            "other recordings"
        )
    end_with_warnings(warnings)


@models.command()
def promote(
    name: Annotated[str, typer.Argument(help="A model, an alias, or a starter.")] = "candidate",
    folder: _Folder = None,
    to: Annotated[
        Literal["champion", "candidate"], typer.Option(help="What it becomes.")
    ] = "champion",
    logs: Annotated[
        list[Path] | None,
        typer.Option(
            help="Logs of the home to check the model with.",
            readable=False,
            show_default="the folder of the models",
        ),
    ] = None,
    anyway: Annotated[
        bool, typer.Option("--anyway", help="Promote without the check, or against its result.")
    ] = False,
) -> None:
    """Make a model the champion, unless it does harm; a running recorder switches to it.

    The model is compared with the current one on recent logs that it was not trained on. No
    comparison is made with the starter model of a new home.
    """
    from hearthlog.models.registry import promote as promote_model

    place = models_folder(folder)
    name = _starter_here(place, name)
    if to == "champion":
        _check_harmless(place, name, logs or [Path(logs_folder())], anyway=anyway)
    else:
        _check_against_champion(place, name)
    model, before = promote_model(place, name, to)
    if model.name == before:
        print(f"{model.name} is the {to} already")
    else:
        print(f"{model.name} ({model.sha256[:12]}) is the {to}{_after(before)}")


@models.command()
def rollback(folder: _Folder = None) -> None:
    """Make the previous champion champion again; before the first, that is a starter model."""
    from hearthlog.models.registry import rollback as roll_back

    model, before = roll_back(models_folder(folder))
    print(f"{model.name} ({model.sha256[:12]}) is champion again{_after(before)}")


def _check_harmless(folder: Path, name: str, home: list[Path], *, anyway: bool) -> None:
    """Raise ModelError if a model was judged harmful; judge a model without a verdict first."""
    from hearthlog.analyzer.promotion import judge, judged_against
    from hearthlog.models.registry import first_starter, is_starter, load, override_judgement
    from hearthlog.models.starter import BY_FEATURES, with_network
    from hearthlog.schemas.errors import ModelError
    from hearthlog.tools.cli.promotion import print_verdict, refusal

    model, first = load(folder, name), first_starter(folder)
    pairs = [(one, with_network(one)) for one in BY_FEATURES]
    is_first = any(first in pair and model.name in pair for pair in pairs)
    is_first = is_first and is_starter(model.name, model.sha256)
    if anyway or is_first:
        override_judgement(folder, model.sha256)
        return
    judgement = judged_against(folder, model, home)
    if judgement is None:
        with share_done(f"judging {model.name}", announce=True) as report:
            verdict = judge(folder, model, home, report)
        own = folder == models_folder()
        print_verdict(verdict, home, model.name if own else str(folder / model.name))
        judgement = verdict.judgement
    if not judgement.may_label:
        raise ModelError(refusal(judgement, model.name))


def _starter_here(folder: Path, name: str) -> str:
    """Return the starter that a name stands for here, unless a model of the folder has this name.

    A starter promoted before a network was installed is in the folder, too.
    """
    from hearthlog.models.registry import is_starter, load
    from hearthlog.schemas.errors import ModelError

    other = str(starter_here(Path(name)))
    if other == name:
        return name
    try:
        model = load(folder, name)
    except ModelError:
        return name
    return other if is_starter(model.name, model.sha256) else name


def _check_against_champion(folder: Path, name: str) -> None:
    """Raise ModelError if a candidate's feature set differs from that of an existing champion."""
    from hearthlog.models.registry import CHAMPION, load
    from hearthlog.schemas.errors import ModelError

    model = load(folder, name)
    try:
        champion = load(folder, CHAMPION)
    except ModelError:
        return
    own, theirs = (one.description.feature_set for one in (model, champion))
    if own != theirs:
        raise ModelError(
            f"{model.name} is for feature set {own}, and {champion.name}, the champion, for "
            f"{theirs}: it cannot label beside it"
        )


def _compare_live(logs: Path, *, as_json: bool) -> None:
    from hearthlog.analyzer.promotion.comparison import compare_on_trial
    from hearthlog.tools.cli.promotion import print_trial, trial_as_json

    trial = compare_on_trial([logs])
    if as_json:
        print(json.dumps(trial_as_json(trial), indent=2))
    else:
        print_trial(trial)
    end_with_warnings(trial.losses)


def _recordings(
    data: Path | None,
    logs: Path | None,
    scenario: "Scenario",
    model: "Model",
    left_out: "list[SkippedClip]",
) -> "list[Recording]":
    from hearthlog.analyzer.training.clips import model_embedder
    from hearthlog.analyzer.training.dataset import UNREADABLE, clip_recordings
    from hearthlog.analyzer.training.home_recordings import home_recordings
    from hearthlog.analyzer.training.manifest import SkippedClip
    from hearthlog.models.features.installed import feature_set

    features = feature_set(model.description.feature_set)
    if logs is not None:
        return list(home_recordings(logs, features, space=model.description.embedding_space))
    assert data is not None
    clips = labelled_clips([data], scenario.labels, left_out)
    with share_done(f"listening to {len(clips)} clips") as report:
        recordings = list(
            clip_recordings(clips, scenario, report, features, embedder=model_embedder(model))
        )
    left_out += [SkippedClip(UNREADABLE, each.fault) for each in recordings if each.fault]
    return recordings


def _named(folder: Path, name: str) -> "Model":
    """Load a model of the folder, a starter model, or a file."""
    from hearthlog.models.modelfile import load_model
    from hearthlog.models.registry import load

    if Path(name).name != name and Path(name).exists():  # a file in another folder
        return load_model(Path(name))
    return load(folder, name)


def _after(before: str | None) -> str:
    return "" if before is None else f", after {before}"


def _shares(
    first: "Model", second: "Model", comparison: "Comparison | None", logs: Path | None
) -> list["_ClassShare"]:
    """Return what two models assign to each class: minutes of a day in logs, or segments."""
    if logs is not None:
        return _minutes_in_logs(first, second, logs)
    assert comparison is not None
    sides = (comparison.a, comparison.b)
    both = [[sum(column) for column in zip(*one.scores.confusion, strict=True)] for one in sides]
    total = max(comparison.a.scores.segments, 1)
    return [
        _ClassShare(name, a / total, b / total, f"{a / total:.1%}", f"{b / total:.1%}")
        for name, a, b in zip(comparison.a.scores.classes, *both, strict=True)
    ]


def _minutes_in_logs(a: "Model", b: "Model", logs: Path) -> list["_ClassShare"]:
    """Return the minutes per average day of each model and class, from recent logs."""
    from hearthlog.analyzer.promotion.comparison import gather_evidence
    from hearthlog.analyzer.promotion.paired_labels import time_words
    from hearthlog.analyzer.promotion.recent_time import recent_logs

    with share_done("listening to the logs with both") as report:
        evidence = gather_evidence(a, b, recent_logs([logs]), report)
    if not evidence.minutes:
        return []
    changes = evidence.changes
    times = zip(changes.classes, changes.before.tolist(), changes.after.tolist(), strict=True)
    return [
        _ClassShare(name, before, after, time_words(before), time_words(after))
        for name, before, after in times
    ]


def _print_comparison(comparison: "Comparison", shares: list["_ClassShare"]) -> None:
    a, b = comparison.a, comparison.b
    print(f"{a.scores.segments} segments from {a.scores.groups} sources", end="")
    print(f"; {comparison.sources_left_out} sources left out, which a model was trained on")
    for reason, count in comparison.skipped.items():
        print(f"{count} recordings left out: {reason}")
    print()
    _print_shares(a.name, b.name, shares, comparison)
    print(f"\n{_verdict(comparison)}")


def _print_shares(
    a: str, b: str, shares: list["_ClassShare"], comparison: "Comparison | None"
) -> None:
    """Print a row for each class that occurs or that either model outputs."""
    sides = () if comparison is None else (comparison.a, comparison.b)
    f1 = [{name: one.f1 for name, one in side.scores.per_class.items()} for side in sides]
    names = dict.fromkeys([*(name for one in f1 for name in one), *(one.name for one in shares)])
    times = {one.name: one for one in shares}
    rows = []
    for name in names:
        time = times.get(name, _ClassShare(name, 0.0, 0.0, "", ""))
        scores = [one.get(name) for one in f1]
        if any(score is not None for score in scores) or time.a or time.b:
            rows.append((name, *map(share, scores), time.a_text, time.b_text))
    if comparison is not None:
        totals = [(one.scores.macro_f1, one.expected_calibration_error) for one in sides]
        macro, calibration = zip(*totals, strict=True)
        rows += [("macro F1", *map(share, macro), "", "")]
        rows += [("calibration error", *map(share, calibration), "", "")]
    head = ["", *(f"F1 {side.name}" for side in sides), f"{a} says", f"{b} says"]
    columns = len(head) if shares else len(head) - 2
    print_table(head[:columns], [row[:columns] for row in rows])


def _verdict(comparison: "Comparison") -> str:
    a, b = comparison.a, comparison.b
    gain, interval = comparison.difference.macro_f1, comparison.difference.interval
    if a.sha256 == b.sha256:
        return "they are the same model"
    change = f"macro F1 of {b.name} is {gain:+.3f}"
    if interval is None:
        return f"one source cannot show a clear difference: {change}"
    change += f" (95 % interval {interval[0]:+.3f} to {interval[1]:+.3f})"
    if not comparison.clear:
        return f"no clear difference: {change}"
    better, worse = (b, a) if gain > 0 else (a, b)
    return f"{better.name} is better than {worse.name}: {change}"


def _network(model: "Model") -> str:
    """Return the name of a model's embedding network; empty for none."""
    mix = model.description.embedding
    return "" if mix is None else mix.network


def _is_here(network: str) -> bool:
    from hearthlog.recorder.labelling.embedder_probe import likely_network

    return likely_network(network) == network


def _row(entry: "ModelEntry") -> tuple[str, ...]:
    from hearthlog.models.classes import OF_EVERY_SCENARIO, in_words

    name = ascii(entry.name)[1:-1]
    alias = ", ".join((*entry.aliases, *["starter"] * entry.starter))
    if entry.model is None:
        return name, alias, "", "cannot be used", ""
    about, network = entry.model.description, _network(entry.model)
    if network and not _is_here(network):
        network += " (not here)"
    sounds = [in_words(one).lower() for one in about.classes if one not in OF_EVERY_SCENARIO]
    figure = f"{about.metrics.macro_f1:.3f}{' simulated' * about.training_data.simulated}"
    return name, alias, network, ", ".join(sounds), figure


def _long_row(entry: "ModelEntry") -> tuple[str, ...]:
    size = f"{entry.size / 1e6:.2f}"
    if entry.model is None:
        return *_row(entry), "", "", "", size
    about = entry.model.description
    inputs = (
        f"{about.feature_set} {about.inputs}{', directions' * bool(about.direction_microphones)}"
    )
    error = f"{about.metrics.expected_calibration_error:.3f}"
    return *_row(entry), inputs, error, entry.model.sha256[:12], size


def _as_json(entry: "ModelEntry") -> dict[str, object]:
    result: dict[str, object] = {
        "name": entry.name,
        "aliases": entry.aliases,
        "starter": entry.starter,
        "bytes": entry.size,
        "problem": entry.problem or None,
    }
    if entry.model is not None:
        description, network = entry.model.description, _network(entry.model)
        result |= {
            "sha256": entry.model.sha256,
            "scenario": description.scenario_name,
            "classes": description.classes,
            "feature_set": description.feature_set,
            "inputs": description.inputs,
            "network": network or None,
            "network_is_here": _is_here(network) if network else None,
            "direction_microphones": description.direction_microphones,
            "simulated": description.training_data.simulated,
            "macro_f1": description.metrics.macro_f1,
            "expected_calibration_error": description.metrics.expected_calibration_error,
        }
    return result
