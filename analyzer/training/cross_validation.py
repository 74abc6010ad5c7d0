"""Classifiers tested on segments that they have not seen."""

from collections.abc import Iterable, Sequence
from itertools import product
from typing import Any

import numpy as np

from hearthlog.analyzer.training.method import Examples, Method
from hearthlog.analyzer.workers.parallel import in_parallel
from hearthlog.schemas.arrays import Float64, Indices
from hearthlog.schemas.errors import Progress

Fold = tuple[Indices, Indices]  # segments to learn from, and segments to test on


def cross_validate(
    methods: Sequence[Method],
    examples: Examples,
    classes: int,
    folds: Iterable[Fold],
    progress: Progress,
) -> Float64:
    """Classify segments by classifiers that have not seen them.

    Parameters
    ----------
    progress : callable
        Is told the share of the fits that is done, 0 to 1.

    Returns
    -------
    np.ndarray [shape=(len(methods), n, C)], float64
        Decision values; -inf for a class that was not learned, NaN for segments that no fold tests.
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
    """Classify the test segments of a fold; joblib sends each array, an argument, once."""
    examples, (seen, unseen) = Examples(*arrays), fold
    learned = method.fit(examples, seen)
    return examples.decide(learned, unseen, classes)


def softmax(values: Float64) -> Float64:
    """Turn decision values into probabilities.

    Parameters
    ----------
    values : np.ndarray [shape=(n, C)], float64
        Decision values; -inf is allowed, but not for a whole row.

    Returns
    -------
    np.ndarray [shape=(n, C)], float64
        Every row sums up to 1; 0 where the decision value is -inf.
    """
    grown = np.exp(values - values.max(axis=1, keepdims=True))
    return grown / grown.sum(axis=1, keepdims=True)
