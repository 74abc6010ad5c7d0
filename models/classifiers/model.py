"""A model: its description and its arrays."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hearthlog.models.classifiers.description import Description
from hearthlog.schemas.arrays import Float32, Float64, Int32, Int64

Array = NDArray[Any]


@dataclass(frozen=True, eq=False)
class Model:
    """A model.

    Attributes
    ----------
    description : Description
    arrays : mapping of str to np.ndarray
        Those of its kind of classifier.
    transitions : np.ndarray [shape=(C, C)], float64
        Probability that a frame of the row's class is followed by one of the column's class; empty
        where segments are merged.
    training_digests : np.ndarray [shape=(k,)], int64
        Digests of the segments that it was learned from.
    training_windows : np.ndarray [shape=(m, window_frames, d)], float32
        Features that it was learned from, of some models of earlier versions; else empty.
    training_floor : np.ndarray [shape=(m, b)], float64
        Floor of the room in each training window; empty for a feature set without bands.
    training_target, training_group : np.ndarray [shape=(m,)], int64
        Classes of the training windows, and numbers of their source groups.
    direction_weights : np.ndarray [shape=(M, C, S)], float64
        For each array of the description, logarithms of how much likelier each class is with each
        sector of the circle; empty without arrays.
    embedding_weights : np.ndarray [shape=(H, W, C)], int32
        Of H linear heads on the W values that are logged of a window of sound, in units of
        `hearthlog.models.classifiers.embedding_heads.UNIT`; empty without heads.
    embedding_bias : np.ndarray [shape=(H, C)], int32
        In the same units.
    embedding_scaler : np.ndarray [shape=(2, W)], float64
        Mean and standard deviation of these values, of what the heads were learned from.
    name : str
        Stem of the model file.
    sha256 : str
        SHA-256 of the model file.
    """

    description: Description
    arrays: Mapping[str, Array]
    transitions: Float64 = field(default_factory=lambda: np.empty((0, 0)))
    training_digests: Int64 = field(default_factory=lambda: np.empty(0, np.int64))
    training_windows: Float32 = field(default_factory=lambda: np.empty((0, 0, 0), np.float32))
    training_floor: Float64 = field(default_factory=lambda: np.empty((0, 0)))
    training_target: Int64 = field(default_factory=lambda: np.empty(0, np.int64))
    training_group: Int64 = field(default_factory=lambda: np.empty(0, np.int64))
    direction_weights: Float64 = field(default_factory=lambda: np.empty((0, 0, 0)))
    embedding_weights: Int32 = field(default_factory=lambda: np.empty((0, 0, 0), np.int32))
    embedding_bias: Int32 = field(default_factory=lambda: np.empty((0, 0), np.int32))
    embedding_scaler: Float64 = field(default_factory=lambda: np.empty((0, 0)))
    name: str = ""
    sha256: str = ""

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the classes, in the order of the probabilities."""
        return tuple(self.description.classes)
