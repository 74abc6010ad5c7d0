"""Methods that train a scikit-learn classifier on windows: support vector machines, landmarks."""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.cluster import KMeans
from sklearn.pipeline import Pipeline, make_pipeline
from sklearn.preprocessing import FunctionTransformer, StandardScaler
from sklearn.svm import SVC

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.training.heads import regressed
from hearthlog.analyzer.training.method import Examples, Method
from hearthlog.analyzer.workers import single_thread
from hearthlog.models.classifiers import ClassifierKind, Machine
from hearthlog.models.classifiers.model import Array, Model
from hearthlog.models.classifiers.rbf_machines import (
    RBF_LANDMARKS,
    SVM_RBF,
    LandmarkParameters,
    LandmarksMachine,
    RoundedDistances,
    Scaler,
    all_landmarks,
    in_steps,
    weakest_pairs,
)
from hearthlog.models.features.network import INPUTS
from hearthlog.schemas.arrays import Float32, Float64, Indices

_SEED = 20_261_122
_ROUNDING = 0.01  # of the standard deviation


def spread_over_classes(target: Indices, weight: Float64, most: int, seed: int) -> Indices:
    """Choose `most` windows at random, highest weights first, but fewer of the large classes."""
    shuffled = np.random.default_rng(_SEED + seed).permutation(len(target))
    shuffled = shuffled[np.argsort(-weight[shuffled], kind="stable")]
    order = np.argsort(target[shuffled], kind="stable")
    counts = np.bincount(target)
    rank = np.empty(len(target), np.intp)
    rank[order] = np.concatenate([np.arange(count) for count in counts])
    return shuffled[np.sort(np.argsort(rank, kind="stable")[:most])]


def balanced(target: Indices, weight: Float64) -> Float64:
    """Return weights scaled inversely to the size of the class, as scikit-learn does."""
    counts = np.bincount(target)
    costs = len(target) / (np.count_nonzero(counts) * np.maximum(counts, 1))
    return weight * costs[target]


def fitted_scaler(inputs: Float32) -> StandardScaler:
    """Return a scaler with the mean and standard deviation of inputs, shape (n, width)."""
    return StandardScaler().fit(inputs.astype(np.float64))


def scaler_arrays(scaler: StandardScaler) -> dict[str, NDArray[Any]]:
    """Return the arrays of `hearthlog.models.classifiers.rbf_machines`."""
    return {"scaler_mean": scaler.mean_, "scaler_scale": scaler.scale_}


def rounded_to_steps(scaler: StandardScaler, steps: int | None) -> Pipeline:
    """Return a scaler with the rounding of the trained SVM, in steps per standard deviation."""
    if steps is None:
        return make_pipeline(scaler)
    rounding = FunctionTransformer(_rounded_to_steps, kw_args={"steps": steps})
    return make_pipeline(scaler, rounding)


def _rounded_to_steps(scaled: Float64, steps: int) -> Float64:
    return in_steps(scaled, steps) / steps


def rounded(inputs: Float32) -> Float32:
    """Round inputs [shape=(n, width)] to half precision, which halves the size of a model file.

    They stay unchanged if the error would exceed a hundredth of the standard deviation of an input.
    """
    with np.errstate(over="ignore"):
        half = inputs.astype(np.float16).astype(np.float32)
    spread, error = inputs.std(axis=0), np.abs(half - inputs).max(axis=0)
    return half if ((error <= _ROUNDING * spread) | (spread == 0.0)).all() else inputs


def kept_inputs(model: Model) -> tuple[Float32, Indices] | None:
    """Return the inputs [shape=(n, width)] and class indices that a model has stored, if any.

    An adapted model has those of its base.
    """
    arrays = model.arrays
    if "landmarks" in arrays:
        counts = arrays["landmark_counts"]
        return arrays["landmarks"], np.repeat(np.arange(len(counts)), counts)
    if "base_target" in arrays:
        support, rows = arrays["support_vectors"], arrays["support_base"]
        target = arrays["base_target"].astype(np.intp)
        inputs = np.empty((len(target), support.shape[1]), np.float32)
        inputs[rows[rows >= 0]] = support[rows >= 0]
        inputs[np.setdiff1d(np.arange(len(target)), rows)] = arrays["base_vectors"]
        return inputs, target
    if "support_counts" in arrays:
        counts = arrays["support_counts"]
        return arrays["support_vectors"], np.repeat(np.arange(len(counts)), counts)
    if "learned_inputs" in arrays:
        return arrays["learned_inputs"], arrays["learned_target"].astype(np.intp)
    if "vectors" in arrays:
        return arrays["vectors"], arrays["vectors_target"].astype(np.intp)
    return None


