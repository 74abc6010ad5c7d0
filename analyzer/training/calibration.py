"""Cross-validation and calibration: probabilities from segments outside the training set."""

from collections.abc import Iterable, Sequence
from collections.abc import Set as AbstractSet
from itertools import product
from typing import Any

import numpy as np

from hearthlog.analyzer.training.dataset import Dataset, source_counts
from hearthlog.analyzer.training.method import Examples, Method
from hearthlog.analyzer.training.scores import calibration_error, score
from hearthlog.analyzer.workers import in_parallel
from hearthlog.models.classes import UNKNOWN
from hearthlog.models.classifiers.model import Elsewhere
from hearthlog.schemas.arrays import Bool, Float64, Indices
from hearthlog.schemas.errors import Progress

Fold = tuple[Indices, Indices]  # training and test segments


def cross_validate(
    methods: Sequence[Method],
    examples: Examples,
    classes: int,
    folds: Iterable[Fold],
    progress: Progress,
) -> Float64:
    """Return decisions [shape=(len(methods), n, C)] for segments, by classifiers of other folds.

    They are -inf for a class without training data, NaN for segments in no test fold. `progress`
    receives the completed share of the fits, 0 to 1.
    """
    from joblib import delayed  # noqa: PLC0415  part of the extra `headless`

    folds = list(folds)
    decisions = np.full((len(methods), len(examples.target), classes), np.nan)
    tasks = list(product(range(len(methods)), folds))
    calls = (
        delayed(_decide_unseen)(methods[number], classes, fold, *examples) for number, fold in tasks
    )
    for done, decided in enumerate(in_parallel(calls)):
        number, (_, unseen) = tasks[done]
        decisions[number, unseen] = decided
        progress((done + 1) / len(tasks))
    return decisions


def _decide_unseen(method: Method, classes: int, fold: Fold, *arrays: Any) -> Float64:
    """Classify the test segments of a fold; joblib sends each array argument once."""
    examples, (seen, unseen) = Examples(*arrays), fold
    learned = method.fit(examples, seen)
    return examples.decide(learned, unseen, classes)


def softmax(values: Float64) -> Float64:
    """Turn decision values [shape=(n, C)] into probabilities; a row may not be -inf completely."""
    grown = np.exp(values - values.max(axis=1, keepdims=True))
    return grown / grown.sum(axis=1, keepdims=True)


LOST_TO_UNKNOWN = 0.05  # share of known segments that may be labelled `unknown`
_FEWEST_COLLECTIONS = 3
_FEWEST_SOURCES = 5  # of a class in other collections
_BASE_SEGMENTS = 30
_FEWEST_LABELLED = 10  # segments of a class, for its calibration error
_FEWEST_SEGMENTS = 20  # of a collection with a fold of its own


def collection_folds(data: Dataset, taught: AbstractSet[int] = frozenset()) -> list[Fold]:
    """Return folds that hold out one collection each; small collections share a fold.

    Empty if there are fewer than three folds, if one leaves a single class for training, or if
    fewer than half of all other classes occur in other collections.
    """
    counts = np.bincount(data.collection)
    fold = np.where(counts < _FEWEST_SEGMENTS, len(counts), np.arange(len(counts)))[data.collection]
    folds = [
        (np.flatnonzero(fold != number), np.flatnonzero(fold == number))
        for number in np.unique(fold)
    ]
    several = all(len(np.unique(data.target[seen])) > 1 for seen, _ in folds)
    tried = np.unique(data.target[trained_elsewhere(data, folds)])
    others = [n for n, name in enumerate(data.classes) if name != UNKNOWN and n not in taught]
    enough = 2 * len(np.setdiff1d(tried, list(taught))) >= len(others)
    return folds if len(folds) >= _FEWEST_COLLECTIONS and several and enough else []


def trained_elsewhere(data: Dataset, folds: Sequence[Fold]) -> Bool:
    """Return which segments have a known class with five sources in the other folds."""
    taught = np.zeros(len(data), bool)
    for seen, unseen in folds:
        sources = source_counts(data.target[seen], data.group[seen], len(data.classes))
        taught[unseen] = sources[data.target[unseen]] >= _FEWEST_SOURCES
    if UNKNOWN in data.classes:
        taught &= data.target != data.classes.index(UNKNOWN)
    return taught


def calibrate_elsewhere(
    decisions: Float64, data: Dataset, folds: Sequence[Fold]
) -> tuple[float, Elsewhere]:
    """Find the temperature for collections outside the training set.

    The `decisions` [shape=(n, C)] are of classifiers trained without the fold of the segment. The
    temperature is fitted on segments of classes with five sources in the other folds. Scores cover
    these segments; macro F1 also covers segments of no class of the scenario.
    """
    taught = trained_elsewhere(data, folds)
    probabilities = nested_probabilities(decisions, data.target, folds, taught)
    elsewhere = scores_elsewhere(probabilities, data, taught)
    return inverse_temperature(decisions[taught], data.target[taught]), elsewhere


