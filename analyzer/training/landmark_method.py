"""Methods that learn a linear head on kernels of landmarks, and move it in a home."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.cluster import KMeans
from threadpoolctl import threadpool_limits

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.training.cross_validation import softmax
from hearthlog.analyzer.training.heads import regressed
from hearthlog.analyzer.training.learned_inputs import (
    balanced,
    fitted_scaler,
    rounded,
    scaler_arrays,
)
from hearthlog.analyzer.training.method import Examples, Learned
from hearthlog.analyzer.training.svm_method import EMBEDDING, ROOM
from hearthlog.analyzer.training.window_method import LearnedMachine, WindowMethod
from hearthlog.models.classifiers.classifier_kind import Machine
from hearthlog.models.classifiers.description import Description
from hearthlog.models.classifiers.landmarks import (
    RBF_LANDMARKS,
    LandmarkParameters,
    LandmarksMachine,
)
from hearthlog.models.classifiers.model import Array, Model
from hearthlog.models.classifiers.rbf_distances import RoundedDistances
from hearthlog.models.classifiers.scaler import Scaler
from hearthlog.schemas.arrays import Float32, Float64, Indices

_ROOT = 0.5  # a class has landmarks as its number of windows to this power
_ROUNDS = 30  # of k-means
_LEAST = 1e-6  # of the largest eigenvalue: what is below is rounding
_LANDMARK_WEIGHT = 3.0  # of what the base says of a landmark; a window of a mark has 1
_SHARE = 0.5  # that counts of what is learned: marks are of few sources, and others lie between
_BELOW = 2.0  # the others on average, is a new class before anything is learned, a logarithm


class Prior(NamedTuple):
    """A model whose weights a home moves.

    Attributes
    ----------
    arrays : mapping of str to np.ndarray
        Of a model, as of `LandmarksKind`.
    inverse : float
        Inverse temperature before it was ever adapted.
    """

    arrays: Mapping[str, Array]
    inverse: float


@dataclass(frozen=True)
class LandmarkMethod(WindowMethod):
    """Multinomial logistic regression on a Nyström map of the inputs.

    Attributes
    ----------
    gamma : float
        Of the kernel, times the number of inputs.
    pull : float
        To zero, of the weights on the map; a window has 1.
    home_pull : float
        The same of what a home adds to the weights.
    landmarks : int
        Centres of the windows of each class, of all classes together.
    steps : int
        Of a standard deviation, to which inputs are rounded.
    prior : Prior, optional
        That is moved, instead of learning from nothing.
    inverse : float
        Inverse temperature of the prior before it was ever adapted.
    """

    gamma: float = 0.5
    pull: float = 0.3
    home_pull: float = 1.0
    landmarks: int = 800
    steps: int = 50
    prior: Prior | None = field(default=None, compare=False)
    inverse: float = field(default=1.0, compare=False)

    @property
    def libraries(self) -> tuple[str, ...]:
        """Distributions whose versions influence the result."""
        return (*super().libraries, "scipy")

    @property
    def parameters(self) -> dict[str, float]:
        """Gamma and pull."""
        return {"gamma": self.gamma, "pull": self.pull}

    def with_parameters(self, values: Mapping[str, float]) -> Self:
        """Return this method with another gamma or pull, as of `Method.with_parameters`."""
        if unknown := values.keys() - {"gamma", "pull"}:
            raise DataError(f"method {self.name} has no {min(unknown)} to choose")
        return replace(self, **values)  # type: ignore[arg-type]

    def variations(self) -> list[Self]:
        """Return nine methods: gamma times 0.5, 1 and 2, each with pull times 0.3, 1 and 3."""
        return [
            replace(self, gamma=self.gamma * gamma, pull=self.pull * pull)
            for gamma in (0.5, 1.0, 2.0)
            for pull in (0.3, 1.0, 3.0)
        ]

    def fit(self, examples: Examples, seen: Indices | slice = slice(None)) -> LearnedMachine:
        """Learn from some segments, or move the prior by them, as of `Method.fit`.

        Raises
        ------
        DataError
            If there are fewer landmarks than classes.
        """
        with threadpool_limits(1):  # sums depend on how many threads share them
            if self.prior is None:
                return super().fit(examples, seen)
            inputs, target, weight = examples.windows(seen)
            own = slice(len(target) - len(examples.more_target))  # the others stand for the prior
            return self._move(self.prior, inputs[own], target[own], weight[own])

    def learn(
        self, inputs: Float32, target: Indices, weight: Float64
    ) -> tuple[Machine, dict[str, NDArray[Any]], dict[str, Any]]:
        """Learn from windows, as of `WindowMethod.learn`."""
        classes = int(target.max()) + 1
        if self.landmarks < classes:
            raise DataError(
                f"method {self.name}: {self.landmarks} landmarks for {classes} classes; each "
                "needs one"
            )
        arrays: dict[str, Array] = scaler_arrays(fitted_scaler(inputs))
        landmarks, counts = self._landmarks(Scaler(arrays)(inputs), target, weight)
        landmarks = landmarks * arrays["scaler_scale"] + arrays["scaler_mean"]
        arrays["landmarks"] = rounded(landmarks.astype(np.float32))
        arrays["landmark_counts"] = counts.astype(np.int64)
        gamma = self.gamma / inputs.shape[1]
        map_ = _Map(arrays, gamma, self.steps)
        before = np.zeros((len(inputs), classes))
        slopes, constants = regressed(
            map_(inputs),
            np.eye(classes)[target],
            balanced(target, weight),
            before,
            np.full(classes, self.pull),
            free=True,
        )
        arrays["weights"], arrays["bias"] = map_.root @ slopes, constants
        parameters = LandmarkParameters(gamma=gamma, steps=self.steps)
        return LandmarksMachine(arrays, parameters), arrays, parameters.model_dump()

    def _landmarks(
        self, scaled: Float64, target: Indices, weight: Float64
    ) -> tuple[Float64, Indices]:
        """Return the centres of the windows of each class, and their number."""
        windows = np.bincount(target)
        share = windows**_ROOT
        wanted = np.maximum(np.rint(self.landmarks * share / share.sum()), 1).astype(np.intp)
        centres = []
        for number, count in enumerate(wanted.tolist()):
            own = target == number
            # The same sound twice makes no two centres.
            most = len(np.unique(scaled[own], axis=0))
            means = KMeans(
                min(count, most), n_init=1, max_iter=_ROUNDS, random_state=self.random_state
            )
            centres.append(means.fit(scaled[own], sample_weight=weight[own]).cluster_centers_)
        counts = np.array([len(each) for each in centres])
        return np.concatenate(centres), counts

    def _move(
        self, prior: Prior, inputs: Float32, target: Indices, weight: Float64
    ) -> LearnedMachine:
        """Add to the weights of a base what windows of a home teach.

        The landmarks, each by what the base says of it, keep the base as it is where the home has
        no windows: a home has few sources, of few classes.
        """
        arrays = dict(prior.arrays)
        base_weights = arrays.setdefault("base_weights", arrays["weights"])
        base_bias = arrays.setdefault("base_bias", arrays["bias"])
        old = len(base_bias)
        new = max(int(target.max(initial=-1)) + 1 - old, 0)
        gamma = self.gamma / inputs.shape[1]
        map_ = _Map(arrays, gamma, self.steps)
        kernels = np.concatenate([map_.kernels(arrays["landmarks"]), map_.kernels(inputs)])
        before = prior.inverse * (kernels @ base_weights + base_bias)
        constant = before.mean() - _BELOW
        before = np.pad(before, ((0, 0), (0, new)), constant_values=constant)
        count = len(arrays["landmarks"])
        mapped = kernels @ map_.root
        mean = mapped[:count].mean(axis=0)
        scale = np.sqrt(np.square(mapped[:count] - mean).sum(axis=1).mean())
        slopes, constants = regressed(
            (mapped - mean) / scale,
            np.concatenate([softmax(before[:count]), np.eye(old + new)[target]]),
            np.concatenate([np.full(count, _LANDMARK_WEIGHT), balanced(target, weight)]),
            before,
            np.full(old + new, self.home_pull),
            free=False,
        )
        taken = np.where(np.arange(old + new) < old, _SHARE, 1.0) / prior.inverse
        slopes, constants = taken * slopes / scale, taken * constants
        weights, bias = map_.root @ slopes, constants - mean @ slopes
        weights[:, :old] += base_weights
        bias[:old] += base_bias
        bias[old:] += constant / prior.inverse
        arrays["weights"], arrays["bias"] = weights, bias
        arrays["landmark_counts"] = np.pad(arrays["landmark_counts"][:old], (0, new))
        parameters = LandmarkParameters(gamma=gamma, steps=self.steps)
        machine = LandmarksMachine(arrays, parameters)
        return LearnedMachine(machine, np.arange(old + new), arrays, parameters.model_dump())

    def remembered(self, base: Model) -> tuple[Float32, Indices] | None:
        """Return a landmark of each class of the base, which all together stand for it.

        Parameters
        ----------
        base : Model
        """
        counts = base.arrays["landmark_counts"]
        classes = np.flatnonzero(counts)
        first = np.cumsum(counts)[classes] - counts[classes]
        return base.arrays["landmarks"][first], classes

    def memory(
        self, remembered: tuple[Float32, Indices], learned: Learned
    ) -> dict[str, NDArray[Any]]:
        """Return nothing more: the arrays have the weights of the base."""
        del remembered, learned
        return {}

    def keeping(self, arrays: Mapping[str, NDArray[Any]], classes: Indices) -> Self:
        """Return this method with the weights of a machine as prior, as of `Method.keeping`."""
        del classes
        return replace(self, prior=Prior(arrays, self.inverse))

    def as_of(self, description: Description) -> Self:
        """Return this method with the kernel of a model, and how sure it was."""
        width = self.features.inputs[description.inputs].width
        values = LandmarkParameters.model_validate(description.parameters)
        inverse = description.base_inverse_temperature or description.inverse_temperature
        return replace(self, gamma=values.gamma * width, steps=values.steps, inverse=inverse)


class _Map:
    """Kernels of landmarks, and the root that makes their products those of the kernel."""

    def __init__(self, arrays: Mapping[str, Array], gamma: float, steps: int) -> None:
        self._scaled = Scaler(arrays)
        self._distances = RoundedDistances(gamma, steps)
        self._landmarks = self._distances.vectors(self._scaled(arrays["landmarks"]))
        values, vectors = np.linalg.eigh(self.kernels(arrays["landmarks"]))
        values = np.maximum(values, _LEAST * values[-1])
        self.root: Float64 = vectors / np.sqrt(values) @ vectors.T

    def kernels(self, inputs: Float32) -> Float64:
        """Return the kernels of windows, shape (n, m)."""
        rows = self._distances.rows(self._scaled(inputs))
        return np.exp(self._distances.between(rows, self._landmarks))

    def __call__(self, inputs: Float32) -> Float64:
        """Return the map of windows, shape (n, m)."""
        return self.kernels(inputs) @ self.root


ROOM_LANDMARKS = LandmarkMethod(
    "landmarks",
    ROOM.feature_set,
    ROOM.inputs,
    RBF_LANDMARKS.name,
    copies=0,
    rooms=ROOM.rooms,
    gate=ROOM.gate,
    observation_weight=0.15,  # of decisions of what was learned, which are too sure
)
EMBEDDING_LANDMARKS = replace(
    ROOM_LANDMARKS,
    name="embedding-landmarks",
    network=EMBEDDING.network,
    observation_weight=EMBEDDING.observation_weight,
    class_exponent=EMBEDDING.class_exponent,
)
