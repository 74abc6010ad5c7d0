"""Methods that learn layers of weights: logistic regression, and a small neural network."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.linear_model import LogisticRegression
from sklearn.neural_network import MLPClassifier
from sklearn.preprocessing import StandardScaler

from hearthlog.analyzer.training.window_methods import (
    WindowMethod,
    as_room,
    balanced,
    fitted_scaler,
    scaler_arrays,
)
from hearthlog.models.classifiers import Machine
from hearthlog.schemas.arrays import Float32, Float64, Indices
from hearthlog_classifiers.layers import LAYERS, LayersMachine


@dataclass(frozen=True)
class LogisticMethod(WindowMethod):
    """Logistic regression.

    Attributes
    ----------
    cost : float
        Of errors in all windows together, relative to that of large weights.
    iterations : int
        At most.
    """

    cost: float = 12.0
    iterations: int = 1000

    def learn(
        self, inputs: Float32, target: Indices, weight: Float64
    ) -> tuple[Machine, dict[str, NDArray[Any]], dict[str, Any]]:
        """Learn from windows, as of `WindowMethod.learn`."""
        scaler = fitted_scaler(inputs)
        regression = LogisticRegression(C=self.cost / len(target), max_iter=self.iterations).fit(
            scaler.transform(inputs.astype(np.float64)), target, balanced(target, weight)
        )
        arrays = layer_arrays(scaler, [regression.coef_.T], [regression.intercept_])
        return LayersMachine(arrays), arrays, {}


@dataclass(frozen=True)
class PerceptronMethod(WindowMethod):
    """A network with one hidden layer of rectified units.

    Attributes
    ----------
    units : int
    decay : float
        Cost of large weights.
    improvement : float
        Of the loss in ten passes over the windows, below which it is done.
    passes : int
        At most.
    """

    units: int = 64
    decay: float = 3.0
    improvement: float = 1e-3
    passes: int = 300

    def learn(
        self, inputs: Float32, target: Indices, weight: Float64
    ) -> tuple[Machine, dict[str, NDArray[Any]], dict[str, Any]]:
        """Learn from windows, as of `WindowMethod.learn`."""
        scaler = fitted_scaler(inputs)
        network = MLPClassifier(
            (self.units,),
            alpha=self.decay,
            tol=self.improvement,
            max_iter=self.passes,
            random_state=self.random_state,
        ).fit(scaler.transform(inputs.astype(np.float64)), target, balanced(target, weight))
        arrays = layer_arrays(scaler, network.coefs_, network.intercepts_)
        return LayersMachine(arrays), arrays, {}


def layer_arrays(
    scaler: StandardScaler, weights: list[Float64], biases: list[Float64]
) -> dict[str, NDArray[Any]]:
    """Return the arrays of `hearthlog_classifiers.layers.LayersKind`.

    Parameters
    ----------
    scaler : StandardScaler
        Fitted.
    weights : list of np.ndarray [shape=(units before, units)], float64
        Of one layer, or of a hidden one and the last.
    biases : list of np.ndarray [shape=(units,)], float64
    """
    *hidden, output = zip(weights, biases, strict=True)
    if output[0].shape[1] == 1:  # one value tells two classes
        output = tuple(values * np.array([0.0, 1.0]) for values in output)
    arrays = scaler_arrays(scaler) | {"output_weights": output[0], "output_bias": output[1]}
    for one in hidden:
        arrays["hidden_weights"], arrays["hidden_bias"] = one
    return arrays


LOGISTIC = LogisticMethod("logistic", **as_room(LAYERS))
PERCEPTRON = PerceptronMethod("perceptron", **as_room(LAYERS))
