"""Adaptation curves: macro F1 of a home against the number of corrected segments.

Run by `python -m hearthlog.tools.lab.adaptation_curve`.

A collection that the machine has never heard stands for the home: it is adapted to segments from
half of the collection's groups, and tried on those of the other half. Corrected are those that were
labelled wrongly, but for silence; those that a reviewer passed by on the way to them, and left as
they were, are kept so. Only classes count of which the home has ten segments from two groups.
"""

from typing import Any, NamedTuple

import numpy as np
from joblib import delayed
from sklearn.metrics import f1_score

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.training.adaptation import HomeLandmarks
from hearthlog.analyzer.training.clips import spread
from hearthlog.analyzer.training.dataset import Dataset
from hearthlog.analyzer.training.home_recordings import HOME_WEIGHT
from hearthlog.analyzer.training.method import Examples, Method, prepare
from hearthlog.analyzer.training.pseudo_labels import MOST_CONFIRMED
from hearthlog.analyzer.training.window_methods import LandmarkMethod
from hearthlog.analyzer.workers import in_parallel
from hearthlog.models.classes import SILENCE, UNKNOWN
from hearthlog.schemas.arrays import Float64, Indices
from hearthlog.schemas.errors import Progress
from hearthlog.tools.cli.evaluate import ScenarioOption, end_with_left_out, learning
from hearthlog.tools.cli.options import Clips, Json, Scheduler
from hearthlog.tools.cli.terminal import print_json, print_table
from hearthlog.tools.lab.command import run
from hearthlog.tools.lab.grid_search import OfFeatures, by_features

CORRECTED = (0, 10, 30, 60)  # segments
_FEWEST_CLASSES = 2
_FEWEST_SEGMENTS = 10  # of a class
_RIGHT = 0.3  # F1 of a class that can be lost
_SHUFFLES = 3


