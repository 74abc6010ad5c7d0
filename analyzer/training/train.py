"""Training: a model is learned from segments, and measured on sources it has not learned from."""

from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import version
from typing import Any

import numpy as np
from sklearn.metrics import confusion_matrix, precision_recall_fscore_support
from sklearn.model_selection import StratifiedGroupKFold

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.training.dataset import Dataset
from hearthlog.analyzer.training.installed import DEFAULT, method_named
from hearthlog.analyzer.training.method import (
    Fold,
    Learned,
    Method,
    cross_validate,
    inverse_temperature,
    prepare,
    softmax,
)
from hearthlog.analyzer.training.scenario import Scenario
from hearthlog.analyzer.training.scores import calibration_error
from hearthlog.analyzer.training.transitions import (
    LAG_SECONDS,
    default_transitions,
    expected_durations,
    transitions_from_sequences,
)
from hearthlog.models.classifiers.description import (
    FORMAT,
    ClassMetrics,
    Collection,
    Description,
    Metrics,
    Smoothing,
    TrainingData,
)
from hearthlog.models.classifiers.model import Model
from hearthlog.schemas.arrays import Float64, Int64
from hearthlog.schemas.progress import Progress

MOST_FOLDS = 5
SMOOTHINGS = ("hmm", "merge")
_SHUFFLES = 20


def train_model(
    data: Dataset,
    scenario: Scenario,
    progress: Progress,
    method: Method = DEFAULT,
    smoothing: str = "hmm",
) -> Model:
    """Learn a model, and calibrate and measure it on folds that never split a source group.

    Parameters
    ----------
    data : Dataset
    scenario : Scenario
        That of the data.
    progress : callable
        Is told the share of the fits that is done, 0 to 1.
    method : Method, optional
    smoothing : str
        `hmm` or `merge`, as field `method` of `Smoothing` has it.

    Raises
    ------
    DataError
        If a class comes from fewer than two source groups, if no division into folds leaves every
        class something to learn from, if all segments are alike, or if the method wants augmented
        copies and its feature set has none.
    ModelError
        If the feature set of the method is not installed.
    """
    check_varied(data)
    folds = group_folds(data)
    examples = prepare(method, data)

    def report(share: float) -> None:
        progress(share * len(folds) / (len(folds) + 1))

    [decisions] = cross_validate([method], examples, len(data.classes), folds, report)
    inverse = inverse_temperature(decisions, data.target)
    learned = method.fit(examples)
    progress(1.0)
    hidden = smoothing == "hmm"
    return Model(
        Description(
            **_method_fields(method, learned),
            **_scenario_fields(scenario, data),
            calibration="temperature",
            inverse_temperature=inverse,
            smoothing=Smoothing(method="hmm", lag_seconds=LAG_SECONDS)
            if hidden
            else Smoothing(method="merge"),
            metrics=_metrics(data, decisions, inverse, len(folds)),
        ),
        learned.arrays(),
        transitions=default_transitions(data.classes) if hidden else np.empty((0, 0)),
        training_windows=data.windows,
        training_target=data.target.astype(np.int64),
        training_group=data.group.astype(np.int64),
    )


def adapt_model(base: Model, home: Dataset, sequences: Sequence[Int64] = ()) -> Model:
    """Learn a model again, from its own segments and those of a home.

    Parameters
    ----------
    base : Model
        A model with its training windows.
    home : Dataset
        Of the same classes, some of which may have no segments.
    sequences : sequence of np.ndarray [shape=(n,)], int64
        Indices of the classes of successive frames in the home, to estimate transitions from. By
        default the model keeps its transitions.

    Returns
    -------
    Model
        With the parameters, calibration and metrics of `base`, which are those of other homes. It
        keeps the windows of `base` only, so that it can be adapted again to more of the home.

    Raises
    ------
    DataError
        If the base model has no training windows, the home has no segments, the method of the
        base model is not installed, or that method wants augmented copies and its feature set has
        none.
    ModelError
        If the method cannot be imported, or its feature set is not installed.
    """
    description = base.description
    if not len(base.training_windows):
        raise DataError(f"{base.name}: has not kept what it learned from; train it anew to adapt")
    if not len(home):
        reasons = "; ".join(f"{count} recordings: {why}" for why, count in home.skipped.items())
        raise DataError(
            f"the home has no segments of a class of the model ({reasons or 'nothing is marked'})"
        )
    joined = replace(
        home,
        windows=np.concatenate([base.training_windows, home.windows]),
        target=np.concatenate([base.training_target, home.target]),
        group=np.concatenate([base.training_group, home.group]),
        weight=np.concatenate([np.ones(len(base.training_windows)), home.weight]),
    )
    method = method_named(description.method).as_of(description)
    examples = prepare(method, joined)
    learned = method.fit(examples, home=np.arange(len(base.training_windows), len(joined)))
    training = description.training_data.model_copy(
        update={"home": home.amounts, "base_sha256": base.sha256}
    )
    return Model(
        description.model_copy(update={"training_data": training}),
        learned.arrays(),
        transitions=(
            transitions_from_sequences(sequences, expected_durations(base.classes))
            if len(base.transitions) and len(sequences)
            else base.transitions
        ),
        training_windows=base.training_windows,
        training_target=base.training_target,
        training_group=base.training_group,
    )


