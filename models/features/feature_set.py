"""A feature set: the values computed from each frame, and everything that depends on them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from hearthlog.models.features.window_inputs import Inputs
from hearthlog.schemas.arrays import Float32, Float64
from hearthlog.schemas.frames import FRAME_SECONDS

SILENCE_POWER = 10 ** (-60 / 10)  # mean square, -60 dBFS: quieter events are not used for training


class Extractor(Protocol):
    """Computes the features of one stream of frames.

    The same frames give the same bits in blocks of any size.
    """

    def __call__(self, frames: Float32) -> Float32:
        """Compute the features of successive frames.

        Parameters
        ----------
        frames : np.ndarray [shape=(n, FRAME_SAMPLES)], float32
            Samples at 16 kHz in full scale, -1 to 1; some may be out of range or not finite.

        Returns
        -------
        np.ndarray [shape=(n, d)], float32
            Always finite.
        """

    def restart(self) -> None:
        """Reset the state; the next frame does not follow the previous frame."""


@dataclass(frozen=True)
class FeatureSet:
    """The values computed from each frame, and everything that depends on them.

    Attributes
    ----------
    power : callable
        Maps features, shape (..., d), to the mean square of the samples, shape (...); full scale
        is 1.
    band_powers : callable or None
        Maps features, shape (n, d), to powers of b bands, shape (n, b), the last of the complete
        frame; the floor of a room is tracked in these bands. None if the set has no bands.
    augmented : callable or None
        Maps windows of features, shape (n, window_frames, d), and a `np.random.Generator` to the
        features that another microphone in another room would give. None if not supported.
    digest : str
        SHA-256 of the file that computes the values, in hexadecimal; empty if code computes them.
    """

    name: str
    version: int
    feature_names: tuple[str, ...]
    units: tuple[str, ...]
    window_frames: int
    extractor: Callable[[], Extractor]
    inputs: Mapping[str, Inputs]
    power: Callable[[NDArray[Any]], NDArray[Any]]
    band_powers: Callable[[Float32], Float64] | None = None
    # in quotes: recorder and bridge never load `numpy.random`, which takes 5 MB
    augmented: "Callable[[Float32, np.random.Generator], Float32] | None" = None
    digest: str = ""

    @property
    def width(self) -> int:
        """Number of values per frame."""
        return len(self.feature_names)

    @property
    def bands(self) -> int:
        """Number of bands in which the floor of a room is tracked."""
        if self.band_powers is None:
            return 0
        return self.band_powers(np.zeros((1, self.width), np.float32)).shape[1]

    @property
    def window_seconds(self) -> float:
        """Length of the window in seconds."""
        return FRAME_SECONDS * self.window_frames
