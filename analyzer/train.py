"""Learn a model from segments, and measure it on sources that it has not heard."""

from collections.abc import Sequence
from dataclasses import asdict, replace
from importlib.metadata import version

import numpy as np
from numpy.typing import NDArray
from sklearn.metrics import confusion_matrix, precision_recall_fscore_support
from sklearn.model_selection import StratifiedGroupKFold
from sklearn.pipeline import Pipeline

from hearthlog.analyzer.dataset import Dataset, Progress
from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.evaluation.scores import calibration_error
from hearthlog.analyzer.hmm import (
    LAG_SECONDS,
    default_transitions,
    expected_durations,
    transitions_from_sequences,
)
from hearthlog.analyzer.recipe import (
    RECIPES,
    Fold,
    Recipe,
    cross_validate,
    fit,
    inverse_temperature,
    prepare,
    softmax,
)
from hearthlog.analyzer.scenario import Scenario
from hearthlog.models.inputs import WINDOW_FRAMES
from hearthlog.models.modelfile import (
    Amount,
    ClassMetrics,
    Collection,
    Description,
    Metrics,
    Model,
    Smoothing,
    TrainingData,
)
from hearthlog.recorder.features import FEATURE_NAMES, FRAME_SAMPLES, NAME, SAMPLE_RATE

MOST_FOLDS = 5
SMOOTHINGS = ("hmm", "merge")
_SHUFFLES = 20

Float64 = NDArray[np.float64]
Indices = NDArray[np.intp]


def train_model(
    data: Dataset,
    scenario: Scenario,
    progress: Progress,
    recipe: Recipe = RECIPES["bands"],
    smoothing: str = "hmm",
) -> Model:
    """Learn from segments; calibrate and measure on folds that never split a source group.

    Parameters
    ----------
    data : Dataset
    scenario : Scenario
        The one the data was built for.
    progress : callable
        Told how many fits of how many are done.
    recipe : Recipe
    smoothing : str
        How labels become segments: see `hearthlog.models.modelfile.Smoothing`.

    Raises
    ------
    DataError
        If a class has too few source groups to be cross-validated, or all segments are alike.
    """
    check_varied(data)
    folds = group_folds(data)
    examples = prepare(recipe, data)

    def report(done: int, _total: int) -> None:
        progress(done, len(folds) + 1)

    [decisions] = cross_validate([recipe], examples, len(data.classes), folds, report)
    inverse = inverse_temperature(decisions, data.target)
    machine = fit(recipe, examples)
    progress(len(folds) + 1, len(folds) + 1)
    hidden = smoothing == "hmm"
    about = Description(
        format=2,
        kind="svm-rbf",
        classes=list(data.classes),
        feature_set=NAME,
        feature_names=list(FEATURE_NAMES),
        inputs=recipe.inputs,
        window_seconds=WINDOW_FRAMES * FRAME_SAMPLES / SAMPLE_RATE,
        scenario_name=scenario.name,
        scenario={name: list(labels) for name, labels in scenario.classes.items()},
        cost=recipe.cost,
        gamma=recipe.gamma / examples.inputs.shape[2],
        copies=recipe.copies,
        calibration="temperature",
        inverse_temperature=inverse,
        smoothing=Smoothing(
            method="hmm" if hidden else "merge", lag_seconds=LAG_SECONDS if hidden else 0.0
        ),
        training_data=_training_data(data),
        metrics=_metrics(data, decisions, inverse, len(folds)),
        versions={name: version(name) for name in ("hearthlog", "numpy", "scikit-learn")},
    )
    return replace(
        _model(about, machine),
        transitions=default_transitions(data.classes) if hidden else np.empty((0, 0)),
        training_windows=data.windows,
        training_target=data.target.astype(np.int64),
        training_group=data.group.astype(np.int64),
    )


def adapt_model(base: Model, home: Dataset, sequences: Sequence[NDArray[np.int64]] = ()) -> Model:
    """Learn once more what a model has learned, and a home's own segments with it.

    Parameters
    ----------
    base : Model
        With its training windows.
    home : Dataset
        Of the same classes; it need not have segments of all of them.
    sequences : sequence of np.ndarray [shape=(n,)], int64
        Classes of successive frames in the home, from which the transitions of its sounds are
        learned.

    Returns
    -------
    Model
        With the parameters, calibration and metrics of `base`, which are those of other homes; it
        keeps the windows of `base` alone, so that it can be adapted again to more of the home.

    Raises
    ------
    DataError
        If the base model has not kept what it was learned from, or the home has no segments.
    """
    about = base.description
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
    recipe = Recipe(about.inputs, about.cost, about.gamma * base.scaler_mean.size, about.copies)
    examples = prepare(recipe, joined)
    machine = fit(recipe, examples)
    found = {name: Amount(**asdict(amount)) for name, amount in home.amounts.items()}
    training = about.training_data.model_copy(update={"home": found, "base_sha256": base.sha256})
    return replace(
        _model(about.model_copy(update={"training_data": training}), machine),
        home_vectors=examples.inputs[0, len(base.training_windows) :],
        home_target=home.target.astype(np.int64),
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
    """Raise DataError if there is nothing to tell the segments apart by."""
    if len(data) and (np.ptp(data.windows.reshape(-1, data.windows.shape[2]), axis=0) == 0).all():
        raise DataError("all segments are alike: their features never change; is this sound?")


def group_folds(data: Dataset) -> list[Fold]:
    """Divide the segments into up to five folds that never split a source group.

    Returns
    -------
    list of (seen, unseen)
        Indices; every class is among the seen of every fold.

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


def _model(about: Description, machine: Pipeline) -> Model:
    """Put a fitted machine into a model."""
    scaler, svc = machine
    # scikit-learn turns the sign of two classes round; in the file all pairs are alike.
    sign = -1.0 if len(about.classes) == 2 else 1.0
    # The file keeps support vectors as they were before scaling, in float32.
    support = svc.support_vectors_ * scaler.scale_ + scaler.mean_
    return Model(
        about,
        scaler_mean=scaler.mean_,
        scaler_scale=scaler.scale_,
        support_vectors=support.astype(np.float32),
        support_counts=svc.n_support_.astype(np.int64),
        dual_coefficients=sign * svc.dual_coef_,
        intercepts=sign * svc.intercept_,
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


def _training_data(data: Dataset) -> TrainingData:
    return TrainingData(
        sha256=data.digest,
        classes={name: Amount(**asdict(amount)) for name, amount in data.amounts.items()},
        collections=[
            Collection(name=name, licence=licence, clips=clips)
            for (name, licence), clips in sorted(data.collections.items())
        ],
    )
