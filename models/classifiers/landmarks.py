"""Kernel logistic regression on landmarks: a linear head on a kernel map of the inputs.

The map is from Williams and Seeger, "Using the Nyström method to speed up kernel machines", 2001:
kernels of a window with some hundreds of points chosen from the training data.
"""

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from hearthlog.models.batch_invariant import aligned, rowwise_matmul
from hearthlog.models.classifiers.classifier_kind import ClassifierKind
from hearthlog.models.classifiers.model import Array, Model
from hearthlog.models.classifiers.rbf_distances import (
    SCALER,
    RoundedDistances,
    Scaler,
    scaler_problem,
    scaler_shapes,
)
from hearthlog.schemas.arrays import Float32, Float64

_LANDMARKS_AT_ONCE = 256  # no BLAS splits a product of this size among threads


class LandmarkParameters(BaseModel):
    """Parameters of the kernel."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", allow_inf_nan=False)

    gamma: Annotated[float, Field(gt=0.0, le=1e6)]  # of the kernel exp(-gamma |x - l|^2)
    steps: Annotated[int, Field(ge=1, le=1024)]


class LandmarksKind(ClassifierKind):
    """Linear decisions on the kernels of landmarks; the arrays for C classes.

    scaler_mean, scaler_scale : [shape=(width,)], float64
        Of the inputs.
    landmarks : [shape=(m, width)], float32
        Unscaled inputs, sorted by class.
    landmark_counts : [shape=(C,)], int64
        Number of landmarks of each class; 0 for a class added by a home.
    home_landmarks : [shape=(h, width)], float32, optional
        Landmarks of the home that the model was adapted to, after the others.
    weights : [shape=(m + h, C)], float64
        Of the kernels.
    bias : [shape=(C,)], float64
    base_weights : [shape=(m, B)], float64, optional
        Weights before any adaptation to a home, of the B classes at that time.
    base_bias : [shape=(B,)], float64, optional
    """

    name = "rbf-landmarks"
    parameters = LandmarkParameters
    arrays: Mapping[str, np.dtype[Any]] = {
        **SCALER,
        "landmarks": np.dtype(np.float32),
        "landmark_counts": np.dtype(np.int64),
        "weights": np.dtype(np.float64),
        "bias": np.dtype(np.float64),
    }
    optional: Mapping[str, np.dtype[Any]] = {
        "home_landmarks": np.dtype(np.float32),
        "base_weights": np.dtype(np.float64),
        "base_bias": np.dtype(np.float64),
    }

    def shapes(
        self, classes: int, width: int, arrays: Mapping[str, Array]
    ) -> dict[str, tuple[int, ...]]:
        """Return the required shapes, as `ClassifierKind.shapes`."""
        count, home, before = (
            len(arrays[name]) if name in arrays and arrays[name].ndim else 0
            for name in ("landmarks", "home_landmarks", "base_bias")
        )
        shapes: dict[str, tuple[int, ...]] = {
            **scaler_shapes(width),
            "landmarks": (count, width),
            "landmark_counts": (classes,),
            "weights": (count + home, classes),
            "bias": (classes,),
        }
        if home:
            shapes["home_landmarks"] = (home, width)
        if before:
            shapes["base_weights"], shapes["base_bias"] = (count, before), (before,)
        return shapes

    def problem(self, classes: int, arrays: Mapping[str, Array]) -> str | None:
        """Return an error in the arrays, as `ClassifierKind.problem`."""
        counts, total = arrays["landmark_counts"], len(arrays["landmarks"])
        if (counts < 0).any() or counts.sum() != total or not total:
            return f"landmark_counts do not add up to the {total} landmarks"
        before = len(arrays.get("base_bias", counts))
        if before > classes or not counts[:before].all() or counts[before:].any():
            return "landmark_counts has classes of the base without landmarks, or others with some"
        return scaler_problem(arrays)

    def machine(self, model: Model) -> "LandmarksMachine":
        """Prepare a model for inference."""
        parameters = LandmarkParameters.model_validate(model.description.parameters)
        return LandmarksMachine(model.arrays, parameters)

    def summary(self, model: Model) -> str:
        """Return the number of landmarks in words."""
        return f"{len(all_landmarks(model.arrays))} landmarks"


RBF_LANDMARKS = LandmarksKind()


def all_landmarks(arrays: Mapping[str, Array]) -> Float32:
    """Return the landmarks of a model and of its home, in the order of the weights."""
    own: Float32 = arrays["landmarks"]
    home = arrays.get("home_landmarks")
    return own if home is None else np.concatenate([own, home])


class LandmarksMachine:
    """Inference of one model."""

    def __init__(self, arrays: Mapping[str, Array], parameters: LandmarkParameters) -> None:
        self._scaled = Scaler(arrays)
        self._distances = RoundedDistances(parameters.gamma, parameters.steps)
        landmarks, weights = self._scaled(all_landmarks(arrays)), arrays["weights"]
        self._bias = arrays["bias"]
        self._blocks = []
        for start in range(0, len(landmarks), _LANDMARKS_AT_ONCE):
            rows = slice(start, start + _LANDMARKS_AT_ONCE)
            block = self._distances.vectors(landmarks[rows])
            self._blocks.append((block, aligned(weights[rows])))

    def decide(self, inputs: Float32) -> tuple[Float64, Float64]:
        """Return decisions [shape=(n, C)] of finite inputs [shape=(n, width)], and novelty, NaN.

        The decisions are logarithms of probabilities up to a constant and a temperature.
        """
        rows = self._distances.rows(self._scaled(inputs))
        decisions = np.tile(self._bias, (len(inputs), 1))
        for landmarks, weights in self._blocks:
            exponents = self._distances.between(rows, landmarks)
            decisions += rowwise_matmul(np.exp(exponents, out=exponents), weights)
        return decisions, np.full(len(inputs), np.nan)
