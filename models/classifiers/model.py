"""A model: what decides, and what it says of itself."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hearthlog.models.classifiers.description import Description
from hearthlog.schemas.arrays import Float32, Float64, Int64

Array = NDArray[Any]


@dataclass(frozen=True, eq=False)
class Model:
    """What decides, and what it says of itself.

    Attributes
    ----------
    description : Description
    arrays : mapping of str to np.ndarray
        Of its kind of classifier.
    transitions : np.ndarray [shape=(C, C)], float64
        Of the hidden Markov model, from row to column, a frame; empty where segments are merged.
    training_windows : np.ndarray [shape=(m, window_frames, d)], float32
        Features that it was learned from, to learn from them again; empty if they are not kept.
    training_target, training_group : np.ndarray [shape=(m,)], int64
        Their classes, and the numbers of their sources.
    name : str
        Stem of the file it was loaded from.
    sha256 : str
        Of that file.
    """

    description: Description
    arrays: Mapping[str, Array]
    transitions: Float64 = field(default_factory=lambda: np.empty((0, 0)))
    training_windows: Float32 = field(default_factory=lambda: np.empty((0, 0, 0), np.float32))
    training_target: Int64 = field(default_factory=lambda: np.empty(0, np.int64))
    training_group: Int64 = field(default_factory=lambda: np.empty(0, np.int64))
    name: str = ""
    sha256: str = ""

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the classes, in the order of the probabilities."""
        return tuple(self.description.classes)
