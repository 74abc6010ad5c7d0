"""Methods: how a classifier is learned from segments, and tested on segments it has not seen."""

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

Fold = tuple[Indices, Indices]  # segments to learn from, and segments to test on
NO_HOME: Indices = np.empty(0, np.intp)


class Examples(NamedTuple):
    """The inputs of segments, unchanged and augmented.

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
    """A classifier that was learned from segments."""

    def decide(self, inputs: Float32, classes: int) -> Float64:
        """Return decision values as `Machine.decide` gives them, for a classifier of this kind.

        Parameters
        ----------
        inputs : np.ndarray [shape=(n, width)], float32
        classes : int
            C, the number of all classes.

        Returns
        -------
        np.ndarray [shape=(n, C)], float64
            -inf for a class that was not learned.
        """

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays of a model file; all classes were learned."""

    def parameters(self) -> dict[str, Any]:
        """Return the values of the field `parameters` in the description of a model."""


@dataclass(frozen=True)
class Method(ABC):
    """How a classifier is learned.

    Attributes
    ----------
    name : str
    feature_set, inputs : str
        Feature set of the classifier, and which of its inputs.
    kind : str
        Kind of classifier.
    copies : int
        Number of augmented copies of each segment.
    """

    name: str
    feature_set: str
    inputs: str
    kind: str
    copies: int

    @property
    def features(self) -> FeatureSet:
        """Feature set of the classifier; raises ModelError if it is not installed."""
        return feature_set(self.feature_set)

    @property
    def libraries(self) -> tuple[str, ...]:
        """Distributions whose versions influence the result."""
        return ()

    @property
    def parameters(self) -> dict[str, float]:
        """Parameters that can be chosen and searched for."""
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
            Indices of the segments to learn from; all by default.
        home : np.ndarray [shape=(h,)], intp
            Indices of those among them that belong to the home to which the classifier is adapted.

        Returns
        -------
        Learned
            The classes that it has not seen have decision values of -inf.
        """

    def with_parameters(self, values: Mapping[str, float]) -> Self:
        """Return this method with other parameters.

        Parameters
        ----------
        values : mapping of str to float
            By name of the parameter, as in `parameters`; those not named stay.

        Raises
        ------
        DataError
            If the method has no such parameter.
        """
        if values:
            raise DataError(f"method {self.name} has no {min(values)} to choose")
        return self

    def variations(self) -> list[Self]:
        """Return the methods that a grid search compares, this one among them."""
        return [self]

    def as_of(self, description: Description) -> Self:
        """Return this method with the parameters of a model.

        Parameters
        ----------
        description : Description
            Of a model that this method has learned.
        """
        del description
        return self


def prepare(method: Method, data: Dataset) -> Examples:
    """Compute the inputs of segments for a method; the same segments give the same inputs.

    Parameters
    ----------
    method : Method
    data : Dataset
        Segments of the method's feature set.

    Returns
    -------
    inputs : Examples
        All segments of `data`, in their order, unchanged and in `method.copies` augmented copies.

    Raises
    ------
    DataError
        If the method wants augmented copies and its feature set has none.
    ModelError
        If the feature set is not installed.
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
    """Classify segments by classifiers that have not seen them.

    Parameters
    ----------
    methods : sequence of Method
        All with the inputs and the number of copies that the examples have.
    examples : Examples
    classes : int
        C, the number of classes.
    folds : iterable of Fold
        Indices of the segments to learn from, and of those to test on.
    progress : callable
        Is told the share of the fits that is done, 0 to 1.

    Returns
    -------
    np.ndarray [shape=(len(methods), n, C)], float64
        Decision values; -inf for a class that was not learned, NaN for segments that no fold tests.
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
    """Classify the test segments of a fold; joblib sends each array, an argument, once."""
    examples, (seen, unseen) = Examples(*arrays), fold
    return method.fit(examples, seen).decide(examples.inputs[0, unseen], classes)


def inverse_temperature(decisions: Float64, target: Indices) -> float:
    """Find the factor of decision values that minimises the log loss of their softmax.

    Parameters
    ----------
    decisions : np.ndarray [shape=(n, C)], float64
        Decision values; -inf for a class that was not learned.
    target : np.ndarray [shape=(n,)], intp
        Indices of the true classes.

    Returns
    -------
    float
        From exp(-5) to exp(5); the inverse of the temperature.

    References
    ----------
    Guo et al., "On Calibration of Modern Neural Networks", 2017.
    """

    def loss(logarithm: float) -> float:
        probabilities = softmax(np.exp(logarithm) * decisions)[np.arange(len(target)), target]
        return float(-np.log(np.maximum(probabilities, 1e-300)).mean())

    result = minimize_scalar(loss, bounds=(-5.0, 5.0), method="bounded", options={"xatol": 1e-6})
    return float(np.exp(result.x))


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
