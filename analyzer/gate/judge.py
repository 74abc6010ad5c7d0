"""Judge a model before it labels a home: against the one that labels there now."""

import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from hearthlog.analyzer.gate.evidence import Evidence, gather_evidence, right_at_random
from hearthlog.analyzer.gate.recent_time import RecentLog, recent_logs
from hearthlog.analyzer.gate.rules import damages, is_worse, less_right
from hearthlog.analyzer.logs.home_logs import find_home_logs
from hearthlog.models.classifiers.model import Model
from hearthlog.models.errors import ModelError
from hearthlog.models.modelfile.modelfile import load_model
from hearthlog.models.modelfile.registry import (
    CHAMPION,
    Judgement,
    find_model,
    load,
    read_judgement,
    write_judgement,
)
from hearthlog.schemas.errors import LogError, Progress, ignore_progress

_LONGEST = 400  # characters of a reason


@dataclass(frozen=True, eq=False)
class Verdict:
    """The judgement of a model, and what it rests on.

    Attributes
    ----------
    model, champion : str
        Names; that of the champion is empty if nothing labels yet.
    evidence : Evidence or None
        None if there is nothing to compare, or with.
    """

    judgement: Judgement
    model: str
    champion: str
    evidence: Evidence | None


def judge(
    folder: Path, model: Model, home: Sequence[Path], progress: Progress = ignore_progress
) -> Verdict:
    """Compare a model with the one that labels a home now, and keep the judgement.

    Parameters
    ----------
    folder : Path
        Of the model; its champion labels now, or else the model that labelled the latest logs.
    progress : callable, optional
        Is told the share that is done, 0 to 1.

    Raises
    ------
    ModelError
        If the model that labels now cannot be found or used, a feature set is not installed, or the
        judgement cannot be written.
    """
    champion = find_champion(folder, home, model)
    evidence, reasons = None, list[str]()
    if champion is None:
        reasons = [f"there are no labels in {_names(home)} to compare its own with"]
    elif other := other_features(champion, model):
        reasons = [other]
    elif champion.sha256 != model.sha256:
        logs = recent_logs(home)
        evidence = gather_evidence(champion, model, logs, progress)
        reasons = damages(evidence, champion.name) or _worse_than_at_first(
            folder, model, champion, home, logs
        )
    judgement = Judgement(
        model=model.sha256,
        champion="" if champion is None else champion.sha256,
        judged=time.time_ns(),
        reasons=tuple(reason[:_LONGEST] for reason in reasons),
    )
    write_judgement(folder, judgement)
    return Verdict(judgement, model.name, "" if champion is None else champion.name, evidence)


def other_features(champion: Model, model: Model) -> str:
    """Say that two models cannot be compared, if they are of different feature sets."""
    mine, theirs = (one.description.feature_set for one in (model, champion))
    if mine == theirs:
        return ""
    text = f"it is for feature set {mine}, and {champion.name}, which labels now, for {theirs}"
    return f"{text}: they cannot be compared on the same logs"


def find_champion(folder: Path, home: Sequence[Path], model: Model) -> Model | None:
    """Find the model that labels a home now.

    Parameters
    ----------
    folder : Path
        Folder of models, whose champion it is, unless that is the model that is judged or is gone.
    home : sequence of Path
        Folders of logs, the latest of which it else has labelled; of several such models the one
        that the model was adapted from goes first.

    Returns
    -------
    Model or None
        None if there are no logs with labels.

    Raises
    ------
    ModelError
        If the model that labelled the latest log is gone.
    """
    with suppress(ModelError):
        champion = load(folder, CHAMPION)
        if champion.sha256 != model.sha256:
            return champion
    with suppress(LogError):
        named = [one for one in find_home_logs(home).latest_models() if one.model]
        base = model.description.training_data.base_sha256
        for name, labelled_by in sorted(named, key=lambda one: one.model_sha256 != base)[:1]:
            path = find_model(folder, labelled_by)
            if path is None:
                raise ModelError(
                    f"{name} ({labelled_by[:12]}), which labels now, is neither in {folder} "
                    "nor a starter model of this version: put its file there to compare with "
                    f"it, or insist: `hearthlog models promote {model.name} --anyway`"
                )
            return load_model(path)
    return None


def _worse_than_at_first(
    folder: Path, model: Model, champion: Model, home: Sequence[Path], logs: Sequence[RecentLog]
) -> list[str]:
    """See whether models that each lost a little have lost what the first one of the home had."""
    first = _first_model(folder, home)
    if first is None or first.sha256 in {model.sha256, champion.sha256}:
        return []
    if first.description.feature_set != model.description.feature_set:
        return []
    right = right_at_random(first, model, logs)
    return [less_right(right, first.name)] if is_worse(right) else []


def _first_model(folder: Path, home: Sequence[Path]) -> Model | None:
    """Find the model that labelled the first log of a home; None if it is gone."""
    with suppress(LogError, ModelError):
        path = find_model(folder, find_home_logs(home).first_model())
        return None if path is None else load_model(path)
    return None


def judged_against(folder: Path, model: Model, home: Sequence[Path]) -> Judgement | None:
    """Return the judgement that lets a model label, if it still holds.

    It does if the model labels now, or was compared with the model that does. A refusal does not:
    there may be more to judge by since.

    Raise `ModelError` as `find_champion`.
    """
    judgement = read_judgement(folder, model.sha256)
    if judgement is None or not judgement.may_label:
        return None
    with suppress(ModelError):
        if load(folder, CHAMPION).sha256 == model.sha256:
            return judgement
    champion = find_champion(folder, home, model)
    sha256 = "" if champion is None else champion.sha256
    return judgement if judgement.champion == sha256 else None


def _names(home: Sequence[Path]) -> str:
    return ", ".join(map(str, home))
