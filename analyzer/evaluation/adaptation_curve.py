"""What some corrected seconds of a new home are worth.

A collection that the machine has never heard stands for the home: it is adapted to segments from
half of the collection's groups, and tried on those of the other half.
"""

from typing import Any, NamedTuple

import numpy as np
from joblib import delayed
from sklearn.metrics import f1_score

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.training.dataset import Dataset
from hearthlog.analyzer.training.home_data import HOME_WEIGHT
from hearthlog.analyzer.training.method import Examples, Method, prepare
from hearthlog.analyzer.workers.parallel import in_parallel
from hearthlog.schemas.arrays import Indices
from hearthlog.schemas.progress import Progress

CORRECTED = (0, 10, 30, 60)  # segments
_FEWEST_GROUPS = 8
_FEWEST_CLASSES = 2
_FEWEST_SEGMENTS = max(CORRECTED)  # to correct, and as many to be tried on
_SHUFFLES = 3


class AdaptationCurve(NamedTuple):
    """Macro F1 against the number of corrected segments."""

    corrected: tuple[int, ...]
    # of each collection that was left out, over the classes that it has
    collections: dict[str, list[float]]
    mean: list[float]


def adaptation_curve(data: Dataset, method: Method, progress: Progress) -> AdaptationCurve:
    """Leave each collection out in turn, and adapt the method to more and more of its segments.

    Parameters
    ----------
    data : Dataset
    method : Method
    progress : callable
        Told the share of the fits that is done, 0 to 1.

    Returns
    -------
    AdaptationCurve
        Means of three divisions of each collection into segments to correct and segments to be
        tried on.

    Raises
    ------
    DataError
        If no collection is large and varied enough to stand for a home, or the method wants
        augmented copies and its feature set has none.
    """
    names = data.collection_names
    chosen = [number for number in range(len(names)) if _is_like_a_home(data, number)]
    if not chosen:
        raise DataError(
            f"no collection has {_FEWEST_CLASSES} classes, {_FEWEST_GROUPS} source groups and "
            f"{2 * _FEWEST_SEGMENTS} segments: none can stand for a new home"
        )
    examples = prepare(method, data)
    splits = [_split(data, number, shuffle) for number in chosen for shuffle in range(_SHUFFLES)]
    calls = (delayed(_scores)(method, len(data.classes), split, *examples) for split in splits)
    scores = np.empty((len(splits), len(CORRECTED)))
    for place, row in enumerate(in_parallel(calls)):
        scores[place] = row
        progress((place + 1) / len(splits))
    each = scores.reshape(len(chosen), _SHUFFLES, -1).mean(axis=1)
    curves = {names[number]: row.tolist() for number, row in zip(chosen, each, strict=True)}
    return AdaptationCurve(CORRECTED, curves, each.mean(axis=0).tolist())


def _is_like_a_home(data: Dataset, number: int) -> bool:
    inside = data.collection == number
    return (
        len(np.unique(data.target[inside])) >= _FEWEST_CLASSES
        and len(np.unique(data.group[inside])) >= _FEWEST_GROUPS
        and inside.sum() >= 2 * _FEWEST_SEGMENTS
    )


class _Split(NamedTuple):
    """Segments of other homes, those of this one to correct, in this order, and to be tried on."""

    others: Indices
    pool: Indices
    test: Indices


def _split(data: Dataset, number: int, shuffle: int) -> _Split:
    rng = np.random.default_rng(shuffle)
    inside = data.collection == number
    groups = rng.permutation(np.unique(data.group[inside]))
    mine = np.isin(data.group, groups[: len(groups) // 2])
    pool = _turn_about(np.flatnonzero(inside & mine), data.target, rng)
    others = np.flatnonzero(~inside & ~np.isin(data.group, groups))
    return _Split(others, pool, np.flatnonzero(inside & ~mine))


def _scores(method: Method, classes: int, split: _Split, *arrays: Any) -> list[float]:
    examples = Examples(*arrays)
    target = examples.target
    right = target[split.test]
    scores = []
    for count in CORRECTED:
        home = split.pool[:count]
        weight = examples.weight.copy()
        weight[home] = HOME_WEIGHT
        seen = np.concatenate([split.others, home])
        learned = method.fit(examples._replace(weight=weight), seen, home)
        decision = examples.decide(learned, split.test, classes)
        predicted, labels = decision.argmax(axis=1), np.unique(right)
        scores.append(f1_score(right, predicted, labels=labels, average="macro", zero_division=0))
    return scores


def _turn_about(rows: Indices, target: Indices, rng: np.random.Generator) -> Indices:
    """Order segments at random, but so that the classes take turns, as a person would correct."""
    rows = rng.permutation(rows)
    turn = np.empty(len(rows), np.intp)
    for value in np.unique(target[rows]):
        same = target[rows] == value
        turn[same] = np.arange(same.sum())
    return rows[np.argsort(turn, kind="stable")]
