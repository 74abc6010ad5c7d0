"""`python -m hearthlog.tools.lab.classifiers MANIFEST`: kinds of classifiers, on the same sounds.

Each method learns from the same windows with the same inputs, so that only the classifier differs.
It is tried on sources and on collections that were left out, each time with the temperature that
the others give. Size and time are of the model that learned from everything.
"""

import os

from hearthlog.schemas.blas import kernel_environment
from hearthlog.tools.lab.command import run

if __name__ == "__main__":  # before numpy is imported: "one core" is to be true for everyone
    os.environ.update(
        dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    )
    os.environ.update(kernel_environment())

import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer
from numpy.typing import NDArray
from sklearn.model_selection import StratifiedGroupKFold

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.training.calibration import (
    Fold,
    collection_folds,
    cross_validate,
    nested_probabilities,
)
from hearthlog.analyzer.training.dataset import Dataset, build_dataset
from hearthlog.analyzer.training.manifest import load_scenario, read_manifest
from hearthlog.analyzer.training.method import Examples, Method, prepare
from hearthlog.analyzer.training.scores import Scores, calibration_error, difference, score
from hearthlog.analyzer.training.train import MOST_FOLDS, method_named
from hearthlog.analyzer.training.window_methods import ROOM
from hearthlog.models.classifiers import Machine
from hearthlog.models.classifiers.classifier import classifier_kind
from hearthlog.models.classifiers.model import Description, Model
from hearthlog.schemas.arrays import Float32, Float64
from hearthlog.schemas.errors import ignore_progress
from hearthlog.schemas.frames import FRAME_SECONDS
from hearthlog.tools.cli.terminal import print_table
from hearthlog.tools.lab.bench.timing import best_of

METHODS = (  # those behind svm are of examples/classifiers
    *("room", "svm", "logistic", "perceptron", "neighbours"),
    *("forest", "extra-trees", "boosting", "one-class"),
)
SCENARIOS = ("general", "bathroom")
_TIMED_ROWS = 256
_Line = tuple[str, ...]
_OF_EACH = ("95 %", "of seeds", "error")
_RIGHT = ("method", "sources", *_OF_EACH, "collections", *_OF_EACH)
_AGAINST = ("against room", "95 %")
_TAKES = ("method", "MB", "ms/s", "ms/s live", "s to learn")


class Tried(NamedTuple):
    """Segments classified by machines that had not learned from them.

    Attributes
    ----------
    probabilities : np.ndarray [shape=(seeds, n, C)], float64
        The temperature is that of the other folds.
    scores : Scores
        Of the first seed.
    macro_f1 : np.ndarray [shape=(seeds,)], float64
    error : float
        Expected calibration error, the mean of all seeds.
    """

    probabilities: Float64
    scores: Scores
    macro_f1: Float64
    error: float


class Cost(NamedTuple):
    """What a model takes.

    Attributes
    ----------
    stored_bytes : int
        Of its arrays in the file.
    seconds, live_seconds : float
        Of CPU for a second of sound, many windows at once and one by one.
    fit_seconds : float
        Of CPU, to learn it.
    """

    stored_bytes: int
    seconds: float
    live_seconds: float
    fit_seconds: float


def classifiers(
    manifest: Annotated[Path, typer.Argument(help="Of labelled clips.")],
    scenario: Annotated[list[str], typer.Option(help="As of `hearthlog train`.")] = [*SCENARIOS],  # noqa: B006  typer copies it
    method: Annotated[list[str], typer.Option(help="Method to try; all by default.")] = [*METHODS],  # noqa: B006
    windows: Annotated[int, typer.Option(min=100, help="To learn from, at most.")] = 4000,
    seeds: Annotated[int, typer.Option(min=1, help="Of folds, and of what methods draw.")] = 1,
) -> None:
    """Compare kinds of classifiers, with the same inputs, on sounds that they have not learned."""
    if unknown := [name for name in method if name not in METHODS]:
        raise typer.BadParameter(f"{unknown[0]}: known are {', '.join(METHODS)}")
    names = [ROOM.name, *(name for name in method if name != ROOM.name)]
    methods = [replace(method_named(name), most_windows=windows) for name in names]  # type: ignore[call-arg]
    for name in scenario:
        data = _segments(manifest, name)
        examples = prepare(ROOM, data)
        print(f"{name}: {len(data)} segments of {len(data.classes)} classes; {_amounts(data)}")
        right, takes, room = list[_Line](), list[_Line](), None
        for one in methods:
            of_sources, of_collections = tried(one, data, examples, seeds)
            room = room or of_collections
            figures = _right(of_sources, of_collections)
            right.append((one.name, *figures, *_against(data, room, of_collections)))
            takes.append((one.name, *_takes(cost_of(one, data, examples))))
            print(f"{name}: {one.name}", file=sys.stderr, flush=True)
        print_table((*_RIGHT, *_AGAINST), right)
        print()
        print_table(_TAKES, takes)
        print()


