"""A one-class support vector machine for each class, of which the surest decides."""

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from hearthlog.models.batch_invariant import aligned, rowwise_matmul
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

_VECTORS_AT_ONCE = 128  # times the classes, a product this small no BLAS divides among threads


class OneClassParameters(BaseModel):
    """Parameters of the machines.

    Attributes
    ----------
    gamma : float
        Of the kernel exp(-gamma |x - s|^2).
    steps : int
        Of a standard deviation, to which inputs are rounded.
    """

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", allow_inf_nan=False)

    gamma: Annotated[float, Field(gt=0.0, le=1e6)]
    steps: Annotated[int, Field(ge=1, le=1024)]


class OneClassKind(ClassifierKind):
    """One-class support vector machines; the arrays for C classes.

    scaler_mean, scaler_scale : [shape=(width,)], float64
        Mean and standard deviation of the inputs.
    support_vectors : [shape=(n, width)], float32
        Inputs, not scaled.
    support_target : [shape=(n,)], int64
        The class whose machine each is of.
    coefficients : [shape=(n,)], float64
        Their weights.
    offsets : [shape=(C,)], float64
        What the weighted kernels must be above where a window is of the class.
    learned_inputs, learned_target : optional
        As of `hearthlog.models.classifiers`.
    """

    name = "one-class"
    parameters = OneClassParameters
    arrays: Mapping[str, np.dtype[Any]] = {
        **SCALER,
        "support_vectors": np.dtype(np.float32),
        "support_target": np.dtype(np.int64),
        "coefficients": np.dtype(np.float64),
        "offsets": np.dtype(np.float64),
    }
    optional: Mapping[str, np.dtype[Any]] = LEARNED

    def shapes(
        self, classes: int, width: int, arrays: Mapping[str, Array]
    ) -> dict[str, tuple[int, ...]]:
        """Return shapes, as of `ClassifierKind.shapes`."""
        count = arrays["support_target"].size
        shapes: dict[str, tuple[int, ...]] = {
            **scaler_shapes(width),
            "support_vectors": (count, width),
            "support_target": (count,),
            "coefficients": (count,),
            "offsets": (classes,),
        }
        return shapes | learned_shapes(width, arrays)

    def problem(self, classes: int, arrays: Mapping[str, Array]) -> str | None:
        """Return what is wrong with the arrays, as of `ClassifierKind.problem`."""
        return scaler_problem(arrays) or target_problem(
            classes, arrays, "support_target", "learned_target"
        )

    def machine(self, model: Model) -> "OneClassMachine":
        """Prepare a model for inference."""
        parameters = OneClassParameters.model_validate(model.description.parameters)
        return OneClassMachine(model.arrays, parameters)

    def summary(self, model: Model) -> str:
        """Return the number of support vectors, in words."""
        return f"{len(model.arrays['support_vectors'])} support vectors"


ONE_CLASS = OneClassKind()


class OneClassMachine:
    """Inference of one model; each machine decides as scikit-learn's `OneClassSVM` within 1e-5.

    Parameters
    ----------
    arrays : mapping of str to np.ndarray
        As of `OneClassKind`.
    parameters : OneClassParameters
    """

    def __init__(self, arrays: Mapping[str, Array], parameters: OneClassParameters) -> None:
        self._scaled = Scaler(arrays)
        self._offsets = arrays["offsets"]
        self._distances = RoundedDistances(parameters.gamma, parameters.steps)
        vectors = self._scaled(arrays["support_vectors"])
        one_hot = np.eye(len(arrays["offsets"]))[arrays["support_target"]]
        weights = one_hot * arrays["coefficients"][:, np.newaxis]
        self._blocks = [
            (
                self._distances.vectors(vectors[start : start + _VECTORS_AT_ONCE]),
                aligned(weights[start : start + _VECTORS_AT_ONCE]),
            )
            for start in range(0, len(vectors), _VECTORS_AT_ONCE)
        ]

    def decide(self, inputs: Float32) -> tuple[Float64, Float64]:
        """Return the decision values of the machines, and NaN as novelty."""
        rows = self._distances.rows(self._scaled(inputs))
        decisions = np.tile(-self._offsets, (len(inputs), 1))
        for vectors, weights in self._blocks:
            kernel = np.exp(self._distances.between(rows, vectors))
            decisions += rowwise_matmul(kernel, weights)
        return decisions, np.full(len(inputs), np.nan)
