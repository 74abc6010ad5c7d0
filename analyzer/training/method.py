"""Methods: training of classifiers from segments."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.training.clips import empty_room
from hearthlog.analyzer.training.dataset import Dataset
from hearthlog.models.classes import SILENCE
from hearthlog.models.features import FeatureSet, Inputs, of_segments, window_places
from hearthlog.models.features.installed import feature_set
from hearthlog.schemas.arrays import Bool, Float32, Float64, Indices

_SEED = 20_261_121
_BELOW_SEGMENT = 10 ** (-6 / 10)  # 6 dB
_ABOVE_FLOOR = 2.0
_EMPTY_ROOMS = 60
_PLACES = (10, 50)  # frames at which windows of an empty room begin


class Examples(NamedTuple):
    """Inputs of segments, unchanged and augmented, window by window."""

    inputs: Float32  # [shape=(versions, n, places, width)]; the first version is unchanged
    usable: Bool  # [shape=(versions, n, places)]; training windows; tests use all of version 0
    target: Indices  # [shape=(n,)]
    weight: Float64  # [shape=(n,)]
    more_inputs: Float32  # [shape=(m, width)]; further windows, always in the training set
    more_target: Indices  # [shape=(m,)]

    def windows(self, seen: Indices | slice) -> tuple[Float32, Indices, Float64]:
        """Return inputs, classes and weights of the training windows of some segments."""
        usable = self.usable[:, seen]
        shape = usable.shape
        target = np.broadcast_to(self.target[seen][:, np.newaxis], shape)[usable]
        weight = np.broadcast_to(self.weight[seen][:, np.newaxis], shape)[usable]
        return (
            np.concatenate([self.inputs[:, seen][usable], self.more_inputs]),
            np.concatenate([target, self.more_target]),
            np.concatenate([weight, np.ones(len(self.more_target))]),
        )

    def decide(self, learned: "Learned", unseen: Indices, classes: int) -> Float64:
        """Return decision values [shape=(m, C)] of `unseen` segments: means over their windows."""
        inputs = self.inputs[0, unseen]
        decisions = learned.decide(inputs.reshape(-1, inputs.shape[-1]), classes)
        return decisions.reshape(*inputs.shape[:2], classes).mean(axis=1)


class Learned(Protocol):
    """A classifier trained on segments."""

    def decide(self, inputs: Float32, classes: int) -> Float64:
        """Return decision values as `Machine.decide` does for this kind of classifier.

        Parameters
        ----------
        inputs : np.ndarray [shape=(n, width)], float32
        classes : int
            C, the total number of classes.

        Returns
        -------
        np.ndarray [shape=(n, C)], float64
            -inf for a class without training data.
        """

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays of a model file; requires that all classes were in the training set."""

    def parameters(self) -> dict[str, Any]:
        """Return the field `parameters` of a model description."""


@dataclass(frozen=True)
class Method(ABC):
    """A method of training a classifier.

    Attributes
    ----------
    name : str
    feature_set, inputs : str
        Feature set of the classifier, and the kind of inputs computed from it.
    kind : str
        Kind of classifier.
    copies : int
        Number of augmented copies of each segment.
    rooms : int
        Number of copies of each clip with the noise of other rooms.
    gate : float
        As in `Description`.
    observation_weight : float
        Weight of a frame's decision values in the hidden Markov model; with a network, of the
        log probabilities.
    network : str
        Name of the network for heads next to the classifier; empty without heads.
    class_exponent : float or None
        As in `Smoothing`.
    seed : int
        Seed for rooms, augmented copies and window selection.
    """

    name: str
    feature_set: str
    inputs: str
    kind: str
    copies: int
    rooms: int = 0
    gate: float = 0.0
    observation_weight: float = 1.5
    network: str = ""
    class_exponent: float | None = None
    seed: int = 0

    @property
    def features(self) -> FeatureSet:
        """Feature set of the classifier; raises ModelError if it is not installed."""
        return feature_set(self.feature_set)

    @property
    def libraries(self) -> tuple[str, ...]:
        """Distributions with an influence on the result."""
        return ()

    @property
    def parameters(self) -> dict[str, float]:
        """Parameters that can be set and searched."""
        return {}

    @abstractmethod
    def fit(self, examples: Examples, seen: Indices | slice = slice(None)) -> Learned:
        """Train on some segments.

        Parameters
        ----------
        examples : Examples
        seen : np.ndarray [shape=(m,)], intp, or slice
            Indices of the training segments; all by default.

        Returns
        -------
        Learned
            Classes without training data have decision values of -inf.
        """

    def with_parameters(self, values: Mapping[str, float]) -> Self:
        """Return this method with other parameters.

        Raise `DataError` if the method has no such parameter.

        Parameters
        ----------
        values : mapping of str to float
            By parameter name, as in `parameters`; other parameters are unchanged.
        """
        if values:
            raise DataError(f"method {self.name} has no {min(values)} to choose")
        return self

    def variations(self) -> list[Self]:
        """Return the methods of a grid search, including this one."""
        return [self]


