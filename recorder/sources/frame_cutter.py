"""From samples in pieces of any size to whole frames."""

import numpy as np
import soxr

from hearthlog.schemas.arrays import Float32
from hearthlog.schemas.frames import FRAME_SAMPLES, SAMPLE_RATE


class FrameCutter:
    """Resamples one sound to 16 kHz and cuts it into frames.

    Parameters
    ----------
    rate : float
        Samples per second of the sound.
    channels : int or None
        Of an array; None for samples without an axis of channels.
    """

    def __init__(self, rate: float = SAMPLE_RATE, channels: int | None = None) -> None:
        self._shape = () if channels is None else (channels,)
        self._held = np.empty((0, *self._shape), np.float32)
        self._resampler = None
        if rate != SAMPLE_RATE:
            self._resampler = soxr.ResampleStream(rate, SAMPLE_RATE, channels or 1, dtype="float32")

    def push(self, samples: Float32, *, last: bool = False) -> Float32:
        """Add samples and return the frames that they complete.

        Parameters
        ----------
        samples : np.ndarray [shape=(m,) or (m, c)], float32
            At the rate of the sound.

        Returns
        -------
        np.ndarray [shape=(n, 800) or (n, 800, c)], float32
            At 16 kHz.
        """
        if self._resampler is not None:
            samples = self._resampler.resample_chunk(samples, last=last)
        self._held = np.concatenate([self._held, samples])
        whole = len(self._held) - len(self._held) % FRAME_SAMPLES
        frames, self._held = np.split(self._held, [whole])
        return frames.reshape(-1, FRAME_SAMPLES, *self._shape)
