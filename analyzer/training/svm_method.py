"""Methods that learn support vector machines, with scikit-learn."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.pipeline import Pipeline, make_pipeline
from sklearn.svm import SVC

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.training.learned_inputs import (
    class_costs,
    fitted_scaler,
    in_whole_steps,
    rounded,
    scaler_arrays,
    spread_over_classes,
)
from hearthlog.analyzer.training.method import Examples, Learned, Method
from hearthlog.models.classifiers.description import Description
from hearthlog.models.classifiers.model import Model
from hearthlog.models.classifiers.svm_rbf import SVM_RBF, weakest_pairs
from hearthlog.models.features.network import INPUTS
from hearthlog.schemas.arrays import Bool, Float32, Float64, Indices

_COST_TIMES = (0.25, 1.0, 4.0)
_GAMMA_TIMES = (0.5, 1.0, 2.0)


class Scaling(NamedTuple):
    """What a machine measures its inputs and errors with.

    Attributes
    ----------
    mean, scale : np.ndarray [shape=(width,)], float64
        Of the inputs.
    costs : dict of int to float
        By number of the class, relative to the cost of the method.
    """

    mean: Float64
    scale: Float64
    costs: dict[int, float]


@dataclass(frozen=True)
class SvmMethod(Method):
    """A support vector machine with RBF kernel, whose classes are weighted against their number.

    Support vector machines are the classifiers of "A ROS framework for audio-based activity
    recognition", section 4.

    Attributes
    ----------
    cost : float
        Cost of a window on the wrong side of the margin.
    gamma : float
        Gamma of the kernel, times the number of inputs.
    steps : int or None
        Of a standard deviation, to which inputs are rounded; None for a model that does not.
    most_windows : int
        That are learned from; the time that it takes grows with their square.
    scaling : Scaling, optional
        Of a machine that is learned again; by default that of the examples.
    """

    cost: float = 4.0
    gamma: float = 1.0
    steps: int | None = 50
    most_windows: int = 12_000
    scaling: Scaling | None = field(default=None, compare=False)

    @property
    def libraries(self) -> tuple[str, ...]:
        """Distributions whose versions influence the result."""
        return ("scikit-learn",)

    @property
    def parameters(self) -> dict[str, float]:
        """Cost and gamma."""
        return {"cost": self.cost, "gamma": self.gamma}

    def fit(self, examples: Examples, seen: Indices | slice = slice(None)) -> "LearnedSvm":
        """Learn from some segments.

        Parameters
        ----------
        examples : Examples
        seen : np.ndarray [shape=(m,)], intp, or slice
            Indices of the segments to learn from; all by default.
        """
        inputs, target, weight = examples.windows(seen)
        remembered = np.arange(-len(inputs), 0) + len(examples.more_target)
        if len(inputs) > self.most_windows:
            kept = spread_over_classes(target, weight, self.most_windows, self.seed)
            inputs, target, weight = inputs[kept], target[kept], weight[kept]
            remembered = remembered[kept]
        inputs = rounded(inputs)
        scaler = self._scaler(inputs)
        machine = SVC(
            C=self.cost, gamma=self.gamma / inputs.shape[1], decision_function_shape="ovo"
        ).fit(
            scaler.transform(inputs.astype(np.float64)),
            target,
            sample_weight=weight * self._costs(target, remembered >= 0),
        )
        support = machine.support_
        learned = make_pipeline(*scaler, machine)
        remembered = np.maximum(remembered[support], -1)
        return LearnedSvm(learned, inputs[support], remembered, self.steps)

    def _scaler(self, inputs: Float32) -> Pipeline:
        scaler = fitted_scaler(inputs)
        if self.scaling is not None:
            scaler.mean_, scaler.scale_ = self.scaling.mean, self.scaling.scale
        return in_whole_steps(scaler, self.steps)

    def _costs(self, target: Indices, remembered: Bool) -> Float64:
        """Weigh windows against the number of their class, an earlier machine's as it did."""
        balanced = class_costs(target)
        if self.scaling is None:
            return balanced[target]
        kept = balanced.copy()
        kept[list(self.scaling.costs)] = list(self.scaling.costs.values())
        return np.where(remembered, kept[target], balanced[target])

    def with_parameters(self, values: Mapping[str, float]) -> Self:
        """Return this method with another cost or gamma.

        Parameters
        ----------
        values : mapping of str to float
            `cost` and `gamma`, as in the attributes; one that is not named stays.

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

    def remembered(self, base: Model) -> tuple[Float32, Indices] | None:
        """Return the support vectors, from which the same machine would be learned again.

        Those of a model that was adapted are those of its own base. Copies in other rooms are among
        them, which the training windows of a model lack.

        Parameters
        ----------
        base : Model

        Returns
        -------
        (np.ndarray [shape=(n, width)], np.ndarray [shape=(n,)]) or None
            None for a method without copies in other rooms.
        """
        if not self.rooms:
            return None
        arrays, support = base.arrays, base.arrays["support_vectors"]
        if "base_target" not in arrays:
            counts = arrays["support_counts"]
            return support, np.repeat(np.arange(len(counts)), counts)
        rows, target = arrays["support_base"], arrays["base_target"]
        inputs = np.empty((len(target), support.shape[1]), np.float32)
        inputs[rows[rows >= 0]] = support[rows >= 0]
        inputs[np.setdiff1d(np.arange(len(target)), rows)] = arrays["base_vectors"]
        return inputs, target

    def memory(
        self, remembered: tuple[Float32, Indices], learned: Learned
    ) -> dict[str, NDArray[Any]]:
        """Return arrays by which a model that was learned from `remembered` gives it again.

        Parameters
        ----------
        remembered : (np.ndarray [shape=(n, width)], np.ndarray [shape=(n,)])
        learned : LearnedSvm

        Returns
        -------
        dict of str to np.ndarray
            By name of the array.
        """
        assert isinstance(learned, LearnedSvm)
        inputs, target = remembered
        costs = {} if self.scaling is None else self.scaling.costs
        numbers = range(len(learned.machine.classes_))
        return {
            "base_target": target.astype(np.int64),
            "base_costs": np.array([costs.get(number, 1.0) for number in numbers]),
            "support_base": learned.remembered.astype(np.int64),
            "base_vectors": inputs[np.setdiff1d(np.arange(len(inputs)), learned.remembered)],
        }

    def keeping(self, arrays: Mapping[str, NDArray[Any]], classes: Indices) -> Self:
        """Return this method with the scaling of a machine, which its vectors then give again.

        With a scaling of the few vectors and of what is new, all borders would move.

        Parameters
        ----------
        arrays : mapping of str to np.ndarray
            As of `hearthlog.models.classifiers.svm_rbf.SvmKind`.
        classes : np.ndarray [shape=(C,)], intp
            Numbers of its classes.

        Returns
        -------
        SvmMethod
            Itself, if it has no copies in other rooms: it learns from all windows again.
        """
        if not self.rooms:
            return self
        if "base_costs" in arrays:
            number = int(arrays["base_target"].max()) + 1
            costs = dict(enumerate(arrays["base_costs"][:number].tolist()))
        else:  # a coefficient is never above the cost of its class, and on the wrong side just that
            target = np.repeat(classes, arrays["support_counts"])
            largest = np.abs(arrays["dual_coefficients"]).max(axis=0) / self.cost
            own = arrays.get("support_base", np.zeros(len(target))) >= 0
            numbers = np.unique(target[own]).tolist()
            costs = {number: float(largest[own & (target == number)].max()) for number in numbers}
        return replace(self, scaling=Scaling(arrays["scaler_mean"], arrays["scaler_scale"], costs))

    def as_of(self, description: Description) -> Self:
        """Return this method with cost, gamma and number of copies of a model.

        Parameters
        ----------
        description : Description
            Of a support vector machine.

        Raises
        ------
        ModelError
            If the feature set of the method is not installed.
        """
        width = self.features.inputs[description.inputs].width
        values = description.parameters
        return replace(
            self,
            cost=values["cost"],
            gamma=values["gamma"] * width,
            steps=values.get("steps"),
            copies=description.copies,
        )


class LearnedSvm:
    """A fitted machine.

    Parameters
    ----------
    machine : sklearn.pipeline.Pipeline
        A scaler, what rounds to steps if they are rounded, and an `SVC`.
    support : np.ndarray [shape=(n, width)], float32
        Inputs that became support vectors, in the order of the `SVC`.
    remembered : np.ndarray [shape=(n,)], intp
        Their places in `Examples.more_inputs`; -1 for those of segments.
    steps : int or None
        Of a standard deviation, to which inputs are rounded.
    """

    def __init__(
        self, machine: Pipeline, support: Float32, remembered: Indices, steps: int | None
    ) -> None:
        self.machine = machine
        self._steps = steps
        self.remembered = remembered
        self._support = support

    def decide(self, inputs: Float32, classes: int) -> Float64:
        """Return decision values, as `SvmMachine` gives them.

        Parameters
        ----------
        inputs : np.ndarray [shape=(n, width)], float32
        classes : int
            C, the number of all classes.

        Returns
        -------
        np.ndarray [shape=(n, C)], float64
            That of the weakest pair of the class; -inf for a class that was not learned.
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
        """Return `cost`, as `gamma` that of the kernel itself, and `steps` if there are."""
        svc = self.machine[-1]
        steps = {} if self._steps is None else {"steps": self._steps}
        return {"cost": float(svc.C), "gamma": float(svc.gamma), **steps}


BANDS = SvmMethod("bands", "auros21", "bands", SVM_RBF.name, copies=1, cost=4.0, gamma=1.25)
PAPER = SvmMethod("paper", "auros21", "statistics", SVM_RBF.name, copies=0, cost=4.0, gamma=0.5)
ROOM = SvmMethod(
    "room",
    "home33",
    "above_floor",
    SVM_RBF.name,
    copies=0,
    rooms=3,
    gate=2.0,
    observation_weight=0.45,
    cost=1.0,  # with 4 sounds of few sources, a shower, are hardly ever recognised
    gamma=0.5,
)
ROOM21 = replace(ROOM, name="room21", feature_set="auros21")
EMBEDDING = replace(
    ROOM, name="embedding", network="yamnet", observation_weight=0.5, class_exponent=0.2
)


def network_method(name: str) -> SvmMethod:
    """Return the method that learns from the embeddings of a network.

    Parameters
    ----------
    name : str
        Of the network, and of the method.
    """
    return SvmMethod(name, name, INPUTS, SVM_RBF.name, copies=0, rooms=1, cost=4.0, gamma=0.5)