_ROWS_AT_ONCE = 256


@dataclass(frozen=True)
class WindowMethod(Method):
    """A scikit-learn classifier with balanced class weights."""

    most_windows: int = 12_000

    @property
    def random_state(self) -> int:
        """Random state of the scikit-learn classifier."""
        return _SEED + self.seed

    @property
    def libraries(self) -> tuple[str, ...]:
        """Distributions with an influence on the result."""
        return ("scikit-learn",)

    def fit(self, examples: Examples, seen: Indices | slice = slice(None)) -> "LearnedMachine":
        """Train on the windows of `seen` segments, by index; all by default."""
        inputs, target, weight = examples.windows(seen)
        if len(inputs) > self.most_windows:
            kept = spread_over_classes(target, weight, self.most_windows, self.seed)
            inputs, target, weight = inputs[kept], target[kept], weight[kept]
        classes, number = np.unique(target, return_inverse=True)
        machine, arrays, parameters = self.learn(rounded(inputs), number, weight)
        return LearnedMachine(machine, classes, arrays, parameters)

    @abstractmethod
    def learn(
        self, inputs: Float32, target: Indices, weight: Float64
    ) -> tuple[Machine, dict[str, NDArray[Any]], dict[str, Any]]:
        """Train on windows.

        Parameters
        ----------
        inputs : np.ndarray [shape=(n, width)], float32
        target : np.ndarray [shape=(n,)], intp
            Indices of the classes, each with at least one window.
        weight : np.ndarray [shape=(n,)], float64
        """


@dataclass(frozen=True)
class KernelMethod(WindowMethod):
    """A classifier with an RBF kernel: its cost and gamma can be set and searched."""

    cost: float = 4.0
    gamma: float = 1.0
    cost_times: ClassVar[Sequence[float]] = (0.25, 1.0, 4.0)

    @property
    def parameters(self) -> dict[str, float]:
        """Cost and gamma."""
        return {"cost": self.cost, "gamma": self.gamma}

    def with_parameters(self, values: Mapping[str, float]) -> Self:
        """Return this method with another cost or gamma; see `Method.with_parameters`."""
        if unknown := values.keys() - {"cost", "gamma"}:
            raise DataError(f"method {self.name} has no {min(unknown)} to choose")
        return replace(self, **values)  # type: ignore[arg-type]

    def variations(self) -> list[Self]:
        """Return nine methods: three costs, each with gamma times 0.5, 1 and 2."""
        return [
            replace(self, cost=self.cost * cost, gamma=self.gamma * gamma)
            for cost, gamma in product(self.cost_times, (0.5, 1.0, 2.0))
        ]


def as_room(kind: ClassifierKind) -> dict[str, Any]:
    """Return the fields of a method with the inputs of method `room`."""
    return {
        "feature_set": "home33",
        "inputs": "above_floor",
        "kind": kind.name,
        "copies": 0,
        "rooms": 3,
        "gate": 2.0,
        "observation_weight": 0.45,
    }