class AdaptationCurve(NamedTuple):
    """Macro F1 against the number of corrected segments."""

    corrected: tuple[int, ...]
    # of each collection that was left out, over the classes that count
    collections: dict[str, list[float]]
    mean: list[float]
    # the largest loss of F1, in any collection, of a class that had 0.3 or more, and of silence
    worst: list[float]
    worst_of_silence: list[float]


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
        If no collection is large and varied enough to stand for a home, or the method learns no
        landmarks, which are what a home moves.
    """
    if not isinstance(method, LandmarkMethod):
        raise DataError(
            f"method {method.name} learns no landmarks, which are what a home moves: choose room"
        )
    names = data.collection_names
    homes = {number: _segments_of_home(data, number) for number in range(len(names))}
    chosen = [
        number
        for number, rows in homes.items()
        if len(np.unique(data.target[rows])) >= _FEWEST_CLASSES
    ]
    if not chosen or len(names) < 2:
        raise DataError(
            f"no collection beside another has {_FEWEST_CLASSES} classes with {_FEWEST_SEGMENTS} "
            "segments from two source groups each: none can stand for a new home"
        )
    examples = prepare(method, data)
    silence = data.classes.index(SILENCE) if SILENCE in data.classes else -1
    splits = [
        _split(data, number, homes[number], shuffle)._replace(silence=silence)
        for number in chosen
        for shuffle in range(_SHUFFLES)
    ]
    calls = (delayed(_scores)(method, len(data.classes), split, *examples) for split in splits)
    scores = np.empty((len(splits), len(CORRECTED), len(data.classes)))
    for place, rows in enumerate(in_parallel(calls)):
        scores[place] = rows
        progress((place + 1) / len(splits))
    each = np.nanmean(scores, axis=2).reshape(len(chosen), _SHUFFLES, -1).mean(axis=1)
    divided = scores.reshape(len(chosen), _SHUFFLES, *scores.shape[1:])
    scores = np.nansum(divided, axis=1) / np.maximum(np.isfinite(divided).sum(axis=1), 1)
    curves = {names[number]: row.tolist() for number, row in zip(chosen, each, strict=True)}
    lost = np.where(scores[:, :1] >= _RIGHT, scores - scores[:, :1], 0.0)
    of_silence = np.array([name == SILENCE for name in data.classes])
    return AdaptationCurve(
        CORRECTED,
        curves,
        each.mean(axis=0).tolist(),
        worst=lost.min(axis=(0, 2)).tolist(),
        worst_of_silence=lost[:, :, of_silence].min(axis=(0, 2), initial=0.0).tolist(),
    )


def _segments_of_home(data: Dataset, number: int) -> Indices:
    """Return the segments of a collection whose classes count; `unknown` is no class to correct."""
    inside = data.collection == number
    counts = np.bincount(data.target[inside], minlength=len(data.classes))
    pairs = np.unique(np.stack([data.target[inside], data.group[inside]]), axis=1)
    groups = np.bincount(pairs[0], minlength=len(data.classes))
    known = np.array([name != UNKNOWN for name in data.classes])
    counted = known & (counts >= _FEWEST_SEGMENTS) & (groups >= 2)
    return np.flatnonzero(inside & counted[data.target])


class _Split(NamedTuple):
    """Segments of other homes, those of this one to review, in this order, and to be tried on."""

    others: Indices
    pool: Indices
    test: Indices
    silence: int = -1  # number of the class


def _split(data: Dataset, number: int, rows: Indices, shuffle: int) -> _Split:
    rng = np.random.default_rng(shuffle)
    inside = data.collection == number
    groups = rng.permutation(np.unique(data.group[rows]))
    mine = np.isin(data.group[rows], groups[: len(groups) // 2])
    pool = _turn_about(rows[mine], data.target, rng)
    others = np.flatnonzero(~inside & ~np.isin(data.group, data.group[inside]))
    return _Split(others, pool, rows[~mine])


def _scores(method: LandmarkMethod, classes: int, split: _Split, *arrays: Any) -> Float64:
    """Return the F1 of each class after each number of corrections; NaN for a class without any."""
    examples = Examples(*arrays)
    target = examples.target
    base = method.fit(examples, split.others)
    fields = method.name, method.feature_set, method.inputs, method.kind
    again = HomeLandmarks(*fields, copies=0, base=base.arrays(), values=base.parameters())
    # The base has numbers for what it learned; what only the home has comes behind.
    order = np.concatenate([base.classes, np.setdiff1d(np.arange(classes), base.classes)])
    at_home = examples._replace(
        target=np.argsort(order)[target],
        more_inputs=examples.more_inputs[:0],
        more_target=examples.more_target[:0],
    )
    labelled = examples.decide(base, split.pool, classes).argmax(axis=1)
    true = target[split.pool]
    wrong = np.flatnonzero((labelled != true) & (true != split.silence))
    scores = np.full((len(CORRECTED), classes), np.nan)
    labels = np.unique(target[split.test])
    for place, count in enumerate(CORRECTED):
        marked = wrong[:count]
        passed = np.flatnonzero((labelled == true)[: marked[-1]]) if len(marked) else marked
        home = split.pool[np.concatenate([marked, _few_of_each(passed, true)])]
        weight = examples.weight.copy()
        weight[split.pool[marked]] = HOME_WEIGHT
        learned, numbers = base, np.arange(classes)
        if len(home):
            numbers = order
            learned = again.fit(at_home._replace(weight=weight), home)
        predicted = numbers[examples.decide(learned, split.test, classes).argmax(axis=1)]
        scores[place, labels] = f1_score(
            target[split.test], predicted, labels=labels, average=None, zero_division=0
        )
    return scores


def _few_of_each(rows: Indices, target: Indices) -> Indices:
    """Choose as many rows of each class as are kept as they were."""
    kept = [spread(rows[target[rows] == number], MOST_CONFIRMED) for number in np.unique(target)]
    return np.concatenate(kept)


def _turn_about(rows: Indices, target: Indices, rng: np.random.Generator) -> Indices:
    """Order segments at random, but so that the classes take turns, as a person would correct."""
    rows = rng.permutation(rows)
    turn = np.empty(len(rows), np.intp)
    for value in np.unique(target[rows]):
        same = target[rows] == value
        turn[same] = np.arange(same.sum())
    return rows[np.argsort(turn, kind="stable")]


def main(
    method: OfFeatures = None,
    *,
    data: Clips,
    scenario: ScenarioOption,
    scheduler: Scheduler = None,
    as_json: Json = False,
) -> None:
    """Show how F1 grows with corrected segments of a home.

    Each collection of the clips stands for a home once, and the others are learned from.
    """
    method = by_features(method, "what marks teach its heads, `hearthlog train --home` tries")
    with learning(method, data, scenario, scheduler) as (chosen, segments, progress):
        curve = adaptation_curve(segments, chosen, progress)
    if as_json:
        print_json({"scenario": scenario, "method": chosen.name} | curve._asdict())
        end_with_left_out(segments.left_out)
        return
    window = f"{chosen.features.window_seconds:g} s"
    print(f"macro F1 after so many corrected segments of {window}\n")
    curves = curve.collections | {"mean": curve.mean}
    print_table(
        ("collection left out", *map(str, curve.corrected)),
        [(name, *(f"{value:.3f}" for value in row)) for name, row in curves.items()],
    )
    print(
        f"\nlargest loss of a class in a home: {-min(curve.worst):.3f}, of silence "
        f"{-min(curve.worst_of_silence):.3f}"
    )
    end_with_left_out(segments.left_out)


if __name__ == "__main__":
    run(main)
