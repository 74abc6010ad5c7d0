"""Methods whose models compare with windows that were learned: neighbours, one-class machines."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.svm import OneClassSVM

from hearthlog.analyzer.training.window_methods import (
    WindowMethod,
    as_room,
    fitted_scaler,
    rounded_to_steps,
    scaler_arrays,
)
from hearthlog.models.classifiers import Machine
from hearthlog.schemas.arrays import Float32, Float64, Indices
from hearthlog_classifiers.neighbours import (
    NEIGHBOURS,
    NeighboursMachine,
    NeighboursParameters,
)
from hearthlog_classifiers.one_class import (
    ONE_CLASS,
    OneClassMachine,
    OneClassParameters,
)


@dataclass(frozen=True)
class NeighboursMethod(WindowMethod):
    """The nearest windows vote; one of weight 3 is there three times.

    Attributes
    ----------
    neighbours : int
    steps : int
        Of a standard deviation, to which inputs are rounded.
    """

    neighbours: int = 15
    steps: int = 50

    def learn(
        self, inputs: Float32, target: Indices, weight: Float64
    ) -> tuple[Machine, dict[str, NDArray[Any]], dict[str, Any]]:
        """Learn from windows, as of `WindowMethod.learn`."""
        times = np.maximum(np.rint(weight), 1).astype(np.intp)
        inputs, target = np.repeat(inputs, times, axis=0), np.repeat(target, times)
        scaler = fitted_scaler(inputs)
        parameters = NeighboursParameters(neighbours=self.neighbours, steps=self.steps)
        arrays = {
            **scaler_arrays(scaler),
            "vectors": inputs,
            "vectors_target": target.astype(np.int64),
        }
        machine = NeighboursMachine(arrays, parameters, int(target.max()) + 1)
        return machine, arrays, parameters.model_dump()


@dataclass(frozen=True)
class OneClassMethod(WindowMethod):
    """A one-class support vector machine with RBF kernel for each class, as in ROAR.

    Attributes
    ----------
    outside : float
        Share of the windows of a class that may be outside of it.
    gamma : float
        Of the kernel, times the number of inputs.
    steps : int
        Of a standard deviation, to which inputs are rounded.
    """

    outside: float = 0.1
    gamma: float = 1.0
    steps: int = 50

    def learn(
        self, inputs: Float32, target: Indices, weight: Float64
    ) -> tuple[Machine, dict[str, NDArray[Any]], dict[str, Any]]:
        """Learn from windows, as of `WindowMethod.learn`."""
        scaler = fitted_scaler(inputs)
        scaled = rounded_to_steps(scaler, self.steps).transform(inputs.astype(np.float64))
        gamma = self.gamma / inputs.shape[1]
        places, coefficients, offsets = [], [], []
        for number in range(target.max() + 1):
            own = np.flatnonzero(target == number)
            machine = OneClassSVM(gamma=gamma, nu=self.outside).fit(
                scaled[own], sample_weight=weight[own]
            )
            places.append(own[machine.support_])
            coefficients.append(machine.dual_coef_[0])
            offsets.append(machine.offset_)
        support = np.concatenate(places)
        parameters = OneClassParameters(gamma=gamma, steps=self.steps)
        arrays = {
            **scaler_arrays(scaler),
            "support_vectors": inputs[support],
            "support_target": target[support].astype(np.int64),
            "coefficients": np.concatenate(coefficients),
            "offsets": np.concatenate(offsets),
        }
        return OneClassMachine(arrays, parameters), arrays, parameters.model_dump()


NEIGHBOURS_VOTE = NeighboursMethod("neighbours", **as_room(NEIGHBOURS))
ONE_CLASS_MACHINES = OneClassMethod("one-class", **as_room(ONE_CLASS))
