"""What a home's marks add to a classifier: to its weights on the kernels of its landmarks.

The classifier stays as it is; what a home teaches is added to its weights, as to those of the
heads beside it. A classifier of another kind is first learned over, by what it says itself.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.training.cross_validation import softmax
from hearthlog.analyzer.training.heads import regressed
from hearthlog.analyzer.training.landmark_method import (
    ROOM,
    LandmarkMap,
    LandmarkMethod,
    centres,
)
from hearthlog.analyzer.training.learned_inputs import balanced, kept_inputs
from hearthlog.analyzer.training.method import Examples, Method
from hearthlog.analyzer.training.window_method import LearnedMachine
from hearthlog.analyzer.workers.parallel import single_thread
from hearthlog.models.classifiers.classifier import classifier_kind
from hearthlog.models.classifiers.landmarks import (
    RBF_LANDMARKS,
    LandmarkParameters,
    LandmarksMachine,
)
from hearthlog.models.classifiers.model import MOST_WEIGHT, Array, Model
from hearthlog.models.classifiers.svm_rbf import SVM_RBF
from hearthlog.schemas.arrays import Float32, Float64, Indices

_PULL = 1.0  # to zero, of what is added to the weights
_PULL_OF_NEW = 0.1  # of those of a class that the base has not: all of it is to be learned
_LANDMARK_WEIGHT = 3.0  # of what the base says of a landmark; a window of a mark has 1
_HOME_LANDMARKS = 200  # at most, of its windows
_SHARE = 0.5  # that counts of what is learned: marks are of few sources, and others lie between
_BELOW = 2.0  # the others on average, is a new class before anything is learned, a logarithm
_IMITATION_COST = 30.0  # probabilities are learned closer than labels, which are wrong at times
_SMOOTHED = 1 / 3  # of the weight of a frame of a machine, which is less sure between its vectors
_ROWS_AT_ONCE = 256
_MOST_BIAS = 100.0


@dataclass(frozen=True)
class HomeLandmarks(Method):
    """Adds to the weights of a classifier on landmarks.

    The landmarks, each by what the base says of it, keep the base as it is where the home has no
    windows: a home has few sources, of few classes.
    """

    base: Mapping[str, Array] = field(default_factory=dict, compare=False)
    values: Mapping[str, float] = field(default_factory=dict)
    inverse: float = 1.0

    @classmethod
    def of_learned(cls, method: LandmarkMethod, learned: LearnedMachine) -> Self:
        """Return the method that moves what another has learned, as it is."""
        return cls(
            method.name,
            method.feature_set,
            method.inputs,
            method.kind,
            copies=0,
            base=learned.arrays(),
            values=learned.parameters(),
        )

    @classmethod
    def of(cls, model: Model) -> Self:
        """Return the method that moves a model of kind `rbf-landmarks`."""
        description = model.description
        return cls(
            description.method,
            description.feature_set,
            description.inputs,
            description.kind,
            copies=0,
            base=model.arrays,
            values=description.parameters,
            inverse=description.base_inverse_temperature or description.inverse_temperature,
        )

    def fit(self, examples: Examples, seen: Indices | slice = slice(None)) -> LearnedMachine:
        """Move the base by some segments of a home, as of `Method.fit`."""
        with single_thread():
            return self._moved(*examples.windows(seen))

    def _moved(self, inputs: Float32, target: Indices, weight: Float64) -> LearnedMachine:
        arrays = dict(self.base)
        arrays.pop("home_landmarks", None)
        base_weights = arrays.setdefault("base_weights", arrays["weights"])
        base_bias = arrays.setdefault("base_bias", arrays["bias"])
        count, old = base_weights.shape
        new = max(int(target.max(initial=-1)) + 1 - old, 0)
        if len(inputs):
            arrays["home_landmarks"], _ = centres(arrays, inputs, target, weight, _HOME_LANDMARKS)
        parameters = LandmarkParameters.model_validate(self.values)
        map_ = LandmarkMap(arrays, parameters)
        kernels = np.concatenate([map_.kernels(arrays["landmarks"]), map_.kernels(inputs)])
        before = self.inverse * (kernels[:, :count] @ base_weights + base_bias)
        constant = before.mean() - _BELOW
        before = np.pad(before, ((0, 0), (0, new)), constant_values=constant)
        mapped = kernels @ map_.root
        mean = mapped[:count].mean(axis=0)
        scale = np.sqrt(np.square(mapped[:count] - mean).sum(axis=1).mean())
        slopes, constants = regressed(
            (mapped - mean) / scale,
            np.concatenate([softmax(before[:count]), np.eye(old + new)[target]]),
            np.concatenate([np.full(count, _LANDMARK_WEIGHT), balanced(target, weight)]),
            before,
            np.where(np.arange(old + new) < old, _PULL, _PULL_OF_NEW),
            free=False,
        )
        taken = np.where(np.arange(old + new) < old, _SHARE, 1.0) / self.inverse
        slopes, constants = taken * slopes / scale, taken * constants
        weights, bias = map_.root @ slopes, constants - mean @ slopes
        weights[:count, :old] += base_weights
        bias[:old] += base_bias
        bias[old:] += constant / self.inverse
        arrays["weights"], arrays["bias"] = weights, bias
        arrays["landmark_counts"] = np.pad(arrays["landmark_counts"][:old], (0, new))
        machine = LandmarksMachine(arrays, parameters)
        return LearnedMachine(machine, np.arange(old + new), arrays, parameters.model_dump())


def is_moved(model: Model) -> bool:
    """Return whether a home moves the classifier of a model as it is."""
    return model.description.kind == RBF_LANDMARKS.name


def learned_over(base: Model) -> Model:
    """Return a model whose landmarks say what the classifier of another kind says.

    Raise `DataError` if the classifier has kept no inputs of its kind, or none of one of its
    classes.
    """
    kept = kept_inputs(base)
    if kept is None or not len(kept[0]):
        raise DataError(f"{base.name}: has not kept what it learned from; train it anew to adapt")
    inputs, target = kept
    classes = int(target.max()) + 1
    lacking = np.setdiff1d(np.arange(classes), target)
    if len(lacking):
        name = base.classes[lacking[0]]
        raise DataError(f"{base.name}: has kept nothing of {name}; train it anew to adapt")
    description = base.description
    width, inverse = inputs.shape[1], description.inverse_temperature
    method, smoothed = replace(ROOM, cost=_IMITATION_COST), 1.0
    if description.kind == SVM_RBF.name:
        if description.embedding is None:  # else smoothed is what the heads say, too
            smoothed = _SMOOTHED
        method = replace(method, gamma=description.parameters["gamma"] * width)
    machine = classifier_kind(description.kind).machine(base)
    parts = np.array_split(inputs, -(-len(inputs) // _ROWS_AT_ONCE))
    decisions = np.concatenate([machine.decide(part)[0] for part in parts])[:, :classes]
    with single_thread():
        _, arrays, parameters = method.imitate(
            inputs, target, np.ones(len(inputs)), softmax(inverse * decisions)
        )
    smoothing, bias = description.smoothing, description.decision_bias
    update = {
        "kind": RBF_LANDMARKS.name,
        "parameters": parameters,
        "inverse_temperature": 1.0,
        "base_inverse_temperature": None,
        "decision_bias": {
            name: float(np.clip(inverse * value, -_MOST_BIAS, _MOST_BIAS))
            for name, value in bias.items()
        },
        "novelty": "doubt",
        "copies": 0,
        "smoothing": smoothing.model_copy(
            update={"weight": min(smoothed * smoothing.weight * inverse, MOST_WEIGHT)}
        ),
    }
    return replace(base, description=description.model_copy(update=update), arrays=arrays)
