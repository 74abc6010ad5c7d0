"""Classifier `nearest-mean`: a window is of the class whose mean it is nearest to."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from hearthlog.models.classifiers import (
    LEARNED,
    ClassifierKind,
    learned_shapes,
    target_problem,
)
from hearthlog.models.classifiers.model import Array, Model

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]


class NoParameters(BaseModel):
    """There is nothing to choose."""

    model_config = ConfigDict(extra="forbid")


class NearestMean(ClassifierKind):
    """Its arrays, for C classes.

    means : [shape=(C, width)], float64
        Of the inputs of each class.
    spread : [shape=(width,)], float64
        By which distances are divided.
    learned_inputs, learned_target : optional
        Windows that it was learned from, by which a home adapts it.
    """

    name = "nearest-mean"
    parameters = NoParameters
    arrays: Mapping[str, np.dtype[Any]] = {
        "means": np.dtype(np.float64),
        "spread": np.dtype(np.float64),
    }
    optional = LEARNED

    def shapes(
        self, classes: int, width: int, arrays: Mapping[str, Array]
    ) -> dict[str, tuple[int, ...]]:
        """Return the shapes that arrays must have."""
        return {
            "means": (classes, width),
            "spread": (width,),
            **learned_shapes(width, arrays),
        }

    def problem(self, classes: int, arrays: Mapping[str, Array]) -> str | None:
        """Say what contradicts itself."""
        if not (arrays["spread"] > 1e-9).all():
            return "spread has values that are too small"
        return target_problem(classes, arrays, "learned_target")

    def machine(self, model: Model) -> "NearestMeanMachine":
        """Make what decides."""
        return NearestMeanMachine(model.arrays["means"], model.arrays["spread"])

    def summary(self, model: Model) -> str:
        """Say how many means there are."""
        return f"{len(model.arrays['means'])} means"


NEAREST_MEAN = NearestMean()


class NearestMeanMachine:
    """Inference: the nearer a mean, the likelier its class."""

    def __init__(self, means: Float64, spread: Float64) -> None:
        self._means, self._spread = means, spread

    def decide(self, inputs: Float32) -> tuple[Float64, Float64]:
        """Decide for each class, and tell how far the nearest mean is."""
        differences = (inputs[:, np.newaxis] - self._means) / self._spread
        distances = np.vecdot(differences, differences) / len(self._spread)
        return -distances, 1.0 - np.exp(-distances.min(axis=1))
