"""Methods that train a scikit-learn classifier on windows."""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.training.learned_inputs import rounded, spread_over_classes
from hearthlog.analyzer.training.method import Examples, Method
from hearthlog.models.classifiers.classifier_kind import ClassifierKind, Machine
from hearthlog.schemas.arrays import Float32, Float64, Indices

_ROWS_AT_ONCE = 256
_SEED = 20_261_122


@dataclass(frozen=True)
class WindowMethod(Method):
    """A scikit-learn classifier with balanced class weights."""

    most_windows: int = 12_000

    @property
    def random_state(self) -> int:
        """Random state of the scikit-learn classifier."""
        return _SEED + self.seed

    @property
    def libraries(self) -> tuple[str, ...]:
        """Distributions with an influence on the result."""
        return ("scikit-learn",)

    def fit(self, examples: Examples, seen: Indices | slice = slice(None)) -> "LearnedMachine":
        """Train on the windows of `seen` segments, by index; all by default."""
        inputs, target, weight = examples.windows(seen)
        if len(inputs) > self.most_windows:
            kept = spread_over_classes(target, weight, self.most_windows, self.seed)
            inputs, target, weight = inputs[kept], target[kept], weight[kept]
        classes, number = np.unique(target, return_inverse=True)
        machine, arrays, parameters = self.learn(rounded(inputs), number, weight)
        return LearnedMachine(machine, classes, arrays, parameters)

    @abstractmethod
    def learn(
        self, inputs: Float32, target: Indices, weight: Float64
    ) -> tuple[Machine, dict[str, NDArray[Any]], dict[str, Any]]:
        """Train on windows.

        Parameters
        ----------
        inputs : np.ndarray [shape=(n, width)], float32
        target : np.ndarray [shape=(n,)], intp
            Indices of the classes, each with at least one window.
        weight : np.ndarray [shape=(n,)], float64
        """


@dataclass(frozen=True)
class KernelMethod(WindowMethod):
    """A classifier with an RBF kernel: its cost and gamma can be set and searched."""

    cost: float = 4.0
    gamma: float = 1.0
    cost_times: ClassVar[Sequence[float]] = (0.25, 1.0, 4.0)

    @property
    def parameters(self) -> dict[str, float]:
        """Cost and gamma."""
        return {"cost": self.cost, "gamma": self.gamma}

    def with_parameters(self, values: Mapping[str, float]) -> Self:
        """Return this method with another cost or gamma; see `Method.with_parameters`."""
        if unknown := values.keys() - {"cost", "gamma"}:
            raise DataError(f"method {self.name} has no {min(unknown)} to choose")
        return replace(self, **values)  # type: ignore[arg-type]

    def variations(self) -> list[Self]:
        """Return nine methods: three costs, each with gamma times 0.5, 1 and 2."""
        return [
            replace(self, cost=self.cost * cost, gamma=self.gamma * gamma)
            for cost, gamma in product(self.cost_times, (0.5, 1.0, 2.0))
        ]


def as_room(kind: ClassifierKind) -> dict[str, Any]:
    """Return the fields of a method with the inputs of method `room`."""
    return {
        "feature_set": "home33",
        "inputs": "above_floor",
        "kind": kind.name,
        "copies": 0,
        "rooms": 3,
        "gate": 2.0,
        "observation_weight": 0.45,
    }


@dataclass(frozen=True, eq=False)
class LearnedMachine:
    """A classifier that decides with the recorder's own code, of trained classes [shape=(c,)]."""

    machine: Machine
    classes: Indices
    _arrays: Mapping[str, NDArray[Any]]
    _parameters: Mapping[str, Any]

    def decide(self, inputs: Float32, classes: int) -> Float64:
        """Return decision values; see `Learned.decide`."""
        decision = np.full((len(inputs), classes), -np.inf)
        for start in range(0, len(inputs), _ROWS_AT_ONCE):
            rows = slice(start, start + _ROWS_AT_ONCE)
            decision[rows, self.classes] = self.machine.decide(inputs[rows])[0]
        return decision

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays of a model file; requires that all classes were in the training set."""
        return dict(self._arrays)

    def parameters(self) -> dict[str, Any]:
        """Return the field `parameters` of a model description."""
        return dict(self._parameters)