def prepare(method: Method, data: Dataset) -> Examples:
    """Compute the inputs of segments for a method; deterministic.

    Raise `DataError` if the method wants augmented copies and its feature set has none. Raise
    `ModelError` if the feature set is not installed.
    """
    features, rng = method.features, np.random.default_rng(_SEED + method.seed)
    if method.copies and features.augmented is None:
        raise DataError(f"method {method.name}: {features.name} cannot be augmented")
    if method.rooms and features.band_powers is None:
        raise DataError(f"method {method.name}: {features.name} has no bands to find a floor in")
    versions, floors = [data.windows, *data.copies], [data.floor, *data.copy_floor]
    for _ in range(method.copies):
        assert features.augmented is not None
        versions.append(features.augmented(data.windows, rng))
        floors.append(data.floor)
    inputs = features.inputs[method.inputs]
    computed = [
        of_segments(inputs, np.nan_to_num(version), floor)
        for version, floor in zip(versions, floors, strict=True)
    ]
    usable = [
        _usable(version, floor, data, features, inputs.window_frames)
        for version, floor in zip(versions, floors, strict=True)
    ]
    more_inputs = np.empty((0, inputs.width), np.float32)
    if method.rooms and SILENCE in data.classes:
        more_inputs = _empty_rooms(features, inputs, rng)
    return Examples(
        np.stack(computed),
        np.stack(usable),
        data.target,
        data.weight,
        more_inputs,
        np.full(len(more_inputs), data.classes.index(SILENCE) if len(more_inputs) else 0),
    )


def _usable(
    segments: Float32, floor: Float64, data: Dataset, features: FeatureSet, window_frames: int
) -> Bool:
    """Return which windows of segments are loud enough for training."""
    power = features.power(segments).astype(np.float64)
    is_finite: Bool = ~np.isnan(power.sum(axis=1, keepdims=True))
    if len(window_places(segments.shape[1], window_frames)) == 1:
        return is_finite
    least = _ABOVE_FLOOR * floor[:, -1:] if floor.shape[1] else None
    loud = loud_windows(power, window_frames, least)
    if SILENCE in data.classes:
        loud |= (data.target == data.classes.index(SILENCE))[:, np.newaxis]
    return loud & is_finite


def loud_windows(power: Float64, window_frames: int, least: Float64 | None = None) -> Bool:
    """Return which windows [shape=(n, places)] are at most 6 dB below their segment.

    `power` [shape=(n, f)] has mean squares of the frames of each segment; `least` [shape=(n, 1)] is
    an additional minimum power of a window.
    """
    places = window_places(power.shape[1], window_frames)
    windows = [power[:, place : place + window_frames].mean(axis=1) for place in places]
    quietest = power.mean(axis=1, keepdims=True) * _BELOW_SEGMENT
    if least is not None:
        quietest = np.maximum(quietest, least)
    return np.stack(windows, axis=1) > quietest


def _empty_rooms(features: FeatureSet, inputs: Inputs, rng: np.random.Generator) -> Float32:
    rooms = [empty_room(features, rng) for _ in range(_EMPTY_ROOMS)]
    frames = inputs.window_frames
    windows = np.stack(
        [room.features[place : place + frames] for place in _PLACES for room in rooms]
    )
    return inputs.of_windows(windows, np.stack([room.floor for room in rooms * len(_PLACES)]))
