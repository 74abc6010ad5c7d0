"""Training: a model is learned from segments, and measured on sources it has not learned from."""

from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import version
from typing import Any

import numpy as np
from sklearn.metrics import confusion_matrix, precision_recall_fscore_support
from sklearn.model_selection import StratifiedGroupKFold

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.training.calibration import (
    calibrate_elsewhere,
    collection_folds,
    home_temperature,
    inverse_temperature,
    unknown_bias,
)
from hearthlog.analyzer.training.dataset import CONFIRMED, Dataset
from hearthlog.analyzer.training.home_spans import merged_spans
from hearthlog.analyzer.training.installed import DEFAULT, method_named
from hearthlog.analyzer.training.learned_segments import learned_digests, segment_digests
from hearthlog.analyzer.training.method import (
    Examples,
    Fold,
    Learned,
    Method,
    cross_validate,
    prepare,
    softmax,
)
from hearthlog.analyzer.training.scenario import Scenario
from hearthlog.analyzer.training.scores import calibration_error
from hearthlog.analyzer.training.transitions import (
    LAG_SECONDS,
    REACH_SECONDS,
    SHORTEST_SECONDS,
    default_transitions,
)
from hearthlog.models.classes import SILENCE, UNKNOWN
from hearthlog.models.classifiers.description import (
    FORMAT,
    MOST_WEIGHT,
    Amount,
    ClassMetrics,
    Collection,
    Description,
    Metrics,
    Smoothing,
    TrainingData,
)
from hearthlog.models.classifiers.model import Model
from hearthlog.schemas.arrays import Bool, Float64, Indices
from hearthlog.schemas.frames import FRAME_SECONDS
from hearthlog.schemas.progress import Progress, ignore_progress

MOST_FOLDS = 5
_FEWEST_OF_HOME = 10  # segments
_HOME_FOLDS = 3  # by which the temperature is found
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
    sources, collections = group_folds(data), collection_folds(data)
    examples, fits = prepare(method, data), len(sources) + len(collections) + 1

    def decide(folds: list[Fold], before: int) -> Float64:
        def report(share: float) -> None:
            progress((before + share * len(folds)) / fits)

        return cross_validate([method], examples, len(data.classes), folds, report)[0]

    decisions = decide(sources, 0)
    bias = unknown_bias(decisions, data.target, data.classes)
    decisions += bias
    inverse, elsewhere = inverse_temperature(decisions, data.target), None
    if collections:
        others = decide(collections, len(sources)) + bias
        inverse, elsewhere = calibrate_elsewhere(others, data, collections)
    learned = method.fit(examples)
    progress(1.0)
    model = Model(
        Description(
            **_method_fields(method, learned, data.classes),
            **_scenario_fields(scenario, data),
            calibration="temperature",
            inverse_temperature=inverse,
            decision_bias={
                name: float(value) for name, value in zip(data.classes, bias, strict=True) if value
            },
            novelty="doubt",
            elsewhere=elsewhere,
            smoothing=_smoothing(smoothing, method, inverse),
            metrics=_metrics(data, decisions, inverse, len(sources)),
        ),
        learned.arrays(),
        transitions=(default_transitions(data.classes) if smoothing == "hmm" else np.empty((0, 0))),
        training_digests=segment_digests(data.windows),
    )
    if method.remembered(model) is not None:
        return model
    return replace(
        model,
        training_windows=data.windows,
        training_floor=data.floor,
        training_target=data.target.astype(np.int64),
        training_group=data.group.astype(np.int64),
    )


def base_classes(model: Model) -> tuple[str, ...]:
    """Return the classes of a model without those that it has from a home alone.

    Parameters
    ----------
    model : Model
        Whose method is installed.

    Raises
    ------
    DataError, ModelError
        If the method is not installed, or cannot be imported.
    """
    description = model.description
    remembered = method_named(description.method).as_of(description).remembered(model)
    target = model.training_target if remembered is None else remembered[1]
    return model.classes[: int(target.max()) + 1] if len(target) else model.classes