def check_varied(data: Dataset) -> None:
    """Check that not all segments are alike.

    Raises
    ------
    DataError
        If there are segments, and their features never change.
    """
    if len(data) and (np.ptp(data.windows.reshape(-1, data.windows.shape[2]), axis=0) == 0).all():
        raise DataError("all segments are alike: their features never change; is this sound?")


def group_folds(data: Dataset) -> list[Fold]:
    """Divide the segments into up to five folds that never split a source group.

    Returns
    -------
    list of Fold
        Indices of the segments to learn from, among which every class is, and of those to test on.

    Raises
    ------
    DataError
        If a class comes from fewer than two groups, or no division leaves every class something
        to learn from.
    """
    sources = [amount.sources for amount in data.amounts.values()]
    fewest = int(np.argmin(sources))
    if sources[fewest] < 2:
        raise DataError(
            f"class {data.classes[fewest]} has {sources[fewest]} source group; it needs at least "
            f"2, better {MOST_FOLDS}, to be tested on recordings that were not learned from"
        )
    count = min(MOST_FOLDS, sources[fewest])
    everything = np.arange(len(data.classes))
    for seed in range(_SHUFFLES):
        divider = StratifiedGroupKFold(count, shuffle=True, random_state=seed)
        folds = list(divider.split(data.target, data.target, data.group))
        if all(np.array_equal(np.unique(data.target[seen]), everything) for seen, _ in folds):
            return folds
    raise DataError(
        f"class {data.classes[fewest]} has {sources[fewest]} source groups, shared with other "
        "classes: no division into folds leaves every class something to learn from; add sources"
    )


def _metrics(data: Dataset, decision: Float64, inverse: float, folds: int) -> Metrics:
    predicted = decision.argmax(axis=1)
    precision, recall, f1, _ = precision_recall_fscore_support(
        data.target, predicted, labels=range(len(data.classes)), zero_division=0.0
    )
    confusion = confusion_matrix(data.target, predicted, labels=range(len(data.classes)))
    return Metrics(
        folds=folds,
        macro_f1=float(f1.mean()),
        expected_calibration_error=calibration_error(softmax(inverse * decision), data.target),
        classes={
            name: ClassMetrics(
                precision=float(precision[i]), recall=float(recall[i]), f1=float(f1[i])
            )
            for i, name in enumerate(data.classes)
        },
        confusion=confusion.tolist(),
    )


def _method_fields(method: Method, learned: Learned) -> dict[str, Any]:
    features = method.features
    return {
        "format": FORMAT,
        "kind": method.kind,
        "parameters": learned.parameters(),
        "method": method.name,
        "feature_set": features.name,
        "feature_set_version": features.version,
        "feature_names": list(features.feature_names),
        "inputs": method.inputs,
        "window_seconds": features.window_seconds,
        "copies": method.copies,
        "versions": {name: version(name) for name in ("hearthlog", "numpy", *method.libraries)},
    }


def _scenario_fields(scenario: Scenario, data: Dataset) -> dict[str, Any]:
    return {
        "classes": list(data.classes),
        "scenario_name": scenario.name,
        "scenario": {name: list(labels) for name, labels in scenario.classes.items()},
        "training_data": _training_data(data),
    }


def _training_data(data: Dataset) -> TrainingData:
    return TrainingData(
        sha256=data.digest,
        classes=data.amounts,
        collections=[
            Collection(name=name, licence=licence, clips=clips)
            for (name, licence), clips in sorted(data.collections.items())
        ],
    )