@dataclass(frozen=True, eq=False)
class LearnedMachine:
    """A classifier that decides with the recorder's own code, of trained classes [shape=(c,)]."""

    machine: Machine
    classes: Indices
    _arrays: Mapping[str, NDArray[Any]]
    _parameters: Mapping[str, Any]

    def decide(self, inputs: Float32, classes: int) -> Float64:
        """Return decision values; see `Learned.decide`."""
        decision = np.full((len(inputs), classes), -np.inf)
        for start in range(0, len(inputs), _ROWS_AT_ONCE):
            rows = slice(start, start + _ROWS_AT_ONCE)
            decision[rows, self.classes] = self.machine.decide(inputs[rows])[0]
        return decision

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays of a model file; requires that all classes were in the training set."""
        return dict(self._arrays)

    def parameters(self) -> dict[str, Any]:
        """Return the field `parameters` of a model description."""
        return dict(self._parameters)


@dataclass(frozen=True)
class SvmMethod(KernelMethod):
    """Support vector machine with RBF kernel and balanced class weights.

    Source: "A ROS framework for audio-based activity recognition", section 4.
    """

    steps: int | None = 50  # rounding steps of inputs per standard deviation; None disables it

    def learn(
        self, inputs: Float32, target: Indices, weight: Float64
    ) -> tuple["LearnedSvm", dict[str, NDArray[Any]], dict[str, Any]]:
        """Train on windows; see `WindowMethod.learn`."""
        scaler = rounded_to_steps(fitted_scaler(inputs), self.steps)
        svc = SVC(C=self.cost, gamma=self.gamma / inputs.shape[1], decision_function_shape="ovo")
        svc.fit(
            scaler.transform(inputs.astype(np.float64)),
            target,
            sample_weight=balanced(target, weight),
        )
        # scikit-learn inverts the sign if there are two classes only; the file does not.
        sign = -1.0 if len(svc.classes_) == 2 else 1.0
        arrays = {
            **scaler_arrays(scaler[0]),
            "support_vectors": inputs[svc.support_],
            "support_counts": svc.n_support_.astype(np.int64),
            "dual_coefficients": sign * svc.dual_coef_,
            "intercepts": sign * svc.intercept_,
        }
        steps = {} if self.steps is None else {"steps": self.steps}
        parameters = {"cost": float(svc.C), "gamma": float(svc.gamma), **steps}
        return LearnedSvm(make_pipeline(*scaler, svc)), arrays, parameters


class LearnedSvm:
    """A fitted support vector machine, which decides as `SvmMachine` does."""

    def __init__(self, pipeline: Pipeline) -> None:
        self.pipeline = pipeline

    def decide(self, inputs: Float32) -> tuple[Float64, Float64]:
        """Return the minimum over the pairs of each class, and no novelty; see `Machine.decide`."""
        values = self.pipeline.decision_function(inputs.astype(np.float64))
        pairs = -values[:, np.newaxis] if values.ndim == 1 else values
        decisions = weakest_pairs(pairs, len(self.pipeline.classes_))
        return decisions, np.full(len(inputs), np.nan)


BANDS = SvmMethod("bands", "auros21", "bands", SVM_RBF.name, copies=1, cost=4.0, gamma=1.25)
PAPER = SvmMethod("paper", "auros21", "statistics", SVM_RBF.name, copies=0, cost=4.0, gamma=0.5)
SVM = SvmMethod("svm", **as_room(SVM_RBF), cost=1.0, gamma=0.5)


def network_method(name: str) -> SvmMethod:
    """Return the method that trains on the embeddings of a network."""
    return SvmMethod(name, name, INPUTS, SVM_RBF.name, copies=0, rooms=1, cost=4.0, gamma=0.5)


_ROOT = 0.5  # exponent of a class's window count in its number of landmarks
_ROUNDS = 30  # of k-means
_LEAST = 1e-6  # of the largest eigenvalue: smaller ones are rounding errors


@dataclass(frozen=True)
class LandmarkMethod(KernelMethod):
    """Multinomial logistic regression on a Nyström map of the inputs."""

    cost: float = 10 / 3
    gamma: float = 0.5
    landmarks: int = 400
    steps: int = 50
    cost_times: ClassVar[Sequence[float]] = (0.3, 1.0, 3.0)

    @property
    def libraries(self) -> tuple[str, ...]:
        """Distributions with an influence on the result."""
        return (*super().libraries, "scipy")

    def fit(self, examples: Examples, seen: Indices | slice = slice(None)) -> LearnedMachine:
        """Fit on some segments; see `Method.fit`.

        Raise `DataError` if there are fewer landmarks than classes.
        """
        with single_thread():
            return super().fit(examples, seen)

    def learn(
        self, inputs: Float32, target: Indices, weight: Float64
    ) -> tuple[Machine, dict[str, NDArray[Any]], dict[str, Any]]:
        """Fit on windows; see `WindowMethod.learn`."""
        truth = np.eye(int(target.max()) + 1)[target]
        weight = balanced(target, weight)
        return self.imitate(inputs, target, weight, truth)

    def imitate(
        self, inputs: Float32, target: Indices, weight: Float64, truth: Float64
    ) -> tuple[Machine, dict[str, NDArray[Any]], dict[str, Any]]:
        """Fit to target probabilities `truth` [shape=(n, C)] of windows [shape=(n, width)].

        `target` [shape=(n,)] is the class for which a window may become a landmark; each class has
        a window.
        """
        classes = truth.shape[1]
        if self.landmarks < classes:
            raise DataError(
                f"method {self.name}: {self.landmarks} landmarks for {classes} classes; each "
                "needs one"
            )
        arrays: dict[str, Array] = scaler_arrays(fitted_scaler(inputs))
        arrays["landmarks"], counts = centres(
            arrays, inputs, target, weight, self.landmarks, self.random_state
        )
        arrays["landmark_counts"] = counts.astype(np.int64)
        parameters = LandmarkParameters(gamma=self.gamma / inputs.shape[1], steps=self.steps)
        map_ = LandmarkMap(arrays, parameters)
        pull = np.full(classes, 1.0 / self.cost)
        before = np.zeros((len(inputs), classes))
        slopes, constants = regressed(
            map_.kernels(inputs) @ map_.root, truth, weight, before, pull, free=True
        )
        arrays["weights"], arrays["bias"] = map_.root @ slopes, constants
        return LandmarksMachine(arrays, parameters), arrays, parameters.model_dump()


class LandmarkMap:
    """Landmark kernels, and the root of the inverse kernel matrix of landmarks [shape=(m, m)].

    Products times the root give the kernel.
    """

    def __init__(self, arrays: Mapping[str, Array], parameters: LandmarkParameters) -> None:
        self._scaled = Scaler(arrays)
        self._distances = RoundedDistances(parameters.gamma, parameters.steps)
        landmarks = all_landmarks(arrays)
        self._landmarks = self._distances.vectors(self._scaled(landmarks))
        values, vectors = np.linalg.eigh(self.kernels(landmarks))
        values = np.maximum(values, _LEAST * values[-1])
        self.root: Float64 = vectors / np.sqrt(values) @ vectors.T

    def kernels(self, inputs: Float32) -> Float64:
        """Return the kernels of windows, shape (n, m)."""
        rows = self._distances.rows(self._scaled(inputs))
        return np.exp(self._distances.between(rows, self._landmarks))


def centres(  # noqa: PLR0913, PLR0917
    scaler: Mapping[str, Array],
    inputs: Float32,
    target: Indices,
    weight: Float64,
    most: int,
    seed: int = 0,
) -> tuple[Float32, Indices]:
    """Return k-means centres of the windows [shape=(n, width)] of each class, and their number.

    There are at most `most` centres; each class with a window has at least one.
    """
    scaled = Scaler(scaler)(inputs)
    windows = np.bincount(target)
    share = windows**_ROOT
    wanted = np.maximum(np.rint(most * share / share.sum()), windows > 0).astype(np.intp)
    found = [np.empty((0, inputs.shape[1]))]
    counts = np.zeros(len(windows), np.intp)
    for number in np.flatnonzero(windows).tolist():
        own = target == number
        # Duplicate sounds give one centre.
        counts[number] = min(wanted[number], len(np.unique(scaled[own], axis=0)))
        means = KMeans(counts[number], n_init=1, max_iter=_ROUNDS, random_state=seed)
        found.append(means.fit(scaled[own], sample_weight=weight[own]).cluster_centers_)
    landmarks = np.concatenate(found) * scaler["scaler_scale"] + scaler["scaler_mean"]
    return rounded(landmarks.astype(np.float32)), counts


ROOM = LandmarkMethod("room", **as_room(RBF_LANDMARKS) | {"observation_weight": 0.15})
ROOM21 = replace(ROOM, name="room21", feature_set="auros21")
EMBEDDING = replace(
    ROOM, name="embedding", network="yamnet", observation_weight=0.5, class_exponent=0.2
)
