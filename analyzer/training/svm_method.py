"""Methods that train support vector machines with scikit-learn."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.pipeline import Pipeline, make_pipeline
from sklearn.svm import SVC

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.training.learned_inputs import (
    balanced,
    fitted_scaler,
    rounded,
    rounded_to_steps,
    scaler_arrays,
    spread_over_classes,
)
from hearthlog.analyzer.training.method import Examples, Method
from hearthlog.analyzer.training.window_method import as_room
from hearthlog.models.classifiers.svm_rbf import SVM_RBF, weakest_pairs
from hearthlog.models.features.network import INPUTS
from hearthlog.schemas.arrays import Float32, Float64, Indices

_COST_TIMES = (0.25, 1.0, 4.0)
_GAMMA_TIMES = (0.5, 1.0, 2.0)


@dataclass(frozen=True)
class SvmMethod(Method):
    """Support vector machine with RBF kernel and balanced class weights.

    Support vector machines are the classifiers of "A ROS framework for audio-based activity
    recognition", section 4.

    Attributes
    ----------
    steps : int or None
        Rounding steps of inputs per standard deviation; None disables rounding.
    """

    cost: float = 4.0
    gamma: float = 1.0
    steps: int | None = 50
    most_windows: int = 12_000

    @property
    def libraries(self) -> tuple[str, ...]:
        """Distributions with an influence on the result."""
        return ("scikit-learn",)

    @property
    def parameters(self) -> dict[str, float]:
        """Cost and gamma."""
        return {"cost": self.cost, "gamma": self.gamma}

    def fit(self, examples: Examples, seen: Indices | slice = slice(None)) -> "LearnedSvm":
        """Train on some segments.

        Parameters
        ----------
        seen : np.ndarray [shape=(m,)], intp, or slice
            Indices of the training segments; all by default.
        """
        inputs, target, weight = examples.windows(seen)
        if len(inputs) > self.most_windows:
            kept = spread_over_classes(target, weight, self.most_windows, self.seed)
            inputs, target, weight = inputs[kept], target[kept], weight[kept]
        inputs = rounded(inputs)
        scaler = rounded_to_steps(fitted_scaler(inputs), self.steps)
        machine = SVC(
            C=self.cost, gamma=self.gamma / inputs.shape[1], decision_function_shape="ovo"
        ).fit(
            scaler.transform(inputs.astype(np.float64)),
            target,
            sample_weight=balanced(target, weight),
        )
        learned = make_pipeline(*scaler, machine)
        return LearnedSvm(learned, inputs[machine.support_], self.steps)

    def with_parameters(self, values: Mapping[str, float]) -> Self:
        """Return this method with another cost or gamma.

        Parameters
        ----------
        values : mapping of str to float
            `cost` and `gamma`; a missing one is unchanged.

        Raises
        ------
        DataError
            If another parameter is named.
        """
        if unknown := values.keys() - {"cost", "gamma"}:
            raise DataError(f"method {self.name} has no {min(unknown)} to choose")
        cost, gamma = values.get("cost", self.cost), values.get("gamma", self.gamma)
        return replace(self, cost=cost, gamma=gamma)

    def variations(self) -> list[Self]:
        """Return nine methods: cost times 0.25, 1 and 4, each with gamma times 0.5, 1 and 2."""
        return [
            replace(self, cost=self.cost * cost, gamma=self.gamma * gamma)
            for cost, gamma in product(_COST_TIMES, _GAMMA_TIMES)
        ]


class LearnedSvm:
    """A fitted support vector machine.

    Parameters
    ----------
    support : np.ndarray [shape=(n, width)], float32
        Support vectors, in the order of the `SVC`.
    """

    def __init__(self, machine: Pipeline, support: Float32, steps: int | None) -> None:
        self.machine = machine
        self._steps = steps
        self._support = support

    def decide(self, inputs: Float32, classes: int) -> Float64:
        """Return decision values as `SvmMachine` computes them.

        Parameters
        ----------
        inputs : np.ndarray [shape=(n, width)], float32

        Returns
        -------
        np.ndarray [shape=(n, C)], float64
            Minimum over the pairs of a class; -inf for a class without training data.
        """
        values = self.machine.decision_function(inputs.astype(np.float64))
        pairs = -values[:, np.newaxis] if values.ndim == 1 else values
        decision = np.full((len(inputs), classes), -np.inf)
        learned = self.machine.classes_
        decision[:, learned] = weakest_pairs(pairs, len(learned))
        return decision

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays of `hearthlog.models.classifiers.svm_rbf.SvmKind`."""
        scaler, svc = self.machine[0], self.machine[-1]
        # scikit-learn inverts the sign if there are two classes only; the file does not.
        sign = -1.0 if len(svc.classes_) == 2 else 1.0
        return {
            **scaler_arrays(scaler),
            "support_vectors": self._support,
            "support_counts": svc.n_support_.astype(np.int64),
            "dual_coefficients": sign * svc.dual_coef_,
            "intercepts": sign * svc.intercept_,
        }

    def parameters(self) -> dict[str, Any]:
        """Return `cost`, the kernel's own `gamma`, and `steps` if set."""
        svc = self.machine[-1]
        steps = {} if self._steps is None else {"steps": self._steps}
        return {"cost": float(svc.C), "gamma": float(svc.gamma), **steps}


BANDS = SvmMethod("bands", "auros21", "bands", SVM_RBF.name, copies=1, cost=4.0, gamma=1.25)
PAPER = SvmMethod("paper", "auros21", "statistics", SVM_RBF.name, copies=0, cost=4.0, gamma=0.5)
SVM = SvmMethod("svm", **as_room(SVM_RBF), cost=1.0, gamma=0.5)


def network_method(name: str) -> SvmMethod:
    """Return the method that trains on the embeddings of a network."""
    return SvmMethod(name, name, INPUTS, SVM_RBF.name, copies=0, rooms=1, cost=4.0, gamma=0.5)
