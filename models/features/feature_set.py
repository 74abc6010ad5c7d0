"""A feature set: what is computed from each frame, and all that depends on what it is."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from hearthlog.models.features.window_inputs import Inputs
from hearthlog.schemas.arrays import Float32
from hearthlog.schemas.frames import FRAME_SECONDS


class Extractor(Protocol):
    """Computes the features of one stream of frames.

    The same frames give the same bits in blocks of any size.
    """

    def __call__(self, frames: Float32) -> Float32:
        """Compute the features of successive frames.

        Parameters
        ----------
        frames : np.ndarray [shape=(n, FRAME_SAMPLES)], float32
            Samples in full scale, -1 to 1, at `SAMPLE_RATE` (of `hearthlog.schemas.frames`).
            Samples that are not finite, or far beyond full scale, may be among them.

        Returns
        -------
        np.ndarray [shape=(n, d)], float32
            Always finite.
        """

    def restart(self) -> None:
        """Forget the past: the next frame does not follow the last one."""


@dataclass(frozen=True)
class FeatureSet:
    """What is computed from each frame, and all that depends on what it is.

    Attributes
    ----------
    name : str
    version : int
        Another one if the same sound gives other values.
    feature_names, units : tuple of str
        Of the d values of a frame.
    window_frames : int
        Frames that statistics are made of, and that labels speak of.
    extractor : callable
        Makes an `Extractor`.
    inputs : mapping of str to Inputs
        What classifiers may look at, by name.
    power : callable
        Tells the mean square of the samples of frames, full scale being 1, from their features,
        shape (..., d); gives shape (...).
    augmented : callable or None
        Changes windows of features, shape (n, window_frames, d), as another microphone in another
        room would have; takes a `np.random.Generator` besides. None if that cannot be told from
        the features.
    """

    name: str
    version: int
    feature_names: tuple[str, ...]
    units: tuple[str, ...]
    window_frames: int
    extractor: Callable[[], Extractor]
    inputs: Mapping[str, Inputs]
    power: Callable[[NDArray[Any]], NDArray[Any]]
    augmented: Callable[[Float32, np.random.Generator], Float32] | None = None

    @property
    def width(self) -> int:
        """How many values a frame has."""
        return len(self.feature_names)

    @property
    def window_seconds(self) -> float:
        """Span of the statistics and of a label."""
        return FRAME_SECONDS * self.window_frames