def adapt_model(base: Model, home: Dataset) -> Model:
    """Learn a model again, from its own segments and those of a home.

    Parameters
    ----------
    base : Model
        A model whose arrays stand for what it learned, or that has kept its training windows.
    home : Dataset
        Of the `base_classes` of the model, some of which may have no segments, and of new ones
        behind them, which have some.

    Returns
    -------
    Model
        With the parameters, transitions and metrics of `base`, which are those of other homes.
        Parts of the home that were left out in turn move the temperature that the model had before
        it was ever adapted. It can be adapted again to more of the home.

    Raises
    ------
    DataError
        If the base model has not kept what it learned from, the home has no segments, the method of
        the base model is not installed, or that method wants augmented copies and its feature set
        has none.
    ModelError
        If the method cannot be imported, or its feature set is not installed.
    """
    description = base.description
    if not len(home):
        raise DataError("the home has no segments of a class of the model")
    method = method_named(description.method).as_of(description)
    remembered = method.remembered(base)
    if remembered is not None:
        examples, others = prepare(method, home), 0
        examples = examples._replace(more_inputs=remembered[0], more_target=remembered[1])
    else:
        joined, others = _joined(base, home), len(base.training_windows)
        examples = prepare(method, joined)
    here = np.arange(others, others + len(home))
    learned = method.fit(examples)
    arrays = learned.arrays()
    if remembered is not None:
        arrays |= method.memory(remembered, learned)
    before = description.base_inverse_temperature or description.inverse_temperature
    description = _of_classes(description, home.classes)
    inverse = _temperature_here(method, examples, here, ~_is_confirmed(home), description)
    smoothing = description.smoothing
    weight = min(smoothing.weight * description.inverse_temperature / inverse, MOST_WEIGHT)
    training = description.training_data.model_copy(
        update={
            "home": home.amounts,
            "home_confirmed": _confirmed(home),
            "home_spans": merged_spans(home.spans),
            "base_sha256": base.sha256,
        }
    )
    update = {
        "training_data": training,
        "inverse_temperature": inverse,
        "base_inverse_temperature": before,
        "smoothing": smoothing.model_copy(update={"weight": weight}),
    }
    transitions = base.transitions
    if len(transitions) and home.classes != base.classes:
        transitions = default_transitions(home.classes)
    return Model(
        description.model_copy(update=update),
        arrays,
        transitions=transitions,
        training_digests=np.union1d(learned_digests(base), segment_digests(home.windows)),
        training_windows=base.training_windows,
        training_floor=base.training_floor,
        training_target=base.training_target,
        training_group=base.training_group,
    )


def _of_classes(description: Description, classes: Sequence[str]) -> Description:
    """Return a description with other classes at its end, of which no figures are known."""
    if tuple(description.classes) == tuple(classes):
        return description
    metrics, training = description.metrics, description.training_data
    confusion = np.zeros((len(classes), len(classes)), int)
    same = len([name for name in classes if name in description.classes])
    confusion[:same, :same] = np.array(metrics.confusion)[:same, :same]
    unknown = ClassMetrics(precision=0.0, recall=0.0, f1=0.0)
    none = Amount(sources=0, segments=0, seconds=0.0)
    figures = {name: metrics.classes.get(name, unknown) for name in classes}
    amounts = {name: training.classes.get(name, none) for name in classes}
    bias = description.decision_bias
    update = {
        "classes": list(classes),
        "scenario": {name: description.scenario.get(name, [name]) for name in classes},
        "decision_bias": {name: value for name, value in bias.items() if name in classes},
        "metrics": metrics.model_copy(update={"classes": figures, "confusion": confusion.tolist()}),
        "training_data": training.model_copy(update={"classes": amounts}),
    }
    return description.model_copy(update=update)


def _confirmed(home: Dataset) -> dict[str, int]:
    """Count the segments of each class that are as they were labelled."""
    counts = np.bincount(home.target[_is_confirmed(home)], minlength=len(home.classes))
    return {name: int(count) for name, count in zip(home.classes, counts, strict=True) if count}


