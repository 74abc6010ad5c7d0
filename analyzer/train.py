"""Learn a model from segments: an RBF support vector machine, chosen and measured by sources."""

import os
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import version

import numpy as np
from numpy.typing import NDArray
from sklearn.calibration import CalibratedClassifierCV
from sklearn.metrics import confusion_matrix, f1_score, precision_recall_fscore_support
from sklearn.model_selection import StratifiedGroupKFold
from sklearn.pipeline import Pipeline, make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.svm import SVC

from analyzer.dataset import Dataset
from analyzer.errors import DataError
from analyzer.scenario import Scenario
from models.inputs import WINDOW_FRAMES
from models.modelfile import (
    Amount,
    ClassMetrics,
    Collection,
    Description,
    Metrics,
    Model,
    Smoothing,
    TrainingData,
)
from recorder.features import FEATURE_NAMES, FRAME_SAMPLES, NAME, SAMPLE_RATE

# Cost and gamma times the number of statistics; of equals the first wins.
GRID = [(c, g) for c in (4.0, 1.0, 16.0) for g in (0.5, 0.25, 1.0)]
MOST_FOLDS = 5
_SHUFFLES = 20
_CALIBRATION_BINS = 15
_WORKERS = 4

Float64 = NDArray[np.float64]
Indices = NDArray[np.intp]
Folds = list[tuple[Indices, Indices]]


def train_model(data: Dataset, scenario: Scenario, progress: Callable[[int, int], None]) -> Model:
    """Choose cost and gamma by cross-validated macro F1, calibrate, and learn from everything.

    Folds never split a source group. The metrics are those of the chosen parameters on segments
    a fold has not seen; the calibration, one temperature, is fitted to the same decisions.

    Parameters
    ----------
    data : Dataset
    scenario : Scenario
        The one the data was built for.
    progress : callable
        Told how many fits of how many are done.

    Raises
    ------
    DataError
        If a class has too few source groups to be cross-validated.
    """
    statistics = data.statistics.astype(np.float64)
    folds = group_folds(data)
    candidates = [(cost, factor / statistics.shape[1]) for cost, factor in GRID]
    jobs = [(candidate, fold) for candidate in candidates for fold in folds]
    decisions = [np.empty((len(statistics), len(data.classes))) for _ in candidates]

    def decide(job: tuple[tuple[float, float], tuple[Indices, Indices]]) -> Float64:
        (cost, gamma), (seen, unseen) = job
        fitted = _classifier(cost, gamma).fit(statistics[seen], data.target[seen])
        return _per_class(fitted.decision_function(statistics[unseen]))

    with ThreadPoolExecutor(min(os.cpu_count() or 1, _WORKERS)) as pool:  # libsvm frees the lock
        for number, decided in enumerate(pool.map(decide, jobs)):
            progress(number, len(jobs) + 1)
            candidate, fold = divmod(number, len(folds))
            decisions[candidate][folds[fold][1]] = decided
    scores = [f1_score(data.target, d.argmax(axis=1), average="macro") for d in decisions]
    best = int(np.argmax(scores))
    cost, gamma = candidates[best]

    calibrated = CalibratedClassifierCV(
        _classifier(cost, gamma), method="temperature", ensemble=False, cv=folds
    ).fit(statistics, data.target)
    progress(len(jobs) + 1, len(jobs) + 1)
    fitted = calibrated.calibrated_classifiers_[0]
    scaler, machine = fitted.estimator
    inverse_temperature = float(fitted.calibrators[0].beta_)
    # scikit-learn turns the sign of two classes round; in the file all pairs are alike.
    sign = -1.0 if len(data.classes) == 2 else 1.0
    return Model(
        Description(
            format=1,
            kind="svm-rbf",
            classes=list(data.classes),
            feature_set=NAME,
            feature_names=list(FEATURE_NAMES),
            window_seconds=WINDOW_FRAMES * FRAME_SAMPLES / SAMPLE_RATE,
            scenario_name=scenario.name,
            scenario={name: list(labels) for name, labels in scenario.classes.items()},
            cost=cost,
            gamma=gamma,
            calibration="temperature",
            inverse_temperature=inverse_temperature,
            smoothing=Smoothing(method="merge"),
            training_data=_training_data(data, scenario),
            metrics=_metrics(data, decisions[best], inverse_temperature, len(folds)),
            versions={name: version(name) for name in ("hearthlog", "numpy", "scikit-learn")},
        ),
        scaler_mean=scaler.mean_,
        scaler_scale=scaler.scale_,
        support_vectors=data.statistics[machine.support_],
        support_counts=machine.n_support_.astype(np.int64),
        dual_coefficients=sign * machine.dual_coef_,
        intercepts=sign * machine.intercept_,
    )


