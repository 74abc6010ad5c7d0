"""Ways to learn: how a classifier is made from segments, and tried on those it has not seen."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, NamedTuple, Protocol, Self

import numpy as np
from joblib import delayed
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.training.dataset import Dataset
from hearthlog.analyzer.workers.parallel import in_parallel
from hearthlog.models.classifiers.description import Description
from hearthlog.models.features.feature_set import FeatureSet
from hearthlog.models.features.installed import feature_set
from hearthlog.schemas.arrays import Float32, Float64, Indices
from hearthlog.schemas.progress import Progress

_SEED = 20_261_121

Fold = tuple[Indices, Indices]  # segments that are seen, and those that are not
NO_HOME: Indices = np.empty(0, np.intp)


class Examples(NamedTuple):
    """The inputs of segments, of each as it is and as other microphones might have heard it.

    Attributes
    ----------
    inputs : np.ndarray [shape=(1 + copies, n, width)], float32
    target : np.ndarray [shape=(n,)], intp
    weight : np.ndarray [shape=(n,)], float64
    """

    inputs: Float32
    target: Indices
    weight: Float64


class Learned(Protocol):
    """What was learned from segments."""

    def decide(self, inputs: Float32, classes: int) -> Float64:
        """Decide as the kind of classifier does with the arrays.

        Parameters
        ----------
        inputs : np.ndarray [shape=(n, width)], float32
        classes : int

        Returns
        -------
        np.ndarray [shape=(n, classes)], float64
            -inf for a class that was not learned.
        """

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays of a model of this kind, of which all classes were learned."""

    def parameters(self) -> dict[str, Any]:
        """Return what the description of such a model has as its parameters."""


@dataclass(frozen=True)
class Method(ABC):
    """A way to learn.

    Attributes
    ----------
    name : str
    feature_set, inputs : str
        What the classifier looks at.
    kind : str
        Of classifier.
    copies : int
        How often each segment is learned from as another microphone might have heard it.
    """

    name: str
    feature_set: str
    inputs: str
    kind: str
    copies: int

    @property
    def features(self) -> FeatureSet:
        """The feature set; raises ModelError if it is not installed."""
        return feature_set(self.feature_set)

    @property
    def libraries(self) -> tuple[str, ...]:
        """Distributions whose versions are part of what comes out."""
        return ()

    @property
    def parameters(self) -> dict[str, float]:
        """What can be chosen, and is searched for."""
        return {}

    @abstractmethod
    def fit(
        self, examples: Examples, seen: Indices | slice = slice(None), home: Indices = NO_HOME
    ) -> Learned:
        """Learn from some segments.

        Parameters
        ----------
        examples : Examples
        seen : np.ndarray [shape=(m,)], intp, or slice
            Those that are learned from.
        home : np.ndarray [shape=(h,)], intp
            Of these, the ones of a home to which the classifier is to be adapted.
        """

    def with_parameters(self, values: Mapping[str, float]) -> Self:
        """Return this method with other parameters.

        Raises
        ------
        DataError
            If it has no such parameter.
        """
        if values:
            raise DataError(f"method {self.name} has no {min(values)} to choose")
        return self

    def variations(self) -> list[Self]:
        """Return methods to search among, this one with them."""
        return [self]

    def as_of(self, about: Description) -> Self:
        """Return the method with the parameters that a model was learned with."""
        del about
        return self


def prepare(method: Method, data: Dataset) -> Examples:
    """Make the examples of a method from segments; the same segments give the same ones.

    Raises
    ------
    DataError
        If its feature set cannot tell what another microphone would have heard.
    """
    features, rng = method.features, np.random.default_rng(_SEED)
    if method.copies and features.augmented is None:
        raise DataError(f"method {method.name}: {features.name} cannot be augmented")
    windows = [data.windows]
    for _ in range(method.copies):
        assert features.augmented is not None
        windows.append(features.augmented(data.windows, rng))
    inputs = features.inputs[method.inputs]
    return Examples(np.stack([inputs.of_windows(w) for w in windows]), data.target, data.weight)


def cross_validate(
    methods: Sequence[Method],
    examples: Examples,
    classes: int,
    folds: Iterable[Fold],
    progress: Progress,
) -> Float64:
    """Decide about segments with classifiers that have not seen them.

    Parameters
    ----------
    methods : sequence of Method
        With the inputs and copies that the examples were made with.
    examples : Examples
    classes : int
    folds : iterable of (seen, unseen)
    progress : callable
        Told the share of the fits that is done.

    Returns
    -------
    np.ndarray [shape=(methods, n, classes)]
        Decision values; -inf for a class that was not among the seen, NaN for segments that are
        unseen in no fold.
    """
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
    """Decide about what is unseen; each array is an argument, which joblib sends once."""
    examples, (seen, unseen) = Examples(*arrays), fold
    return method.fit(examples, seen).decide(examples.inputs[0, unseen], classes)


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
