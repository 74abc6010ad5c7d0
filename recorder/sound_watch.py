"""Sound in which little can be recognised: it is clipped, or the room is as loud as sounds are."""

import numpy as np

from hearthlog.models.features.floor import decibels
from hearthlog.schemas.arrays import Bool, Float32, Float64
from hearthlog.schemas.frames import FRAME_SECONDS

_FULL_SCALE = 0.999
_CLIPPED_SAMPLES = 4  # of a frame; the highest sample of a recording may be full scale
_CLIPPED_FRAMES = round(1.0 / FRAME_SECONDS)  # of the last minute
_MINUTE = round(60.0 / FRAME_SECONDS)
_LOUD_DBFS = -25.0
_LOUD_FRAMES = 10 * _MINUTE

CLIPS = "the microphone clips: turn its volume down"
LOUD = "the room is as loud as most sounds: turn the microphone down, or put it elsewhere"


class SoundWatch:
    """Watches the sound of one microphone."""

    def __init__(self) -> None:
        self._clipped: Bool = np.empty(0, bool)  # frames of the last minute
        self._loud = 0  # frames since the floor of the room was not loud

    def add_samples(self, samples: Float32) -> None:
        """Add successive frames.

        Parameters
        ----------
        samples : np.ndarray [shape=(n, FRAME_SAMPLES)], float32
            In full scale, -1 to 1.
        """
        clipped = (np.abs(samples) >= _FULL_SCALE).sum(axis=1) >= _CLIPPED_SAMPLES
        self._clipped = np.concatenate([self._clipped, clipped])[-_MINUTE:]

    def add_floor(self, powers: Float64) -> None:
        """Add the floor of the room at successive frames.

        Parameters
        ----------
        powers : np.ndarray [shape=(n,)], float64
            Mean squares; full scale is 1.
        """
        low = np.flatnonzero(decibels(powers) <= _LOUD_DBFS)
        self._loud = len(powers) - 1 - int(low[-1]) if len(low) else self._loud + len(powers)

    def problem(self) -> str:
        """Return what is wrong and what to do; empty if nothing is."""
        if self._clipped.sum() >= _CLIPPED_FRAMES:
            return CLIPS
        return LOUD if self._loud >= _LOUD_FRAMES else ""