def scores_elsewhere(probabilities: Float64, data: Dataset, taught: Bool) -> Elsewhere:
    """Score probabilities [shape=(n, C)] of classifiers trained without the segment's collection.

    `taught` [shape=(n,)] is the result of `trained_elsewhere`.
    """
    predicted, scored = probabilities.argmax(axis=1), taught.copy()
    if UNKNOWN in data.classes:
        scored |= data.target == data.classes.index(UNKNOWN)
    scores = score(data.target[scored], predicted[scored], data.group[scored], data.classes)
    return Elsewhere(
        collections=len(np.unique(data.collection)),
        segments=int(taught.sum()),
        right=float((predicted == data.target)[taught].mean()),
        expected_calibration_error=calibration_error(probabilities[taught], data.target[taught]),
        macro_f1=scores.macro_f1,
        macro_f1_interval=scores.macro_f1_interval and list(scores.macro_f1_interval),
        classes={name: one.f1 for name, one in scores.per_class.items() if one.f1 is not None},
        calibration_errors=_of_classes(probabilities[taught], data.target[taught], data.classes),
    )


def _of_classes(
    probabilities: Float64, target: Indices, classes: Sequence[str]
) -> dict[str, float]:
    """Return the calibration error of each known class: probability against frequency."""
    predicted, sure = probabilities.argmax(axis=1), probabilities.max(axis=1)
    errors = {}
    for number, name in enumerate(classes):
        so = predicted == number
        if name != UNKNOWN and so.sum() >= _FEWEST_LABELLED:
            errors[name] = float(abs(sure[so].mean() - (target[so] == number).mean()))
    return errors


def home_temperature(decisions: Float64, target: Indices, base: float) -> float:
    """Adjust the inverse temperature `base` to a home; it weighs as much as 30 segments.

    The `decisions` [shape=(n, C)] are of classifiers adapted to other segments of the home.
    """
    if not len(target):
        return base
    share = len(target) / (len(target) + _BASE_SEGMENTS)
    here = inverse_temperature(decisions, target)
    return float(np.exp(share * np.log(here) + (1.0 - share) * np.log(base)))


def nested_probabilities(
    decisions: Float64, target: Indices, folds: Sequence[Fold], used: Bool | None = None
) -> Float64:
    """Turn decisions into probabilities [shape=(n, C)], with the temperature of the other folds.

    The `decisions` are of classifiers trained without the fold of the segment. There are at least
    two folds; each segment is tested in one. `used` [shape=(n,)] selects segments for fitting
    temperatures; all by default.
    """
    used = np.ones(len(target), bool) if used is None else used
    probabilities = np.empty_like(decisions)
    for _, unseen in folds:
        others = used.copy()
        others[unseen] = False
        if not others.any():  # no other fold has used segments
            others[unseen] = True
        inverse = inverse_temperature(decisions[others], target[others])
        probabilities[unseen] = softmax(inverse * decisions[unseen])
    return probabilities


def unknown_bias(decisions: Float64, target: Indices, classes: Sequence[str]) -> Float64:
    """Find the bias of class `unknown` that keeps false rejections of known segments rare.

    The `decisions` [shape=(n, C)] are of segments outside the training set; the bias [shape=(C,)]
    is zero except for class `unknown`, if it exists.
    """
    bias = np.zeros(len(classes))
    if UNKNOWN in classes:
        unknown = classes.index(UNKNOWN)
        others = target != unknown
        best = np.delete(decisions[others], unknown, axis=1).max(axis=1)
        margin = best - decisions[others, unknown]
        margin = margin[np.isfinite(margin)]
        if len(margin):
            bias[unknown] = np.clip(np.quantile(margin, LOST_TO_UNKNOWN), -100.0, 100.0)
    return bias


def inverse_temperature(decisions: Float64, target: Indices) -> float:
    """Find the factor of decision values [shape=(n, C)] that minimises log loss of their softmax.

    It is the inverse of the temperature, from exp(-5) to exp(5). Decision values are -inf for a
    class without training data. Source: Guo et al., "On Calibration of Modern Neural Networks",
    2017.
    """

    def loss(logarithm: float) -> float:
        probabilities = softmax(np.exp(logarithm) * decisions)[np.arange(len(target)), target]
        return float(-np.log(np.maximum(probabilities, 1e-300)).mean())

    from scipy.optimize import minimize_scalar  # noqa: PLC0415  applying one does without scipy

    result = minimize_scalar(loss, bounds=(-5.0, 5.0), method="bounded", options={"xatol": 1e-6})
    return float(np.exp(result.x))
