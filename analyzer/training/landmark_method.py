"""Methods that fit a linear head on landmark kernels, the default method among them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from sklearn.cluster import KMeans

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.training.heads import regressed
from hearthlog.analyzer.training.learned_inputs import (
    balanced,
    fitted_scaler,
    rounded,
    scaler_arrays,
)
from hearthlog.analyzer.training.method import Examples
from hearthlog.analyzer.training.window_method import KernelMethod, LearnedMachine, as_room
from hearthlog.analyzer.workers.workers import single_thread
from hearthlog.models.classifiers.classifier_kind import Machine
from hearthlog.models.classifiers.landmarks import (
    RBF_LANDMARKS,
    LandmarkParameters,
    LandmarksMachine,
    all_landmarks,
)
from hearthlog.models.classifiers.model import Array
from hearthlog.models.classifiers.rbf_distances import RoundedDistances, Scaler
from hearthlog.schemas.arrays import Float32, Float64, Indices

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
