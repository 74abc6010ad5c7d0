"""Logistic regression, and networks with one hidden layer: layers of weights."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hearthlog.models.batch_invariant import aligned, rowwise_matmul
from hearthlog.models.classifiers import (
    LEARNED,
    ClassifierKind,
    NoParameters,
    learned_shapes,
    target_problem,
)
from hearthlog.models.classifiers.model import Array, Model
from hearthlog.models.classifiers.rbf_machines import SCALER, Scaler, scaler_problem, scaler_shapes
from hearthlog.schemas.arrays import Float32, Float64

MOST_UNITS = 1024
_WEIGHTS_AT_ONCE = 4096  # a product this small no BLAS divides among threads


class LayersKind(ClassifierKind):
    """Layers of weights; the arrays for C classes and h hidden units.

    scaler_mean, scaler_scale : [shape=(width,)], float64
        Mean and standard deviation of the inputs.
    hidden_weights : [shape=(width, h)], float64, optional
        Of scaled inputs; hidden units are rectified: what is negative is 0.
    hidden_bias : [shape=(h,)], float64, optional
    output_weights : [shape=(h, C)], float64
        Of hidden units; of scaled inputs, with shape (width, C), where there are none.
    output_bias : [shape=(C,)], float64
    learned_inputs, learned_target : optional
        As of `hearthlog.models.classifiers`.
    """

    name = "layers"
    parameters = NoParameters
    arrays: Mapping[str, np.dtype[Any]] = {
        **SCALER,
        "output_weights": np.dtype(np.float64),
        "output_bias": np.dtype(np.float64),
    }
    optional: Mapping[str, np.dtype[Any]] = {
        "hidden_weights": np.dtype(np.float64),
        "hidden_bias": np.dtype(np.float64),
        **LEARNED,
    }

    def shapes(
        self, classes: int, width: int, arrays: Mapping[str, Array]
    ) -> dict[str, tuple[int, ...]]:
        """Return shapes, as of `ClassifierKind.shapes`."""
        shapes: dict[str, tuple[int, ...]] = {
            **scaler_shapes(width),
            "output_weights": (width, classes),
            "output_bias": (classes,),
        }
        if "hidden_bias" in arrays or "hidden_weights" in arrays:
            units = arrays.get("hidden_bias", np.empty(0)).size
            shapes["hidden_weights"], shapes["hidden_bias"] = (width, units), (units,)
            shapes["output_weights"] = (units, classes)
        return shapes | learned_shapes(width, arrays)

    def problem(self, classes: int, arrays: Mapping[str, Array]) -> str | None:
        """Return what is wrong with the arrays, as of `ClassifierKind.problem`."""
        if not 1 <= len(arrays.get("hidden_bias", arrays["output_bias"])) <= MOST_UNITS:
            return f"hidden_bias has no unit, or more than {MOST_UNITS}"
        return scaler_problem(arrays) or target_problem(classes, arrays, "learned_target")

    def machine(self, model: Model) -> "LayersMachine":
        """Prepare a model for inference."""
        return LayersMachine(model.arrays)

    def summary(self, model: Model) -> str:
        """Return the number of weights, and of hidden units, in words."""
        weights = [array.size for name, array in model.arrays.items() if name.endswith("_weights")]
        hidden = len(model.arrays.get("hidden_bias", ()))
        return f"{sum(weights)} weights" + (f", {hidden} hidden units" if hidden else "")


LAYERS = LayersKind()


class LayersMachine:
    """Inference of one model, as scikit-learn's within 1e-5.

    Parameters
    ----------
    arrays : mapping of str to np.ndarray
        As of `LayersKind`.
    """

    def __init__(self, arrays: Mapping[str, Array]) -> None:
        self._scaled = Scaler(arrays)
        self._output = _Layer(arrays["output_weights"], arrays["output_bias"])
        self._hidden = None
        if "hidden_bias" in arrays:
            self._hidden = _Layer(arrays["hidden_weights"], arrays["hidden_bias"])

    def decide(self, inputs: Float32) -> tuple[Float64, Float64]:
        """Return the values of the last layer, and NaN as novelty."""
        values = self._scaled(inputs)
        if self._hidden is not None:
            values = np.maximum(self._hidden(values), 0.0)
        return self._output(values), np.full(len(inputs), np.nan)


class _Layer:
    """Rows times weights, plus a bias, so that a row does not depend on the others."""

    def __init__(self, weights: NDArray[Any], bias: NDArray[Any]) -> None:
        columns = max(_WEIGHTS_AT_ONCE // len(weights), 1)
        cuts = range(columns, weights.shape[1], columns)
        self._blocks = [aligned(block) for block in np.split(weights, cuts, axis=1)]
        self._bias = bias

    def __call__(self, rows: Float64) -> Float64:
        products = [rowwise_matmul(rows, block) for block in self._blocks]
        return np.concatenate(products, axis=1) + self._bias
