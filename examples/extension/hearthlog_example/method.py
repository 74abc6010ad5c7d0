"""The way to learn `nearest-octaves`: the means of octave levels."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.training.method import Examples, Method
from hearthlog.schemas.arrays import Indices
from hearthlog_example.classifier import NEAREST_MEAN, NearestMeanMachine
from hearthlog_example.features import OCTAVES

_LEAST_SPREAD = 1e-3


@dataclass(frozen=True)
class MeansMethod(Method):
    """Learns the mean of each class, and how far segments are from it."""

    def fit(self, examples: Examples, seen: Indices | slice = slice(None)) -> "LearnedMeans":
        """Learn from some segments, by their weight."""
        inputs, target, weight = examples.windows(seen)
        classes = np.unique(target)
        means = np.stack(
            [np.average(inputs[target == c], axis=0, weights=weight[target == c]) for c in classes]
        )
        spread = (inputs - means[np.searchsorted(classes, target)]).std(axis=0)
        kept = {"learned_inputs": inputs, "learned_target": target.astype(np.int64)}
        return LearnedMeans(classes, means, np.maximum(spread, _LEAST_SPREAD), kept)


class LearnedMeans:
    """What was learned."""

    def __init__(
        self,
        classes: Indices,
        means: NDArray[np.float64],
        spread: NDArray[np.float64],
        kept: dict[str, NDArray[Any]],
    ) -> None:
        self._classes, self._means, self._spread, self._kept = classes, means, spread, kept

    def decide(self, inputs: NDArray[np.float32], classes: int) -> NDArray[np.float64]:
        """Decide as the classifier does."""
        decision = np.full((len(inputs), classes), -np.inf)
        machine = NearestMeanMachine(self._means, self._spread)
        decision[:, self._classes] = machine.decide(inputs)[0]
        return decision

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays of `NearestMean`."""
        return {"means": self._means, "spread": self._spread, **self._kept}

    def parameters(self) -> dict[str, Any]:
        """Return nothing."""
        return {}


NEAREST_OCTAVES = MeansMethod(
    name="nearest-octaves",
    feature_set=OCTAVES.name,
    inputs="statistics",
    kind=NEAREST_MEAN.name,
    copies=0,
)