def group_folds(data: Dataset) -> Folds:
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
    sources = [len(np.unique(data.group[data.target == i])) for i in range(len(data.classes))]
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
        folds = list(divider.split(data.statistics, data.target, data.group))
        if all(np.array_equal(np.unique(data.target[seen]), everything) for seen, _ in folds):
            return folds
    raise DataError(
        f"class {data.classes[fewest]} has {sources[fewest]} source groups, shared with other "
        "classes: no division into folds leaves every class something to learn from; add sources"
    )


def calibration_error(probabilities: Float64, target: Indices) -> float:
    """Compute the expected calibration error of the winning class, over 15 bins of equal width.

    Parameters
    ----------
    probabilities : np.ndarray [shape=(n, C)]
    target : np.ndarray [shape=(n,)]

    References
    ----------
    Guo et al., "On Calibration of Modern Neural Networks", 2017.
    """
    confidence = probabilities.max(axis=1)
    right = probabilities.argmax(axis=1) == target
    place = np.minimum((confidence * _CALIBRATION_BINS).astype(int), _CALIBRATION_BINS - 1)
    return float(np.abs(np.bincount(place, right - confidence)).sum() / len(target))


def _classifier(cost: float, gamma: float) -> Pipeline:
    return make_pipeline(StandardScaler(), SVC(C=cost, gamma=gamma, class_weight="balanced"))


def _per_class(decision: Float64) -> Float64:
    return np.stack([-decision, decision], axis=1) if decision.ndim == 1 else decision


def _metrics(data: Dataset, decision: Float64, inverse_temperature: float, folds: int) -> Metrics:
    probabilities = np.exp(inverse_temperature * (decision - decision.max(axis=1, keepdims=True)))
    probabilities /= probabilities.sum(axis=1, keepdims=True)
    predicted = decision.argmax(axis=1)
    precision, recall, f1, _ = precision_recall_fscore_support(
        data.target, predicted, labels=range(len(data.classes)), zero_division=0.0
    )
    confusion = confusion_matrix(data.target, predicted, labels=range(len(data.classes)))
    return Metrics(
        folds=folds,
        macro_f1=float(f1.mean()),
        expected_calibration_error=calibration_error(probabilities, data.target),
        classes={
            name: ClassMetrics(
                precision=float(precision[i]), recall=float(recall[i]), f1=float(f1[i])
            )
            for i, name in enumerate(data.classes)
        },
        confusion=confusion.tolist(),
    )


def _training_data(data: Dataset, scenario: Scenario) -> TrainingData:
    class_of = scenario.class_of
    seconds = dict.fromkeys(data.classes, 0.0)
    for clip, duration in zip(data.clips, data.clip_seconds, strict=True):
        seconds[class_of[clip.label]] += duration
    collections = Counter((clip.source, clip.licence) for clip in data.clips)
    return TrainingData(
        sha256=data.digest,
        classes={
            name: Amount(
                sources=len(np.unique(data.group[data.target == i])),
                segments=int((data.target == i).sum()),
                seconds=round(seconds[name], 3),
            )
            for i, name in enumerate(data.classes)
        },
        collections=[
            Collection(name=name, licence=licence, clips=clips)
            for (name, licence), clips in sorted(collections.items())
        ],
    )