def tried(method: Method, data: Dataset, examples: Examples, seeds: int) -> tuple[Tried, Tried]:
    """Try a method on sources, and on collections, that it has not learned from.

    Parameters
    ----------
    method : Method
        With the inputs of the examples.
    data : Dataset
    examples : Examples
        Of this data.
    seeds : int
        How often: each time the sources are divided anew, and what the method draws is drawn anew.

    Raises
    ------
    DataError
        If there are fewer than three collections to leave out.
    """
    collections = collection_folds(data)
    if not collections:
        raise DataError(
            "there are too few collections (column source of the manifest) to leave out"
        )
    of_sources, of_collections = [], []
    for seed in range(seeds):
        drawn = replace(method, seed=seed)
        of_sources.append(_probabilities(drawn, data, examples, _source_folds(data, seed)))
        of_collections.append(_probabilities(drawn, data, examples, collections))
    return _tried(data, of_sources), _tried(data, of_collections)


def cost_of(method: Method, data: Dataset, examples: Examples) -> Cost:
    """Learn from everything, and measure what the model takes.

    Parameters
    ----------
    method : Method
        With the inputs of the examples.
    data : Dataset
    examples : Examples
        Of this data.
    """
    began = time.process_time()
    learned = method.fit(examples)
    fit_seconds = time.process_time() - began
    arrays = learned.arrays()
    description = Description.model_construct(
        parameters=learned.parameters(), classes=list(data.classes), novelty="doubt"
    )
    machine = classifier_kind(method.kind).machine(Model(description, arrays))
    rows = examples.inputs[0].reshape(-1, examples.inputs.shape[-1])[:_TIMED_ROWS]
    seconds = best_of(
        {"many": lambda: machine.decide(rows), "one": lambda: _one_by_one(machine, rows)},
        least=0.2,
    )
    windows_a_second = 1.0 / FRAME_SECONDS
    of_many, of_one = (seconds[name].cpu / len(rows) * windows_a_second for name in seconds)
    return Cost(stored_bytes(arrays), of_many, of_one, fit_seconds)


def stored_bytes(arrays: Mapping[str, NDArray[Any]]) -> int:
    """Return the bytes that arrays take in a model file, which halves what loses nothing by it.

    Parameters
    ----------
    arrays : mapping of str to np.ndarray
    """
    return sum(array.nbytes // (2 if _is_half(array) else 1) for array in arrays.values())


def _is_half(array: NDArray[Any]) -> bool:
    with np.errstate(over="ignore"):
        return array.dtype == np.float32 and np.array_equal(array.astype(np.float16), array)


def _segments(manifest: Path, name: str) -> Dataset:
    scenario = load_scenario(name)
    clips = read_manifest(manifest, scenario.labels)
    scenario = scenario.with_unknown((clip.label, clip.source_group) for clip in clips)
    return build_dataset(clips, scenario, ignore_progress, (), ROOM.features, ROOM.rooms)


def _amounts(data: Dataset) -> str:
    groups, collections = len(np.unique(data.group)), len(data.collection_names)
    return f"{groups} sources, {collections} collections in {len(collection_folds(data))} folds"


def _source_folds(data: Dataset, seed: int) -> list[Fold]:
    divider = StratifiedGroupKFold(MOST_FOLDS, shuffle=True, random_state=seed)
    return list(divider.split(data.target, data.target, data.group))


def _probabilities(
    method: Method, data: Dataset, examples: Examples, folds: Sequence[Fold]
) -> Float64:
    [decisions] = cross_validate([method], examples, len(data.classes), folds, ignore_progress)
    return nested_probabilities(decisions, data.target, folds)


def _tried(data: Dataset, probabilities: Sequence[Float64]) -> Tried:
    scores = [score(data.target, p.argmax(axis=1), data.group, data.classes) for p in probabilities]
    errors = [calibration_error(p, data.target) for p in probabilities]
    macro_f1 = np.array([one.macro_f1 for one in scores])
    return Tried(np.stack(probabilities), scores[0], macro_f1, float(np.mean(errors)))


def _one_by_one(machine: Machine, rows: Float32) -> None:
    for place in range(len(rows)):
        machine.decide(rows[place : place + 1])


def _right(*tries: Tried) -> _Line:
    return tuple(
        text
        for one in tries
        for text in (
            f"{one.macro_f1.mean():.3f}",
            _interval(one.scores.macro_f1_interval),
            _range(one.macro_f1),
            f"{one.error:.3f}",
        )
    )


def _against(data: Dataset, room: Tried, other: Tried) -> tuple[str, str]:
    if other is room:
        return "", ""
    probabilities = room.probabilities[0], other.probabilities[0]
    against = difference(data.target, *probabilities, data.group, data.classes)
    return f"{against.macro_f1:+.3f}", _interval(against.interval, "+")


def _takes(cost: Cost) -> _Line:
    return (
        f"{cost.stored_bytes / 1e6:.2f}",
        f"{1000 * cost.seconds:.2f}",
        f"{1000 * cost.live_seconds:.2f}",
        f"{cost.fit_seconds:.1f}",
    )


def _range(values: Float64) -> str:
    return f"{values.min():.3f}-{values.max():.3f}"


def _interval(interval: tuple[float, float] | None, sign: str = "") -> str:
    return "" if interval is None else f"{interval[0]:{sign}.3f} to {interval[1]:{sign}.3f}"


if __name__ == "__main__":
    run(classifiers)
