"""The nearest of the windows that were learned, which vote."""

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from hearthlog.models.classifiers import (
    LEARNED,
    ClassifierKind,
    learned_shapes,
    target_problem,
)
from hearthlog.models.classifiers.model import Array, Model
from hearthlog.models.classifiers.rbf_machines import (
    SCALER,
    RoundedDistances,
    Scaler,
    scaler_problem,
    scaler_shapes,
)
from hearthlog.schemas.arrays import Float32, Float64
from hearthlog_classifiers.shares import log_shares

_ROWS_AT_ONCE = 32  # bounds memory
_VECTORS_AT_ONCE = 256  # a product this small no BLAS divides among threads


class NeighboursParameters(BaseModel):
    """Parameters of neighbours.

    Attributes
    ----------
    neighbours : int
        How many vote; more where several are as far as the last of them.
    steps : int
        Of a standard deviation, to which inputs are rounded.
    """

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid")

    neighbours: Annotated[int, Field(ge=1, le=1000)]
    steps: Annotated[int, Field(ge=1, le=1024)]


class NeighboursKind(ClassifierKind):
    """Windows that vote; the arrays for C classes.

    scaler_mean, scaler_scale : [shape=(width,)], float64
        Mean and standard deviation of the inputs.
    vectors : [shape=(n, width)], float32
        Inputs that were learned, not scaled.
    vectors_target : [shape=(n,)], int64
        Their classes.
    learned_inputs, learned_target : optional
        As of `hearthlog.models.classifiers`, of a model that was adapted: those
        before it was.
    """

    name = "neighbours"
    parameters = NeighboursParameters
    arrays: Mapping[str, np.dtype[Any]] = {
        **SCALER,
        "vectors": np.dtype(np.float32),
        "vectors_target": np.dtype(np.int64),
    }
    optional: Mapping[str, np.dtype[Any]] = LEARNED

    def shapes(
        self, classes: int, width: int, arrays: Mapping[str, Array]
    ) -> dict[str, tuple[int, ...]]:
        """Return shapes, as of `ClassifierKind.shapes`."""
        del classes
        count = arrays["vectors_target"].size
        shapes: dict[str, tuple[int, ...]] = {
            **scaler_shapes(width),
            "vectors": (count, width),
            "vectors_target": (count,),
        }
        return shapes | learned_shapes(width, arrays)

    def problem(self, classes: int, arrays: Mapping[str, Array]) -> str | None:
        """Return what is wrong with the arrays, as of `ClassifierKind.problem`."""
        if not len(arrays["vectors"]):
            return "has no vectors"
        return scaler_problem(arrays) or target_problem(
            classes, arrays, "vectors_target", "learned_target"
        )

    def machine(self, model: Model) -> "NeighboursMachine":
        """Prepare a model for inference."""
        parameters = NeighboursParameters.model_validate(model.description.parameters)
        return NeighboursMachine(model.arrays, parameters, len(model.classes))

    def summary(self, model: Model) -> str:
        """Return the number of vectors, in words."""
        return f"{len(model.arrays['vectors'])} windows, the nearest of which vote"


NEIGHBOURS = NeighboursKind()


class NeighboursMachine:
    """Inference of one model, as scikit-learn's `KNeighborsClassifier` where no two are as far.

    Squares of distances are exact (`RoundedDistances`), and where some are as far as the last
    neighbour, all of them vote: the order of the windows in the file does not matter.

    Parameters
    ----------
    arrays : mapping of str to np.ndarray
        As of `NeighboursKind`.
    parameters : NeighboursParameters
    classes : int
        Number of classes.
    """

    def __init__(
        self, arrays: Mapping[str, Array], parameters: NeighboursParameters, classes: int
    ) -> None:
        self._scaled = Scaler(arrays)
        self._distances = RoundedDistances(1.0, parameters.steps)
        vectors = self._scaled(arrays["vectors"])
        cuts = range(_VECTORS_AT_ONCE, len(vectors), _VECTORS_AT_ONCE)
        self._blocks = [self._distances.vectors(part) for part in np.split(vectors, cuts)]
        self._place = min(parameters.neighbours, len(vectors)) - 1
        self._one_hot = np.eye(classes)[arrays["vectors_target"]]

    def decide(self, inputs: Float32) -> tuple[Float64, Float64]:
        """Return the logarithms of the shares of votes (`log_shares`), and NaN as novelty."""
        votes = np.empty((len(inputs), self._one_hot.shape[1]))
        for start in range(0, len(inputs), _ROWS_AT_ONCE):
            rows = slice(start, start + _ROWS_AT_ONCE)
            votes[rows] = self._votes(self._scaled(inputs[rows]))
        return log_shares(votes / votes.sum(axis=1, keepdims=True)), np.full(len(inputs), np.nan)

    def _votes(self, scaled: Float64) -> Float64:
        """Count the votes: whole numbers, which are exact in whatever order they are added."""
        rows = self._distances.rows(scaled)
        exponents = [self._distances.between(rows, vectors) for vectors in self._blocks]
        farness = -np.concatenate(exponents, axis=1)
        last = np.partition(farness, self._place, axis=1)[:, self._place]
        is_near = farness <= last[:, np.newaxis]
        votes: Float64 = is_near.astype(np.float64) @ self._one_hot
        return votes
