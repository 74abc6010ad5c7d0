"""How a support vector machine is made from segments, and tried on those it has not seen."""

from collections.abc import Callable, Iterable, Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from joblib import delayed
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from sklearn.metrics.pairwise import rbf_kernel
from sklearn.pipeline import Pipeline, make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.svm import SVC

from hearthlog.analyzer.augment import augmented
from hearthlog.analyzer.dataset import Dataset
from hearthlog.analyzer.workers.parallel import in_parallel
from hearthlog.models.classifier import HOME_SHARPNESS, home_votes, weakest_pairs
from hearthlog.models.inputs import Kind, window_inputs

_SEED = 20_261_121

Float64 = NDArray[np.float64]
Indices = NDArray[np.intp]
Fold = tuple[Indices, Indices]  # segments that are seen, and those that are not


class Recipe(NamedTuple):
    """How to learn.

    Attributes
    ----------
    inputs : str
        What the classifier looks at.
    cost : float
    gamma : float
        Times the number of inputs.
    copies : int
        How often each segment is learned from as another microphone might have heard it.
    """

    inputs: Kind
    cost: float
    gamma: float
    copies: int


RECIPES = {"bands": Recipe("bands", 4.0, 1.25, 1), "paper": Recipe("statistics", 4.0, 0.5, 0)}


class Examples(NamedTuple):
    """The inputs of segments, of each as it is and as other microphones might have heard it.

    Attributes
    ----------
    inputs : np.ndarray [shape=(1 + copies, n, width)], float32
    target : np.ndarray [shape=(n,)], intp
    weight : np.ndarray [shape=(n,)], float64
    """

    inputs: NDArray[np.float32]
    target: Indices
    weight: Float64


def prepare(recipe: Recipe, data: Dataset) -> Examples:
    """Make the examples of a recipe from segments; the same segments give the same ones."""
    rng = np.random.default_rng(_SEED)
    versions = [data.windows] + [augmented(data.windows, rng) for _ in range(recipe.copies)]
    inputs = np.stack([window_inputs(recipe.inputs, windows) for windows in versions])
    return Examples(inputs, data.target, data.weight)


def fit(recipe: Recipe, examples: Examples, seen: Indices | slice = slice(None)) -> Pipeline:
    """Learn from some segments.

    Returns
    -------
    sklearn.pipeline.Pipeline
        A scaler and an `SVC`, classes weighted against their number.
    """
    copies, _, width = examples.inputs.shape
    inputs = examples.inputs[:, seen].reshape(-1, width).astype(np.float64)
    machine = SVC(
        C=recipe.cost,
        gamma=recipe.gamma / width,
        class_weight="balanced",
        decision_function_shape="ovo",
    )
    return make_pipeline(StandardScaler(), machine).fit(
        inputs,
        np.tile(examples.target[seen], copies),
        svc__sample_weight=np.tile(examples.weight[seen], copies),
    )


def cross_validate(
    recipes: Sequence[Recipe],
    examples: Examples,
    classes: int,
    folds: Iterable[Fold],
    progress: Callable[[int, int], None],
) -> Float64:
    """Decide about segments with machines that have not seen them.

    Parameters
    ----------
    recipes : sequence of Recipe
        With the inputs and copies that the examples were made with.
    examples : Examples
    classes : int
    folds : iterable of (seen, unseen)
    progress : callable
        Told how many fits of how many are done.

    Returns
    -------
    np.ndarray [shape=(recipes, n, classes)]
        Decision values; -inf for a class that was not among the seen, NaN for segments that are
        unseen in no fold.
    """
    folds = list(folds)
    decisions = np.full((len(recipes), len(examples.target), classes), np.nan)
    tasks = list(product(range(len(recipes)), folds))
    calls = (
        delayed(_decide_unseen)(recipes[number], classes, fold, *examples) for number, fold in tasks
    )
    for done, decided in enumerate(in_parallel(calls)):
        number, (_, unseen) = tasks[done]
        decisions[number, unseen] = decided
        progress(done + 1, len(tasks))
    return decisions


def _decide_unseen(recipe: Recipe, classes: int, fold: Fold, *arrays: Any) -> Float64:
    """Decide about what is unseen; each array is an argument, which joblib sends once."""
    examples, (seen, unseen) = Examples(*arrays), fold
    return decide(fit(recipe, examples, seen), examples.inputs[0, unseen], classes)


def decide(machine: Pipeline, inputs: NDArray[np.float32], classes: int) -> Float64:
    """Decide as `hearthlog.models.classifier.Classifier` does.

    Returns
    -------
    np.ndarray [shape=(n, classes)]
        -inf for a class that was not learned.
    """
    found = machine.decision_function(inputs.astype(np.float64))
    pairs = -found[:, np.newaxis] if found.ndim == 1 else found
    decision = np.full((len(inputs), classes), -np.inf)
    decision[:, machine.classes_] = weakest_pairs(pairs, len(machine.classes_))
    return decision


def decide_with_home(
    machine: Pipeline,
    inputs: NDArray[np.float32],
    classes: int,
    home: NDArray[np.float32],
    target: Indices,
) -> Float64:
    """Decide as `hearthlog.models.classifier.Classifier` does for a home with vectors of its own.

    Parameters
    ----------
    machine : sklearn.pipeline.Pipeline
        As `fit` makes it.
    inputs, home : np.ndarray [shape=(n, width)] and [shape=(h, width)], float32
    classes : int
    target : np.ndarray [shape=(h,)], intp
        Classes of the home's segments.
    """
    decision = decide(machine, inputs, classes)
    if not len(home):
        return decision
    scaler, svc = machine
    gamma, here = HOME_SHARPNESS * svc.gamma, scaler.transform(inputs.astype(np.float64))
    near = rbf_kernel(here, scaler.transform(home.astype(np.float64)), gamma=gamma)
    others = rbf_kernel(here, svc.support_vectors_, gamma=gamma).sum(axis=1, keepdims=True)
    return decision + home_votes(near @ np.eye(classes)[target], others)


def inverse_temperature(decisions: Float64, target: Indices) -> float:
    """Find what to multiply decisions with, so that their softmax is as sure as it is right.

    References
    ----------
    Guo et al., "On Calibration of Modern Neural Networks", 2017.
    """

    def loss(logarithm: float) -> float:
        probabilities = softmax(np.exp(logarithm) * decisions)[np.arange(len(target)), target]
        return float(-np.log(np.maximum(probabilities, 1e-300)).mean())

    found = minimize_scalar(loss, bounds=(-5.0, 5.0), method="bounded", options={"xatol": 1e-6})
    return float(np.exp(found.x))


def softmax(values: Float64) -> Float64:
    """Turn rows into probabilities; -inf has none."""
    grown = np.exp(values - values.max(axis=1, keepdims=True))
    return grown / grown.sum(axis=1, keepdims=True)
