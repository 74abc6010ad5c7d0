"""Scores of classified segments: confidence intervals, calibration, model comparison."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.errors import DataError
from hearthlog.schemas.arrays import Float64, Indices, Int64

RESAMPLES = 1000
_BINS = 15
_SEED = 0
_COUNTS_AT_ONCE = 4_000_000  # counts of resamples per batch; bounds memory
_INTERVAL = (2.5, 97.5)

Interval = tuple[float, float]
Counts = Int64
Integers = NDArray[np.integer]


@dataclass(frozen=True)
class ClassScores:
    """Scores of one class; None if undefined, such as the recall of an absent class."""

    precision: float | None
    recall: float | None
    f1: float | None
    f1_interval: Interval | None  # 95 %, bootstrap over groups; None with a single group
    support: int


@dataclass(frozen=True)
class Scores:
    """Scores of classified segments."""

    macro_f1: float
    macro_f1_interval: Interval | None  # 95 %, bootstrap over groups; None with a single group
    macro_precision: float
    macro_recall: float
    per_class: dict[str, ClassScores]
    confusion: list[list[int]]
    segments: int
    groups: int
    classes: tuple[str, ...]


@dataclass(frozen=True)
class Bin:
    """Segments with the probability of the winning class in one of 15 equal ranges."""

    bin: int
    confidence: float  # mean probability of the winning class
    accuracy: float
    count: int


@dataclass(frozen=True)
class F1Difference:
    """Macro F1 of a second model minus that of a first on the same segments."""

    macro_f1: float
    interval: Interval | None  # 95 %, paired bootstrap over groups; None with a single group


def score(
    target: Integers,
    predicted: Integers,
    group: Integers,
    classes: Sequence[str],
    weight: Counts | None = None,
) -> Scores:
    """Compute the scores of predicted classes [shape=(n,)].

    Raise `DataError` if there is no segment. The source groups are the resampling units of the
    intervals. `weight` is the number of segments that a row represents, at least 0; 1 by default.
    """
    confusions = _confusions(target, predicted, group, len(classes), weight)
    confusion = confusions.sum(axis=0)
    support = confusion.sum(axis=1)
    precision, recall, f1 = _rates(confusion)
    resampled = np.concatenate([_rates(counts)[2] for counts in _resamples(confusions)])
    return Scores(
        macro_f1=float(np.nanmean(f1)),
        macro_f1_interval=_interval(_macro(resampled), confusions),
        macro_precision=float(precision[support > 0].mean()),
        macro_recall=float(np.nanmean(recall)),
        per_class={
            name: ClassScores(
                precision=_finite(precision[i]),
                recall=_finite(recall[i]),
                f1=_finite(f1[i]),
                f1_interval=_interval(resampled[:, i], confusions) if support[i] else None,
                support=int(support[i]),
            )
            for i, name in enumerate(classes)
        },
        confusion=confusion.astype(np.int64).tolist(),
        segments=int(confusion.sum()),
        groups=len(confusions),
        classes=tuple(classes),
    )


def difference(
    target: Integers,
    probabilities_a: NDArray[np.floating],
    probabilities_b: NDArray[np.floating],
    group: Integers,
    classes: Sequence[str],
) -> F1Difference:
    """Compute the macro F1 of model b minus that of model a on the same segments.

    The class with the highest of the probabilities [shape=(n, C)] is the predicted one; source
    groups are the resampling units of the interval. Raise `DataError` if there is no segment.
    """
    first, second = (
        _confusions(target, probabilities.argmax(axis=1), group, len(classes))
        for probabilities in (probabilities_a, probabilities_b)
    )
    resampled = np.concatenate(
        [
            _macro(_rates(b)[2]) - _macro(_rates(a)[2])
            for a, b in zip(_resamples(first), _resamples(second), strict=True)  # the same draws
        ]
    )
    macro = [float(np.nanmean(_rates(c.sum(axis=0))[2])) for c in (first, second)]
    return F1Difference(macro[1] - macro[0], _interval(resampled, first))


def calibration_error(probabilities: NDArray[np.floating], target: Integers) -> float:
    """Compute the expected calibration error of the winning class, over 15 bins of equal width.

    It is 0 (calibrated) to 1. The probabilities [shape=(n, C)] have at least one row. Source: Guo
    et al., "On Calibration of Modern Neural Networks", 2017.
    """
    place, confidence, right = _binned(probabilities, target)
    return float(np.abs(np.bincount(place, right - confidence)).sum() / len(target))


def reliability(probabilities: NDArray[np.floating], target: Integers) -> list[Bin]:
    """Compute confidence and accuracy of probabilities [shape=(n, C)] by bins.

    Bins are by confidence, ascending, without empty ones.
    """
    place, confidence, right = _binned(probabilities, target)
    count = np.bincount(place, minlength=_BINS)
    sure = np.bincount(place, confidence, minlength=_BINS)
    correct = np.bincount(place, right, minlength=_BINS)
    return [
        Bin(i, float(sure[i] / count[i]), float(correct[i] / count[i]), int(count[i]))
        for i in np.flatnonzero(count).tolist()
    ]


def _binned(
    probabilities: NDArray[np.floating], target: Integers
) -> tuple[Indices, Float64, Float64]:
    confidence = probabilities.max(axis=1).astype(np.float64)
    right = (probabilities.argmax(axis=1) == target).astype(np.float64)
    return np.minimum((confidence * _BINS).astype(np.intp), _BINS - 1), confidence, right


def _confusions(
    target: Integers,
    predicted: Integers,
    group: Integers,
    classes: int,
    weight: Counts | None = None,
) -> Float64:
    """Return the confusion matrix of each group, shape (G, C, C)."""
    if not len(target):
        raise DataError("there is nothing to score")
    names, number = np.unique(group, return_inverse=True)
    place = (number * classes + target) * classes + predicted
    counts = np.bincount(place, weight, minlength=len(names) * classes**2)
    return counts.astype(np.float64).reshape(len(names), classes, classes)


def _resamples(confusions: Float64) -> Iterator[Float64]:
    """Yield the confusion matrices of all resamples of the groups, in batches."""
    groups, classes, _ = confusions.shape
    flat = confusions.reshape(groups, -1)
    share = np.full(groups, 1.0 / groups)
    rng = np.random.default_rng(_SEED)
    at_once = max(_COUNTS_AT_ONCE // max(groups, classes**2), 1)
    for start in range(0, RESAMPLES, at_once):
        drawn = rng.multinomial(groups, share, min(at_once, RESAMPLES - start))
        yield (drawn.astype(np.float64) @ flat).reshape(-1, classes, classes)


def _rates(confusion: Float64) -> tuple[Float64, Float64, Float64]:
    """Return precision, recall and F1 of each class from matrices (..., C, C).

    Recall and F1 are NaN for an absent class; precision is NaN if the class is neither present nor
    predicted, and 0 if present but not predicted.
    """
    right = np.diagonal(confusion, axis1=-2, axis2=-1)
    true, predicted = confusion.sum(axis=-1), confusion.sum(axis=-2)
    with np.errstate(invalid="ignore"):
        precision = right / np.where(true > 0, np.maximum(predicted, 1), predicted)
        recall = right / true
        f1 = np.where(true > 0, 2.0 * right / (true + predicted), np.nan)
    return precision, recall, f1


def _macro(f1: Float64) -> Float64:
    """Return the mean over the present classes; every resample has at least one."""
    return np.nanmean(f1, axis=-1)


def _interval(resampled: Float64, confusions: Float64) -> Interval | None:
    if len(confusions) < 2:
        return None
    low, high = np.nanpercentile(resampled, _INTERVAL)
    return float(low), float(high)


def _finite(value: float) -> float | None:
    return None if np.isnan(value) else float(value)
