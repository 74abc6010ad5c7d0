"""Feature set `rasta`: as `plp`, of a spectrum in which only what changes like speech is left.

After Hermansky and Morgan, "RASTA processing of speech", 1994: in each critical band the logarithm
of the power runs through a filter that passes changes of about 1 to 12 Hz. The filter is made for
steps of 10 ms, so a frame of 50 ms is five steps, and its values are of their mean.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter, lfilter_zi

from hearthlog.schemas.frames import FRAME_SAMPLES
from hearthlog_feature_sets.frame_level import in_half_precision, levels, sane_samples
from hearthlog_feature_sets.plp import WIDTH, cepstral_set
from hearthlog_feature_sets.prediction import BANDS, cepstra_of, critical_bands

_STEP = 160  # 10 ms
_WINDOW = 400  # 25 ms
_STEPS = FRAME_SAMPLES // _STEP
_NUMERATOR = np.array([0.2, 0.1, 0.0, -0.1, -0.2])
_DENOMINATOR = np.array([1.0, -0.98])


class RelativeCepstra:
    """The features of one stream of frames; the state is that of the filters."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Forget the past: the next frame does not follow the last one."""
        self._recent: NDArray[np.float64] = np.zeros(_WINDOW - _STEP)
        self._state: NDArray[np.float64] | None = None

    def __call__(self, frames: NDArray[np.float32]) -> NDArray[np.float32]:
        """Compute the features of frames [shape=(n, FRAME_SAMPLES)]."""
        if not len(frames):
            return np.empty((0, WIDTH), np.float32)
        samples = sane_samples(frames)
        sound = np.concatenate([self._recent, samples.ravel()])
        self._recent = sound[len(sound) - len(self._recent) :].copy()
        windows = np.lib.stride_tricks.sliding_window_view(sound, _WINDOW)[::_STEP]
        spectrum = np.log(critical_bands(windows))
        if self._state is None:  # as if the first step had lasted for ever
            rest = lfilter_zi(_NUMERATOR, np.pad(_DENOMINATOR, (0, 3)))
            self._state = rest[:, np.newaxis] * spectrum[0]
        changes, self._state = lfilter(_NUMERATOR, _DENOMINATOR, spectrum, axis=0, zi=self._state)
        means = np.einsum("ijk->ik", changes.reshape(-1, _STEPS, BANDS)) / _STEPS
        return in_half_precision(levels(samples), cepstra_of(np.exp(means)))


RASTA = cepstral_set("rasta", RelativeCepstra)