def _is_confirmed(home: Dataset) -> Bool:
    names = np.array(home.collection_names)
    confirmed: Bool = names[home.collection] == CONFIRMED
    return confirmed


def _temperature_here(
    method: Method, examples: Examples, home: Indices, marked: Bool, description: Description
) -> float:
    """Return the inverse temperature of a model adapted to a home, by parts of it left out.

    Marks alone, of what was hard, would make it unsure of all the rest.
    """
    before = description.base_inverse_temperature or description.inverse_temperature
    if marked.sum() < _FEWEST_OF_HOME:
        return before
    everything = np.arange(len(examples.target))
    of_marks, others = (np.array_split(home[same], _HOME_FOLDS) for same in (marked, ~marked))
    parts = map(np.concatenate, zip(of_marks, others, strict=True))
    folds = [(np.setdiff1d(everything, part), part) for part in parts]
    classes = description.classes
    [decisions] = cross_validate([method], examples, len(classes), folds, ignore_progress)
    bias = np.array([description.decision_bias.get(name, 0.0) for name in classes])
    tried = home[np.isfinite(decisions[home]).all(axis=1)]
    return home_temperature(decisions[tried] + bias, examples.target[tried], before)


def _joined(base: Model, home: Dataset) -> Dataset:
    """Join the training windows of a model with the segments of a home."""
    count = len(base.training_windows)
    if not count:
        raise DataError(f"{base.name}: has not kept what it learned from; train it anew to adapt")
    floor = base.training_floor if len(base.training_floor) else np.zeros((count, home.bands))
    return replace(
        home,
        windows=np.concatenate([base.training_windows, home.windows]),
        target=np.concatenate([base.training_target, home.target]),
        group=np.concatenate([base.training_group, home.group]),
        weight=np.concatenate([np.ones(count), home.weight]),
        floor=np.concatenate([floor, home.floor]),
        copies=home.copies[:0],
        copy_floor=home.copy_floor[:0],
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
    numbers = range(len(data.classes))
    precision, recall, f1, _ = precision_recall_fscore_support(
        data.target, predicted, labels=numbers, zero_division=0.0
    )
    confusion = confusion_matrix(data.target, predicted, labels=numbers)
    known = [number for number in numbers if data.classes[number] != UNKNOWN]
    return Metrics(
        folds=folds,
        macro_f1=float(f1[known].mean()),
        expected_calibration_error=calibration_error(softmax(inverse * decision), data.target),
        classes={
            name: ClassMetrics(
                precision=float(precision[i]), recall=float(recall[i]), f1=float(f1[i])
            )
            for i, name in enumerate(data.classes)
        },
        confusion=confusion.tolist(),
    )


def _smoothing(name: str, method: Method, inverse: float) -> Smoothing:
    if name == "merge":
        return Smoothing(method="merge")
    return Smoothing(
        method="hmm",
        lag_seconds=LAG_SECONDS,
        weight=min(method.observation_weight / inverse, MOST_WEIGHT),
        reach_seconds=REACH_SECONDS,
        shortest_seconds=SHORTEST_SECONDS,
    )


def _method_fields(method: Method, learned: Learned, classes: Sequence[str]) -> dict[str, Any]:
    features = method.features
    window = features.inputs[method.inputs].window_frames
    return {
        "format": FORMAT,
        "kind": method.kind,
        "parameters": learned.parameters(),
        "method": method.name,
        "feature_set": features.name,
        "feature_set_version": features.version,
        "feature_names": list(features.feature_names),
        "inputs": method.inputs,
        "window_seconds": window * FRAME_SECONDS,
        "label_frame": window // 2,
        "gate": method.gate if SILENCE in classes else 0.0,
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
        home_spans=merged_spans(data.spans),
        collections=[
            Collection(name=name, licence=licence, clips=clips)
            for (name, licence), clips in sorted(data.collections.items())
        ],
    )
